"""Simulated data: exact where it must be exact, of the right statistics where it is random, and fit for a filter."""

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxnav import earth, rotations, units
from jaxnav.epochs import pack
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import REST
from jaxnav.measurements import GNSS, layout
from jaxnav.mechanizations import local_level
from jaxnav.metrics import chi2_bounds, nees
from jaxnav.run import enable_x64, run
from jaxnav.scenarios import SCENARIOS, describe
from jaxnav.sensors import gnss, imu
from jaxnav.sensors.grades import GRADES, Grade
from jaxnav.simulation import matched_params, simulate, sizes, to_recording
from jaxnav.trajectories import NODES, Motion, Travel, _integrate, travel, urban
from jaxnav.types import Imu, Nav, Origin

enable_x64()
START = np.array([48.0 * units.DEG, 11.0 * units.DEG, 500.0])
SHORT = SCENARIOS["urban_short"]
RUNS = 24
KEYS = jax.random.split(jax.random.key(20), RUNS)
SURE = 0.9999  # probability of the chi-square intervals
quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # what runs once need not be fast


@pytest.fixture(scope="module")
def batch():
    """Many short runs."""
    return quick(jax.vmap(partial(simulate, SHORT)))(KEYS)


def standing(t):
    """At rest, tilted."""
    return Motion(0 * t * jnp.ones(3), 0 * t + jnp.array([0.05, -0.1, 2.0]))


def flying(t):
    """Fast, with every rate and acceleration at work; closed form."""
    vel = jnp.stack([150 + 30 * jnp.sin(0.2 * t), -80 * jnp.cos(0.15 * t), 10 * jnp.sin(0.1 * t)])
    return Motion(vel, jnp.stack([0.6 * jnp.sin(0.3 * t), 0.3 * jnp.cos(0.2 * t), 0.5 * t]))


def drift(way: Travel, merge: int = 1):
    """Navigate back the error-free IMU of a travel, ``merge`` samples as one: position error, ENU m, (E, 3)."""
    samples, omega, force = imu.ideal(way)
    ends, zero, E = way.ends, jnp.zeros(3), way.points.t.shape[0] - 1
    q = rotations.from_dcm(rotations.from_rph(ends.rph[0]))
    origin = Origin(ends.lla[0], jnp.zeros(()), ends.t[0])
    nav = Nav(ends.t[0], ends.lla[0], ends.vel[0], q, zero, zero, omega[0], force[0], origin)
    mean = Imu(*(a.reshape(E, -1, merge, *a.shape[1:]).mean(2) for a in samples))  # half the rate: the mean of two

    def epoch(nav, samples):
        nav = local_level.propagate(nav, REST, samples)[0]
        return nav, nav.pos

    _, pos = lax.scan(epoch, nav, mean._replace(dt=mean.dt * merge))
    return jax.vmap(earth.enu_difference)(pos, ends.lla[1:])


# ---------------------------------------------------------------------------- trajectory and ideal IMU


def test_noise_free_imu_navigates_back():
    way = quick(jax.vmap(lambda key: travel(urban(key, 300.0, 20.0), START, 0.01, 500, 60)))
    ways = way(jax.random.split(jax.random.key(5), 4))

    def rms(merge):
        error = jax.jit(jax.vmap(lambda points: drift(Travel(points, 0.01), merge)))(ways.points)
        return float(jnp.sqrt(jnp.mean(jnp.sum(error[..., :2] ** 2, -1))))

    slow, fast = rms(4), rms(1)
    assert fast < 0.002  # m, 100 Hz
    assert slow / fast >= 3.5**2  # second order at least: two doublings


def test_noise_free_imu_at_rest_stays():
    error = jax.jit(lambda: drift(travel(standing, START, 0.02, 500, 60)))()
    assert np.abs(error[:, :2]).max() < 1e-4


def slope(a, dt):
    """Central differences of fourth order, (n - 4, ...)."""
    return (a[:-4] - 8 * a[1:-3] + 8 * a[3:-1] - a[4:]) / (12 * dt)


def in_inertial_axes(p):
    """Position m, gravitation m/s^2 and body axes of a point in axes that do not turn."""
    turn = rotations.to_dcm(rotations.exp(jnp.array([0, 0, earth.RATE]) * p.t))
    up = earth.axes(p.lla[0], p.lla[1])[:, 2]
    r = earth.lla_to_ecef(p.lla)
    gravitation = -earth.gravity(p.lla[0], p.lla[2]) * up - earth.RATE**2 * r * np.array([1, 1, 0])
    C = earth.axes(p.lla[0], p.lla[1]) @ rotations.from_rph(p.rph)
    return turn @ r, turn @ gravitation, turn @ C


@pytest.mark.parametrize("shape", [flying, urban(jax.random.key(3), 100.0, 10.0)], ids=["flying", "urban"])
def test_position_velocity_and_imu_are_derivatives(shape):
    # by another road: differences of positions and attitudes in inertial axes
    dt = 0.02
    way = quick(lambda: travel(shape, START, dt, 1, 3000))()
    ends = way.ends
    v_e = slope(np.asarray(jax.vmap(earth.lla_to_ecef)(ends.lla)), dt)
    v_n = jax.vmap(lambda lla, v: earth.axes(lla[0], lla[1]).T @ v)(ends.lla[2:-2], v_e)
    np.testing.assert_allclose(v_n, ends.vel[2:-2], atol=2e-6)

    _, omega, force = quick(lambda points: imu.ideal(Travel(points, dt)))(way.points)
    r, gravitation, C = (np.asarray(a) for a in quick(jax.vmap(in_inertial_axes))(ends))
    f = np.einsum("tji,tj->ti", C[4:-4], slope(slope(r, dt), dt) - gravitation[4:-4])
    np.testing.assert_allclose(force[4:-4], f, atol=1e-4)
    W = np.einsum("tji,tjk->tik", C[2:-2], slope(C, dt))
    np.testing.assert_allclose(omega[2:-2], np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], 1), atol=1e-5)


def test_quadrature_is_exact_for_polynomials():
    t = 0.5 * (np.arange(4)[:, None] + NODES)
    for power, exact_inside in ((2, True), (5, False)):  # collocation of three points; at the edges order 6
        inside, edges = _integrate(jnp.asarray(t**power), 0.5)
        np.testing.assert_allclose(edges, (0.5 * np.arange(5)) ** (power + 1) / (power + 1), atol=1e-12)
        if exact_inside:
            np.testing.assert_allclose(inside, t ** (power + 1) / (power + 1), atol=1e-12)


def test_samples_are_means_over_their_interval():
    fine, coarse = (
        quick(lambda dt=dt, k=k: imu.ideal(travel(flying, START, dt, k, 10))[0])() for dt, k in ((0.01, 50), (0.05, 10))
    )
    np.testing.assert_allclose(coarse.gyro, fine.gyro.reshape(-1, 5, 3).mean(1), atol=1e-12)
    np.testing.assert_allclose(coarse.accel, fine.accel.reshape(-1, 5, 3).mean(1), atol=1e-9)


def test_at_rest_only_gravity_is_felt():
    level = lambda t: Motion(0 * t * jnp.ones(3), 0 * t * jnp.ones(3))  # noqa: E731
    samples, _, _ = quick(lambda: imu.ideal(travel(level, START, 0.01, 10, 2)))()
    g = earth.gravity(START[0], START[2])
    np.testing.assert_allclose(samples.accel, np.tile([0, 0, -g], (20, 1)), atol=1e-9)
    lat = START[0]  # nose north: forward, right, down
    rate = earth.RATE * np.array([np.cos(lat), 0, -np.sin(lat)])
    np.testing.assert_allclose(samples.gyro, np.tile(rate, (20, 1)), atol=1e-16)


def test_a_drive_keeps_to_what_a_car_does():
    def one(key):
        shape, t = urban(key, 300.0, 20.0, 20.0), 0.2 * jnp.arange(1501.0)
        return jax.vmap(lambda t: jax.jvp(shape, (t,), (jnp.ones_like(t),)))(t)

    motion, rate = quick(jax.vmap(one))(jax.random.split(jax.random.key(1), 40))
    speed = np.linalg.norm(motion.vel, axis=-1)
    accel = np.diff(speed, axis=1) / 0.2
    assert speed.min() >= 0 and speed.max() <= 20
    assert accel.min() > -2.6 and accel.max() < 1.9
    assert np.abs(speed * rate.rph[..., 2]).max() < 4  # m/s^2, across
    assert np.abs(rate.vel[..., 2]).max() < 1.5
    assert (speed[:, :101] == 0).all() and (speed[:, 125:175] > 0.5).any(1).all()  # stands, then goes
    stands = (speed[:, 150:] < 1e-9).mean(1)
    assert 0.03 < stands.mean() < 0.3
    rest = speed < 1e-12
    still = rest[:, :-2] & rest[:, 1:-1] & rest[:, 2:]
    assert np.abs(np.asarray(rate.rph)[:, 1:-1][still]).max() < 1e-12  # a car that stands does not turn
    turned = np.abs(np.diff(np.asarray(motion.rph[..., 2]), axis=1))[:, 150:].sum(1)
    assert turned.mean() > 2 * np.pi  # crossings, not a motorway
    moving = speed > 1
    roll, pitch, _ = (np.asarray(motion.rph)[moving] / units.DEG).std(0)
    assert 0.3 < roll < 0.8 and 0.8 < pitch < 1.6


def test_drives_are_differentiable():
    def end(speed_max):
        return travel(urban(jax.random.key(4), 60.0, 2.0, speed_max), START, 0.1, 10, 60).ends.lla[-1, :2] * earth.A

    derivative = quick(jax.jacfwd(end))(15.0)
    at = quick(end)
    numeric = (at(15.0 + 1e-4) - at(15.0 - 1e-4)) / 2e-4
    assert np.abs(numeric).max() > 1
    np.testing.assert_allclose(derivative, numeric, rtol=1e-4, atol=1e-3)


# ---------------------------------------------------------------------------- sensor errors


def inside_bounds(squares, dof_each=1):
    """Is the mean of these chi-square values what it should be?"""
    squares = np.ravel(squares)
    low, high = chi2_bounds(dof_each, squares.size, SURE)
    return low < squares.mean() < high


def test_white_noise_has_the_datasheets_density():
    grade, n, dt = GRADES["consumer"], 4000, 0.02
    quiet = Imu(jnp.full(n, dt), jnp.ones((n, 3)), jnp.ones((n, 3)))
    out, b_g, b_a = imu.corrupt(jax.random.key(0), quiet, dt, grade)
    # an increment over dt has the variance arw^2 dt
    assert inside_bounds(((out.gyro - 1 - b_g) * dt) ** 2 / (grade.arw**2 * dt))
    assert inside_bounds(((out.accel - 1 - b_a) * dt) ** 2 / (grade.vrw**2 * dt))


def test_biases_and_scale_errors_have_their_sizes():
    grade, one = GRADES["adis16465"], Imu(jnp.full(1, 0.01), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    keys = jax.random.split(jax.random.key(1), 600)
    _, b_g, b_a = jax.vmap(lambda k: imu.corrupt(k, one, 0.01, grade))(keys)
    assert inside_bounds(b_g**2 / (grade.gyro_turn_on**2 + grade.gyro_instability**2))
    assert inside_bounds(b_a**2 / (grade.accel_turn_on**2 + grade.accel_instability**2))
    loud = one._replace(gyro=1e6 * jnp.ones((1, 3)), accel=1e9 * jnp.ones((1, 3)))
    out, _, _ = jax.vmap(lambda k: imu.corrupt(k, loud, 0.01, grade, 1e-3, 2e-3))(keys)
    assert inside_bounds((out.gyro / 1e6 - 1) ** 2 / 1e-6)
    assert inside_bounds((out.accel / 1e9 - 1) ** 2 / 4e-6)


def test_gauss_markov_is_stationary_with_its_time_constant():
    b = np.asarray(imu.gauss_markov(jax.random.normal(jax.random.key(2), (301, 4000)), 0.1, 10.0))
    for i in (0, 100, 300):
        assert inside_bounds(b[i] ** 2)
    assert np.mean(b[200] * b[100]) == pytest.approx(np.exp(-1), abs=0.07)
    assert np.diff(b, axis=0).std() == pytest.approx(np.sqrt(2 * (1 - np.exp(-0.01))), rel=0.01)


def test_fixes_are_the_antenna_plus_white_noise(batch):
    fix, truth = batch.epochs.fix, batch.truth
    C = jax.vmap(jax.vmap(rotations.to_dcm))(truth.q)
    arm = C @ jnp.array(SHORT.lever_arm_m)
    offset = jax.vmap(jax.vmap(earth.enu_difference))(fix.value[..., :3], truth.pos) - arm
    position = np.asarray(offset) / SHORT.position_sd_m
    swing = jnp.cross(jnp.einsum("reij,rej->rei", C, truth.omega), arm)
    velocity = np.asarray(fix.value[..., 3:] - truth.vel - swing) / SHORT.velocity_sd_mps
    for noise in (position, velocity):
        assert inside_bounds(noise**2)
        assert abs((noise[:, 1:] * noise[:, :-1]).mean()) < 4 / np.sqrt(noise.size)  # white
    assert abs((position * velocity).mean()) < 4 / np.sqrt(position.size)
    np.testing.assert_array_equal(fix.sd[0, 0], SHORT.position_sd_m + SHORT.velocity_sd_mps)


def test_antenna_swings_on_its_arm():
    # velocity of the antenna against differences of its position
    dt = 0.05

    @quick
    def both():
        way = travel(flying, START, dt, 1, 40)
        _, omega, force = imu.ideal(way)
        q = jax.vmap(lambda rph: rotations.from_dcm(rotations.from_rph(rph)))(way.ends.rph)
        origin = Origin(way.ends.lla, way.ends.t, way.ends.t)
        nav = Nav(way.ends.t, way.ends.lla, way.ends.vel, q, force, force, omega, force, origin)
        lla, vel = jax.vmap(gnss.antenna, (0, None))(nav, jnp.array([1.0, -2.0, 3.0]))
        return jax.vmap(earth.enu_difference)(lla, nav.pos), vel - nav.vel

    away, swing = both()
    assert np.linalg.norm(away[0]) == pytest.approx(np.sqrt(14))
    # local level axes turn on the way, by the transport rate: 1e-4 m/s
    np.testing.assert_allclose(slope(np.asarray(away), dt), swing[2:-2], atol=3e-4)


# ---------------------------------------------------------------------------- simulate


def test_outages_are_where_they_should_be(batch):
    t = np.asarray(batch.truth.t[0])
    (first, last), *_ = SHORT.outages_s
    expected = (t > first + 1e-3) & (t < last + 1e-3)
    assert expected.sum() == 10
    np.testing.assert_array_equal(batch.hidden, np.tile(expected, (RUNS, 1)))
    np.testing.assert_array_equal(batch.epochs.fix.valid, np.tile(~expected[:, None], (RUNS, 1, 6)))


def test_random_outages_do_not_meet():
    draw = jax.vmap(lambda k: gnss.random_outages(k, 3, 20.0, 140.0, (10.0, 25.0)))
    windows = np.asarray(draw(jax.random.split(jax.random.key(3), 200)))
    length = windows[..., 1] - windows[..., 0]
    assert length.min() >= 10 and length.max() <= 25 and length.std() > 3
    assert windows.min() >= 20 and windows.max() <= 140
    assert (windows[:, 1:, 0] > windows[:, :-1, 1]).all()
    with pytest.raises(ValueError, match="do not fit"):
        gnss.random_outages(jax.random.key(0), 5, 20.0, 100.0, (10.0, 20.0))


@pytest.fixture(scope="module")
def drifting():
    """The first run of the batch, all changed but the drive: an IMU that only drifts, other GNSS and start."""
    other = SHORT._replace(grade="drifting", position_sd_m=(9.0, 9.0, 9.0), prior_heading_sd_deg=20.0, random_outages=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(GRADES, "drifting", Grade(0.0, 0.0, 0.01, 0.1, 0.01, 0.1, 5.0, "no white noise"))
        return quick(partial(simulate, other))(KEYS[0])


def test_truth_biases_are_those_of_the_imu(drifting):
    # without white noise, the last sample of a standing epoch minus its bias is what the truth feels
    still, samples, truth = slice(0, 5), drifting.epochs.imu, drifting.truth
    np.testing.assert_allclose(samples.gyro[still, -1] - truth.b_g[still], truth.omega[still], atol=1e-12)
    np.testing.assert_allclose(samples.accel[still, -1] - truth.b_a[still], truth.force[still], atol=1e-9)
    assert np.abs(np.diff(truth.b_g, axis=0)).max() > 1e-3
    np.testing.assert_allclose(samples.gyro[0, 0] - drifting.start.b_g, drifting.start.omega, atol=1e-12)


def test_batch_is_a_loop_and_a_key_is_a_run(batch):
    one = quick(partial(simulate, SHORT))
    alone = one(KEYS[2])
    chex.assert_trees_all_close(alone, jax.tree.map(lambda a: a[2], batch), rtol=1e-9, atol=1e-9)
    chex.assert_trees_all_equal(alone, one(KEYS[2]))
    assert all(not leaf.weak_type for leaf in jax.tree.leaves(alone))
    chex.assert_tree_all_finite(alone)
    assert np.abs(np.asarray(batch.truth.vel[0] - batch.truth.vel[1])).max() > 1
    E, k = sizes(SHORT)
    assert alone.epochs.imu.gyro.shape == (E, k, 3) and alone.epochs.fix.value.shape == (E, 6)
    np.testing.assert_allclose(alone.truth.t, np.arange(1, E + 1), atol=1e-12)


def test_purposes_do_not_mix(batch, drifting):
    a, b = jax.tree.map(lambda a: a[0], batch), drifting
    for field in ("pos", "vel", "q", "omega", "force"):
        np.testing.assert_allclose(getattr(a.truth, field), getattr(b.truth, field), rtol=0, atol=1e-9)
    np.testing.assert_allclose(a.epochs.fix.value[:, 3:], b.epochs.fix.value[:, 3:], atol=1e-9)
    np.testing.assert_allclose(a.initial.pos, b.initial.pos, rtol=0, atol=1e-15)
    assert b.outages.shape == (2, 2) and b.hidden.sum() > a.hidden.sum()


def test_purposes_are_independent(batch):
    # what would come out alike if two of them shared a key: the first numbers of each
    grade, truth, start = GRADES[SHORT.grade], batch.truth, batch.start
    bias = np.concatenate([start.b_g / grade.gyro_turn_on, start.b_a / grade.accel_turn_on], 1)
    off = jax.vmap(earth.enu_difference)(batch.initial.pos, start.pos) / np.array(SHORT.prior_position_sd_m)
    off = np.concatenate([off, (batch.initial.vel - start.vel) / np.array(SHORT.prior_velocity_sd_mps)], 1)
    fix = np.asarray(batch.epochs.fix.value[:, 0, 3:] - truth.vel[:, 0]) / SHORT.velocity_sd_mps
    assert abs((bias * off).mean()) < 4 / np.sqrt(bias.size)
    assert abs((bias[:, 3:] * fix).mean()) < 4 / np.sqrt(fix.size)
    assert abs((off[:, 3:] * fix).mean()) < 4 / np.sqrt(fix.size)


def test_start_is_off_by_the_prior(batch):
    start, initial = batch.start, batch.initial
    position = jax.vmap(earth.enu_difference)(initial.pos, start.pos) / np.array(SHORT.prior_position_sd_m)
    assert inside_bounds(position**2)
    assert inside_bounds(((initial.vel - start.vel) / np.array(SHORT.prior_velocity_sd_mps)) ** 2)
    turn = lambda a, b: rotations.log(rotations.multiply(a, rotations.conjugate(b)))  # noqa: E731
    sd = np.array([SHORT.prior_tilt_sd_deg, SHORT.prior_tilt_sd_deg, SHORT.prior_heading_sd_deg]) * units.DEG
    assert inside_bounds((jax.vmap(turn)(initial.q, start.q) / sd) ** 2)
    assert not initial.b_g.any() and not initial.b_a.any()


def test_a_matched_filter_is_consistent_and_accurate(batch):
    filt, params = build("ekf15", cov_stride=5), matched_params(SHORT)
    info = quick(jax.vmap(lambda nav, epochs: run(filt, params, nav, epochs)))(batch.initial, batch.epochs)
    assert info.ok.all()
    seen = ~np.asarray(batch.hidden)
    assert inside_bounds(np.asarray(info.nis)[seen], 6)
    position = jax.vmap(jax.vmap(earth.enu_difference))(info.nav.pos, batch.truth.pos)
    error = jnp.concatenate([position, info.nav.vel - batch.truth.vel], -1)
    anees = jax.vmap(nees)(error[:, 40], info.P[:, 40, :6, :6])
    assert inside_bounds(anees, 6)
    late = np.asarray(position)[:, 35:50]
    assert np.sqrt((late[..., :2] ** 2).mean()) < 0.6
    assert np.sqrt((np.asarray(error)[:, 35:50, 3:] ** 2).mean()) < 0.1
    end = np.linalg.norm(np.asarray(position)[:, 59, :2], axis=-1)  # after 10 s without a fix
    assert 0.3 < np.median(end) < 5


def test_recording_packs_into_the_same_epochs(batch):
    sim = jax.tree.map(lambda a: a[1], batch)
    rec = to_recording(sim, SHORT, t0=100.0)
    packed = pack(rec.imu, rec.aiding, 1.0)
    np.testing.assert_allclose(packed.t, 100 + np.arange(1, 81), atol=1e-9)
    chex.assert_trees_all_close(packed.epochs.imu, sim.epochs.imu, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(packed.epochs.fix.valid, sim.epochs.fix.valid)
    seen = ~np.asarray(sim.hidden)
    np.testing.assert_array_equal(packed.epochs.fix.value[seen], sim.epochs.fix.value[seen])
    assert set(rec.aiding) == set(layout(GNSS))
    assert rec.aiding["position"].t.size == 70 and rec.truth.t[0] == 100.0 and rec.truth.lla.shape == (81, 3)


def test_scenarios_are_printable_and_checked():
    text = describe(SCENARIOS["urban"])
    assert "imu_rate_hz" in text and text.count("\n") == len(SHORT) - 1
    assert hash(SHORT) == hash(SHORT._replace())
    with pytest.raises(ValueError, match="multiple of gnss_rate_hz"):
        sizes(SHORT._replace(imu_rate_hz=25.5))
    with pytest.raises(ValueError, match="whole epochs"):
        sizes(SHORT._replace(duration_s=80.3))
    with pytest.raises(ValueError, match="no IMU grade 'x'"):
        sizes(SHORT._replace(grade="x"))
