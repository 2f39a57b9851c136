"""Simulated data: exact where it must be exact, of the right statistics where it is random, and fit for a filter."""

from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxnav.analysis.metrics import chi2_bounds, nees
from jaxnav.filters.catalogue import build
from jaxnav.filters.compiler import enable_x64
from jaxnav.filters.epochs import pack
from jaxnav.filters.error_model import error_model
from jaxnav.filters.run import run
from jaxnav.maths import earth, rotations, units
from jaxnav.measurements import GNSS, layout
from jaxnav.simulate import imu
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params, simulate, simulate_shape, sizes, to_recording
from jaxnav.simulate.trajectories import Circle, SShape, Static, Urban, shape_of, travel
from jaxnav.states.grades import GRADES, Grade
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Imu, Nav, Origin

enable_x64()
SHORT = SCENARIOS["urban_short"]
ROOF, START_OF = SHORT.gnss, SHORT.start
RUNS = 24
KEYS = jax.random.split(jax.random.key(20), RUNS)
SURE = 0.9999  # probability of the chi-square intervals
quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # what runs once need not be fast


@pytest.fixture(scope="module")
def batch():
    """Many short runs."""
    return quick(jax.vmap(partial(simulate, scenario=SHORT)))(KEYS)


def inside_bounds(squares, dof_each=1):
    """Is the mean of these chi-square values what it should be?"""
    squares = np.ravel(squares)
    low, high = chi2_bounds(dof_each, squares.size, SURE)
    return low < squares.mean() < high


# ---------------------------------------------------------------------------- the one IMU stream serves every frame

START = np.array([48.0 * units.DEG, 11.0 * units.DEG, 500.0])
MOTIONS = (Static((2.0, -3.0, 40.0)), Circle(10.0, 126.0), SShape(10.0, 60.0, 60.0))


@cache
def streams(seconds, *more):
    """For each motion: start, error-free samples at 100 Hz (s, 100, 3), true points (s, ...)."""

    def stream(motion):
        shape = shape_of(jax.random.key(0), motion, seconds)
        way = quick(lambda: travel(shape, START, 0.01, 100, seconds, imu.sense))()
        p, (omega, force) = way.start
        q = rotations.from_dcm(rotations.from_rph(p.rph))
        return Nav(p.t, p.lla, p.vel, q, omega, force, Origin(p.lla, p.t, p.t), {}), way.means, way.ends[0]

    return [stream(motion) for motion in MOTIONS + more]


@partial(quick, static_argnums=(0, 1))
def navigate(frame, merge, nav, means, ends):
    """Largest horizontal and vertical error, m, of error-free samples navigated back, ``merge`` of them as one."""
    model, home = error_model(frame, ()), FRAMES[frame]
    propagate = home.fast or home.propagate  # the form that `build` takes
    gyro, accel = (a.reshape(a.shape[0], -1, merge, 3).mean(2) for a in means)

    def epoch(nav, samples):
        nav = propagate(nav, None, Imu(jnp.full(100 // merge, 0.01 * merge), *samples))[0]
        return nav, model.report(nav, jnp.zeros(9), jnp.eye(9))[0].pos

    _, pos = lax.scan(epoch, model.enter(nav), (gyro, accel))
    off = jax.vmap(earth.enu_difference)(pos, ends.lla)
    return jnp.hypot(off[:, 0], off[:, 1]).max(), jnp.abs(off[:, 2]).max()


def navigate_back(frame, merges, seconds, *more):
    """`navigate` for the motions at the rates 100 Hz / merge: horizontal and vertical (rates, motions)."""
    errors = [[navigate(frame, merge, *stream) for stream in streams(seconds, *more)] for merge in merges]
    return np.moveaxis(np.array(errors, float), 2, 0)


@pytest.mark.full
@pytest.mark.parametrize("frame", FRAMES)
def test_noise_free_imu_navigates_back(frame):
    horizontal, vertical = navigate_back(frame, (2, 4), 200)
    assert horizontal[0, 0] < 1e-4 and horizontal[0, 1:].max() < 1e-3  # 50 Hz; at rest rounding is all there is
    assert (horizontal[1, 1:] / horizontal[0, 1:]).min() >= 3.5
    assert vertical.max() < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("frame", FRAMES)
def test_noise_free_imu_navigates_back_for_an_hour(frame, capsys):
    horizontal, vertical = navigate_back(frame, (1, 2), 3600, Urban())
    with capsys.disabled():
        print(f"\n{frame}, 1 h at 100 Hz, largest error in m: horizontal {horizontal[0]}, vertical {vertical[0]}")
    assert horizontal[0, 0] <= 1e-3 and horizontal[0, 1:].max() <= 0.1
    # in town the kinks of the third derivative of pitch and roll set the limit, of 1e-8 rad after an hour
    assert (horizontal[1, 1:3] / horizontal[0, 1:3]).min() >= 3.5


def test_at_rest_only_gravity_is_felt():
    way = quick(lambda: travel(shape_of(jax.random.key(0), Static(), 1.0), START, 0.01, 10, 2, imu.sense))()
    gyro, accel = (a.reshape(-1, 3) for a in way.means)
    g = earth.gravity(START[0], START[2])
    np.testing.assert_allclose(accel, np.tile([0, 0, -g], (20, 1)), atol=1e-9)
    lat = START[0]  # nose north: forward, right, down
    rate = earth.RATE * np.array([np.cos(lat), 0, -np.sin(lat)])
    np.testing.assert_allclose(gyro, np.tile(rate, (20, 1)), atol=1e-16)


# ---------------------------------------------------------------------------- simulate


def test_outages_are_where_they_should_be(batch):
    t = np.asarray(batch.truth.t[0])
    (first, last), *_ = ROOF.outages_s
    expected = (t > first + 1e-3) & (t < last + 1e-3)
    assert expected.sum() == 10
    np.testing.assert_array_equal(batch.hidden, np.tile(expected, (RUNS, 1)))
    np.testing.assert_array_equal(batch.epochs.fix.valid, np.tile(~expected[:, None], (RUNS, 1, 6)))


def test_fixes_are_the_antenna_plus_white_noise(batch):
    fix, truth = batch.epochs.fix, batch.truth
    C = jax.vmap(jax.vmap(rotations.to_dcm))(truth.q)
    arm = C @ jnp.array(ROOF.lever_arm_m)
    offset = jax.vmap(jax.vmap(earth.enu_difference))(fix.value[..., :3], truth.pos) - arm
    position = np.asarray(offset) / ROOF.position_sd_m
    swing = jnp.cross(jnp.einsum("reij,rej->rei", C, truth.omega), arm)
    velocity = np.asarray(fix.value[..., 3:] - truth.vel - swing) / ROOF.velocity_sd_mps
    hidden = np.asarray(batch.hidden[0])
    assert np.abs(position[:, hidden]).max() < 1e-6 and np.abs(velocity[:, hidden]).max() < 1e-3  # free of error
    position, velocity = position[:, :50], velocity[:, :50]  # before the outage
    assert not hidden[:50].any()
    for noise in (position, velocity):
        assert inside_bounds(noise**2)
        assert abs((noise[:, 1:] * noise[:, :-1]).mean()) < 4 / np.sqrt(noise.size)  # white
    assert abs((position * velocity).mean()) < 4 / np.sqrt(position.size)
    np.testing.assert_array_equal(fix.sd[0, 0], ROOF.position_sd_m + ROOF.velocity_sd_mps)


@pytest.fixture(scope="module")
def drifting():
    """The first run of the batch, all changed but the drive: an IMU that only drifts, other GNSS and start."""
    other = SHORT._replace(
        imu=SHORT.imu._replace(grade="drifting"),
        gnss=ROOF._replace(position_sd_m=(9.0, 9.0, 9.0), random_outages=1),
        start=START_OF._replace(prior_heading_sd_deg=20.0),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(GRADES, "drifting", Grade(0.0, 0.0, 0.01, 0.1, 0.01, 0.1, 5.0, "no white noise"))
        return quick(partial(simulate, scenario=other))(KEYS[0])


def test_truth_biases_are_those_of_the_imu(drifting):
    # without white noise, the last sample of a standing epoch minus its bias is what the truth feels
    still, samples, truth = slice(0, 5), drifting.epochs.imu, drifting.truth
    np.testing.assert_allclose(
        samples.gyro[still, -1] - truth.errors["gyro_bias"][still], truth.omega[still], atol=1e-12
    )
    np.testing.assert_allclose(
        samples.accel[still, -1] - truth.errors["accel_bias"][still], truth.force[still], atol=1e-9
    )
    assert np.abs(np.diff(truth.errors["gyro_bias"], axis=0)).max() > 1e-3
    np.testing.assert_allclose(
        samples.gyro[0, 0] - drifting.start.errors["gyro_bias"], drifting.start.omega, atol=1e-12
    )


def test_batch_is_a_loop_and_a_key_is_a_run(batch):
    one = quick(partial(simulate, scenario=SHORT))
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
    seen = ~np.asarray(a.hidden | b.hidden)
    np.testing.assert_allclose(a.epochs.fix.value[seen, 3:], b.epochs.fix.value[seen, 3:], atol=1e-9)
    np.testing.assert_allclose(a.initial.pos, b.initial.pos, rtol=0, atol=1e-15)
    assert b.outages.shape == (2, 2) and b.hidden.sum() > a.hidden.sum()


def test_purposes_are_independent(batch):
    # what would come out alike if two of them shared a key: the first numbers of each
    grade, truth, start = GRADES[SHORT.imu.grade], batch.truth, batch.start
    bias = np.concatenate(
        [start.errors["gyro_bias"] / grade.gyro_turn_on, start.errors["accel_bias"] / grade.accel_turn_on], 1
    )
    off = jax.vmap(earth.enu_difference)(batch.initial.pos, start.pos) / np.array(START_OF.prior_position_sd_m)
    off = np.concatenate([off, (batch.initial.vel - start.vel) / np.array(START_OF.prior_velocity_sd_mps)], 1)
    fix = np.asarray(batch.epochs.fix.value[:, 0, 3:] - truth.vel[:, 0]) / ROOF.velocity_sd_mps
    assert abs((bias * off).mean()) < 4 / np.sqrt(bias.size)
    assert abs((bias[:, 3:] * fix).mean()) < 4 / np.sqrt(fix.size)
    assert abs((off[:, 3:] * fix).mean()) < 4 / np.sqrt(fix.size)


def test_start_is_off_by_the_prior(batch):
    start, initial = batch.start, batch.initial
    position = jax.vmap(earth.enu_difference)(initial.pos, start.pos) / np.array(START_OF.prior_position_sd_m)
    assert inside_bounds(position**2)
    assert inside_bounds(((initial.vel - start.vel) / np.array(START_OF.prior_velocity_sd_mps)) ** 2)
    turn = lambda a, b: rotations.log(rotations.multiply(a, rotations.conjugate(b)))
    sd = np.array([START_OF.prior_tilt_sd_deg, START_OF.prior_tilt_sd_deg, START_OF.prior_heading_sd_deg]) * units.DEG
    assert inside_bounds((jax.vmap(turn)(initial.q, start.q) / sd) ** 2)
    assert initial.errors == {}


ROUND = SHORT._replace(  # cheap to compile
    duration_s=20.0, motion=Circle(), gnss=ROOF._replace(outages_s=((12.0, 15.0),), gnss_noise_factor=0.0)
)


def test_a_late_fix_tells_where_the_antenna_was():
    late = ROUND._replace(gnss=ROUND.gnss._replace(latency_s=0.2))
    once, often = (quick(partial(simulate, scenario=s))(KEYS[0]) for s in (late, ROUND._replace(gnss_rate_hz=5.0)))
    np.testing.assert_allclose(once.epochs.fix.value, often.epochs.fix.value[3::5], rtol=0, atol=1e-9)
    np.testing.assert_allclose(once.truth.pos, often.truth.pos[4::5], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(once.epochs.fix.valid[:, 0], ~((np.arange(1, 21) > 12) & (np.arange(1, 21) <= 15)))
    known = matched_params(late).measurements
    assert known["position"].latency == known["velocity"].latency == 0.2
    with pytest.raises(ValueError, match="less than an epoch"):
        simulate(KEYS[0], ROUND._replace(gnss=ROUND.gnss._replace(latency_s=1.0)))


def test_any_shape_can_be_simulated():
    # the scenario's motion does not matter then, and neither does that of others
    own = quick(partial(simulate_shape, scenario=ROUND, shape=shape_of(KEYS[0], Static(), 20.0)))(KEYS[0])
    named = quick(partial(simulate, scenario=ROUND._replace(motion=Static())))(KEYS[0])
    chex.assert_trees_all_equal(own, named)


def test_an_alignment_is_not_part_of_the_recording():
    aligned = ROUND._replace(motion=Static(), start=START_OF._replace(alignment_s=5.0))
    sim = quick(partial(simulate, scenario=aligned))(KEYS[0])
    rec = to_recording(sim, aligned)
    packed = pack(rec.imu, rec.aiding, 1.0)
    np.testing.assert_allclose(packed.t, sim.truth.t, atol=1e-9)
    assert packed.start == pytest.approx(5.0) and rec.truth.t[0] == 5.0 and rec.imu.t[0] == pytest.approx(5.04)


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
