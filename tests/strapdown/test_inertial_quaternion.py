"""The inertial quaternion frame: the paper's launch in closed form, other frames, and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.run import initial_nav
from jaxnav.maths import earth, rotations
from jaxnav.states.grades import GRADES
from jaxnav.states.motion import A, P, V, prior_sd
from jaxnav.states.table import BIASES
from jaxnav.strapdown import inertial_quaternion, tangent_frame
from jaxnav.strapdown.errors import inertial_quaternion as inertial
from jaxnav.strapdown.errors import local_level as local_errors
from jaxnav.strapdown.fast import local_level
from jaxnav.strapdown.inertial_quaternion import AXES
from jaxnav.strapdown.tangent_frame import from_ecef, gravity
from jaxnav.types import ErrorInputs, Fix, Forcing, Imu
from tests.conftest import told

PARAMS = datasheet_params(GRADES["adis16465"])
MODEL = error_model("inertial")
G, B = slice(9, 12), slice(12, 15)
SIZES = np.repeat([10.0, 1.0, 1e-3, 1e-4, 1e-2], 3)
LLA = np.array([np.deg2rad(37.5), 2.1, 120.0])
AZIMUTH = 0.6
propagate = jax.jit(inertial_quaternion.propagate)
enter, leave = jax.jit(inertial_quaternion.enter), jax.jit(inertial_quaternion.leave)


def launch(t):
    """Eq. 33: 20 s at rest, then 20 s of forward motion to 3 m/s^2 and 30 m/s; position, velocity, acceleration."""
    s, c = np.maximum(t - 20, 0), 20 / np.pi
    along = np.stack([3 * (s**2 / 4 - c**2 * np.sin(s / 2 / c) ** 2), 1.5 * (s - c * np.sin(s / c)),
                      3 * np.sin(s / 2 / c) ** 2])  # fmt: skip
    return along[..., None] * np.array([0.0, 1.0, 0.0])


def geometry():
    """Axes of N (right, forward, up) in ECEF as columns, the origin in ECEF, and the Earth's rate in N: plain numpy."""
    (sl, so), (cl, co) = np.sin(LLA[:2]), np.cos(LLA[:2])
    east, north, up = np.array([-so, co, 0]), np.array([-sl * co, -sl * so, cl]), np.array([cl * co, cl * so, sl])
    forward = np.sin(AZIMUTH) * east + np.cos(AZIMUTH) * north
    C_en = np.stack([np.cross(forward, up), forward, up], 1)
    return C_en, np.asarray(earth.lla_to_ecef(LLA)), C_en.T @ [0, 0, earth.RATE]


@pytest.fixture(scope="module")
def launched():
    """The launch's IMU at 100 Hz, means over each sample by Gauss's formula; body level and facing forward."""
    C_en, origin, w = geometry()
    C_bn = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])

    @jax.jit
    @jax.vmap
    def gravity(r):
        lla = earth.ecef_to_lla(origin + C_en @ r)
        return -earth.gravity(lla[0], lla[2]) * C_en.T @ earth.axes(lla[0], lla[1])[:, 2]

    node, weight = np.polynomial.legendre.leggauss(4)
    t = np.arange(4000) / 100
    r, v, a = launch(t[:, None] + 0.01 * (node + 1) / 2)
    g = np.asarray(gravity(r.reshape(-1, 3))).reshape(r.shape)
    force = np.einsum("g,kgi->ki", weight / 2, a + 2 * np.cross(w, v) - g)
    imu = Imu(jnp.full(4000, 0.01), jnp.tile(C_bn @ w, (4000, 1)), jnp.asarray(force @ C_bn.T))
    nav = initial_nav(LLA, rph=[0.0, 0.0, AZIMUTH], azimuth=AZIMUTH)
    # the body has been turning with the Earth, and held against gravity, before the first sample too
    return nav._replace(omega=imu.gyro[0], force=imu.accel[0]), imu


def test_inertial_navigation_of_the_launch(launched):
    nav, imu = launched
    path = propagate(enter(nav), None, imu)[1].nav
    r, v, _ = launch(np.asarray(path.t))
    assert np.abs(path.pos - r).max() < 1e-4
    assert np.abs(path.vel - v).max() < 1e-5
    # the body has not turned in N, and in I by the Earth's rotation alone
    turn = jax.vmap(lambda n: rotations.multiply(inertial_quaternion.turned(n.origin, n.t), n.q))(path)
    np.testing.assert_allclose(turn, np.tile(turn[0], (4000, 1)), rtol=0, atol=1e-12)


def test_frames_agree_on_the_same_samples(launched):
    nav, imu = launched
    ours = jax.jit(jax.vmap(leave))(propagate(enter(nav), None, imu)[1].nav)
    for other in (local_level, tangent_frame):
        theirs = jax.jit(other.propagate)(getattr(other, "enter", lambda n: n)(nav), None, imu)[1].nav
        theirs = jax.vmap(getattr(other, "leave", lambda n: n))(theirs)
        apart = jax.vmap(earth.enu_difference)(ours.pos, theirs.pos)
        assert np.abs(apart).max() < 1e-3
        np.testing.assert_allclose(ours.vel, theirs.vel, rtol=0, atol=1e-4)
        np.testing.assert_allclose(ours.q, theirs.q, rtol=0, atol=1e-9)


def a_nav(seed=0):
    """Well away from origin and time of the frame: it has turned by 0.2 rad."""
    rng = np.random.default_rng(seed)
    nav = initial_nav([0.8, -1.3, 900.0], [60.0, -45.0, 5.0], [0.2, -0.3, 2.0], t=3000.0)
    origin = nav.origin._replace(lla=jnp.array([0.801, -1.302, 600.0]), azimuth=jnp.asarray(0.7), t=jnp.asarray(5.0))
    draw = lambda scale: jnp.asarray(rng.normal(size=3) * scale)
    return nav._replace(
        origin=origin,
        errors={"gyro_bias": draw(1e-3), "accel_bias": draw(0.1)},
        omega=draw(0.1),
        force=draw(1.0) - jnp.array([0, 0, 9.8]),
    )


def an_imu(k, T, seed=1):
    rng = np.random.default_rng(seed)
    accel = np.tile(rng.normal(size=3) * 2 - [0, 0, 9.8], (k, 1))
    return Imu(jnp.full(k, T / k), jnp.asarray(np.tile(rng.normal(size=3) * 0.02, (k, 1))), jnp.asarray(accel))


def test_enter_and_leave_are_inverse_and_stand_on_the_earth():
    nav = a_nav()
    inside = enter(nav)
    back = leave(inside)
    assert np.abs(earth.enu_difference(back.pos, nav.pos)).max() < 1e-8
    np.testing.assert_allclose(back.vel, nav.vel, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs(back.q @ nav.q), 1, rtol=0, atol=1e-14)
    np.testing.assert_allclose(jnp.linalg.norm(inside.vel), jnp.linalg.norm(nav.vel), rtol=1e-14)
    # forward of the origin by 100 m lies north by cos(azimuth) of it
    start = nav.origin.lla
    ahead = earth.move(start, 100 * jnp.array([jnp.sin(0.7), jnp.cos(0.7), 0.0]))
    there = enter(nav._replace(pos=ahead))
    np.testing.assert_allclose(there.pos, [0, 100, 0], atol=2e-3)
    # at the origin's time I is N: level and facing along the azimuth, body axes are (forward, right, down)
    level = initial_nav(start, rph=[0.0, 0.0, 0.7], t=5.0)._replace(origin=nav.origin)
    np.testing.assert_allclose(rotations.to_dcm(enter(level).q), [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-14)


def difference(estimate, truth):
    """The inverse of retract, written out."""
    phi = rotations.log(rotations.multiply(estimate.q, rotations.conjugate(truth.q)))
    dr, dv = estimate.pos - truth.pos, estimate.vel - truth.vel
    dp = dv + jnp.cross(inertial_quaternion.earth_rate(truth.origin), dr)
    return jnp.concatenate(
        [
            dr,
            dp,
            phi,
            estimate.errors["gyro_bias"] - truth.errors["gyro_bias"],
            estimate.errors["accel_bias"] - truth.errors["accel_bias"],
        ]
    )


def test_retract_removes_what_difference_measures():
    nav, x = enter(a_nav()), SIZES * np.random.default_rng(2).normal(size=15)
    found = difference(nav, MODEL.retract(nav, jnp.asarray(x)))
    np.testing.assert_allclose(found / SIZES, x / SIZES, rtol=0, atol=1e-9)


@pytest.mark.parametrize("T", [0.1, 1.0])
def test_discretize_is_the_derivative_of_the_mechanization(T):
    nav, imu = enter(a_nav(3)), an_imu(10, T, 4)
    end, path = propagate(nav, None, imu)

    @jax.jit
    @jax.vmap
    def after(x):
        return difference(end, inertial_quaternion.propagate(MODEL.retract(nav, x), None, imu)[0])

    steps = jnp.asarray(np.diag(SIZES))
    exact = np.asarray((after(steps) - after(-steps)) / (2 * SIZES[:, None])).T
    full, simple = (
        np.asarray(jax.jit(error_model("inertial", form=form).discretize)(PARAMS, path, imu.dt, None)[0])
        for form in ("full", "simple")
    )
    change = np.abs(exact - np.eye(15))
    for row, column in ((P, P), (P, V), (V, V), (V, A), (V, B), (A, G)):
        assert np.abs(full - exact)[row, column].max() < (3e-5 if T < 0.5 else 2e-4) * change[row, column].max() + 1e-12
    # what the simple form lacks is gravitation's gradient
    assert np.abs(full - exact)[V, P].max() < 1e-2 * change[V, P].max() < 0.02 * np.abs(simple - exact)[V, P].max()
    assert np.abs(full - simple)[A].max() == 0
    # a drive moves the error as it moves navigation
    u = Forcing(jnp.array([1e-3, -2e-3, 3e-3]), jnp.array([0.1, 0.2, -0.3]))
    driven = propagate(nav, u, imu)[0]
    still = path._replace(
        nav=path.nav._replace(
            errors={"gyro_bias": 0 * path.nav.errors["gyro_bias"], "accel_bias": 0 * path.nav.errors["accel_bias"]}
        )
    )
    d = jax.jit(MODEL.discretize)(PARAMS, still, imu.dt, u)[2]
    np.testing.assert_allclose(difference(driven, end)[:9], d[:9], rtol=0, atol=1e-3 * T)
    assert np.abs(d[V]).min() > 0.05 * T


def test_report_and_observe_linearise_leave():
    nav, x = enter(a_nav(5)), jnp.asarray(SIZES * np.random.default_rng(6).normal(size=15)) * 0.3

    def local(nav, x):
        """The error in local level, by navigating out of the frame."""
        here, there = leave(nav), leave(MODEL.retract(nav, x))
        phi = rotations.log(rotations.multiply(here.q, rotations.conjugate(there.q)))
        dp = earth.enu_difference(here.pos, there.pos)
        return jnp.concatenate([dp, here.vel - there.vel, phi, x[G], x[B]])

    reported = MODEL.report(nav, x, jnp.eye(15))[1]
    exact = (local(nav, x) - local(nav, -x)) / 2
    np.testing.assert_allclose(reported / SIZES, exact / SIZES, rtol=0, atol=1e-6)
    there = leave(nav)
    np.testing.assert_allclose(inertial.enu_rows(nav, there) @ x[:9], reported[:9], atol=1e-12)
    # what measurements see of it: of the antenna in the IMU, where it is and how it moves in local level
    fix = Fix(jnp.concatenate([there.pos, there.vel]), jnp.ones(6), jnp.zeros(6), jnp.ones(6, bool))
    y, H, _ = MODEL.observe(PARAMS, jax.tree.map(lambda a: jnp.stack([a, a]), nav), fix)
    np.testing.assert_allclose(y, 0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(H @ x, reported[:6], atol=1e-12)


def test_priors_are_in_enu_and_noise_in_body_axes():
    nav = enter(a_nav())
    params = told(PARAMS, position_sd=[1.0, 2.0, 3.0], attitude_sd=[0.1, 0.2, 0.3])
    for states in ((), BIASES):
        model = error_model("inertial", states)
        P_enu = model.report(nav, jnp.zeros(model.n_states), model.covariance(params, nav))[2]
        np.testing.assert_allclose(np.sqrt(np.diag(P_enu))[:9], prior_sd(params.prior), rtol=1e-12)
        for i, name in enumerate(states):
            sd = np.sqrt(np.diag(P_enu))[9 + 3 * i : 12 + 3 * i]
            np.testing.assert_allclose(sd, params.states[name].sd, rtol=1e-12)
    imu, T = an_imu(4, 0.02), 0.02
    path = propagate(nav, None, imu)[1]
    params = told(PARAMS, accel=[1.0, 2.0, 3.0], gyro=[0.1, 0.2, 0.3])
    Q = np.asarray(MODEL.discretize(params, path, imu.dt, None)[1])
    C = np.asarray(path.C.mean(0))
    to_n = np.asarray(rotations.to_dcm(inertial_quaternion.turned(nav.origin, nav.t)))
    assert np.abs(to_n - np.eye(3)).max() > 0.1
    np.testing.assert_allclose(Q[A, A], T * C @ np.diag([0.01, 0.04, 0.09]) @ C.T, rtol=0, atol=1e-4 * T)
    np.testing.assert_allclose(Q[V, V], T * to_n @ C @ np.diag([1.0, 4, 9]) @ C.T @ to_n.T, rtol=0, atol=0.01 * T)


def test_absorb_feeds_a_model_error_to_the_sensors():
    nav, imu = enter(a_nav(5)), an_imu(10, 0.1)
    drive = Forcing(jnp.array([1e-3, 2e-3, 0.0]), jnp.array([0.1, -0.2, 0.3]))
    x = difference(propagate(nav, None, imu)[0], propagate(MODEL.absorb(nav, drive), None, imu)[0])
    np.testing.assert_allclose(x[V], 0.1 * drive.accel, atol=2e-3)
    np.testing.assert_allclose(x[A], 0.1 * drive.omega, atol=2e-6)


def test_unknown_form_is_refused():
    with pytest.raises(ValueError, match="form is"):
        error_model("inertial", form="short")


@pytest.mark.parametrize("lat", [0.1, 0.9, -1.2])
def test_the_gradient_of_gravitation_is_that_of_gravity_without_the_centrifugal_part(lat):
    """gravitation = gravity - omega^2 rho, rho from the axis outwards: by central differences of 1 km."""
    nav = initial_nav(np.array([lat, 0.3, 100.0]))._replace(pos=jnp.zeros(3))
    none = dict.fromkeys(("force", "gyro", "accel"), jnp.zeros(3))
    block = inertial.dynamics(ErrorInputs(nav=nav, C=jnp.eye(3), **none), "full")["velocity", "position"]
    C_en = np.asarray(from_ecef(nav.origin).T @ AXES.T)
    center, axis = np.asarray(earth.lla_to_ecef(nav.origin.lla)), np.array([0.0, 0.0, 1.0])

    def gravitation(p):
        r = center + C_en @ p
        return C_en.T @ (np.asarray(gravity(jnp.asarray(r))) - earth.RATE**2 * (r - axis * r[2]))

    slope = [(gravitation(1e3 * e) - gravitation(-1e3 * e)) / 2e3 for e in np.eye(3)]
    np.testing.assert_allclose(block, np.array(slope).T, atol=2e-10)  # omega^2 is 5e-9


@pytest.mark.parametrize("lat", [0.1, 0.9, -1.2])
def test_further_north_the_earth_turns_otherwise(lat):
    """Local level at rest: the attitude's error grows against the change of the Earth's rate with the position."""
    nav = initial_nav(np.array([lat, 0.3, 100.0]))
    none = dict.fromkeys(("force", "gyro", "accel"), jnp.zeros(3))
    block = local_errors.dynamics(ErrorInputs(nav=nav, C=jnp.eye(3), **none), "full")["attitude", "position"]
    rate = lambda north: np.asarray(earth.earth_rate(jnp.asarray(lat + north / float(earth.radii(lat)[0] + 100.0))))
    np.testing.assert_allclose(block[:, 1], -(rate(1e3) - rate(-1e3)) / 2e3, atol=1e-18)
    np.testing.assert_array_equal(block[:, [0, 2]], np.zeros((3, 2)))
