"""What is summed up before the state is known gives what the samples give, but for 0.3 % of what biases do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.catalogue import build
from jaxnav.filters.core import padded
from jaxnav.filters.epochs import hide, pack
from jaxnav.filters.run import prepare, run, run_jit
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.strapdown.fast import local_level
from jaxnav.types import Forcing
from tests.conftest import leaves_equal
from tests.strapdown.test_mechanization import ANYWHERE, lively
from tuning.fit.objectives import innovation_nll

propagate = jax.jit(local_level.propagate, static_argnums=3)
preintegrate = jax.jit(local_level.preintegrate, static_argnums=2)


def difference(a, b):
    """Of states (w, ...): m, m/s, rad, one after the other."""
    turn = jax.vmap(lambda p, q: rotations.log(rotations.multiply(p, rotations.conjugate(q))))(a.q, b.q)
    return np.asarray(jax.vmap(earth.enu_difference)(a.pos, b.pos)), np.asarray(a.vel - b.vel), np.asarray(turn)


@pytest.mark.full
@ANYWHERE
@pytest.mark.parametrize("n", [60, 240], ids=["one_block", "three_blocks"])
def test_biases_are_taken_out_of_the_sums(n, lat, speed):
    """200 deg/h and 5 mg on a body that turns and shakes; states inside intervals, the last of which is half full."""
    nav, imu = lively(n, 0.01, lat, speed)
    imu = imu._replace(dt=imu.dt.at[n - 5 :].set(0.0))
    u = Forcing(np.array([1e-3, -2e-3, 1e-3]), np.array([0.01, 0.02, -0.01]))
    keep = jnp.array([0, 9, 10, 33, n - 7, n - 6])
    b_g, b_a = 200 * DEG / 3600 * np.array([0.6, -0.7, 0.4]), 0.05 * np.array([0.5, -0.6, 0.6])
    known = nav._replace(errors={"gyro_bias": jnp.asarray(b_g), "accel_bias": jnp.asarray(b_a)})
    sums = preintegrate(imu, (nav.omega, nav.force), 10, keep)
    without, _ = propagate(nav, u, sums, 10)
    samples, path = propagate(nav, u, imu, 10, keep)
    leaves_equal(without, samples, 1e-14, 1e-12)  # the same sums
    (exact, path), (found, coarse) = propagate(known, u, imu, 10, keep), propagate(known, u, sums, 10)
    for error, bias in zip(difference(found, exact), difference(exact, samples), strict=True):
        assert np.abs(error).max() < 3e-3 * np.abs(bias).max()
    for leaf in ("t", "omega", "force"):
        np.testing.assert_allclose(getattr(found, leaf), getattr(exact, leaf), rtol=0, atol=1e-14)
    np.testing.assert_allclose(coarse.C, path.C, rtol=0, atol=1e-6)
    np.testing.assert_allclose(coarse.force, path.force, rtol=0, atol=2e-5)
    leaves_equal(coarse.nav.t, path.nav.t, 1e-14)


@pytest.fixture(scope="module")
def biased(case):
    """The drive with sensors of 100 deg/h and 5 mg; epochs of 20 samples, padded to 25."""
    imu = case.imu._replace(gyro=case.imu.gyro + 5e-4, accel=case.imu.accel + 0.05)
    epochs = pack(imu, case.aiding, 1.0).epochs
    return epochs._replace(imu=jax.vmap(lambda imu: padded(imu, 25))(epochs.imu))


@pytest.mark.full
def test_prepared_epochs_are_run_like_the_samples(case, biased):
    """Solution and likelihood, after fixes were hidden; states of late fixes are from inside the intervals."""
    filt = build("ekf15", cov_stride=5, history=4)
    late = case.params.mounting._replace(time_offset=jnp.array(-0.11))
    hidden = np.arange(biased.fix.valid.shape[0]) % 20 > 14
    params, ready = case.params._replace(mounting=late), prepare(filt, biased)

    @jax.jit
    def along(epochs):
        info = run(filt, params, case.nav, hide(epochs, hidden))
        return info.nav, innovation_nll(info, ~hidden)

    (samples, nll), (sums, ready_nll) = along(biased), along(ready)
    # the biases are found, so that there was something to take out
    assert np.abs(samples.errors["gyro_bias"][-1]).min() > 1e-4
    for error, bound in zip(difference(sums, samples), (1e-3, 1e-4, 1e-5), strict=True):  # m, m/s, rad
        assert np.abs(error).max() < bound
    assert float(ready_nll) == pytest.approx(float(nll), rel=1e-4)


@pytest.mark.full
def test_samples_that_cannot_be_summed_are_handed_on(case, biased):
    """Other strides and frames: the samples themselves. Many runs are those of one."""
    for options in ({}, {"cov_stride": 25}, {"fast": False, "cov_stride": 5}):
        leaves_equal(prepare(build("ekf9", **options), biased).imu.samples, biased.imu)
    filt = build("ekf9", frame="tangent", cov_stride=5)
    leaves_equal(*(run_jit(filt, case.params, case.nav, e).nav for e in (biased, prepare(filt, biased))), 1e-12, 1e-12)
    filt = build("ekf9", cov_stride=5)
    two = prepare(filt, jax.tree.map(lambda a: jnp.stack([a, a]), biased))
    one = prepare(filt, biased)
    leaves_equal(jax.tree.map(lambda a: a[1], two), one, 1e-15)
    # coning and sculling of an epoch's first sample are with the last one before it
    third, last = jax.tree.map(lambda a: a[3], biased.imu), (biased.imu.gyro[2, -1], biased.imu.accel[2, -1])
    leaves_equal(preintegrate(third, last, 5, one.imu.keep[3]), jax.tree.map(lambda a: a[3], one.imu.samples), 1e-12)


@pytest.mark.parametrize("options", [{"history": 3, "cov_stride": 5}, {"cov_stride": 10}, {}])
def test_epochs_prepared_for_another_filter_are_refused(case, biased, options):
    ready = prepare(build("ekf9", cov_stride=5), biased)
    with pytest.raises(ValueError, match=r"prepared for a stride and history of \(5, 2\) samples, the filter has"):
        jax.eval_shape(lambda e: run(build("ekf9", **options), case.params, case.nav, e), ready)
