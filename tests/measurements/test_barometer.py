"""Barometric height: what it tells the height and its own bias."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import build, initial_nav
from jaxnav.filters.error_model import error_model
from jaxnav.measurements import BAROMETER, GNSS
from jaxnav.types import Fix


@pytest.mark.full
def test_height_and_bias_share_a_residual_by_their_variances():
    """One reading of sd 1 m that is 6 m high: 1 of 2^2 + 1 + 1^2 parts is noise, 4 are height, 1 is bias."""
    filt = build("ekf9", ("barometer",), states=("barometer_bias",))
    params = filt.params("consumer", position_sd=2.0)
    known = params.states["barometer_bias"]._replace(sd=jnp.ones(()))
    params = params._replace(states=params.states | {"barometer_bias": known})
    nav = initial_nav([0.8, 0.1, 100.0])
    fix = Fix(jnp.array([106.0]), jnp.ones(1), jnp.zeros(1), jnp.ones(1, bool))
    _, info = filt.correct(params, filt.init(params, nav), fix)
    np.testing.assert_allclose(info.nav.pos[2], 104.0, rtol=1e-12)
    np.testing.assert_allclose(info.nav.errors["barometer_bias"], 1.0, rtol=1e-12)


def test_a_filter_without_the_state_takes_the_reading_for_the_height():
    model, nav = error_model("local_level", (), measurements=(*GNSS, BAROMETER)), initial_nav([0.8, 0.1, 100.0])
    past = jax.tree.map(lambda a: jnp.stack([a, a]), nav)
    fix = Fix(jnp.full(7, 90.0), jnp.ones(7), jnp.zeros(7), jnp.ones(7, bool))
    params = build("ekf9", (*GNSS, "barometer")).params()
    y, H, _ = model.observe(params, past, fix)
    assert y[6] == 10.0 and H.shape == (7, 9) and np.array_equal(H[6], np.eye(9)[2])


def test_a_bias_that_nothing_sees_is_refused():
    with pytest.raises(ValueError, match="barometer_bias.*seen by no sensor.*barometer"):
        build("ekf15", states=("barometer_bias",))
