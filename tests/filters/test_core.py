"""The filter core: exact no-ops, equivalent ways to run it, and consistency on a matched simulation."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.custom_derivatives import SymbolicZero

from jaxnav.analysis import metrics
from jaxnav.filters import core
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.core import make_filter, masked, shift
from jaxnav.filters.epochs import pack
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import Poles, observer, open_loop, reset
from jaxnav.filters.papers.gpid import literal_params
from jaxnav.filters.parameters import datasheet_params, history_for
from jaxnav.filters.rule import Correction, Innovation, Rule
from jaxnav.filters.rules.kalman import correct as kalman_correct
from jaxnav.filters.run import first_failure, run, run_jit
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.states.table import BIASES, zeros
from jaxnav.strapdown.fast import local_level
from jaxnav.strapdown.increments import thin
from jaxnav.types import Epoch, Forcing, Imu
from tests.conftest import GRADE, all_finite, gnss, leaves_equal

RUNS = 16


@pytest.fixture(scope="module")
def info(case):
    return run_jit(build("ekf15"), case.params, case.nav, case.packed.epochs)


def apart(a, b):
    """Largest distance of two solutions, m, m/s, rad."""
    position = np.abs(jax.vmap(earth.enu_difference)(a.pos, b.pos)).max()
    return position, np.abs(a.vel - b.vel).max(), np.abs(a.q - b.q).max()


def take(tree, index):
    return jax.tree.map(lambda a: a[index], tree)


def blind(epochs: Epoch) -> Epoch:
    return epochs._replace(fix=epochs.fix._replace(valid=jnp.zeros_like(epochs.fix.valid)))


def test_the_drive_is_followed(case, info):
    error = np.asarray(jax.vmap(earth.enu_difference)(info.nav.pos, case.truth.lla[20::20]))
    assert (metrics.rms(error[10:]) < [1.0, 1.0, 1.5]).all()  # of 2, 2, 3 m that the fixes have
    assert np.asarray(info.ok).all() and np.asarray(info.used).all()
    np.testing.assert_allclose(info.nav.t, case.packed.t, rtol=0, atol=1e-12)


def test_padding_changes_nothing(case, info):
    padded = case.packed.epochs._replace(imu=jax.vmap(lambda imu: core.padded(imu, 27))(case.packed.epochs.imu))
    assert padded.imu.dt.shape == (60, 27)
    other = run_jit(build("ekf15"), case.params, case.nav, padded)
    position, velocity, attitude = apart(info.nav, other.nav)
    assert position < 2e-8 and velocity < 1e-9 and attitude < 1e-11
    np.testing.assert_allclose(other.P, info.P, rtol=1e-7, atol=1e-14)


def test_without_fixes_it_is_pure_inertial_navigation(case):
    info = run_jit(build("ekf15"), case.params, case.nav, blind(case.packed.epochs))
    alone = jax.jit(local_level.propagate)(case.nav, None, Imu(case.imu.dt, case.imu.gyro, case.imu.accel))[1].nav
    position, velocity, attitude = apart(info.nav, take(alone, slice(19, None, 20)))
    assert position < 1e-7 and velocity < 1e-9 and attitude < 1e-12  # blocks of 20 samples, and of 100
    assert not info.nu.any() and not info.used.any() and not info.x.any()
    np.testing.assert_array_equal(info.S, np.broadcast_to(np.eye(6), (60, 6, 6)))


def test_a_missing_channel_is_an_exact_no_op(case):
    """Whatever stands in it, and its own statistics are those of nothing."""
    fix = case.packed.epochs.fix
    valid = fix.valid.at[:, 3:].set(False).at[7:30].set(False)
    results = []
    for value, sd in ((fix.value, fix.sd), (fix.value.at[:, 4].set(1e9), fix.sd.at[:, 5].set(1e-9))):
        epochs = case.packed.epochs._replace(fix=fix._replace(value=value, sd=sd, valid=valid))
        results.append(run_jit(build("ekf15"), case.params, case.nav, epochs))
    a, b = results
    leaves_equal(a._replace(residual=b.residual), b)
    assert not a.nu[:, 3:].any() and not a.used[:, 3:].any() and not a.used[7:30].any() and a.used[31, :3].all()
    np.testing.assert_array_equal(a.S[3, 3:, 3:], np.eye(3))
    assert a.residual[10, 0] != 0  # a hidden fix still has a residual


def test_correlated_fixes_change_the_innovation_covariance(case, info):
    corr = jnp.array([0.5, -0.3, 0.2, -0.6, 0.1, 0.4])
    fix = case.packed.epochs.fix
    other = run_jit(
        build("ekf15"), case.params, case.nav,
        case.packed.epochs._replace(fix=fix._replace(corr=jnp.broadcast_to(corr, (60, 6)))),
    )  # fmt: skip
    change = np.asarray(other.S[0] - info.S[0])
    expected = np.zeros((6, 6))
    for block, c in ((0, corr[:3]), (3, corr[3:])):
        for i, j, r in ((0, 1, c[0]), (1, 2, c[1]), (2, 0, c[2])):
            i, j = i + block, j + block
            expected[i, j] = expected[j, i] = float(r * fix.sd[0, i] * fix.sd[0, j])
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-12)
    nu, S = np.asarray(other.nu[0]), np.asarray(other.S[0])
    assert other.nis[0] == pytest.approx(nu @ np.linalg.inv(S) @ nu)


def test_streaming_sample_by_sample_is_the_same(case, info):
    filt = build("ekf15")
    predict, correct = jax.jit(filt.predict), jax.jit(filt.correct)
    state = filt.init(case.params, case.nav)
    for e in range(12):
        imu, fix = take((case.packed.epochs.imu, case.packed.epochs.fix), e)
        for k in range(20):
            state = predict(case.params, state, take(imu, slice(k, k + 1)))
        assert state.T == pytest.approx(1.0)
        state, row = correct(case.params, state, fix)
        batch = take(info, e)
        assert np.abs(earth.enu_difference(row.nav.pos, batch.nav.pos)).max() < 1e-4  # how an epoch is split
        leaves_equal(
            (row.nav.vel, row.nav.q, row.nav.errors["gyro_bias"], row.nav.errors["accel_bias"]),
            (batch.nav.vel, batch.nav.q, batch.nav.errors["gyro_bias"], batch.nav.errors["accel_bias"]),
            5e-5,
        )
        sd = np.sqrt(np.diag(batch.P))
        np.testing.assert_allclose(row.P / np.outer(sd, sd), batch.P / np.outer(sd, sd), rtol=0, atol=1e-3)


def test_the_plain_form_is_the_same(case, info):
    plain = run_jit(build("ekf15", fast=False), case.params, case.nav, case.packed.epochs)
    position, velocity, attitude = apart(info.nav, plain.nav)
    assert position < 1e-7 and velocity < 1e-9 and attitude < 1e-11


def test_covariance_stride_costs_millimetres(case, info):
    thin = run_jit(build("ekf15", cov_stride=5), case.params, case.nav, case.packed.epochs)
    position, velocity, attitude = apart(info.nav, thin.nav)
    assert 0 < position < 3e-3 and velocity < 3e-4 and attitude < 1e-4
    np.testing.assert_allclose(
        jnp.diagonal(thin.P, axis1=1, axis2=2) / jnp.diagonal(info.P, axis1=1, axis2=2), 1, atol=0.03
    )
    # a stride that does not divide the 20 samples of an epoch: they are padded to 21
    uneven = run_jit(build("ekf15", cov_stride=7), case.params, case.nav, case.packed.epochs)
    assert apart(info.nav, uneven.nav)[0] < 5e-3


def test_thin_weighs_by_time_and_padding_not_at_all():
    dt = jnp.array([0.1, 0.3, 0.2, 0.0, 0.0, 0.0])
    value = thin(jnp.array([1.0, 5.0, 2.0, 99.0, 3.0, 3.0])[:, None], dt, 2)
    np.testing.assert_allclose(value[:, 0], [4.0, 2.0, 3.0])  # a block of padding keeps its own value, finite


def test_shift_keeps_the_last_real_samples(case):
    at = lambda t: jax.tree.map(lambda a: jnp.broadcast_to(a, (len(t), *a.shape)), case.nav)._replace(t=jnp.array(t))  # noqa: E501
    past = at([1.0, 2.0, 3.0, 4.0])
    # after n samples at 5, 6, 7, 8, ... s the last four of them; where there are fewer, the first one stands in
    for n, recent, expected in (
        (0, [5.0, 5.0, 5.0, 5.0], [1.0, 2.0, 3.0, 4.0]),
        (2, [5.0, 5.0, 5.0, 6.0], [3.0, 4.0, 5.0, 6.0]),
        (6, [7.0, 8.0, 9.0, 10.0], [7.0, 8.0, 9.0, 10.0]),
    ):
        np.testing.assert_array_equal(shift(past, at(recent), jnp.array(n)).t, expected)


# ------------------------------------------------------------------------------------------------ feedback


def test_open_loop_is_reset_while_errors_are_small(case):
    closed, free = (
        run_jit(build("kf9_simple", feedback=f), case.params, case.nav, case.packed.epochs) for f in (reset, open_loop)
    )
    assert np.abs(free.x[:, :3]).max() > 0.3  # the error is carried, not fed back
    position, velocity, attitude = apart(closed.nav, free.nav)
    moved = np.abs(jax.vmap(earth.enu_difference)(closed.nav.pos, case.truth.lla[20::20])).max()
    assert position < 0.02 * moved and velocity < 0.01 and attitude < 1e-3


@pytest.mark.parametrize("tau", [0.4, 4.0])
def test_observer_is_stable_for_any_epoch_length(case, info, tau):
    """Epochs of 1 s with time constants on either side of it; the paper's own gains fail for tau < 1 s."""
    poles = Poles(jnp.asarray(tau), jnp.asarray(tau))
    params = case.params._replace(feedback=poles)
    seen = run_jit(build("ekf15", feedback=observer), params, case.nav, case.packed.epochs)
    assert seen.ok.all()
    position, velocity, attitude = apart(info.nav, seen.nav)
    assert position < 0.1 and velocity < 0.03 and attitude < 2e-3


def test_an_observer_reckons_with_the_time_between_fixes_of_a_kind(case):
    """Velocity 20 ms after position, every 2 s: what velocity corrects has to last until the next position."""
    filt = build("ekf15", feedback=observer)
    params = case.params._replace(feedback=Poles(jnp.asarray(1.0), jnp.asarray(1.0)))
    fix = jax.tree.map(lambda a: a[0], case.packed.epochs.fix)
    fix = fix._replace(valid=jnp.arange(6) >= 3, value=fix.value + 0.1)

    @jax.jit
    def drive(T, age):
        state = filt.init(params, case.nav)._replace(T=T, age=jnp.full(6, age))
        return filt.correct(params, state, fix)[0].u

    short, long = drive(0.02, 1.98), drive(2.0, 0.0)
    assert np.abs(long.accel).max() > 1e-3
    leaves_equal(short, long, 1e-12)


@pytest.mark.parametrize("tau", [0.3, 1.0, 5.0])
def test_observer_places_the_poles(case, tau):
    """Position and velocity errors of a double integrator, sampled: both poles at exp(-T / tau)."""
    T = 1.0
    gains = [observer(Poles(jnp.asarray(tau), jnp.asarray(tau)), lambda nav, x: nav, (), e, T)[2] for e in jnp.eye(9)]
    k, c, spin = gains[0].accel[0], gains[3].accel[0], gains[6].omega[0]
    M = np.array([[1 + k * T**2 / 2, T + c * T**2 / 2], [k * T, 1 + c * T]])
    # a double pole splits by the root of rounding
    np.testing.assert_allclose(np.linalg.eigvals(M), np.exp(-T / tau), atol=1e-6)
    assert 1 + spin * T == pytest.approx(np.exp(-T / tau))


# ------------------------------------------------------------------------------------------------ rules


def test_gpid_without_gains_is_the_kalman_filter(case):
    theta = literal_params(0.0, 0.0)
    plain = run_jit(build("kf9_simple"), case.params, case.nav, case.packed.epochs)
    pid = run_jit(build("gpid_literal"), case.params._replace(rule=theta), case.nav, case.packed.epochs)
    leaves_equal(plain, pid, 1e-10, 1e-12)


def test_only_an_observer_carries_a_drive(case):
    """Without one nothing is turned or pushed, in place of by zero at every sample."""
    for name, entry in FILTERS.items():
        params = case.params._replace(rule=entry.theta(), feedback=entry.feedback_theta())
        u = jax.eval_shape(build(name).init, params, case.nav).u
        assert (u is not None) is (entry.feedback is observer), name


class Seen(NamedTuple):
    age: jax.Array
    T: jax.Array


def test_a_rule_sees_ages_and_its_fade_and_drive_are_obeyed(case):
    drive = jnp.array([0.1, 0.2, -0.3])

    def watching(theta, memory, z: Innovation) -> Correction:
        c = kalman_correct((), (), z)
        used = z.valid.at[3:].set(False)
        return c._replace(memory=Seen(z.age, z.T), used=used, fade=1.25, drive=Forcing(jnp.zeros(3), drive))

    rule = Rule(lambda n, m: Seen(jnp.zeros(m), jnp.zeros(())), watching, estimates=BIASES)
    filt = make_filter(local_level.propagate, error_model(states=(), form="simple"), rule, reset)
    step, state = jax.jit(filt.step), filt.init(case.params, case.nav)
    epochs = case.packed.epochs._replace(
        fix=case.packed.epochs.fix._replace(valid=case.packed.epochs.fix.valid.at[1].set(False))
    )
    rows = []
    for e in range(3):
        before = state
        state, info = step(case.params, state, take(epochs, e))
        rows.append((state, info, before))
    (s0, i0, b0), (s1, i1, _), (s2, _, _) = rows
    np.testing.assert_allclose(s0.memory.age, 1.0)
    np.testing.assert_allclose(s2.memory.age, [2.0] * 3 + [3.0] * 3)  # no fix in between, velocity never accepted
    assert s2.memory.T == pytest.approx(1.0)
    leaves_equal(s1.memory, s0.memory)  # where nothing is valid the rule's answer is discarded
    np.testing.assert_allclose(s0.P, 1.25**2 * i0.P, rtol=1e-14)
    np.testing.assert_array_equal(s1.P, i1.P)
    C = rotations.to_dcm(b0.past.q[-1])
    absorbed = s0.past.errors["accel_bias"][-1] - b0.past.errors["accel_bias"][-1]
    assert np.abs(C @ absorbed - drive).max() < 0.05  # the attitude has moved by an epoch
    np.testing.assert_array_equal(s1.past.errors["accel_bias"][-1], s0.past.errors["accel_bias"][-1])


# ------------------------------------------------------------------------------------------------ batches


class Batch(NamedTuple):
    params: object
    nav: object  # (B, ...)
    epochs: Epoch  # (B, E, ...)
    info: object


run_batch = jax.jit(jax.vmap(run, (None, None, 0, 0)), static_argnums=0)


@pytest.fixture(scope="module")
def batch(case):
    """Runs whose sensors, fixes and start are drawn from exactly what the filter believes."""
    rng = np.random.default_rng(11)
    params = datasheet_params(GRADE, tilt_sd=0.2 * DEG, heading_sd=0.7 * DEG)
    E, k = case.packed.epochs.imu.dt.shape
    dt = 1 / 20
    navs, epochs = [], []
    model = error_model()
    sd = np.sqrt(np.diag(model.covariance(params, case.nav)))
    retract = jax.jit(model.retract)
    for _ in range(RUNS):
        x = rng.normal(size=15) * sd
        navs.append(retract(case.nav._replace(errors=zeros(BIASES)), -x)._replace(errors={}))
        draw = lambda root_psd: np.cumsum(rng.normal(size=(E * k, 3)), 0) * np.sqrt(dt) * float(root_psd)
        gyro = (
            draw(params.states["gyro_bias"].driving_noise)
            + rng.normal(size=(E * k, 3)) * GRADE.arw / np.sqrt(dt)
            - x[9:12]
        )
        accel = (
            draw(params.states["accel_bias"].driving_noise)
            + rng.normal(size=(E * k, 3)) * GRADE.vrw / np.sqrt(dt)
            - x[12:15]
        )
        imu = case.imu._replace(gyro=case.imu.gyro + gyro, accel=case.imu.accel + accel)
        epochs.append(pack(imu, gnss(case.truth, 20, rng), 1.0).epochs)
    stack = lambda trees: jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
    nav, epochs = stack(navs), stack(epochs)
    return Batch(params, nav, epochs, run_batch(build("ekf15"), params, nav, epochs))


@pytest.mark.full
def test_a_batch_is_its_runs_one_by_one(batch):
    for i in (0, 5):
        nav, epochs, expected = take((batch.nav, batch.epochs, batch.info), i)
        alone = run_jit(build("ekf15"), batch.params, nav, epochs)
        position, velocity, attitude = apart(alone.nav, expected.nav)
        assert position < 2e-8 and velocity < 1e-9 and attitude < 1e-10
        np.testing.assert_allclose(alone.P, expected.P, rtol=1e-7, atol=1e-13)


def test_a_matched_filter_is_consistent(case, batch):
    """NIS over all fixes, NEES over the runs at their end: inside the two-sided 99 % bounds of chi-square."""
    E = batch.info.nis.shape[1]
    low, high = metrics.chi2_bounds(6, RUNS * E, 0.99)
    assert low < float(batch.info.nis.mean()) < high
    z = metrics.normalized_innovations(batch.info)
    np.testing.assert_allclose(metrics.rms(z.reshape(-1, 6)), 1.0, atol=0.08)
    lla, vel = jnp.asarray(case.truth.lla[-1]), jnp.asarray(case.truth.vel[-1])
    q = rotations.conjugate(rotations.from_dcm(rotations.from_rph(jnp.asarray(case.truth.rph[-1]))))

    @jax.jit
    @jax.vmap
    def value(nav, P):
        phi = rotations.log(rotations.multiply(nav.q, q))
        return metrics.nees(jnp.concatenate([earth.enu_difference(nav.pos, lla), nav.vel - vel, phi]), P[:9, :9])

    end = take(batch.info, (slice(None), -1))
    low, high = metrics.chi2_bounds(9, RUNS, 0.99)
    assert low < float(value(end.nav, end.P).mean()) < high


def test_a_nan_freezes_its_run_and_no_other(case, batch):
    bad, epoch = 3, 20
    gyro = batch.epochs.imu.gyro.at[bad, epoch, 5, 1].set(jnp.nan)
    info = run_batch(
        build("ekf15"), batch.params, batch.nav, batch.epochs._replace(imu=batch.epochs.imu._replace(gyro=gyro))
    )
    assert all_finite(info)
    ok = np.ones((RUNS, 60), bool)
    ok[bad, epoch:] = False
    np.testing.assert_array_equal(info.ok, ok)
    others = np.arange(RUNS) != bad
    leaves_equal(take(info, others), take(batch.info, others))
    one, was = (take(i, bad) for i in (info, batch.info))
    leaves_equal(take(one, slice(epoch)), take(was, slice(epoch)))
    for e in (epoch, 59):
        leaves_equal(take(one.nav, e), take(was.nav, epoch - 1), 1e-15)
    assert not one.used[epoch:].any()
    text = first_failure(one, case.packed.t)
    assert "t = 21.000 s" in text and "epoch 20 of 60" in text
    assert first_failure(was, case.packed.t) is None


# ------------------------------------------------------------------------------------------------ entry


def test_one_trace_serves_all_values(case):
    jitted = jax.jit(chex.assert_max_traces(run, n=1), static_argnums=0)
    for scale in (1.0, 1.1):
        params = datasheet_params(GRADE, tilt_sd=scale * DEG)
        jitted.trace(build("kf9_simple"), params, case.nav, case.packed.epochs)  # built anew: the same object
    assert build("kf9_simple") is build("kf9_simple") and set(FILTERS) > {"ekf15", "gpid"}


@pytest.mark.full
@pytest.mark.parametrize("feedback", [reset, observer])
def test_a_gradient_differentiates_an_epoch_once(case, feedback):
    """What depends on the parameters is known from the start; else the scan begins again until it is."""
    tried = []

    @jax.custom_jvp
    def seen(nav, rate):
        return nav

    def rule(primals, tangents):  # called for every set of derivatives that the scan tries
        tried.append([type(t) is not SymbolicZero for t in jax.tree.leaves(tangents)])
        return primals[0], jax.tree.map(lambda t: jnp.zeros(t.shape) if isinstance(t, SymbolicZero) else t, tangents[0])

    seen.defjvp(rule, symbolic_zeros=True)

    def loss(noise):
        def propagate(nav, *rest):
            return local_level.propagate(seen(nav, noise.gyro), *rest)

        filt = make_filter.__wrapped__(propagate, error_model(), Rule(lambda n, m: None, kalman_correct), feedback)
        params = case.params._replace(noise=noise, feedback=Poles(1.0, 1.0))
        return jnp.sum(run(filt, params, case.nav, case.packed.epochs).nu ** 2)

    jax.jit(jax.grad(loss)).trace(case.params.noise)
    assert len(tried) == 1, tried


def test_names_and_options_that_are_not_there():
    with pytest.raises(ValueError, match="no filter 'ekf99': did you mean ekf9"):
        build("ekf99")
    with pytest.raises(ValueError, match="history must be at least 2"):
        build("ekf15", history=1)


def test_a_missing_channel_is_correlated_with_none():
    """Its row of H and its residual are zero, its R an identity; what is left keeps its correlations."""
    R = np.array([[4.0, 1.0, 2.0], [1.0, 9.0, 3.0], [2.0, 3.0, 16.0]])
    y, H, left = masked(jnp.ones(3), jnp.ones((3, 5)), jnp.asarray(R), jnp.array([True, False, True]))
    np.testing.assert_array_equal(y, [1.0, 0.0, 1.0])
    np.testing.assert_array_equal(H, np.outer([1.0, 0.0, 1.0], np.ones(5)))
    np.testing.assert_array_equal(left, [[4.0, 0.0, 2.0], [0.0, 1.0, 0.0], [2.0, 0.0, 16.0]])


def test_driving_noise_keeps_a_bias_as_large_as_its_instability():
    """A Gauss-Markov process of sd s and time T is driven by s sqrt(2 / T): what is lost in T / 2 is put in again."""
    grade = GRADE._replace(gyro_walk=0.0)
    drive = float(np.ravel(datasheet_params(grade).states["gyro_bias"].driving_noise)[0])
    assert drive**2 * grade.tau / 2 == pytest.approx(grade.gyro_instability**2)


def test_history_reaches_back_as_far_as_a_fix_is_old():
    """A fix of 0.1 s at 100 Hz lies ten samples back, or by rounding eleven: now, those, and the one before them."""
    params = datasheet_params(GRADE)
    old = params.measurements["position"]._replace(latency=jnp.asarray(0.1))
    late = params._replace(measurements=params.measurements | {"position": old})
    assert history_for(params, 100.0, 60.0) == 2 + 6 and history_for(late, 100.0, 60.0) == 2 + 16
    assert history_for(late, 100.0, 60.0, 0.05) == 2 + 16 and history_for(late, 100.0, 60.0, 0.051) == 2 + 26
