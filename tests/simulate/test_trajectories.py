"""Trajectories: closed forms, exact quadrature, smoothness, what a car does, and a spline through a real track."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import io
from jaxnav.filters.compiler import enable_x64
from jaxnav.maths import earth, rotations, units
from jaxnav.simulate import imu
from jaxnav.simulate.trajectories import (
    NODES,
    WEIGHTS,
    Circle,
    LaunchMove,
    Motion,
    SShape,
    Static,
    Straight,
    Urban,
    Waypoints,
    recorded,
    shape_of,
    travel,
    urban,
)
from jaxnav.simulate.trajectories.pieces import BUMP_MEAN, BUMP_PEAK, PEAK, bump, bump_area, step, step_area
from jaxnav.simulate.trajectories.quadrature import _integrate, partial_weights
from jaxnav.types import DataError

enable_x64()
START = np.array([48.0 * units.DEG, 11.0 * units.DEG, 500.0])
KEY = jax.random.key(3)
quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})  # what runs once need not be fast
where = lambda point: point.lla


def flying(t):
    """Fast, with every rate and acceleration at work; closed form."""
    vel = jnp.stack([150 + 30 * jnp.sin(0.2 * t), -80 * jnp.cos(0.15 * t), 10 * jnp.sin(0.1 * t)])
    return Motion(vel, jnp.stack([0.6 * jnp.sin(0.3 * t), 0.3 * jnp.cos(0.2 * t), 0.5 * t]))


def watched(shape, t):
    """Motion and its rate at times (n,)."""
    return quick(jax.vmap(lambda t: jax.jvp(shape, (t,), (jnp.ones_like(t),))))(jnp.asarray(t, float))


def slope(a, dt):
    """Central differences of fourth order, (n - 4, ...)."""
    return (a[:-4] - 8 * a[1:-3] + 8 * a[3:-1] - a[4:]) / (12 * dt)


# ---------------------------------------------------------------------------- quadrature


def test_quadrature_is_exact_for_polynomials():
    t = 0.5 * (np.arange(4)[:, None] + NODES)
    for power, exact_inside in ((2, True), (5, False)):  # collocation of three points; at the edges order 6
        inside, edges = _integrate(jnp.asarray(t**power), 0.5)
        np.testing.assert_allclose(edges, (0.5 * np.arange(5)) ** (power + 1) / (power + 1), atol=1e-12)
        if exact_inside:
            np.testing.assert_allclose(inside, t ** (power + 1) / (power + 1), atol=1e-12)
    np.testing.assert_allclose(partial_weights(1.0), WEIGHTS, atol=1e-15)


def in_inertial_axes(p):
    """Position m, gravitation m/s^2 and body axes of a point in axes that do not turn."""
    turn = rotations.to_dcm(rotations.exp(jnp.array([0, 0, earth.RATE]) * p.t))
    up = earth.axes(p.lla[0], p.lla[1])[:, 2]
    r = earth.lla_to_ecef(p.lla)
    gravitation = -earth.gravity(p.lla[0], p.lla[2]) * up - earth.RATE**2 * r * np.array([1, 1, 0])
    C = earth.axes(p.lla[0], p.lla[1]) @ rotations.from_rph(p.rph)
    return turn @ r, turn @ gravitation, turn @ C


@pytest.mark.parametrize("shape", [flying, urban(KEY, 100.0, 10.0, traffic=0.5)], ids=["flying", "urban"])
def test_position_velocity_and_imu_are_derivatives(shape):
    # by another road: differences of positions and attitudes in inertial axes
    dt = 0.02
    way = quick(lambda: travel(shape, START, dt, 1, 3000, imu.sense))()
    ends, (omega, force) = way.ends
    v_e = slope(np.asarray(jax.vmap(earth.lla_to_ecef)(ends.lla)), dt)
    v_n = jax.vmap(lambda lla, v: earth.axes(lla[0], lla[1]).T @ v)(ends.lla[2:-2], v_e)
    np.testing.assert_allclose(v_n, ends.vel[2:-2], atol=2e-6)

    r, gravitation, C = (np.asarray(a) for a in quick(jax.vmap(in_inertial_axes))(ends))
    f = np.einsum("tji,tj->ti", C[4:-4], slope(slope(r, dt), dt) - gravitation[4:-4])
    np.testing.assert_allclose(force[4:-4], f, atol=1e-4)
    W = np.einsum("tji,tjk->tik", C[2:-2], slope(C, dt))
    np.testing.assert_allclose(omega[2:-2], np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], 1), atol=1e-5)


def test_samples_are_means_and_memory_does_not_matter():
    fine, coarse = (
        quick(lambda dt=dt, k=k, n=n: travel(flying, START, dt, k, n, imu.sense))()
        for dt, k, n in ((0.01, 50, 10), (0.05, 5, 20))
    )
    for a, b, atol in zip(fine.means, coarse.means, (1e-12, 1e-9), strict=True):
        np.testing.assert_allclose(b.reshape(-1, 3), a.reshape(-1, 5, 3).mean(1), atol=atol)
    np.testing.assert_allclose(coarse.ends[0].lla[1::2], fine.ends[0].lla, rtol=1e-14)
    np.testing.assert_allclose(fine.ends[0].t, 0.5 * np.arange(1, 11), atol=1e-12)


def test_late_points_are_where_the_vehicle_was():
    # 0.123 s before the end of epochs of 0.5 s, against a grid that hits these times
    late, grid = (
        quick(lambda a=a: travel(flying, START, *a))() for a in ((0.05, 10, 4, where, 0.123), (0.001, 1, 2000, where))
    )
    (late, lla), grid = late.late, jax.tree.map(lambda a: a[500 - 123 - 1 :: 500], grid.ends[0])
    assert np.abs(late.t - grid.t).max() < 1e-12
    assert np.abs(jax.vmap(earth.enu_difference)(lla, grid.lla)).max() < 1e-6  # m, at 200 m/s
    np.testing.assert_allclose(late.vel, grid.vel, atol=1e-9)
    np.testing.assert_array_equal(late.lla, lla)
    with pytest.raises(ValueError, match="less than an epoch"):
        travel(flying, START, 0.05, 10, 4, where, 0.5)


# ---------------------------------------------------------------------------- closed forms


def test_static_straight_and_circle():
    t = np.array([0.0, 7.0, 126.0])
    still, rate = watched(shape_of(KEY, Static((1.0, 2.0, 3.0)), 1.0), t)
    np.testing.assert_allclose(still.rph / units.DEG, np.tile([1.0, 2.0, 3.0], (3, 1)))
    assert not still.vel.any() and not any(leaf.any() for leaf in rate)
    climb, _ = watched(shape_of(KEY, Straight(20.0, 90.0, 30.0), 1.0), t)
    np.testing.assert_allclose(climb.vel, np.tile([20 * np.cos(np.pi / 6), 0, 10], (3, 1)), atol=1e-12)
    np.testing.assert_allclose(climb.rph[0], [0, np.pi / 6, np.pi / 2])
    round_, rate = watched(shape_of(KEY, Circle(10.0, 126.0, 90.0, banked=True), 1.0), t)
    w = 2 * np.pi / 126
    np.testing.assert_allclose(round_.vel[0], [10, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rate.vel[0], [0, -10 * w, 0], atol=1e-12)  # clockwise: to the right, south
    np.testing.assert_allclose(np.tan(round_.rph[:, 0]) * units.G0, 10 * w)  # balanced: right wing down
    np.testing.assert_allclose(round_.vel[2], round_.vel[0], atol=1e-12)  # a whole turn


def test_a_banked_turn_is_felt_along_the_bodys_down_axis():
    shape = shape_of(KEY, Circle(50.0, 60.0, banked=True), 1.0)
    _, force = quick(lambda: travel(shape, START, 0.1, 10, 3, imu.sense))().ends[1]
    # standard gravity for the local one, and the Earth's rotation: 2 w v = 7e-3
    assert np.abs(force[:, 1]).max() < 0.02 and force[:, 2].max() < -10


def test_a_small_circle_closes_and_a_snake_comes_back_to_its_line():
    lla = quick(lambda: travel(shape_of(KEY, Circle(), 1.0), START, 1.0, 63, 2, where))().ends[1]
    half, full = (np.asarray(earth.enu_difference(p, jnp.asarray(START))) for p in lla)
    np.testing.assert_allclose(half, [2 * 10 * 126 / (2 * np.pi), 0, 0], atol=0.02)  # opposite, to the right
    assert np.abs(full).max() < 0.03  # ENU turns with the meridians
    snake = shape_of(KEY, SShape(10.0, 60.0, 60.0), 1.0)
    motion, rate = watched(snake, np.linspace(0, 60, 241))
    np.testing.assert_allclose(np.linalg.norm(motion.vel, axis=1), 10)
    assert np.abs(motion.rph[:, 2]).max() == pytest.approx(60 * units.DEG)
    assert rate.rph[:, 2].max() == pytest.approx(60 * units.DEG * 2 * np.pi / 60)
    banked, rate = watched(shape_of(KEY, SShape(10.0, 60.0, 60.0, banked=True), 1.0), np.linspace(0, 60, 241))
    np.testing.assert_allclose(np.tan(banked.rph[:, 0]) * units.G0, 10 * rate.rph[:, 2], atol=1e-12)  # balanced
    east = quick(lambda: travel(snake, START, 0.5, 30, 4, where))().ends[1][:, 1] - START[1]
    assert abs(east[-1]) < 1e-3 * abs(east[0])  # after a whole period


def test_launch_move_is_the_papers_equation_33():
    tau = np.array([0.0, 3.0, 11.0, 20.0])
    move = shape_of(KEY, LaunchMove(), 40.0)
    motion, rate = watched(move, 20 + tau)
    c = 20 / np.pi
    np.testing.assert_allclose(motion.vel[:, 1], 1.5 * (tau - c * np.sin(tau / c)), atol=1e-12)
    np.testing.assert_allclose(rate.vel[:, 1], 3 * np.sin(tau / (2 * c)) ** 2, atol=1e-12)
    assert motion.vel[-1, 1] == pytest.approx(30.0) and not np.abs(motion.vel[:, [0, 2]]).any()
    way = quick(lambda: travel(move, START, 0.1, 100, 4, where))().ends[1]
    r = 3 * (tau[-1] ** 2 / 4 - c**2 * np.sin(tau[-1] / (2 * c)) ** 2)
    # metres per radian at the start differ by 1e-6 from those on the way
    assert float(earth.enu_difference(way[-1], jnp.asarray(START))[1]) == pytest.approx(r, rel=1e-5)
    assert r == pytest.approx(178.4, abs=0.05) and not (way[1] - START).any()
    motion, rate = watched(move, [5.0, 60.0, 70.0])
    np.testing.assert_allclose(motion.vel[:, 1], [0, 60, 60], atol=1e-12)
    np.testing.assert_allclose(rate.vel, 0, atol=1e-12)


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (Circle(10.0, 0.0), "period_s must not be 0"),
        (SShape(period_s=-1.0), "period_s must be positive"),
        (Waypoints(points_m=((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))), "three points"),
        (Waypoints(speeds_mps=(0.0, 0.0, 1.0)), "two points in a row"),
        (Waypoints(speeds_mps=(1.0, 1.0)), "must have 3 values"),
        (Waypoints(waits_s=(0.0, 5.0, 0.0)), "does not stop"),
        (Waypoints(points_m=((0.0, 0.0, 0.0),) * 3), "are the same"),
        ("circle", "motion must be one of Static, Straight, Circle"),
    ],
)
def test_motions_that_make_no_shape(motion, words):
    with pytest.raises(ValueError, match=words):
        shape_of(KEY, motion, 10.0)


# ---------------------------------------------------------------------------- routes and drives


def test_smooth_pieces_rise_by_one_within_their_rate():
    u = np.linspace(0, 1, 2001)
    for f, area, mean, peak in ((step, step_area, 0.5, PEAK), (bump, bump_area, BUMP_MEAN, BUMP_PEAK)):
        rate = jax.vmap(jax.grad(f))(u)
        np.testing.assert_allclose(jax.vmap(jax.grad(area))(u), f(u), atol=1e-12)
        assert float(area(1.0)) == pytest.approx(mean) and 0.99 * peak < np.abs(rate).max() <= peak * (1 + 1e-12)


def test_waypoints_are_passed_at_their_speeds():
    points = ((0.0, 0.0, 0.0), (0.0, 100.0, 2.0), (80.0, 180.0, 5.0), (200.0, 150.0, 0.0), (260.0, 60.0, 0.0))
    route = Waypoints(points, (0.0, 8.0, 12.0, 0.0, 6.0), (3.0, 0.0, 0.0, 4.0, 0.0))
    shape = shape_of(KEY, route, 1.0)
    t = 0.05 * np.arange(1, 2401)
    point, _ = quick(lambda: travel(shape, START, 0.05, 1, 2400, where))().ends
    at = np.asarray(jax.vmap(earth.enu_difference)(point.lla, jnp.broadcast_to(START, point.lla.shape)))
    for place, speed in zip(points[1:], route.speeds_mps[1:], strict=True):
        i = np.argmin(np.linalg.norm(at - place, axis=1))
        assert np.linalg.norm(at[i] - place) < 0.32  # half a sample at 12 m/s, and 1e-4 of the way by the map
        assert np.linalg.norm(point.vel[i]) == pytest.approx(speed, abs=0.15)
    speed = np.linalg.norm(point.vel, axis=1)
    assert (speed[t <= 3] == 0).all() and abs((speed < 1e-9).sum() * 0.05 - 7) < 0.5  # two waits
    motion, rate = watched(shape, t)
    moving = speed > 0.1
    course = np.arctan2(motion.vel[:, 0], motion.vel[:, 1])
    np.testing.assert_allclose(motion.rph[moving, 2], course[moving], atol=1e-9)
    jump = np.abs(np.diff(rate.vel, axis=0)).max(), np.abs(np.diff(rate.rph, axis=0)).max()
    assert jump[0] < 0.35 and jump[1] < 0.05  # acceleration and turn rate are continuous
    assert np.linalg.norm(motion.vel[-1]) == pytest.approx(6.0)  # it goes on


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


def test_traffic_is_stop_and_go():
    def speeds(traffic):
        def one(key):
            shape, t = shape_of(key, Urban(20.0, 20.0, traffic), 300.0), 0.2 * jnp.arange(1501.0)
            return jnp.linalg.norm(jax.vmap(shape)(t).vel, axis=-1)

        return np.asarray(quick(jax.vmap(one))(jax.random.split(jax.random.key(1), 24)))

    free, jam = speeds(0.0), speeds(1.0)
    starts = [((v[:, :-1] < 1e-9) & (v[:, 1:] >= 1e-9)).sum(1).mean() for v in (free, jam)]
    assert starts[1] > 2 * starts[0]
    accel = np.diff(jam, axis=1) / 0.2
    assert jam.min() >= 0 and accel.min() > -2.6 and accel.max() < 1.9
    crawl = (jam > 0.3) & (jam < 4.0)  # the spurts of a queue
    assert crawl.mean() > 2 * ((free > 0.3) & (free < 4.0)).mean()


def test_drives_are_differentiable():
    def end(speed_max):
        return (
            travel(urban(jax.random.key(4), 60.0, 2.0, speed_max), START, 0.1, 10, 60, where).ends[1][-1, :2] * earth.A
        )

    derivative = quick(jax.jacfwd(end))(15.0)
    at = quick(end)
    numeric = (at(15.0 + 1e-4) - at(15.0 - 1e-4)) / 2e-4
    assert np.abs(numeric).max() > 1
    np.testing.assert_allclose(derivative, numeric, rtol=1e-4, atol=1e-3)


# ---------------------------------------------------------------------------- recorded


def noisy_track(sd):
    """A drive at 1 Hz for 120 s as positions with noise, and the drive."""
    shape = urban(jax.random.key(8), 120.0, 10.0)
    way, _ = quick(lambda: travel(shape, START, 0.1, 10, 120, where))().ends
    lla = np.concatenate([START[None], way.lla])
    noise = sd * np.random.default_rng(0).normal(size=lla.shape)
    return np.arange(121.0), lla + noise / np.asarray(earth.metres_per_radian(jnp.asarray(START))), shape


def test_a_spline_follows_a_track_that_is_known():
    t, lla, shape = noisy_track(0.01)
    track = recorded(t + 1e5, lla, 0.01)
    assert track.duration_s == 120 and np.allclose(np.array(track.start_deg_m[:2]) * units.DEG, START[:2], atol=1e-8)
    fine = np.arange(1.0, 119.0, 0.05)
    (motion, rate), (true, _) = watched(track.shape, fine), watched(shape, fine)
    assert np.sqrt(np.mean((motion.vel - true.vel) ** 2)) < 0.1
    fast = np.linalg.norm(true.vel, axis=1) > 3
    heading = (np.asarray(motion.rph[:, 2] - true.rph[:, 2])[fast] + np.pi) % (2 * np.pi) - np.pi
    assert np.sqrt(np.mean(heading**2)) < 3 * units.DEG
    # C2: what acceleration and turn rate do between two points is what their own rate says
    for value in (np.asarray(rate.vel), np.asarray(rate.rph)):
        step, bend = np.abs(np.diff(value, axis=0)).max(), np.abs(np.diff(value, 2, axis=0)).max()
        assert bend < 0.25 * step
    own = np.asarray(quick(lambda: travel(track.shape, lla[0], 0.1, 10, 120, where))().ends[1])
    off = np.asarray(jax.vmap(earth.enu_difference)(own, jnp.asarray(lla[1:])))
    assert np.sqrt(np.mean(off**2)) < 0.03

    rph = np.stack([0.1 * np.sin(t / 9), 0.05 * np.cos(t / 7), t / 11], 1)
    given = recorded(t, lla, np.full(t.size, 0.01), rph)
    for i in (7, 60, 101):
        np.testing.assert_allclose(given.shape(t[i]).rph, rph[i], atol=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t, lla: (t[:5], lla[:5]), "10 rows"),
        (lambda t, lla: (t[::-1], lla), "must increase"),
        (lambda t, lla: (t, np.where(t[:, None] == 3, np.nan, lla)), "finite"),
        (lambda t, lla: (t, np.tile(lla[:1], (t.size, 1))), "never faster"),
    ],
)
def test_tracks_that_cannot_be_followed(change, words):
    t = np.arange(30.0)
    with pytest.raises(DataError, match=words):
        recorded(*change(t, START + np.outer(t, [1e-6, 0, 0])))


def test_the_recorded_hour(data_dir):
    samples = io.read_rtk_track(data_dir / "leador_rtk_track" / "GNSS-RTK.txt")
    cut = slice(0, 900)
    track = recorded(samples.t[cut], samples.value[cut], samples.sd[cut])
    motion, rate = watched(track.shape, np.arange(0, 899.0, 0.1))
    speed = np.linalg.norm(motion.vel[:, :2], axis=1)
    assert 8 < speed.max() < 20 and np.abs(rate.vel).max() < 4 and np.abs(rate.rph).max() < 40 * units.DEG
    still = speed < 0.05
    assert np.abs(np.asarray(rate.rph)[still]).max() < 1 * units.DEG  # noise turns nobody who stands
    start = np.array(track.start_deg_m) * [units.DEG, units.DEG, 1.0]
    lla = quick(lambda: travel(track.shape, start, 0.1, 10, 899, where))().ends[1]
    off = np.asarray(jax.vmap(earth.enu_difference)(lla, jnp.asarray(samples.value[1:900])))
    assert (off.std(0) < [0.02, 0.02, 0.05]).all()
