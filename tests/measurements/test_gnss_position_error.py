"""A receiver's slow error: what of a fix is the way, what the receiver's, and what noise."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import build, initial_nav
from jaxnav.maths import earth
from jaxnav.types import Fix, Imu


def test_position_error_and_noise_share_a_residual_by_their_variances():
    """A fix of sd 1 m that is (6, -3, 12) m off: of 2^2 + 1 + 1^2 parts 4 are position, 1 is the error."""
    filt = build("ekf9", ("position",), states=("gnss_position_error",))
    params = filt.params("consumer", position_sd=2.0)
    known = params.states["gnss_position_error"]._replace(sd=jnp.ones(()))
    params = params._replace(states=params.states | {"gnss_position_error": known})
    nav = initial_nav([0.8, 0.1, 100.0])
    off = jnp.array([6.0, -3.0, 12.0])
    fix = Fix(earth.move(nav.pos, off), jnp.ones(3), jnp.zeros(3), jnp.ones(3, bool))
    _, info = filt.correct(params, filt.init(params, nav), fix)
    np.testing.assert_allclose(earth.enu_difference(info.nav.pos, nav.pos), off * 4 / 6, rtol=1e-5)
    np.testing.assert_allclose(info.nav.errors["gnss_position_error"], off / 6, rtol=1e-5)


def test_it_is_forgotten_and_stays_as_large_as_it_may_be():
    """Half a minute without a fix: the estimate falls by exp(-30 / 300), its sd, steady from the start, stays."""
    filt = build("ekf9", ("position",), states=("gnss_position_error",))
    params, nav = filt.params("consumer"), initial_nav([0.8, 0.1, 100.0])
    state = filt.init(params, nav._replace(errors={"gnss_position_error": jnp.array([2.0, -1.0, 4.0])}))
    rest = Imu(jnp.full(10, 3.0), jnp.zeros((10, 3)), jnp.zeros((10, 3)).at[:, 2].set(-9.8))
    after = filt.predict(params, state, rest)
    expected = np.exp(-30 / 300) * np.array([2.0, -1.0, 4.0])
    np.testing.assert_allclose(after.past.errors["gnss_position_error"][-1] - after.x[9:], expected, rtol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(after.P)[9:]), 1.5, rtol=1e-3)


def test_an_error_that_nothing_sees_is_refused():
    with pytest.raises(ValueError, match="gnss_position_error.*seen by no sensor.*position"):
        build("ekf15", ("velocity",), states=("gnss_position_error",))
