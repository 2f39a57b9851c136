"""Strapdown navigation against python-ins' exact increments and its own bars, and against closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from pyins import sim
from scipy.spatial.transform import Rotation

from jaxnav.filters.run import initial_nav, track
from jaxnav.maths import components, earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.strapdown import local_level as plain
from jaxnav.strapdown.fast import local_level
from jaxnav.strapdown.increments import increments, thin
from jaxnav.types import Forcing, Imu
from tests.conftest import leaves_equal, simulate_drive, start

propagate = jax.jit(local_level.propagate)


def navigate(frame, imu):
    """Errors of inertial navigation against a python-ins trajectory: NED m, NED m/s, roll pitch heading deg."""
    values = frame[["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]].to_numpy()
    lla, ned, rph = values[:, :3] * [DEG, DEG, 1], values[:, 3:6], values[:, 6:] * DEG
    dt = np.diff(frame.index)
    readings = imu.to_numpy()[1:] / dt[:, None]
    nav = initial_nav(lla[0], ned[0, [1, 0, 2]] * [1, 1, -1], rph[0])
    path = propagate(nav, None, Imu(dt, readings[:, :3], readings[:, 3:]))[1].nav
    solution = track(path)
    position = np.asarray(jax.vmap(earth.enu_difference)(path.pos, lla[1:]))
    turn = np.remainder(solution.rph - rph[1:] + np.pi, 2 * np.pi) - np.pi
    swap, sign = [1, 0, 2], [1, 1, -1]
    return position[:, swap] * sign, solution.vel[:, swap] * sign - ned[1:], turn / DEG


def assert_below(errors, bounds):
    for name, e, bound in zip(("position", "velocity", "attitude"), errors, bounds, strict=True):
        worst = np.abs(e).max(0)
        assert (worst < bound).all(), f"{name}: {worst} is not below {bound}"


@pytest.mark.full
def test_an_hour_of_sine_motion_within_the_bars_of_pyins():
    motion = sim.generate_sine_velocity_motion(
        0.01, 3600, [55, 37, 1500], [5, -3, 0.2], velocity_change_amplitude=1, sensor_type="increment"
    )
    bars = ([0.1, 0.1, 3], [1e-3, 1e-3, 1e-2], [1e-6, 1e-6, 1e-5])
    assert_below(navigate(*motion), bars)


def test_the_block_form_has_the_derivative_of_the_scan():
    """Though its first sweeps are not differentiated: what ENU's turn does is there to second order."""
    imu, truth = simulate_drive(1.0, lla0=(75.0, 12.0, 9000.0))
    imu = Imu(imu.dt, jnp.asarray(imu.gyro), jnp.asarray(imu.accel))

    def end(form, x):
        nav = start(truth)
        nav = nav._replace(vel=nav.vel + 200.0 + x[:3], errors={"gyro_bias": x[3:6], "accel_bias": x[6:]})
        last = form(nav, None, imu)[0]
        return jnp.concatenate([last.vel, last.q])

    fast, slow = (
        jax.jit(jax.jacrev(partial(end, form)))(jnp.zeros(9)) for form in (local_level.propagate, plain.propagate)
    )
    assert np.abs(fast[:3, :3] - np.eye(3)).max() > 1e-4  # Coriolis
    np.testing.assert_allclose(fast, slow, rtol=0, atol=5e-6)


def test_an_hour_at_rest_within_the_bars_of_pyins():
    t = np.arange(36000) * 0.1
    rph = np.tile([-5.0, 10.0, 110.0], (t.size, 1))
    motion = sim.generate_imu(t, np.tile([55.0, 37.0, 150.0], (t.size, 1)), rph, sensor_type="increment")
    assert_below(navigate(*motion), ([1e-3, 1e-3, 1e-2], [1e-6, 1e-6, 1e-5], [1e-8] * 3))


def test_halving_the_step_cuts_the_error_fourfold():
    def error(rate):
        imu, truth = simulate_drive(20.0, rate)
        nav = propagate(start(truth), None, Imu(imu.dt, imu.gyro, imu.accel))[0]
        return np.linalg.norm(earth.enu_difference(nav.pos, truth.lla[-1])), np.linalg.norm(nav.vel - truth.vel[-1])

    coarse, fine = error(10.0), error(20.0)
    assert coarse[0] < 0.02  # and small to begin with
    assert coarse[0] / fine[0] > 3.5 and coarse[1] / fine[1] > 3.5


def test_coning_correction_cuts_the_drift():
    """Classical coning, half-angle 2 deg at 2 Hz sampled at 50 Hz: exact gyro increments, rotation in closed form."""
    a, w, dt, n = 2 * DEG, 2 * np.pi * 2, 0.02, 500
    edges = np.arange(n + 1) * dt

    # body rate of the cone q = [cos(a/2), 0, sin(a/2) cos wt, sin(a/2) sin wt], integrated over each sample
    def integral(t):
        return np.stack([-2 * w * np.sin(a / 2) ** 2 * t, np.sin(a) * np.cos(w * t), np.sin(a) * np.sin(w * t)], 1)

    gyro = np.diff(integral(edges), axis=0) / dt
    truth = Rotation.from_rotvec(a * np.stack([0 * edges, np.cos(w * edges), np.sin(w * edges)], 1))
    before = np.diff(integral(np.array([-dt, 0.0])), axis=0)[0] / dt
    nav = initial_nav([0.5, 0.0, 0.0])._replace(omega=jnp.asarray(before))
    made = increments(nav, Imu(jnp.full(n, dt), jnp.asarray(gyro), jnp.zeros((n, 3))))

    def drift(theta):
        R = truth[0]
        for turn in Rotation.from_rotvec(np.array(theta)):
            R = R * turn
        return (truth[-1].inv() * R).magnitude()

    assert drift(gyro * dt) > 1e-4
    assert drift(gyro * dt) / drift(np.stack(made.theta, 1)) > 50


def test_sculling_correction_cuts_the_velocity_error():
    """Rocking about x in phase with thrust along y: the mean push along z that uncorrected increments miss."""
    a, b, w, dt, n = 0.05, 3.0, 2 * np.pi * 2, 0.02, 500
    t = np.arange(-1, n + 1) * dt
    angle = a * np.sin(w * t)
    gyro = np.stack([np.diff(angle) / dt, 0 * t[1:], 0 * t[1:]], 1)
    accel = np.stack([0 * t[1:], np.diff(-b / w * np.cos(w * t)) / dt, 0 * t[1:]], 1)  # f_y = b sin wt
    fine = (np.arange(n * 400) + 0.5) * dt / 400  # the exact integral of C f
    exact = np.mean(b * np.sin(w * fine) * np.sin(a * np.sin(w * fine)))  # z component
    nav = initial_nav([0.5, 0.0, 0.0])._replace(omega=jnp.asarray(gyro[0]), force=jnp.asarray(accel[0]))
    made = increments(nav, Imu(jnp.full(n, dt), jnp.asarray(gyro[1:]), jnp.asarray(accel[1:])))
    s, c = np.sin(angle[1:-1]), np.cos(angle[1:-1])
    push = lambda dv: np.mean(s * dv[:, 1] + c * dv[:, 2]) / dt
    rotated = accel[1:] * dt + 0.5 * np.cross(gyro[1:] * dt, accel[1:] * dt)
    assert abs(push(accel[1:] * dt) - exact) > 5e-4
    assert abs(push(accel[1:] * dt) - exact) / abs(push(np.stack(made.dv, 1)) - exact) > 50
    assert abs(push(rotated) - exact) / abs(push(np.stack(made.dv, 1)) - exact) > 10


@pytest.fixture(scope="module")
def resting():
    """At rest, level, heading 30 deg: nav and a sample that keeps it there."""
    nav = initial_nav([0.3, 0.4, 100.0], rph=[0.02, -0.01, 30 * DEG])
    C = rotations.to_dcm(nav.q)
    gyro = C.T @ earth.earth_rate(nav.pos[0])
    accel = C.T @ jnp.array([0.0, 0.0, 1.0]) * earth.gravity(nav.pos[0], nav.pos[2])
    return nav, gyro, accel


def samples(gyro, accel, dt, n):
    return Imu(jnp.full(n, dt), jnp.tile(gyro, (n, 1)), jnp.tile(accel, (n, 1)))


def test_at_rest_stays_at_rest_and_biases_are_subtracted(resting):
    nav, gyro, accel = resting
    b_g, b_a = jnp.array([1e-3, -2e-3, 3e-3]), jnp.array([0.1, 0.2, -0.3])
    out = propagate(
        nav._replace(errors={"gyro_bias": b_g, "accel_bias": b_a}), None, samples(gyro + b_g, accel + b_a, 0.1, 100)
    )[0]
    np.testing.assert_allclose(out.vel, 0, atol=1e-8)
    np.testing.assert_allclose(out.pos, nav.pos, atol=1e-8)
    np.testing.assert_allclose(out.q, nav.q, atol=1e-11)
    np.testing.assert_allclose(out.omega, gyro, atol=1e-17)
    np.testing.assert_allclose(out.force, accel, atol=1e-14)
    assert out.t == pytest.approx(10.0, abs=1e-12)


def test_observer_drive_has_the_stated_signs(resting):
    nav, gyro, accel = resting
    imu = samples(gyro, accel, 0.1, 100)
    spin, push = np.array([1e-4, -2e-4, 3e-4]), np.array([1e-3, 2e-3, -3e-3])
    pushed = propagate(nav, Forcing(np.zeros(3), push), imu)[0]
    coriolis = 2 * earth.RATE * 0.04 * 10 / 2
    np.testing.assert_allclose(pushed.vel, 10 * push, rtol=0, atol=coriolis)
    np.testing.assert_allclose(earth.enu_difference(pushed.pos, nav.pos), 50 * push, rtol=0, atol=10 * coriolis)
    spun = propagate(nav, Forcing(spin, np.zeros(3)), imu)[0]
    turn = rotations.log(rotations.multiply(spun.q, rotations.conjugate(nav.q)))
    np.testing.assert_allclose(turn, 10 * spin, rtol=0, atol=4e-6)  # its axes are those at the start


def test_schuler_period():
    """At the equator a velocity error north swings at sqrt(g / R), undisturbed by Foucault's coupling."""
    nav = initial_nav([0.0, 0.0, 0.0], vel=[0.0, 0.1, 0.0])
    C = rotations.to_dcm(nav.q)
    g = earth.gravity(0.0, 0.0)
    imu = samples(C.T @ earth.earth_rate(jnp.array(0.0)), C.T @ jnp.array([0, 0, g]), 1.0, 5000)
    path = propagate(nav, None, imu)[1].nav
    v, t = np.asarray(path.vel[:, 1]), np.asarray(path.t)
    i = np.flatnonzero(np.diff(np.sign(v)))
    crossings = t[i] + v[i] / (v[i] - v[i + 1])
    period = 2 * np.pi * np.sqrt(earth.radii(0.0)[0] / g)
    assert 84.0 < period / 60 < 84.6
    np.testing.assert_allclose(crossings, [period / 4, 3 * period / 4], rtol=5e-3)


def test_padding_changes_nothing(case):
    imu = jax.tree.map(lambda a: a[4], case.packed.epochs.imu)
    pad = lambda a: jnp.concatenate([a, jnp.broadcast_to(a[-1], (27, *a.shape[1:]))])
    padded = Imu(jnp.concatenate([imu.dt, jnp.zeros(27)]), pad(imu.gyro), pad(imu.accel))
    u = Forcing(np.array([1e-5, 0, 2e-5]), np.array([1e-3, 0, 0]))
    # start past the first sample of a run: its rates are in the state, as within a run
    nav = propagate(case.nav, u, jax.tree.map(lambda a: a[3], case.packed.epochs.imu))[0]
    plain, filled = propagate(nav, u, imu)[0], propagate(nav, u, padded)[0]
    # a unit quaternion that is normalised remat may move by its last bit; everything else is the same bit for bit
    np.testing.assert_allclose(plain.q, filled.q, rtol=0, atol=2.3e-16)
    jax.tree.map(np.testing.assert_array_equal, plain._replace(q=nav.q), filled._replace(q=nav.q))


def test_path_is_the_time_series_of_the_state(case):
    imu = jax.tree.map(lambda a: a[0], case.packed.epochs.imu)
    nav, path = propagate(case.nav, None, imu)
    leaves_equal(nav, jax.tree.map(lambda a: a[-1], path.nav), 1e-14, 1e-14)
    first = propagate(case.nav, None, jax.tree.map(lambda a: a[:7], imu))[0]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[6], rtol=1e-14, atol=1e-14), first, path.nav)
    # the specific force in ENU is what changes the velocity, with gravity and Coriolis
    lla, vel = path.nav.pos[0], 0.5 * (case.nav.vel + path.nav.vel[0])
    w = 2 * earth.earth_rate(lla[0]) + earth.transport_rate(lla[0], lla[2], vel)
    down = jnp.array([0, 0, -earth.gravity(lla[0], lla[2])])
    expected = (path.nav.vel[0] - case.nav.vel) / imu.dt[0] - down + jnp.cross(w, vel)
    np.testing.assert_allclose(path.force[0], expected, atol=2e-3)


def lively(n, dt, lat, speed):
    """Start and IMU samples of a body that turns and shakes."""
    rng = np.random.default_rng(5)
    t = np.arange(n)[:, None] * dt
    gyro = 0.3 * np.sin(3 * t + rng.uniform(0, 6, 3)) + 0.02 * rng.normal(size=(n, 3))
    accel = np.array([0, 0, -9.8]) + 5 * np.sin(2 * t + rng.uniform(0, 6, 3)) + rng.normal(size=(n, 3))
    nav = initial_nav([lat, 0.4, 5000.0], [0.6 * speed, 0.8 * speed, 3.0], [0.1, 0.2, 0.3])
    return nav, Imu(jnp.full(n, dt), jnp.asarray(gyro), jnp.asarray(accel))


ANYWHERE = pytest.mark.parametrize(
    "lat, speed", [(0.6, 25.0), (np.deg2rad(85.0), 300.0)], ids=["car", "arctic_aircraft"]
)


@ANYWHERE
def test_blocks_change_nothing(lat, speed):
    """Samples one by one, with the Earth looked up for each, against a series over 100 of them."""
    n = 250
    nav, imu = lively(n, 0.02, lat, speed)

    one = lambda nav, sample: (local_level.propagate(nav, None, jax.tree.map(lambda a: a[None], sample))[0], None)
    exact = jax.jit(lambda nav: lax.scan(one, nav, imu)[0])(nav)
    for form in (local_level.propagate, plain.propagate):
        end, path = jax.jit(form)(nav, None, imu)
        angle = rotations.log(rotations.multiply(end.q, rotations.conjugate(exact.q)))
        assert np.abs(earth.enu_difference(end.pos, exact.pos)).max() < 1e-6
        assert np.abs(end.vel - exact.vel).max() < 1e-9 and np.abs(angle).max() < 1e-11
        assert path.nav.pos.shape == (n, 3) and path.C.shape == (n, 3, 3)


@pytest.mark.full
@ANYWHERE
@pytest.mark.parametrize("form, n", [(local_level.propagate, 60), (local_level.propagate, 240)])
def test_intervals_of_samples_are_the_samples(form, n, lat, speed):
    """Intervals of 10, the last one half full: states inside them, and the means."""
    nav, imu = lively(n, 0.01, lat, speed)
    imu = imu._replace(dt=imu.dt.at[n - 5 :].set(0.0))
    u = Forcing(np.array([1e-3, -2e-3, 1e-3]), np.array([0.01, 0.02, -0.01]))
    keep = jnp.array([0, 9, 10, 33, n - 7, n - 6])
    exact, path = propagate(nav, u, imu)
    exact = jax.tree.map(lambda a: a[keep], path.nav)
    some, coarse = jax.jit(form, static_argnums=3)(nav, u, imu, 10, keep)
    position = np.abs(jax.vmap(earth.enu_difference)(some.pos, exact.pos)).max()
    turn = jax.vmap(lambda a, b: rotations.log(rotations.multiply(a, rotations.conjugate(b))))(some.q, exact.q)
    # transport and Coriolis see the mean velocity of 0.1 s: of second order in how fast ENU turns and velocity changes
    bound = 1e-6 if speed < 100 else 1e-4
    assert position < bound and np.abs(some.vel - exact.vel).max() < bound and np.abs(turn).max() < 1e-9
    for leaf in ("t", "omega", "force"):
        np.testing.assert_allclose(getattr(some, leaf), getattr(exact, leaf), rtol=1e-14)
    means = thin(path, imu.dt, 10)
    np.testing.assert_allclose(coarse.C, means.C, rtol=0, atol=2e-4)
    np.testing.assert_allclose(coarse.force, means.force, rtol=0, atol=5e-3)


def test_an_interval_of_padding_is_finite_and_at_rest():
    nav, imu = lively(40, 0.01, 0.6, 25.0)
    imu = imu._replace(dt=imu.dt.at[20:].set(0.0))
    end, path = jax.jit(local_level.propagate, static_argnums=3)(nav, None, imu, 10, jnp.array([19, 39]))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((end, path)))
    still = end._replace(omega=end.t, force=end.t)  # but for the readings, which padding has too
    jax.tree.map(lambda a: np.testing.assert_allclose(a[0], a[1], rtol=1e-15), still)


def test_products_of_rotations_have_the_derivative_of_the_loop():
    """In closed form against step by step, both ways; a change of length included."""
    rng = np.random.default_rng(3)
    unit = lambda *shape: tuple((q := rng.normal(size=(4, *shape))) / np.linalg.norm(q, axis=0))
    given = unit(), unit(7)
    d_given = jax.tree.map(lambda a: rng.normal(size=np.shape(a)), given)
    weights = tuple(rng.normal(size=(4, 7)))

    def loop(first, steps):
        q, out = first, []
        for i in range(7):
            q = components.multiply(q, tuple(a[i] for a in steps))
            out.append(q)
        return tuple(jnp.stack(c) for c in zip(*out, strict=True))

    close = partial(jax.tree.map, partial(np.testing.assert_allclose, rtol=0, atol=1e-13))
    close(jax.jvp(components.products, given, d_given), jax.jvp(loop, given, d_given))
    close(jax.vjp(components.products, *given)[1](weights), jax.vjp(loop, *given)[1](weights))
