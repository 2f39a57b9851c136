"""Scale factor errors against what they do: readings (1 + s) times the truth."""

import jax.numpy as jnp
import numpy as np

from jaxnav.states.sensors import corrected_reading
from jaxnav.states.state import Reading
from jaxnav.states.table import STATES


def test_taking_scale_and_bias_out_gives_the_truth_back():
    rng = np.random.default_rng(0)
    w, s, b = rng.normal(size=(50, 3)), 3e-3 * rng.normal(size=3), 1e-2 * rng.normal(size=3)
    errors = {"gyro_bias": jnp.asarray(b), "gyro_scale": jnp.asarray(s), "accel_scale": jnp.ones(3)}
    back = corrected_reading(jnp.asarray((1 + s) * w + b), "gyro", errors, 0 * w)
    np.testing.assert_allclose(back, w, rtol=0, atol=3 * (4 * 3e-3) ** 4)
    assert np.abs(back - ((1 + s) * w)).max() > 1e-3


def test_the_effect_of_a_scale_error_is_the_reading_of_its_own_axis():
    w = jnp.array([0.1, -0.2, 9.8])
    np.testing.assert_array_equal(STATES["accel_scale"].effect(Reading(w, 0 * w)), np.diag(w))
