"""Scale errors and misalignment as noise: its size in a filter, and the attitude error that a turn leaves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.catalogue import build
from jaxnav.filters.parameters import change
from jaxnav.filters.run import initial_nav, prepare, run_jit
from jaxnav.states.sensitivity import ESTIMATES, SENSITIVITY_S, sensitivity_noise
from jaxnav.types import Epoch, Fix, Imu

K, E, RATE, SCALE = 20, 10, 0.3, 3e-3


def test_it_is_a_share_of_rate_and_acceleration_over_the_length_of_a_turn():
    root = sensitivity_noise(jnp.asarray(SCALE), jnp.array([0.0, 0.3, 0.4]), jnp.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose(root, SCALE * np.array([0.5, 2.0]) * np.sqrt(2 * SENSITIVITY_S))
    still = jax.grad(lambda scale: sensitivity_noise(scale, jnp.zeros(3), jnp.zeros(3)).sum())
    assert float(still(jnp.asarray(SCALE))) == 0.0 == float(still(jnp.asarray(0.0)))


def test_a_filter_that_estimates_them_takes_none_of_it_for_noise():
    some, every = (build("ekf15", states=states).params("consumer").noise for states in (ESTIMATES[:2], ESTIMATES))
    assert float(some.scale) == SCALE and float(every.scale) == 0.0


@pytest.mark.full
def test_heading_is_less_sure_after_a_turn_and_not_after_a_straight():
    """The heading's variance grows by k^2 w^2 2 tau T while a vehicle turns without fixes, and not at rest."""
    filt = build("ekf15", cov_stride=2)
    plain = change(filt.params("consumer"), {"noise.scale": 0.0})
    m, variance = filt.model.n_channels, {}
    for rate in (0.0, RATE):
        imu = Imu(
            jnp.full((E, K), 0.05), jnp.zeros((E, K, 3)).at[..., 2].set(rate), jnp.zeros((E, K, 3)).at[..., 2].set(-9.8)
        )
        fix = Fix(jnp.zeros((E, m)), jnp.ones((E, m)), jnp.zeros((E, m)), jnp.zeros((E, m), bool))
        epochs = prepare(filt, Epoch(imu, fix))
        for scale in (0.0, SCALE):
            params = change(plain, {"noise.scale": scale})
            variance[rate, scale] = float(run_jit(filt, params, initial_nav([0.7, 0.2, 100.0]), epochs).P[-1, 8, 8])
    assert variance[0.0, SCALE] - variance[0.0, 0.0] < 1e-3 * SCALE**2
    grown = variance[RATE, SCALE] - variance[RATE, 0.0]
    np.testing.assert_allclose(grown, (SCALE * RATE) ** 2 * 2 * SENSITIVITY_S * E, rtol=0.02)
