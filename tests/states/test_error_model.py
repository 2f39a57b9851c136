"""The error model against finite differences of the functions that it linearises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxnav.filters.catalogue import build
from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.run import initial_nav, run_jit
from jaxnav.maths import earth, rotations
from jaxnav.measurements import MEASUREMENTS, counted_from, layout
from jaxnav.measurements.measurement import at, covariance
from jaxnav.states.grades import GRADES
from jaxnav.states.motion import MOTION, A, P, V, prior_sd
from jaxnav.states.table import BIASES, chosen, mask, zeros
from jaxnav.states.table import layout as state_layout
from jaxnav.strapdown.errors.local_level import dynamics
from jaxnav.strapdown.fast import local_level
from jaxnav.types import Fix, Forcing, Imu
from tests.conftest import dynamics_15, leaves_equal, told

propagate = jax.jit(local_level.propagate)
NAMED = ("position", "velocity", "zero_velocity", "zero_rate", "nonholonomic", "speed")
ALL = tuple(MEASUREMENTS[name] for name in NAMED)  # the others: tests/test_contract_rows.py
MODEL = error_model("local_level", BIASES, "full", ALL)
STATES = MOTION | state_layout(chosen(BIASES))
G, B = (STATES[name] for name in BIASES)
SLICES = layout(ALL)
observe, discretize, retract = jax.jit(MODEL.observe), jax.jit(MODEL.discretize), jax.jit(MODEL.retract)
PARAMS = datasheet_params(GRADES["adis16465"])
#: sizes of error whose third order is negligible and whose first order stands clear of rounding in latitude
SIZES = np.repeat([10.0, 1.0, 1e-3, 1e-4, 1e-2], 3)


def difference(estimate, truth):
    """The inverse of retract, written out: x with truth = retract(estimate, x)."""
    phi = rotations.log(rotations.multiply(estimate.q, rotations.conjugate(truth.q)))
    dp = earth.enu_difference(estimate.pos, truth.pos)
    return jnp.concatenate(
        [
            dp,
            estimate.vel - truth.vel,
            phi,
            estimate.errors["gyro_bias"] - truth.errors["gyro_bias"],
            estimate.errors["accel_bias"] - truth.errors["accel_bias"],
        ]
    )


difference_jit = jax.jit(difference)


def a_nav(seed=0):
    rng = np.random.default_rng(seed)
    nav = initial_nav([0.8, -1.3, 900.0], [60.0, -45.0, 5.0], [0.2, -0.3, 2.0], t=3.0)
    draw = lambda scale: jnp.asarray(rng.normal(size=3) * scale)
    return nav._replace(
        errors={"gyro_bias": draw(1e-3), "accel_bias": draw(0.1)},
        omega=draw(0.1),
        force=draw(1.0) - jnp.array([0, 0, 9.8]),
    )


def an_imu(k, T, seed=1):
    """A turn with thrust: constant, so that the mean over a block is a fair point."""
    rng = np.random.default_rng(seed)
    gyro = np.tile(rng.normal(size=3) * 0.02, (k, 1))
    accel = np.tile(rng.normal(size=3) * 2 - [0, 0, 9.8], (k, 1))
    return Imu(jnp.full(k, T / k), jnp.asarray(gyro), jnp.asarray(accel))


def test_retract_removes_what_difference_measures():
    nav, x = a_nav(), jnp.asarray(SIZES * np.random.default_rng(2).normal(size=15))
    truth = retract(nav, x)
    np.testing.assert_allclose(np.asarray(difference_jit(nav, truth)) / SIZES, x / SIZES, rtol=0, atol=1e-9)
    # C_est = exp([phi x]) C_true
    turned = rotations.multiply(rotations.exp(x[A]), truth.q)
    np.testing.assert_allclose(turned, nav.q, atol=1e-15)
    np.testing.assert_allclose(truth.vel, nav.vel - x[V], atol=1e-13)
    nine = error_model(states=()).retract(nav, x[:9])
    leaves_equal(
        (nine.errors["gyro_bias"], nine.errors["accel_bias"], nine.q),
        (nav.errors["gyro_bias"], nav.errors["accel_bias"], truth.q),
    )


def transitions(T, seed):
    """The derivative of the error after T s by its start, by central differences through the mechanization."""
    nav, imu = a_nav(seed), an_imu(10, T, seed + 1)
    end, path = propagate(nav, None, imu)

    @jax.jit
    def after(x):
        return difference(end, local_level.propagate(MODEL.retract(nav, x), None, imu)[0])

    columns = [(after(s * e) - after(-s * e)) / (2 * s) for s, e in zip(SIZES, np.eye(15), strict=True)]
    return np.stack(columns, 1), {
        form: np.asarray(jax.jit(error_model(form=form).discretize)(PARAMS, path, imu.dt, None)[0])
        for form in ("full", "simple")
    }


@pytest.fixture(scope="module", params=[(0.1, 0), (1.0, 4)], ids=["0.1s", "1s"])
def transition(request):
    return request.param[0], *transitions(*request.param)


def worst(Phi, exact):
    """Largest error of a block of Phi - I, against the largest entry of that block, over blocks that matter."""
    D = SIZES / SIZES[:, None]  # in units of the sizes
    error, change = (np.abs(M * D).reshape(5, 3, 5, 3).max((1, 3)) for M in (Phi - exact, exact - np.eye(15)))
    return error / np.maximum(change, 1e-7), error


@pytest.mark.parametrize("tau", [0.05, 0.3, 3.0])
def test_biases_that_forget_within_an_epoch_decay(tau):
    nav, imu = a_nav(), an_imu(10, 1.0)
    _, path = propagate(nav, None, imu)
    params = told(PARAMS, gyro_tau=jnp.asarray(tau), accel_tau=jnp.full(3, 2 * tau))
    Phi, Q, d = discretize(params, path, imu.dt, None)
    np.testing.assert_allclose(np.diag(Phi)[G], np.exp(-1 / tau), rtol=1e-9)
    np.testing.assert_allclose(np.diag(Phi)[B], np.exp(-0.5 / tau), rtol=1e-9)
    np.testing.assert_allclose(d[G], -np.expm1(-1 / tau) * nav.errors["gyro_bias"], rtol=1e-9)
    assert (
        np.diag(Q)[G] < 1.01 * params.states["gyro_bias"].driving_noise ** 2 * tau / 2
    ).all()  # never above the bias's own variance


def test_discretize_is_the_derivative_of_the_mechanization(transition):
    T, exact, Phi = transition
    full, simple = worst(Phi["full"], exact)[1], worst(Phi["simple"], exact)[1]
    step = np.abs(exact - np.eye(15)).max()
    assert step > 0.05
    bound = 3e-5 if T < 0.5 else 2e-4
    blocks = worst(Phi["full"], exact)[0]
    big = [(P, V), (V, A), (V, B), (A, G)]  # what drives the errors
    for row, column in big:
        assert blocks[row.start // 3, column.start // 3] < bound
    # the terms that only the full form has are Coriolis and transport: it is better by far in velocity and attitude
    assert full[1, 1] < 0.02 * simple[1, 1]
    assert full[2, 2] < 0.02 * simple[2, 2]
    assert full[0, 0] < 0.05 * simple[0, 0]


def test_full_form_has_the_terms_of_position(transition):
    """How gravity, Coriolis and transport change with position: tiny over a block, but they make Schuler and drift."""
    T, exact, Phi = transition
    for row in (V, A):
        change = exact[row, P]
        np.testing.assert_allclose(Phi["full"][row, P], change, rtol=0, atol=0.02 * np.abs(change).max())
    np.testing.assert_allclose(Phi["full"][A, V], exact[A, V], rtol=0, atol=5e-3 * np.abs(exact[A, V]).max())


def test_nine_states_are_the_first_of_fifteen():
    nav, imu = a_nav(), an_imu(4, 0.2)
    points = propagate(nav, None, imu)[1]
    for form in ("full", "simple"):
        nine, fifteen = (
            jax.jit(error_model(states=BIASES if n > 9 else (), form=form).discretize)(PARAMS, points, imu.dt, None)
            for n in (9, 15)
        )
        np.testing.assert_allclose(nine[0], fifteen[0][:9, :9], rtol=0, atol=1e-15)
        np.testing.assert_allclose(nine[1][V, V], fifteen[1][V, V], rtol=1e-2)


def test_noise_enters_as_root_psd_in_body_axes():
    nav, imu, T = a_nav(), an_imu(4, 0.02), 0.02
    points = propagate(nav, None, imu)[1]
    C = np.asarray(points.C.mean(0))
    params = told(PARAMS, accel=jnp.array([1.0, 2.0, 3.0]), gyro=jnp.array([0.1, 0.2, 0.3]))
    Q = np.asarray(discretize(params, points, imu.dt, None)[1])
    np.testing.assert_allclose(Q[V, V], T * C @ np.diag([1.0, 4.0, 9.0]) @ C.T, rtol=0, atol=0.01 * T)
    np.testing.assert_allclose(Q[A, A], T * C @ np.diag([0.01, 0.04, 0.09]) @ C.T, rtol=0, atol=1e-4 * T)
    np.testing.assert_allclose(np.diag(Q)[G], T * float(params.states["gyro_bias"].driving_noise) ** 2, rtol=1e-4)
    np.testing.assert_allclose(np.diag(Q)[B], T * float(params.states["accel_bias"].driving_noise) ** 2, rtol=1e-4)
    assert np.linalg.eigvalsh(Q / np.sqrt(np.outer(np.diag(Q), np.diag(Q)) + 1e-300)).min() > -1e-12


def test_noise_follows_a_body_that_turns_within_an_epoch():
    """A gyro noisy about one axis, one radian in a second: the integral of C diag C' over the samples."""
    k = 100
    points = jax.tree.map(lambda a: jnp.repeat(a[:1], k, 0), propagate(a_nav(), None, an_imu(4, 0.2))[1])
    C = jax.vmap(lambda a: rotations.to_dcm(rotations.exp(a * jnp.array([0.0, 0.0, 1.0]))))((jnp.arange(k) + 0.5) / k)
    params = told(PARAMS, gyro=jnp.array([1.0, 0.0, 0.0]), gyro_bias=jnp.array(0.0))
    Q = np.asarray(discretize(params, points._replace(C=C), jnp.full(k, 1 / k), None)[1])
    np.testing.assert_allclose(Q[A, A], np.einsum("ki,kj->ij", C[..., 0], C[..., 0]) / k, rtol=0, atol=0.01)


def test_no_noise_is_lost_where_rounding_moves_the_ends_of_points():
    """Of ten points one ends at the middle, where a third of the noise is integrated, or by rounding just beside."""
    points = jax.tree.map(lambda a: jnp.repeat(a[:1], 10, 0), propagate(a_nav(), None, an_imu(4, 0.2))[1])
    params = told(PARAMS, accel=jnp.array(1.0), gyro=jnp.array(0.0))
    T = np.stack([np.full(10, np.full(10, 1 / rate).sum()) for rate in range(50, 401)])  # sums of ten samples
    Q = jax.jit(jax.vmap(lambda T: discretize(params, points, T, None)[1]))(T)
    np.testing.assert_allclose(jnp.diagonal(Q[:, V, V], axis1=1, axis2=2) / T.sum(1)[:, None], 1.0, atol=0.01)


def test_correlated_noise_is_van_loans_integral():
    """Constant attitude and specific force, so that F is constant; every leaf a root of its own."""
    rng, T = np.random.default_rng(11), 0.2
    points = jax.tree.map(lambda a: a[:1], propagate(a_nav(), None, an_imu(4, T))[1])
    sizes = {"gyro": 3e-3, "accel": 2e-2, "gyro_bias": 1e-5, "accel_bias": 1e-4}
    roots = {name: size * (np.eye(3) + np.tril(rng.normal(size=(3, 3)), -1)) for name, size in sizes.items()}
    params = told(PARAMS, **{name: jnp.asarray(L) for name, L in roots.items()})
    Q = np.asarray(discretize(params, points, jnp.array([T]), None)[1])
    F = dynamics_15(dynamics(jax.tree.map(lambda a: a[0], points), "full"))
    C, G_c = np.asarray(points.C[0]), np.zeros((15, 15))
    turned = ((V, C @ roots["accel"]), (A, C @ roots["gyro"]), (G, roots["gyro_bias"]), (B, roots["accel_bias"]))
    for states, L in turned:
        G_c[states, states] = L @ L.T
    loan = expm(np.block([[-F, G_c], [0 * F, F.T]]) * T)
    exact = loan[15:, 15:].T @ loan[:15, 15:]
    sd = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(Q / np.outer(sd, sd), exact / np.outer(sd, sd), rtol=0, atol=2e-5)  # Strang
    assert abs(exact[G, G][0, 1]) > 0.1 * sd[G][0] * sd[G][1]  # and there was something to correlate


def test_drive_moves_the_error_as_it_moves_navigation():
    """The observer drives the estimate, not the truth: their difference responds by d."""
    nav, imu = a_nav(3), an_imu(10, 1.0)
    u = Forcing(jnp.array([1e-3, -2e-3, 3e-3]), jnp.array([0.1, 0.2, -0.3]))
    driven, free = (propagate(nav, drive, imu) for drive in (u, None))
    path = driven[1]
    still = path._replace(
        nav=path.nav._replace(
            errors={"gyro_bias": 0 * path.nav.errors["gyro_bias"], "accel_bias": 0 * path.nav.errors["accel_bias"]}
        )
    )
    d = discretize(PARAMS, still, imu.dt, u)[2]
    np.testing.assert_allclose(difference_jit(driven[0], free[0])[:9], d[:9], rtol=0, atol=1e-3)
    assert abs(d[0]) > 0.04 and abs(d[6]) > 9e-4


def test_absorb_feeds_a_model_error_to_the_sensors():
    nav, imu = a_nav(5), an_imu(10, 0.1)
    drive = Forcing(jnp.array([1e-3, 2e-3, 0.0]), jnp.array([0.1, -0.2, 0.3]))
    before, after = (propagate(n, None, imu)[0] for n in (nav, MODEL.absorb(nav, drive)))
    x = difference_jit(before, after)
    np.testing.assert_allclose(x[V], 0.1 * drive.accel, atol=2e-3)
    np.testing.assert_allclose(x[A], 0.1 * drive.omega, atol=2e-6)


# ------------------------------------------------------------------------------------------------ observe


def history(latency):
    """A past of 12 samples at 20 Hz, and everything about the mounting unlike its default."""
    imu = an_imu(12, 0.6, 7)
    imu = imu._replace(gyro=imu.gyro + 0.3 * jnp.sin(jnp.arange(12.0))[:, None] * jnp.array([0.2, -0.1, 1.0]))
    nav = a_nav(6)
    past = propagate(nav, None, imu)[1].nav
    times = dict(time_offset=0.4, position_latency=0.5, velocity_latency=-0.3) if latency else {}
    install = told(PARAMS,
        lever_arm=jnp.array([1.0, -2.0, -1.5]), vehicle=jnp.array([0.03, -0.05]), wheel_arm=jnp.array([-1.0, 0.7, 1.2]),
        speed_scale=jnp.asarray(0.02, float), **{k: jnp.asarray(v * latency, float) for k, v in times.items()},
    )  # fmt: skip
    rng = np.random.default_rng(8)
    value = np.concatenate([past.pos[-1] + rng.normal(size=3) * [1e-6, 1e-6, 1], rng.normal(size=12)])
    fix = Fix(jnp.asarray(value), jnp.full(15, 0.5), jnp.zeros(15), jnp.ones(15, bool))
    return nav, imu, past, install, fix


def shifted(past, x):
    """Every sample of the past without the error that is x at its end (tests/measurements/test_latency.py has that)."""
    moved = jax.vmap(MODEL.retract)(past, MODEL.earlier(past, x))
    return moved._replace(omega=past.omega + x[G], force=past.force + x[B])


@jax.jit
def residual_jacobian(install, past, fix):
    return jax.jacfwd(lambda x: MODEL.observe(install, shifted(past, x), fix)[0])(jnp.zeros(15))


@pytest.mark.parametrize("latency", [0.0, 0.2])
def test_observe_is_the_derivative_of_the_residual(latency):
    _, _, past, install, fix = history(latency)
    _, H, _ = observe(install, past, fix)
    # the residual of the estimate minus that of the truth is H x
    J = -residual_jacobian(install, past, fix)
    assert J.shape == H.shape == (15, 15)
    for name, s in SLICES.items():
        error = np.abs(np.asarray(H - J)[s] * SIZES).max() / np.abs(np.asarray(J)[s] * SIZES).max()
        # what is left: how the radii and the Earth rate change with position
        assert error < 5e-6, name
    for states in STATES.values():
        assert np.abs(J[:, states]).max() > 0 or states == B


def test_observe_compares_with_the_state_at_the_fix_s_own_time():
    _, _, past, install, fix = history(0.0)
    for latency in (0.0, 0.075, 0.13):
        moved = told(install, position_latency=jnp.asarray(latency), lever_arm=jnp.zeros(3))
        then = at(past, past.t[-1] - latency)
        there = fix._replace(value=fix.value.at[:3].set(then.pos))
        y = observe(moved, past, there)[0]
        np.testing.assert_allclose(y[:3], 0, atol=2e-9)
    # linear interpolation of a path whose acceleration is a is wrong by a dt^2 / 8
    exact = past.pos[-1] - (past.pos[-1] - past.pos[-3]) * 0.75
    assert np.abs(earth.enu_difference(at(past, past.t[-1] - 0.075).pos, exact)).max() < 15 * 0.05**2


@pytest.mark.parametrize("origin", [0.0, 420.0])
def test_a_clock_that_drifts_is_off_by_the_time_since_its_origin(origin):
    _, _, past, install, fix = history(0.2)
    past = counted_from(past._replace(t=past.t + 300.0), origin)
    drifting = told(install, clock_drift=jnp.asarray(3e-4))
    late = told(install, time_offset=install.mounting.time_offset + 3e-4 * (past.t[-1] - origin))
    seen, expected, without = (observe(each, past, fix) for each in (drifting, late, install))
    leaves_equal(seen, expected)
    assert np.abs(seen[0] - without[0]).max() > 0.1


def test_at_extends_beyond_the_samples_and_needs_no_gap():
    nav = a_nav()
    past = jax.tree.map(lambda a: jnp.stack([a, a]), nav)  # a run's first epoch: the same state twice
    assert np.isfinite(np.asarray(at(past, nav.t - 0.3).pos)).all()
    bent = jax.tree.map(lambda a: jnp.stack([a] * 4), nav)
    bent = bent._replace(t=jnp.arange(4.0), errors={"accel_bias": jnp.arange(4.0)[:, None] ** 2 * jnp.ones(3)})
    for t, expected in ((0.5, 0.5), (1.0, 1.0), (1.5, 2.5), (2.75, 7.75), (3.0, 9.0), (4.0, 14.0), (-1.0, -1.0)):
        np.testing.assert_allclose(at(bent, t).errors["accel_bias"], expected, rtol=1e-14)
    past = past._replace(t=jnp.array([1.0, 2.0]), vel=jnp.array([[0.0, 1, 2], [1.0, 1, 0]]))
    np.testing.assert_allclose(at(past, 2.5).vel, [1.5, 1, -1])
    noisy = past._replace(omega=past.vel, force=10 * past.vel)  # held, where position and velocity are extended
    for t, i in ((2.5, -1), (0.5, 0)):
        np.testing.assert_allclose(at(noisy, t).omega, past.vel[i], rtol=1e-14)
        np.testing.assert_allclose(at(noisy, t).force, 10 * past.vel[i], rtol=1e-14)
    np.testing.assert_allclose(at(past, 0.5).vel, [-0.5, 1, 3])


def test_residuals_have_the_sign_estimate_minus_measurement():
    nav = initial_nav([0.5, 0.1, 10.0], [3.0, 4.0, 0.0], [0.0, 0.0, np.arctan2(3.0, 4.0)])
    past = jax.tree.map(lambda a: jnp.stack([a, a]), nav)
    install = told(PARAMS, speed_scale=jnp.asarray(0.1))
    value = jnp.concatenate(
        [earth.move(nav.pos, jnp.array([1.0, 2.0, 3.0])), nav.vel + 1, jnp.zeros(8), jnp.array([5.0])]
    )
    y = observe(install, past, Fix(value, jnp.ones(15), jnp.zeros(15), jnp.ones(15, bool)))[0]
    np.testing.assert_allclose(y[SLICES["position"]], [-1, -2, -3], atol=1e-6)
    np.testing.assert_allclose(y[SLICES["velocity"]], -1)
    np.testing.assert_allclose(y[SLICES["zero_velocity"]], [3, 4, 0], atol=1e-12)
    np.testing.assert_allclose(y[SLICES["nonholonomic"]], 0, atol=1e-12)
    np.testing.assert_allclose(y[SLICES["speed"]], 0.5, atol=1e-12)  # 5 m/s that the wheel shows as 5, scale 1.1
    w = rotations.to_dcm(nav.q).T @ earth.earth_rate(nav.pos[0])
    np.testing.assert_allclose(y[SLICES["zero_rate"]], -w, atol=1e-18)


@pytest.mark.parametrize("pitch, yaw", [(0.2, 0.0), (0.0, 0.3)])
def test_the_vehicle_drives_where_its_own_nose_points(pitch, yaw):
    """A nose up by pitch or to the right by yaw in the axes of the IMU: driving along it, wheels do not slip."""
    nav = initial_nav([0.5, 0.1, 10.0], rph=[0.1, -0.2, 1.0])
    nose = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    past = jax.tree.map(lambda a: jnp.stack([a, a]), nav._replace(vel=7.0 * rotations.to_dcm(nav.q) @ nose))
    install = told(PARAMS, vehicle=jnp.array([pitch, yaw]))
    fix = Fix(jnp.zeros(15), jnp.ones(15), jnp.zeros(15), jnp.ones(15, bool))
    y = observe(install, past, fix)[0]
    np.testing.assert_allclose(y[SLICES["nonholonomic"]], 0, atol=1e-14)
    np.testing.assert_allclose(y[SLICES["speed"]], 7.0, rtol=1e-14)


def test_correlations_make_the_covariance_of_the_fix():
    _, _, past, install, fix = history(0.0)
    sd = jnp.asarray(np.linspace(1.0, 2.0, 15))
    corr = jnp.zeros(15).at[:6].set(jnp.array([0.5, -0.3, 0.2, -0.6, 0.1, 0.4]))
    params = told(install, position_scale=jnp.array([2.0, 1.0, 3.0]))
    fix = fix._replace(sd=sd, corr=corr)
    R = np.asarray(observe(params, past, fix)[2])
    s = np.asarray(sd[:3]) * [2, 1, 3]
    expected = np.array([[1, 0.5, 0.2], [0.5, 1, -0.3], [0.2, -0.3, 1]]) * np.outer(s, s)
    np.testing.assert_allclose(R[:3, :3], expected, rtol=1e-14)
    np.testing.assert_allclose(
        R[3:6, 3:6] / np.outer(sd[3:6], sd[3:6]), [[1, -0.6, 0.4], [-0.6, 1, 0.1], [0.4, 0.1, 1]]
    )
    assert np.linalg.eigvalsh(R).min() > 0 and np.array_equal(R, R.T) and not R[:3, 3:].any()
    # the north channel is missing: its two correlations go, the third stays
    R = np.asarray(observe(params, past, fix._replace(valid=fix.valid.at[1].set(False)))[2])
    assert R[0, 1] == R[1, 2] == 0 and R[0, 2] == pytest.approx(expected[0, 2]) and R[1, 1] == pytest.approx(s[1] ** 2)


def test_a_root_correlates_the_channels_of_a_fix():
    _, _, past, install, fix = history(0.0)
    sd, corr = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5, -0.3, 0.2])
    L = np.array([[2.0, 0, 0], [0.7, 1.5, 0], [-0.4, 0.9, 3.0]])
    C = np.array([[1, 0.5, 0.2], [0.5, 1, -0.3], [0.2, -0.3, 1]])
    params = told(install, position_scale=jnp.asarray(L), velocity_scale=jnp.asarray(2 * L))
    fix = fix._replace(sd=fix.sd.at[:3].set(sd), corr=fix.corr.at[:3].set(corr))
    R = np.asarray(observe(params, past, fix)[2])
    LD = L @ np.diag(sd)
    np.testing.assert_allclose(R[:3, :3], LD @ C @ LD.T, rtol=1e-14)
    np.testing.assert_allclose(R[3:6, 3:6], L @ L.T, rtol=1e-14)  # the sd is 0.5
    assert np.array_equal(R, R.T) and not R[:3, 3:].any()
    # a diagonal is the same in either form, also with channels missing
    for gone in ((), (0,), (1,), (0, 2)):
        valid = jnp.ones(3, bool).at[np.array(gone, int)].set(False)
        a, b = (covariance([root], [3], sd, corr, valid) for root in (jnp.diag(L), jnp.diag(jnp.diag(L))))
        np.testing.assert_allclose(a, b, rtol=1e-15)
    # what the missing channel says changes nothing in those that are there; up takes its share of it at its own sd
    valid = jnp.array([True, False, True])
    a = covariance([jnp.asarray(L)], [3], sd, corr, valid)
    b = covariance([jnp.asarray(L)], [3], sd.at[1].set(77.0), corr.at[:2].set(0.9), valid)
    there = np.ix_([0, 2], [0, 2])
    np.testing.assert_array_equal(a[there], b[there])
    east, up = np.array([2.0, 0, 0]), np.array([-0.4, 0.9 * 3.0, 3.0 * 3.0])
    C = np.array([[1, 0, 0.2], [0, 1, 0], [0.2, 0, 1]])
    np.testing.assert_allclose(a[there], [[east @ C @ east, east @ C @ up], [up @ C @ east, up @ C @ up]], rtol=1e-14)


# ------------------------------------------------------------------------------------------------ states and priors


def test_priors_and_masks_are_by_name():
    params = told(PARAMS, velocity_sd=0.7, attitude_sd=[0.1, 0.2, 0.3], gyro_bias_sd=[1e-3, 2e-3, 3e-3])
    sd = prior_sd(params.prior)
    np.testing.assert_allclose(sd[V], 0.7)
    np.testing.assert_allclose(sd[A], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(np.diag(error_model(states=()).covariance(params, a_nav())), np.asarray(sd) ** 2)
    fifteen = np.diag(MODEL.covariance(params, a_nav()))
    np.testing.assert_allclose(fifteen[G], np.array([1e-3, 2e-3, 3e-3]) ** 2)
    np.testing.assert_allclose(fifteen[B], float(params.states["accel_bias"].sd) ** 2)
    np.testing.assert_array_equal(mask("position", "gyro_bias", states=BIASES), np.repeat([1, 0, 0, 1, 0], 3))
    with pytest.raises(ValueError, match="no heading.*position"):
        mask("heading")
    with pytest.raises(ValueError, match="no state 'gyro'.*gyro_bias"):
        error_model(states=("gyro",))
    with pytest.raises(ValueError, match="form is"):
        error_model(form="short")


def test_a_gauss_markov_bias_decays_while_no_fix_comes(case):
    """Closed loop without fixes: the bias estimate is b exp(-t / tau), and attitude feels the decaying bias."""
    tau, b_g, b_a = 20.0, np.array([1e-3, -2e-3, 0.5e-3]), np.array([0.03, 0.01, -0.02])
    params = told(case.params, gyro_tau=tau, accel_tau=2 * tau)
    epochs = case.packed.epochs
    blind = epochs._replace(fix=epochs.fix._replace(valid=jnp.zeros_like(epochs.fix.valid)))
    nav = case.nav._replace(errors={"gyro_bias": jnp.asarray(b_g), "accel_bias": jnp.asarray(b_a)})
    info = run_jit(build("ekf15"), params, nav, blind)
    t = np.asarray(case.packed.t)
    np.testing.assert_allclose(info.nav.errors["gyro_bias"], b_g * np.exp(-t / tau)[:, None], rtol=0, atol=2e-3 * 2e-3)
    np.testing.assert_allclose(
        info.nav.errors["accel_bias"], b_a * np.exp(-t / tau / 2)[:, None], rtol=0, atol=1e-3 * 0.03
    )
    imu, decay = case.imu, lambda tau: np.exp(-(case.imu.t - case.imu.dt / 2) / tau)[:, None]
    clean = Imu(imu.dt, imu.gyro - b_g * decay(tau), imu.accel - b_a * decay(2 * tau))
    exact = propagate(case.nav._replace(errors=zeros(BIASES)), None, clean)[1].nav
    x = np.asarray(jax.jit(jax.vmap(difference))(info.nav, jax.tree.map(lambda a: a[19::20], exact)))
    assert np.abs(x[-1, A]).max() < 5e-5  # of 40 mrad that the biases turn
    assert np.abs(x[-1, P]).max() < 0.3  # of more than 100 m
