"""Gradients of whole runs against central differences, and finite where norms vanish."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.catalogue import build
from jaxnav.filters.papers.gpid import gpid_params
from jaxnav.filters.parameters import datasheet_params, get, mounting, put
from jaxnav.filters.run import run
from jaxnav.maths import earth
from jaxnav.maths.interpolation import columns_at
from jaxnav.types import Epoch, Params
from tests.conftest import GRADE, all_finite
from tuning.fit.objectives import innovation_nll

EPOCHS = 15
#: leaves and steps; even near the origin a step must move positions by far more than 1e-11 m, what latitude resolves
STEPS = {
    "noise.gyro": 6e-5,
    "noise.accel": 6e-4,
    "measurements.position.scale": 1e-2,
    "prior.position": 1e-2,
    "prior.attitude": 1e-4,
    "rule.ki": 1e-3,
    "rule.kd": 3e-3,
    "mounting.time_offset": 1e-3,
    "mounting.clock_drift": 1e-4,
    "mounting.lever_arm": 1e-2,
}


class Setting(NamedTuple):
    scores: Callable  # (params, epochs) -> (2,)
    gradient: Callable  # (params, epochs) -> Params of (2, ...)
    params: Params
    epochs: Epoch


@pytest.fixture(scope="module")
def setting(fine_case):
    case = fine_case
    install = mounting((0.5, -0.3, -1.0), 0.02)
    params = datasheet_params(GRADE, tilt_sd=0.01, heading_sd=0.05, install=install, rule=gpid_params(0.02, 0.1, 15))
    # distinct values on each axis, so that every component has a derivative of its own
    params = put(params, "noise.gyro", jnp.array([2e-3, 3e-3, 4e-3]))
    params = put(params, "noise.accel", jnp.asarray(2e-2, float))
    # a start with errors, for the priors to matter
    lla = earth.move(case.nav.pos, jnp.array([2.0, -3.0, 2.0]))
    nav = case.nav._replace(pos=lla, vel=case.nav.vel + jnp.array([0.1, -0.1, 0.05]))
    truth = jnp.asarray(case.truth.lla[20::20][:EPOCHS])
    filt = build("gpid15")

    def scores(params, epochs):
        """Truth-free and supervised: innovation likelihood, and mean squared position error."""
        info = run(filt, params, nav, epochs)
        error = jax.vmap(earth.enu_difference)(info.nav.pos, truth)
        return jnp.stack([innovation_nll(info, jnp.ones(EPOCHS, bool)), jnp.mean(error**2)])

    epochs = jax.tree.map(lambda a: a[:EPOCHS], case.packed.epochs)
    return Setting(jax.jit(scores), jax.jit(jax.jacrev(scores)), params, epochs)


@pytest.fixture(scope="module")
def gradients(setting):
    return setting.gradient(setting.params, setting.epochs)


@pytest.mark.full
@pytest.mark.parametrize("name", STEPS)
def test_gradient_of_a_whole_run(setting, gradients, name):
    value, gradient = get(setting.params, name), np.asarray(get(gradients, name)).reshape(2, -1)
    h = STEPS[name]
    for i in range(value.size):
        step = h * np.eye(value.size)[i].reshape(value.shape)

        def moved(k, step=step):
            return np.asarray(setting.scores(put(setting.params, name, value + k * step), setting.epochs))

        # fourth order, for a step that rounding allows
        numeric = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h)
        assert np.abs(gradient[:, i]).min() > 0
        for analytic, expected, largest in zip(gradient[:, i], numeric, np.abs(gradient).max(1), strict=True):
            # relative to itself, or, for a component that hardly matters, to a tenth of its leaf's largest
            assert abs(analytic - expected) <= 1e-4 * max(abs(expected), 0.1 * largest)


@pytest.mark.full
def test_gradients_are_finite_at_singular_points(setting):
    """No lever arm, gain or rotation, padded epochs, missing fixes: norms of zero, and where 0 * nan would show."""
    params, epochs = setting.params, setting.epochs
    for name in ("mounting.lever_arm", "mounting.time_offset", "mounting.clock_drift", "rule.ki", "rule.kd"):
        params = put(params, name, jnp.zeros_like(get(params, name)))
    fix, dt = epochs.fix, epochs.imu.dt
    broken = epochs._replace(
        imu=epochs.imu._replace(dt=dt.at[3, 5:].set(0.0), gyro=epochs.imu.gyro.at[0].set(0.0)),  # no turn at all
        fix=fix._replace(valid=fix.valid.at[2:5].set(False).at[7, 3:].set(False), value=fix.value.at[3].set(0.0)),
    )
    for e in (epochs, broken):
        gradient = setting.gradient(params, e)
        assert all_finite(gradient)  # of infinite time constants too
        for name in STEPS:
            assert np.abs(get(gradient, name)).max() > 0, name


@pytest.mark.parametrize("true", [4e-3, -2e-3])
def test_innovations_know_the_drift_of_a_clock(setting, fine_case, true):
    """Fixes without noise, of a receiver whose time gains on the IMU's: the likelihood is greatest at that drift."""
    params, fix = setting.params, setting.epochs.fix
    for name, value in (("lever_arm", jnp.zeros(3)), ("time_offset", 0.02), ("clock_drift", true)):
        params = put(params, f"mounting.{name}", jnp.asarray(value))
    for name in ("measurements.position.scale", "measurements.velocity.scale"):
        params = put(params, name, jnp.full_like(get(params, name), 0.05))
    stamp, truth = np.arange(1.0, EPOCHS + 1), fine_case.truth
    then = stamp - 0.02 - true * stamp
    seen = np.hstack([columns_at(then, truth.t, a) for a in (truth.lla, truth.vel)])
    epochs = setting.epochs._replace(fix=fix._replace(value=jnp.asarray(seen)))
    h = 2e-3
    low, mid, high = (
        setting.scores(put(params, "mounting.clock_drift", jnp.asarray(true + d)), epochs)[0] for d in (-h, 0.0, h)
    )
    assert low > mid < high
    lowest = true + 0.5 * h * (low - high) / (low - 2 * mid + high)
    assert lowest == pytest.approx(true, abs=2e-5)


@pytest.mark.full
def test_missing_values_may_be_nan(setting):
    """A missing channel's value, sd and correlation are nan: value and gradient as with numbers; a valid nan shows."""
    fix = setting.epochs.fix
    fix = fix._replace(valid=fix.valid.at[4:7].set(False).at[9, :3].set(False))
    gone = lambda a: jnp.where(fix.valid, a, jnp.nan)
    missing = fix._replace(value=gone(fix.value), sd=gone(fix.sd), corr=gone(fix.corr))
    numbers, nan = (setting.epochs._replace(fix=each) for each in (fix, missing))
    np.testing.assert_array_equal(setting.scores(setting.params, nan), setting.scores(setting.params, numbers))
    jax.tree.map(
        np.testing.assert_array_equal, setting.gradient(setting.params, nan), setting.gradient(setting.params, numbers)
    )
    # of a position alone the longitude: its channel is east, the first one
    some = setting.epochs.fix.valid.at[4:7, 0].set(False)
    part = setting.epochs._replace(fix=setting.epochs.fix._replace(valid=some))
    blank = part._replace(fix=part.fix._replace(value=part.fix.value.at[4:7, 1].set(jnp.nan)))
    np.testing.assert_array_equal(setting.scores(setting.params, blank), setting.scores(setting.params, part))
    jax.tree.map(
        np.testing.assert_array_equal, setting.gradient(setting.params, blank), setting.gradient(setting.params, part)
    )
    latitude = part._replace(fix=part.fix._replace(value=part.fix.value.at[4:7, 0].set(jnp.nan)))
    assert not np.isfinite(setting.scores(setting.params, latitude)).all()
    valid = setting.epochs._replace(fix=missing._replace(valid=jnp.ones_like(fix.valid)))
    assert not np.isfinite(setting.scores(setting.params, valid)).all()
