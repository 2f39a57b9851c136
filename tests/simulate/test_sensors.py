"""Sensor errors: each of its size and kind, from a key, and independent of the size of the others."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis.metrics import chi2_bounds
from jaxnav.filters.compiler import enable_x64
from jaxnav.filters.parameters import datasheet_params
from jaxnav.maths import earth, rotations, units
from jaxnav.simulate import faults, gnss, imu
from jaxnav.simulate.faults import Burst, Constant, GaussMarkov, Ramp, White
from jaxnav.simulate.gnss import Receiver
from jaxnav.simulate.imu import ImuErrors
from jaxnav.simulate.processes import gauss_markov, normal
from jaxnav.simulate.trajectories import Motion, travel
from jaxnav.states.grades import GRADES, Grade
from jaxnav.types import Imu, Nav, Origin

enable_x64()
SURE = 0.9999  # probability of the chi-square intervals
DT = 0.02
QUIET = Grade(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 10.0, "no errors")
LOUD = ImuErrors(gyro_scale_sd_ppm=1000.0, accel_scale_sd_ppm=2000.0, gyro_misalignment_sd_mrad=3.0,
                 accel_misalignment_sd_mrad=4.0)  # fmt: skip
quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # what runs once need not be fast


def inside_bounds(squares, dof_each=1):
    """Is the mean of these chi-square values what it should be?"""
    squares = np.ravel(squares)
    low, high = chi2_bounds(dof_each, squares.size, SURE)
    return low < squares.mean() < high


def still(n, gyro=(1.0, 1.0, 1.0), accel=(1.0, 1.0, 1.0)):
    """n equal samples."""
    return Imu(jnp.full(n, DT), jnp.tile(jnp.array(gyro), (n, 1)), jnp.tile(jnp.array(accel), (n, 1)))


def many(grade, samples, errors, runs=600, seed=1):
    """`imu.corrupt` over many keys."""
    keys = jax.random.split(jax.random.key(seed), runs)
    return jax.jit(jax.vmap(lambda k: corrupt(k, samples, DT, grade, errors)))(keys)


def corrupt(*arguments):
    """What the IMU puts out, and its true biases."""
    out, true = imu.corrupt(*arguments)
    return out, true["gyro_bias"], true["accel_bias"]


# ---------------------------------------------------------------------------- IMU


def test_white_noise_has_the_datasheets_density():
    grade, n = GRADES["consumer"], 4000
    out, b_g, b_a = corrupt(jax.random.key(0), still(n), DT, grade)
    # an increment over dt has the variance arw^2 dt
    assert inside_bounds(((out.gyro - 1 - b_g) * DT) ** 2 / (grade.arw**2 * DT))
    assert inside_bounds(((out.accel - 1 - b_a) * DT) ** 2 / (grade.vrw**2 * DT))


def test_constant_biases_have_their_sizes():
    grade, none = GRADES["adis16465"], ImuErrors()
    _, b_g, b_a = many(grade, still(1), none)
    assert inside_bounds(b_g**2 / (grade.gyro_turn_on**2 + grade.gyro_instability**2))
    assert inside_bounds(b_a**2 / (grade.accel_turn_on**2 + grade.accel_instability**2))
    untold = none._replace(gyro_bias_sd_deg_per_hour=3600.0, accel_bias_sd_mg=30.0)
    _, g, a = many(grade, still(1), untold)
    assert inside_bounds((g - b_g) ** 2 / units.DEG**2) and inside_bounds((a - b_a) ** 2 / (30 * units.MG) ** 2)
    assert abs(np.mean((g - b_g) * b_g)) < 4 * units.DEG * b_g.std() / np.sqrt(b_g.size)
    # of fixed size with a random sign, as Ansari et al. 2024, Table 1 has them
    table1 = GRADES["tactical"]
    _, g, a = many(table1, still(1), none._replace(fixed_bias=True))
    np.testing.assert_allclose(np.abs(g), table1.gyro_turn_on, rtol=1e-12)
    np.testing.assert_allclose(np.abs(a), table1.accel_turn_on, rtol=1e-12)
    assert np.abs(np.sign(g).mean((0, 1))).max() < 0.2 and len({tuple(s) for s in np.sign(g[:, 0])}) == 8


def test_a_walking_bias_walks_from_zero():
    grade, n = QUIET._replace(gyro_walk=0.01, accel_walk=0.1), 101
    out, b_g, b_a = many(grade, still(n), ImuErrors(), 200)
    for bias, root in ((b_g, 0.01), (b_a, 0.1)):
        assert inside_bounds(bias[:, 0] ** 2 / (root**2 * DT)) and inside_bounds(bias[:, -1] ** 2 / (root**2 * DT * n))
        assert inside_bounds(np.diff(bias, axis=1) ** 2 / (root**2 * DT))
    np.testing.assert_allclose(out.gyro, 1 + b_g, atol=1e-12)
    known = datasheet_params(grade).states
    assert float(known["gyro_bias"].driving_noise) == 0.01 and float(known["accel_bias"].driving_noise) == 0.1


@pytest.mark.parametrize("shape", [(3,), (11, 13), (4, 5, 6), ()])
def test_normal_numbers_are_those_of_jax(shape):
    key = jax.random.key(7)
    np.testing.assert_allclose(normal(key, shape), jax.random.normal(key, shape, float), rtol=1e-14)


def test_gauss_markov_is_stationary_with_its_time_constant():
    b = np.asarray(gauss_markov(jax.random.normal(jax.random.key(2), (301, 4000)), 0.1, 10.0))
    for i in (0, 100, 300):
        assert inside_bounds(b[i] ** 2)
    assert np.mean(b[200] * b[100]) == pytest.approx(np.exp(-1), abs=0.07)
    assert np.diff(b, axis=0).std() == pytest.approx(np.sqrt(2 * (1 - np.exp(-0.01))), rel=0.01)


def test_scale_and_misalignment_mix_the_axes():
    # one axis excited at a time: its own column of the matrix shows
    for axis in range(3):
        e = np.eye(3)[axis]
        out, _, _ = many(QUIET, still(1, e, e), LOUD, seed=axis)
        for value, scale, angle in ((out.gyro[:, 0], 1e-3, 3e-3), (out.accel[:, 0], 2e-3, 4e-3)):
            assert inside_bounds((value[:, axis] - 1) ** 2 / scale**2)
            assert inside_bounds(np.delete(value, axis, 1) ** 2 / angle**2)
    assert np.array_equal(many(QUIET, still(1), ImuErrors())[0].gyro, np.ones((600, 1, 3)))


def test_vibration_is_a_mean_over_each_sample():
    shaken = ImuErrors(vibration_hz=7.0, gyro_vibration_deg_per_s=(1.0, 2.0, 3.0), accel_vibration_mps2=(4.0, 5.0, 6.0))
    out, _, _ = many(QUIET, still(500), shaken, 20)  # 10 s hold whole periods
    amplitude = np.array([1.0, 2.0, 3.0]) * units.DEG * np.sinc(7 * DT)
    np.testing.assert_allclose(np.std(out.gyro, axis=1), np.tile(amplitude / np.sqrt(2), (20, 1)), rtol=1e-9)
    np.testing.assert_allclose(out.accel.mean(1), 1, atol=1e-12)
    power = np.abs(np.fft.rfft(out.accel[0, :, 0] - 1)) ** 2
    assert np.argmax(power) == 70 and power[70] > 0.999 * power.sum()
    assert np.std(out.gyro[:, 0, 0]) > 0.3 * amplitude[0]  # the phase is each run's own
    aliased, _, _ = many(QUIET, still(500), shaken._replace(vibration_hz=57.0), 1)
    assert np.argmax(np.abs(np.fft.rfft(aliased.accel[0, :, 0] - 1))) == 70  # 57 Hz at 50 Hz looks like 7 Hz


def test_quantisation_rounds_and_keeps_the_derivative():
    coarse = ImuErrors(gyro_step_deg_per_s=0.5, accel_step_mg=3.0)
    values = Imu(jnp.full(400, DT), *jax.random.normal(jax.random.key(0), (2, 400, 3), float))
    out, _, _ = corrupt(jax.random.key(1), values, DT, QUIET, coarse)
    for a, b, step in ((out.gyro, values.gyro, 0.5 * units.DEG), (out.accel, values.accel, 3 * units.MG)):
        np.testing.assert_allclose(a / step, np.round(a / step), atol=1e-6)
        assert 0.45 * step < np.abs(a - b).max() <= 0.5 * step * (1 + 1e-9)
    total = lambda x: imu.corrupt(jax.random.key(1), values._replace(gyro=x), DT, QUIET, coarse)[0].gyro.sum()
    np.testing.assert_allclose(jax.grad(total)(values.gyro), 1.0)


def test_one_errors_size_changes_no_draw_of_another():
    grade = GRADES["consumer"]._replace(gyro_walk=1e-5, accel_walk=1e-4)
    run = lambda g, e: corrupt(jax.random.key(4), still(50), DT, g, e)
    everything = LOUD._replace(fixed_bias=True, gyro_bias_sd_deg_per_hour=9.0, accel_bias_sd_mg=2.0)
    plain, b_g, b_a = run(grade, ImuErrors())
    _, B_g, _ = run(grade, everything)
    white = plain.gyro - 1 - b_g
    out, bias, _ = run(grade, everything._replace(gyro_scale_sd_ppm=0.0, gyro_misalignment_sd_mrad=0.0))
    np.testing.assert_allclose(out.gyro - 1 - bias, white, atol=1e-12)
    np.testing.assert_allclose(bias, B_g, atol=0)
    half, bias, _ = run(grade, everything._replace(imu_noise_factor=0.5))
    drift = lambda b: b - b[0]
    np.testing.assert_allclose(drift(bias), 0.5 * drift(B_g), atol=1e-15)
    np.testing.assert_allclose(drift(b_g), drift(B_g), atol=1e-15)
    no_walk, bias, _ = run(grade._replace(gyro_walk=0.0, accel_walk=0.0), ImuErrors())
    np.testing.assert_allclose(no_walk.gyro - bias, plain.gyro - b_g, atol=1e-12)


def test_errors_have_draws_of_their_own():
    # one at a time, as unit white noise; no two agree at any shift
    n = 2000
    short = QUIET._replace(tau=1e-6)  # the drift then is white

    def draws(grade, errors=ImuErrors()):
        out, bias, _ = corrupt(jax.random.key(4), still(n), DT, grade, errors)
        return out.gyro - 1, bias

    root = np.sqrt(DT)
    white = draws(short._replace(arw=root))[0]
    drift = draws(short._replace(gyro_instability=1.0))[1]
    walk = np.diff(draws(short._replace(gyro_walk=1 / root))[1], axis=0)
    found = [np.fft.fft(np.asarray(a)[: n - 1, i]) for a in (white, drift, walk) for i in range(3)]
    for i, a in enumerate(found):
        for b in found[i + 1 :]:
            assert np.abs(np.fft.ifft(a * b.conj())).max() / n < 6 / np.sqrt(n)


def test_every_grade_has_a_source_and_makes_parameters():
    for name, grade in GRADES.items():
        assert len(grade.source) > 10 and min(grade[:6]) >= 0 and grade.tau > 0, name
        params = datasheet_params(grade)
        chex.assert_tree_all_finite(
            (params.noise, [(state.sd, state.driving_noise) for state in params.states.values()])
        )
    assert GRADES["adis16488a"].arw == pytest.approx(0.26 / 60 * units.DEG)
    assert GRADES["fwekf"].arw / np.sqrt(0.01) == pytest.approx(3e-4) and GRADES["fwekf"].vrw * 10 == pytest.approx(
        3e-3
    )
    order = ["hg9900", "tactical", "adis16488a", "icm20602"]
    assert all(GRADES[a].gyro_turn_on < GRADES[b].gyro_turn_on for a, b in zip(order[:-1], order[1:], strict=True))


# ---------------------------------------------------------------------------- GNSS

N = 1200
T = jnp.arange(1, N + 1, dtype=float)
AT = np.array([48.0 * units.DEG, 11.0 * units.DEG, 500.0])


def parked(n=N):
    """Truth that stands still, level, nose north."""
    q = rotations.from_dcm(rotations.from_rph(jnp.zeros(3)))
    wide = lambda a: jnp.broadcast_to(jnp.asarray(a, float), (n, *jnp.shape(a)))
    rest = earth.RATE * np.array([np.cos(AT[0]), 0, -np.sin(AT[0])])
    origin = Origin(wide(AT), wide(0.0), wide(0.0))
    return Nav(wide(0.0), wide(AT), wide(np.zeros(3)), wide(q), wide(rest), wide(AT), origin, {})


def errors(receiver, fault=(), seed=0, hidden=None, runs=1):
    """Fixes minus truth (runs, N, 6), ENU m and m/s, without a lever arm."""
    hidden = jnp.zeros(N, bool) if hidden is None else hidden

    def one(key):
        fix = gnss.fixes(key, parked(), T, 1.0, hidden, receiver, fault)
        off = jax.vmap(earth.enu_difference)(fix.value[:, :3], jnp.broadcast_to(AT, (N, 3)))
        return jnp.concatenate([off, fix.value[:, 3:]], 1)

    return np.asarray(quick(jax.vmap(one))(jax.random.split(jax.random.key(seed), runs)))


SD = np.array(Receiver().position_sd_m + Receiver().velocity_sd_mps)


def test_receiver_noise_white_and_correlated():
    # 40 runs at a lag of one correlation time: exp(-1) of the correlated share
    share = Receiver(correlated_share=0.7, correlation_s=60.0, gnss_noise_factor=2.0)
    e = errors(share, runs=40) / (2 * SD)
    assert e.var() == pytest.approx(1.0, rel=0.04)
    assert np.mean(e[:, 60:] * e[:, :-60]) == pytest.approx(0.7 * np.exp(-1), abs=0.04)
    assert np.mean(e[:, 1:] * e[:, :-1]) == pytest.approx(0.7 * np.exp(-1 / 60), abs=0.04)
    white = errors(Receiver()) / SD
    assert inside_bounds(white**2) and abs(np.mean(white[:, 1:] * white[:, :-1])) < 4 / np.sqrt(white.size)
    assert np.corrcoef(white[0, :, 3:].ravel(), white[0, :, :3].ravel())[0, 1] < 4 / np.sqrt(3 * N)


def test_slow_errors_of_a_position_are_a_process_of_minutes():
    """Its variance and its correlation after one time constant; the noise beside it stays what it was."""
    slow = Receiver(slow_position_sd_m=3.0, slow_position_s=60.0)
    e = (errors(slow, runs=40) - errors(Receiver(), runs=40)) / 3.0
    assert e[..., :3].var() == pytest.approx(1.0, rel=0.06) and np.abs(e[..., 3:]).max() < 1e-9
    assert np.mean(e[:, 60:, :3] * e[:, :-60, :3]) == pytest.approx(np.exp(-1), abs=0.06)


def test_a_receiver_that_integrates_has_its_velocitys_errors_in_its_position():
    """p_k = exp(-1 / 30) p_(k-1) + 1 s of v_k; and what is left is the noise that it had without."""
    e, plain = errors(Receiver(integrates_velocity=True, slow_position_s=30.0), runs=2), errors(Receiver(), runs=2)
    np.testing.assert_array_equal(e[..., 3:], plain[..., 3:])
    p = e[..., :3] - plain[..., :3]
    np.testing.assert_allclose(p[:, 1:], np.exp(-1 / 30) * p[:, :-1] + e[:, 1:, 3:], atol=1e-5)


def test_outliers_come_with_their_probability_and_change_no_other_fix():
    clean, spoilt = errors(Receiver(), runs=4), errors(Receiver(outlier_probability=0.05, outlier_factor=20.0), runs=4)
    extra = (spoilt - clean) / SD
    hit = np.abs(extra[..., 0]) > 1e-4
    assert hit.mean() == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / (4 * N)))
    assert inside_bounds(extra[hit] ** 2 / 20**2) and np.abs(extra[~hit]).max() < 1e-4


def test_hidden_fixes_are_free_of_error():
    hidden = (T > 100) & (T <= 120)
    e = errors(Receiver(), (Constant(0.0, 2000.0, (50.0,) * 3),), hidden=hidden)[0]
    assert np.abs(e[hidden]).max() < 1e-8 and (np.abs(e[~hidden]).max(1) > 1e-3).all()


@pytest.mark.full
def test_faults_follow_their_course_in_time():
    window = (np.asarray(T) > 600) & (np.asarray(T) <= 1100)
    clean = errors(Receiver())[0]

    def extra(fault, seed=0, runs=1):
        e = errors(Receiver(), (fault,), seed, runs=runs) - errors(Receiver(), seed=seed, runs=runs)
        assert np.abs(e[:, ~window]).max() < 1e-6 or fault.stop_s == np.inf
        return e[:, window]

    sizes = (50.0, 40.0, 30.0), (0.5, 0.4, 0.3)
    flat = np.concatenate(sizes)
    np.testing.assert_allclose(extra(Constant(600.0, 1100.0, *sizes)), np.tile(flat, (1, 500, 1)), atol=1e-3)
    signed = extra(Constant(600.0, 1100.0, *sizes, random_sign=True), runs=40)
    np.testing.assert_allclose(np.abs(signed[:, 0]), np.tile(flat, (40, 1)), atol=1e-3)
    assert len({tuple(s) for s in np.sign(signed[:, 7])}) > 20 and np.ptp(signed, axis=1).max() < 1e-3
    velocity = extra(Constant(600.0, 1100.0, velocity_mps=(0.5,) * 3))
    assert np.abs(velocity[..., :3]).max() < 1e-6 and np.allclose(velocity[..., 3:], 0.5)
    ramp = extra(Ramp(600.0, 1100.0, *sizes))[0]
    np.testing.assert_allclose(ramp[[0, 249, -1]], np.outer([0.002, 0.5, 1.0], flat), atol=1e-3)
    stays = errors(Receiver(), (Constant(1000.0, np.inf, sizes[0]),))[0] - clean
    np.testing.assert_allclose(stays[1000:, :3], np.tile(sizes[0], (200, 1)), atol=1e-3)
    assert np.abs(stays[:1000]).max() < 1e-6
    np.testing.assert_allclose(extra(Burst(600.0, 1100.0, 5.0))[0], 4 * clean[window], atol=1e-3)


def test_random_faults_have_their_size_and_correlation():
    sizes = (50.0, 40.0, 30.0), (0.5, 0.4, 0.3)
    window = slice(600, 1100)

    def extra(fault):
        noise = jnp.zeros((N, 6))
        draw = jax.jit(jax.vmap(lambda key: faults.offsets(key, (fault,), T, noise)))
        return np.asarray(draw(jax.random.split(jax.random.key(0), 60)))[:, window] / np.concatenate(sizes)

    white = extra(White(600.0, 1100.0, *sizes))
    assert inside_bounds(white**2) and abs(np.mean(white[:, 1:] * white[:, :-1])) < 4 / np.sqrt(white.size)
    slow = extra(GaussMarkov(600.0, 1100.0, *sizes, tau_s=60.0))
    assert slow.var() == pytest.approx(1.0, abs=0.08)  # 8 correlation times, 60 runs, 6 channels
    assert np.mean(slow[:, 60:] * slow[:, :-60]) == pytest.approx(np.exp(-1), abs=0.08)


def test_faults_that_are_none_are_refused():
    noise = jnp.zeros((N, 6))
    for fault, words in (
        (Ramp(5.0, 5.0), "stop_s must be after"),
        (("constant", 1.0), "must be one of Constant, Ramp"),
    ):
        with pytest.raises(ValueError, match=r"faults\[0\].*" + words):
            faults.offsets(jax.random.key(0), (fault,), T, noise)


def test_faults_of_one_receiver_have_keys_of_their_own():
    noise = jnp.zeros((N, 6))
    a = White(0.0, 500.0, (1.0,) * 3)
    both = faults.offsets(jax.random.key(1), (a, a), T, noise)
    alone = faults.offsets(jax.random.key(1), (a,), T, noise)
    second = np.asarray(both - alone)[:500, :3]
    assert inside_bounds(second**2) and abs(np.mean(second * alone[:500, :3])) < 4 / np.sqrt(1500)


def test_random_outages_do_not_meet():
    draw = jax.vmap(lambda k: gnss.random_outages(k, 3, 20.0, 140.0, (10.0, 25.0)))
    windows = np.asarray(draw(jax.random.split(jax.random.key(3), 200)))
    length = windows[..., 1] - windows[..., 0]
    assert length.min() >= 10 and length.max() <= 25 and length.std() > 3
    assert windows.min() >= 20 and windows.max() <= 140
    assert (windows[:, 1:, 0] > windows[:, :-1, 1]).all()
    with pytest.raises(ValueError, match="do not fit"):
        gnss.random_outages(jax.random.key(0), 5, 20.0, 100.0, (10.0, 20.0))
    fixed = Receiver(outages_s=((150.0, 160.0), (230.0, 241.0)), outage_shift_s=55.0)
    moved = np.asarray(jax.vmap(lambda k: gnss.outages(k, fixed, 0.0, 400.0))(jax.random.split(jax.random.key(0), 400)))
    np.testing.assert_allclose(moved[..., 1] - moved[..., 0], np.tile([10.0, 11.0], (400, 1)))
    shift = moved[..., 0] - [150.0, 230.0]
    assert shift.min() >= 0 and shift.max() <= 55 and np.allclose(shift.mean(0), 27.5, atol=4)
    assert abs(np.corrcoef(shift.T)[0, 1]) < 0.2


def flying(t):
    """Fast, with every rate and acceleration at work; closed form."""
    vel = jnp.stack([150 + 30 * jnp.sin(0.2 * t), -80 * jnp.cos(0.15 * t), 10 * jnp.sin(0.1 * t)])
    return Motion(vel, jnp.stack([0.6 * jnp.sin(0.3 * t), 0.3 * jnp.cos(0.2 * t), 0.5 * t]))


def test_antenna_swings_on_its_arm():
    # velocity of the antenna against differences of its position
    dt = 0.05

    @quick
    def both():
        point, (omega, force) = travel(flying, AT, dt, 1, 40, imu.sense).ends
        q = jax.vmap(lambda rph: rotations.from_dcm(rotations.from_rph(rph)))(point.rph)
        nav = Nav(point.t, point.lla, point.vel, q, omega, force, Origin(point.lla, point.t, point.t), {})
        lla, vel = jax.vmap(gnss.antenna, (0, None))(nav, jnp.array([1.0, -2.0, 3.0]))
        return jax.vmap(earth.enu_difference)(lla, nav.pos), vel - nav.vel

    away, swing = both()
    assert np.linalg.norm(away[0]) == pytest.approx(np.sqrt(14))
    a = np.asarray(away)
    slope = (a[:-4] - 8 * a[1:-3] + 8 * a[3:-1] - a[4:]) / (12 * dt)
    # local level axes turn on the way, by the transport rate: 1e-4 m/s
    np.testing.assert_allclose(slope, swing[2:-2], atol=3e-4)
