"""Gradients of whole runs against central differences, and finite where norms vanish."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import earth
from jaxnav.filters.catalogue import build
from jaxnav.filters.gpid import gpid_params
from jaxnav.run import run
from jaxnav.sensors.grades import datasheet_params, mounting
from tests.conftest import GRADE
from tuning.objectives import innovation_nll
from tuning.transforms import get, put

EPOCHS = 15
#: leaves and steps: latitude in radians steps by 7e-10 m, so that a step must move positions by much more than that
STEPS = {
    "noise.gyro": 1e-2 * 2e-4,
    "noise.accel": 1e-2 * 2e-3,
    "noise.position_scale": 1e-2,
    "prior.position": 1e-2,
    "prior.attitude": 1e-4,
    "rule.ki": 1e-3,
    "rule.kd": 3e-3,
    "mounting.time_offset": 1e-3,
    "mounting.lever_arm": 1e-2,
}


@pytest.fixture(scope="module")
def setting(case):
    install = mounting((0.5, -0.3, -1.0), 0.02)
    params = datasheet_params(GRADE, tilt_sd=0.01, heading_sd=0.05, install=install, rule=gpid_params(0.02, 0.1, 15))
    # distinct values on each axis, so that every component has a derivative of its own
    params = put(params, "noise.gyro", jnp.array([2e-4, 3e-4, 4e-4]))
    # a start with errors, for the priors to matter
    lla = earth.move(case.nav.pos, jnp.array([2.0, -3.0, 2.0]))
    nav = case.nav._replace(pos=lla, vel=case.nav.vel + jnp.array([0.1, -0.1, 0.05]))
    epochs = jax.tree.map(lambda a: a[:EPOCHS], case.packed.epochs)
    truth = jnp.asarray(case.truth.lla[20::20][:EPOCHS])
    filt = build("gpid15")

    def scores(free: dict) -> jax.Array:
        """Truth-free and supervised: innovation likelihood, and mean squared position error."""
        p = params
        for name, value in free.items():
            p = put(p, name, value)
        info = run(filt, p, nav, epochs)
        error = jax.vmap(earth.enu_difference)(info.nav.pos, truth)
        return jnp.stack([innovation_nll(info, jnp.ones(EPOCHS, bool)), jnp.mean(error**2)])

    free = {name: jnp.asarray(get(params, name), float) for name in STEPS}
    return jax.jit(scores), jax.jit(jax.jacrev(scores)), free


@pytest.fixture(scope="module")
def gradients(setting):
    return jax.tree.map(np.asarray, setting[1](setting[2]))


@pytest.mark.parametrize("name", STEPS)
def test_gradient_of_a_whole_run(setting, gradients, name):
    scores, _, free = setting
    value = free[name]
    h = STEPS[name]
    for i in range(value.size):
        step = h * np.eye(value.size)[i].reshape(value.shape)

        def moved(k, step=step):
            return np.asarray(scores(free | {name: value + k * step}))

        # fourth order, for a step that rounding allows
        numeric = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h)
        analytic = gradients[name].reshape(2, -1)[:, i]
        assert np.abs(analytic).min() > 0
        np.testing.assert_allclose(analytic, numeric, rtol=1e-4, atol=1e-4 * np.abs(gradients[name]).max() / 3)


def test_gradients_are_finite_without_lever_arm_or_gains(setting):
    _, gradient, free = setting
    zero = {"mounting.lever_arm", "mounting.time_offset", "rule.ki", "rule.kd"}
    at_zero = {k: jnp.zeros_like(v) if k in zero else v for k, v in free.items()}
    for name, g in gradient(at_zero).items():
        assert np.isfinite(g).all() and np.abs(g).max() > 0, name


def test_gradients_are_finite_where_an_epoch_is_padded_or_missing(case, setting):
    """Missing fixes and samples of dt = 0 are where 0 * nan would show."""
    filt = build("gpid15")
    params = datasheet_params(GRADE, rule=gpid_params(0.02, 0.1, 15))
    epochs = jax.tree.map(lambda a: a[:3], case.packed.epochs)
    epochs = epochs._replace(
        imu=epochs.imu._replace(dt=epochs.imu.dt.at[1:, 5:].set(0.0)),
        fix=epochs.fix._replace(valid=epochs.fix.valid.at[1].set(False).at[2, 3:].set(False)),
    )

    def loss(params):
        info = run(filt, params, case.nav, epochs)
        return innovation_nll(info, jnp.ones(3, bool)) + jnp.sum(info.nav.vel**2)

    grads = jax.jit(jax.grad(loss))(params)
    infinite = grads._replace(noise=grads.noise._replace(gyro_tau=0.0, accel_tau=0.0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(infinite))
    # a time constant that is infinite has no derivative by itself that is of use, but must not be nan
    assert np.isfinite(grads.noise.gyro_tau).all() and np.isfinite(grads.noise.accel_tau).all()
