"""The tangent frame: its axes and gravity, its mechanization against local level, its error model by differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.linalg import block_diag

from jaxnav.filters.catalogue import build
from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import datasheet_params, mounting
from jaxnav.filters.run import initial_nav, run
from jaxnav.maths import earth, rotations
from jaxnav.simulate.imu import sense
from jaxnav.simulate.trajectories import Motion, travel
from jaxnav.states.grades import GRADES
from jaxnav.states.motion import A, P, V
from jaxnav.states.table import BIASES
from jaxnav.strapdown import tangent_frame
from jaxnav.strapdown.errors.tangent_frame import dynamics, enu_rows
from jaxnav.strapdown.fast import local_level
from jaxnav.types import Imu, Origin
from tests.conftest import leaves_equal, simulate_drive, start

PARAMS = datasheet_params(GRADES["adis16465"])
SIZES = np.repeat([10.0, 1.0, 1e-3, 1e-4, 1e-2], 3)
MODEL = error_model("tangent")
G, B = slice(9, 12), slice(12, 15)
propagate = jax.jit(tangent_frame.propagate)
navigate_enu = jax.jit(local_level.propagate)
enter, leave = jax.jit(tangent_frame.enter), jax.jit(tangent_frame.leave)


def origin(lat=0.7, lon=-1.2, azimuth=0.6):
    return Origin(jnp.array([lat, lon, 300.0]), jnp.asarray(azimuth), jnp.zeros(()))


def a_nav(seed=0):
    """Two kilometres from its origin, fast and turned."""
    rng = np.random.default_rng(seed)
    nav = initial_nav([0.8, -1.3, 900.0], [60.0, -45.0, 5.0], [0.2, -0.3, 2.0], t=3.0, azimuth=0.6)
    draw = lambda scale: jnp.asarray(rng.normal(size=3) * scale)
    nav = nav._replace(pos=earth.move(nav.pos, jnp.array([1500.0, -1200.0, 80.0])))
    return nav._replace(
        errors={"gyro_bias": draw(1e-3), "accel_bias": draw(0.1)},
        omega=draw(0.1),
        force=draw(1.0) - jnp.array([0, 0, 9.8]),
    )


# ------------------------------------------------------------------------------------------------ axes and gravity


def test_the_earths_rate_in_the_frame_is_equation_20():
    for at in (origin(), origin(-0.3, 2.0, -2.5), origin(1.2, 0.0, 0.0)):
        w = tangent_frame.from_ecef(at) @ jnp.array([0.0, 0.0, earth.RATE])
        np.testing.assert_allclose(w, tangent_frame.earth_rate(at), rtol=0, atol=3e-20)


def test_axes_are_at_the_azimuth_up_and_to_the_right():
    east, north, up = np.eye(3)
    C = np.asarray(tangent_frame.from_enu(jnp.asarray(0.5)))
    np.testing.assert_allclose(C @ (np.sin(0.5) * east + np.cos(0.5) * north), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(C @ up, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(C @ (np.cos(0.5) * east - np.sin(0.5) * north), [0, 0, 1], atol=1e-15)
    assert np.linalg.det(C) == pytest.approx(1.0)


@pytest.mark.parametrize("height", [-400.0, 0.0, 12e3])
def test_gravity_is_the_projects_down_the_normal(height):
    @jax.vmap
    def both(lla):
        up = earth.axes(lla[0], lla[1])[:, 2]
        return tangent_frame.gravity(earth.lla_to_ecef(lla)), -earth.gravity(lla[0], lla[2]) * up

    lat = np.array([-1.5, -0.8, 0.0, 0.3, 1.1, 1.55])
    found, expected = both(jnp.stack([lat, lat - 2.0, np.full(6, height)], 1))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_entering_and_leaving_are_inverse_and_metric():
    nav = a_nav()
    there = enter(nav)
    back = leave(there)
    np.testing.assert_allclose(earth.enu_difference(back.pos, nav.pos), 0, atol=5e-9)
    np.testing.assert_allclose(back.vel, nav.vel, atol=1e-12)
    turn = rotations.log(rotations.multiply(back.q, rotations.conjugate(nav.q)))
    np.testing.assert_allclose(turn, 0, atol=1e-14)
    # lengths are kept, and near the origin the axes are those of `from_enu`
    chord = np.linalg.norm(earth.lla_to_ecef(nav.pos) - earth.lla_to_ecef(nav.origin.lla))
    assert np.linalg.norm(there.pos) == pytest.approx(chord, rel=1e-12)
    C = tangent_frame.from_enu(nav.origin.azimuth)
    near = nav._replace(pos=earth.move(nav.origin.lla, jnp.array([3.0, 4.0, 2.0])))
    np.testing.assert_allclose(enter(near).pos, C @ jnp.array([3.0, 4.0, 2.0]), atol=1e-5)
    np.testing.assert_allclose(enter(near).vel, C @ nav.vel, atol=1e-4)
    np.testing.assert_allclose(rotations.to_dcm(enter(near).q), C @ rotations.to_dcm(nav.q), atol=2e-6)


# ------------------------------------------------------------------------------------------------ mechanization


def winding(climb):
    """A drive that winds and, with ``climb`` in m/s, goes up and down; 5 km from its start after ten minutes."""

    def shape(t):
        speed = 10 + 4 * jnp.sin(2 * jnp.pi * t / 50)
        heading = 0.7 + 0.8 * jnp.sin(2 * jnp.pi * t / 80) + 0.1 * jnp.sin(2 * jnp.pi * t / 13)
        rph = jnp.stack([0.05 * jnp.sin(2 * jnp.pi * t / 9), 0.03 * jnp.sin(2 * jnp.pi * t / 13), heading])
        up = climb * jnp.sin(2 * jnp.pi * t / 300)
        return Motion(jnp.stack([speed * jnp.sin(heading), speed * jnp.cos(heading), up]), rph)

    return shape


def both(nav, imu, truth):
    """Both mechanizations on one stream: ENU m and rad between them, and ENU m of each to the true position."""
    level, tangent = navigate_enu(nav, None, imu)[0], leave(propagate(enter(nav), None, imu)[0])
    turn = rotations.log(rotations.multiply(tangent.q, rotations.conjugate(level.q)))
    off = [np.asarray(earth.enu_difference(n.pos, truth)) for n in (level, tangent)]
    return off[1] - off[0], np.asarray(turn), off


def test_frames_agree_and_converge():
    """At rates so low that the step's error stands clear of rounding; 60 deg north, up and down."""
    found = {}
    for rate in (5.0, 10.0):
        imu, truth = simulate_drive(40.0, rate, (60.0, 12.0, 200.0))
        found[rate] = both(start(truth), Imu(imu.dt, imu.gyro, imu.accel), truth.lla[-1])
    between, turn, off = ({rate: f[i] for rate, f in found.items()} for i in range(3))
    assert np.abs(between[10.0][:2]).max() < 1e-4 and np.abs(turn[10.0]).max() < 1e-8
    assert np.linalg.norm(between[5.0]) > 3.5 * np.linalg.norm(between[10.0])
    assert all(np.linalg.norm(off[5.0][i]) > 3.5 * np.linalg.norm(off[10.0][i]) for i in (0, 1))


@pytest.mark.slow
@pytest.mark.parametrize("latitude, climb", [(35.7, 0.0), (35.7, 3.0), (60.0, 0.0), (60.0, 3.0)])
def test_frames_agree_after_ten_minutes(latitude, climb):
    """To 10 mm and 1e-6 rad at 100 Hz (here: to micrometres), and nearer the truth by more than 3.5 at 200 Hz."""
    lla, found = jnp.array([np.deg2rad(latitude), 0.3, 200.0]), []
    for rate in (100, 200):
        way = travel(winding(climb), lla, 1 / rate, rate, 600, sense)
        gyro, accel = (a.reshape(-1, 3) for a in way.means)
        first, (omega, force) = way.start
        nav = initial_nav(first.lla, first.vel, first.rph, azimuth=0.6)._replace(omega=omega, force=force)
        last = way.ends[0].lla[-1]
        found.append(both(nav, Imu(jnp.full(gyro.shape[0], 1 / rate), gyro, accel), last))
        assert np.linalg.norm(earth.enu_difference(last, lla)) > 5000.0
    (between, turn, coarse), (_, _, fine) = found
    assert np.abs(between[:2]).max() < 2e-6 and np.abs(turn).max() < 1e-11
    assert all(np.linalg.norm(coarse[i][:2]) > 3.5 * np.linalg.norm(fine[i][:2]) for i in (0, 1))


def test_at_rest_stays_at_rest_away_from_the_origin():
    nav = initial_nav([0.3, 0.4, 100.0], rph=[0.02, -0.01, 0.5], azimuth=1.0)
    nav = nav._replace(pos=earth.move(nav.pos, jnp.array([3000.0, -4000.0, 50.0])))
    C = rotations.to_dcm(nav.q)
    gyro = C.T @ earth.earth_rate(nav.pos[0])
    accel = C.T @ jnp.array([0.0, 0.0, 1.0]) * earth.gravity(nav.pos[0], nav.pos[2])
    imu = Imu(jnp.full(100, 0.1), jnp.tile(gyro, (100, 1)), jnp.tile(accel, (100, 1)))
    out = leave(propagate(enter(nav), None, imu)[0])
    np.testing.assert_allclose(out.vel, 0, atol=1e-8)
    np.testing.assert_allclose(earth.enu_difference(out.pos, nav.pos), 0, atol=1e-7)
    np.testing.assert_allclose(out.q, nav.q, atol=1e-11)


def test_padding_changes_nothing(case):
    imu = jax.tree.map(lambda a: a[4], case.packed.epochs.imu)
    pad = lambda a: jnp.concatenate([a, jnp.broadcast_to(a[-1], (7, *a.shape[1:]))])
    padded = Imu(jnp.concatenate([imu.dt, jnp.zeros(7)]), pad(imu.gyro), pad(imu.accel))
    nav = propagate(enter(case.nav), None, jax.tree.map(lambda a: a[3], case.packed.epochs.imu))[0]
    plain, filled = propagate(nav, None, imu)[0], propagate(nav, None, padded)[0]
    leaves_equal(plain._replace(q=nav.q), filled._replace(q=nav.q))
    np.testing.assert_allclose(plain.q, filled.q, rtol=0, atol=2.3e-16)


# ------------------------------------------------------------------------------------------------ error model


def difference(estimate, truth):
    """x with truth = retract(estimate, x), in the axes of the frame."""
    phi = rotations.log(rotations.multiply(estimate.q, rotations.conjugate(truth.q)))
    parts = (
        estimate.pos - truth.pos,
        estimate.vel - truth.vel,
        phi,
        estimate.errors["gyro_bias"] - truth.errors["gyro_bias"],
    )
    return jnp.concatenate([*parts, estimate.errors["accel_bias"] - truth.errors["accel_bias"]])


def central(function):
    """The derivative of function(x) at x = 0 by central differences, (rows, 15)."""
    return np.stack([(function(s * e) - function(-s * e)) / (2 * s) for s, e in zip(SIZES, np.eye(15), strict=True)], 1)


@pytest.mark.parametrize("T, seed", [(0.1, 0), (1.0, 4)], ids=["0.1s", "1s"])
def test_discretize_is_the_derivative_of_the_mechanization(T, seed):
    rng = np.random.default_rng(seed + 1)
    gyro, accel = rng.normal(size=3) * 0.02, rng.normal(size=3) * 2 - [0, 0, 9.8]
    imu = Imu(jnp.full(10, T / 10), jnp.tile(gyro, (10, 1)), jnp.tile(accel, (10, 1)))
    nav = enter(a_nav(seed))
    end, path = propagate(nav, None, imu)
    exact = central(jax.jit(lambda x: difference(end, tangent_frame.propagate(MODEL.retract(nav, x), None, imu)[0])))
    full, simple = (
        np.asarray(jax.jit(error_model("tangent", form=form).discretize)(PARAMS, path, imu.dt, None)[0])
        for form in ("full", "simple")
    )
    bound = 3e-5 if T < 0.5 else 2e-4
    for row, column in [(P, V), (V, A), (V, B), (A, G)]:
        change = (exact - np.eye(15))[row, column]
        np.testing.assert_allclose((full - np.eye(15))[row, column], change, rtol=0, atol=bound * np.abs(change).max())
    # Coriolis is in both forms; the gravity gradient, 3e-6 per s^2, is in the full one only
    for Phi in (full, simple):
        np.testing.assert_allclose((Phi - exact)[V, V], 0, atol=2e-4 * 1.5e-4 * T + 2e-6 * T**2)
    gradient = exact[V, P]
    np.testing.assert_allclose(full[V, P], gradient, rtol=0, atol=0.02 * np.abs(gradient).max())
    assert not simple[V, P].any() and np.abs(gradient).max() > 2e-6 * T


def test_simple_form_is_equation_22():
    nav = enter(a_nav())
    imu = Imu(jnp.full(2, 0.1), jnp.full((2, 3), 0.02), jnp.tile(jnp.array([1.0, 2.0, -9.0]), (2, 1)))
    point = jax.tree.map(lambda a: a[1], tangent_frame.propagate(nav, None, imu)[1])
    blocks = dynamics(point, "simple")
    w = tangent_frame.earth_rate(nav.origin)
    np.testing.assert_array_equal(blocks["velocity", "velocity"], -2 * rotations.skew(w))
    np.testing.assert_array_equal(blocks["attitude", "attitude"], -rotations.skew(w))
    np.testing.assert_array_equal(blocks["velocity", "attitude"], -rotations.skew(point.force))
    assert ("velocity", "position") not in blocks


def test_reported_errors_are_those_of_local_level():
    nav = enter(a_nav())

    def enu(x):
        estimate, truth = tangent_frame.leave(nav), tangent_frame.leave(MODEL.retract(nav, x))
        return difference(estimate, truth).at[P].set(earth.enu_difference(estimate.pos, truth.pos))

    exact = central(jax.jit(enu))
    J = np.asarray(jax.jit(lambda n: block_diag(enu_rows(tangent_frame.leave(n)), jnp.eye(6)))(nav))
    sizes = SIZES / SIZES[:, None]
    np.testing.assert_allclose(J * sizes, exact * sizes, rtol=0, atol=1e-6)
    np.testing.assert_allclose(J[A, P], exact[A, P], rtol=0, atol=1e-3 * np.abs(exact[A, P]).max())
    np.testing.assert_allclose(J[V, P], exact[V, P], rtol=0, atol=1e-3 * np.abs(exact[V, P]).max())
    x, cov = jnp.asarray(SIZES), MODEL.covariance(PARAMS, nav)
    local, x_enu, P_enu = jax.jit(MODEL.report)(nav, x, cov)
    np.testing.assert_allclose(x_enu, J @ x, rtol=1e-12)
    sd = [*PARAMS.prior[:3], *(PARAMS.states[name].sd for name in BIASES)]
    sd = np.concatenate([np.broadcast_to(s, 3) for s in sd])
    np.testing.assert_allclose(P_enu / np.outer(sd, sd), np.eye(15), atol=1e-12)  # entered and reported: the prior
    leaves_equal(local, tangent_frame.leave(nav), atol=1e-9)


def test_a_filter_gives_the_same_solution_in_both_frames(case):
    """Lever arm, latency and a start with errors included: millimetres would be enough, it is micrometres."""
    params = case.params._replace(mounting=mounting((0.5, -0.3, -1.0), 0.02))
    pos = earth.move(case.nav.pos, jnp.array([2.0, -3.0, 2.0]))
    nav = case.nav._replace(pos=pos, origin=case.nav.origin._replace(azimuth=jnp.asarray(0.6)))
    a, b = (
        jax.jit(lambda epochs, f=build("ekf15", cov_stride=20, frame=name): run(f, params, nav, epochs))(
            case.packed.epochs
        )
        for name in ("local_level", "tangent")
    )
    apart = jax.vmap(earth.enu_difference)(a.nav.pos, b.nav.pos)
    np.testing.assert_allclose(apart, 0, atol=2e-5)
    # one in intervals of half a second, the other in samples
    np.testing.assert_allclose(a.nav.vel, b.nav.vel, rtol=0, atol=5e-5)
    np.testing.assert_allclose(a.nav.q, b.nav.q, rtol=0, atol=5e-6)
    sd = np.sqrt(np.einsum("eii->ei", a.P))
    np.testing.assert_allclose((a.P - b.P) / (sd[:, :, None] * sd[:, None]), 0, atol=1e-3)
    np.testing.assert_allclose(a.nis, b.nis, rtol=1e-4)


def test_other_sizes_and_forms_are_refused():
    with pytest.raises(ValueError, match="form is 'full' or 'simple'"):
        error_model("tangent", form="short")
    with pytest.raises(ValueError, match="no frame 'tangential'.*tangent"):
        error_model("tangential")
