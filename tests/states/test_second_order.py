"""Second-order terms of large attitude errors, and the covariance after a large correction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis.metrics import state_error
from jaxnav.filters.catalogue import build
from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import datasheet_params, history_for, late, mounting
from jaxnav.filters.run import initial_nav, run
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.measurements.measurement import FIXES_ALIKE
from jaxnav.simulate.gnss import Receiver
from jaxnav.simulate.imu import ImuErrors
from jaxnav.simulate.scenarios import InitialErrors, Scenario
from jaxnav.simulate.simulation import matched_params, perturb, simulate
from jaxnav.simulate.trajectories import Static
from jaxnav.states.grades import GRADES
from jaxnav.states.motion import reset_covariance, reset_rows
from jaxnav.states.second_order import SECOND_ORDER_S, reliability, second_order
from jaxnav.strapdown import local_level
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Fix, Imu

T, K = 1.0, 50
FORCE = np.array([2.0, -1.0, -9.8])  # m/s^2, body
RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def epoch():
    """A second of navigation in local level: Phi, and the velocity at its end from a start without the error x."""
    model, imu = error_model(), Imu(jnp.full(K, T / K), jnp.zeros((K, 3)), jnp.tile(jnp.asarray(FORCE), (K, 1)))
    nav = initial_nav([0.7, 0.2, 100.0], [3.0, 2.0, 0.0], [0.1, -0.05, 1.0])
    nav = nav._replace(errors={"gyro_bias": jnp.zeros(3), "accel_bias": jnp.zeros(3)})
    end, path = local_level.propagate(nav, None, imu)
    Phi = model.discretize(datasheet_params(GRADES["consumer"]), path, imu.dt, None)[0]
    velocity = jax.jit(lambda x: local_level.propagate(model.retract(nav, x), None, imu)[0].vel)
    return Phi, velocity


@pytest.mark.full
def test_the_rest_of_a_large_error_is_the_cross_product_of_attitude_and_what_it_does(epoch):
    """Velocity of the estimate minus the truth's: Phi x - phi x w, to third order."""
    Phi, velocity = epoch
    for size in (0.02, 0.01):
        x = np.zeros(15)
        x[6:9], x[12:] = size * np.array([0.5, -0.4, 2.0]), 10 * size * np.array([1.0, -0.7, 0.5])
        exact = np.asarray(velocity(jnp.zeros(15)) - velocity(jnp.asarray(x)))
        w = Phi[3:6, 6:] @ np.concatenate([0.5 * x[6:9], x[9:]])
        second = -np.cross(x[6:9], w)
        left = np.abs(exact - Phi[3:6] @ x - second).max()
        assert left < 2 * size * np.abs(second).max(), (size, left)


@pytest.mark.full
def test_its_power_is_that_of_samples(epoch):
    """The second moment of phi x w and of what the heading's column leaves out, as white acceleration."""
    Phi, _ = epoch
    root = RNG.normal(size=(15, 15)) * np.repeat([1.0, 1.0, 0.05, 0.002, 0.1], 3)[:, None] / 4
    P = root @ root.T
    reduced, Q = jax.tree.map(np.asarray, jax.jit(second_order)(Phi, P, jnp.asarray(T)))
    x = RNG.multivariate_normal(np.zeros(15), P, size=400_000)
    q = np.cross(x[:, 6:9], np.concatenate([0.5 * x[:, 6:9], x[:, 9:]], 1) @ Phi[3:6, 6:].T)
    rest = x @ (Phi - reduced)[3:6].T
    sampled = (q.T @ q + rest.T @ rest) / len(q)
    size = np.sqrt(np.diag(sampled))
    power = Q[3:, 3:] / (2 * SECOND_ORDER_S / T)
    np.testing.assert_allclose(power / np.outer(size, size), sampled / np.outer(size, size), atol=0.02)
    np.testing.assert_allclose(Q, np.kron([[T**2 / 3, T / 2], [T / 2, 1]], Q[3:, 3:]), rtol=1e-12)


def test_a_lost_attitude_is_bounded(epoch):
    """An unknown heading adds what a radian would, not its square."""
    Phi, _ = epoch
    sizes = []
    for sd in (10.0, 100.0):
        P = np.diag(np.repeat([1.0, 0.1, 0.01, 1e-4, 1e-2], 3) ** 2)
        P[8, 8] = sd**2
        sizes.append(np.sqrt(np.diag(second_order(Phi, P, jnp.asarray(T))[1])[3:]).max())
    assert sizes[1] < 11 * sizes[0]


def test_the_heading_counts_by_its_column_and_the_column_s_error(epoch):
    """|l|^2 / (|l|^2 + E|e|^2) by columns of other attitudes and biases, as sampled; noise has the rest."""
    Phi, _ = epoch
    root = RNG.normal(size=(15, 15)) * np.repeat([1.0, 1.0, 0.3, 0.002, 1.0], 3)[:, None] / 4
    P = root @ root.T
    wrong = RNG.multivariate_normal(np.zeros(15), P, size=200_000)[:, 6:] @ Phi[3:6, 6:].T  # of specific force, x T
    r = float(reliability(Phi[3:6, 6:], P)[0])
    size, lost = np.sum(Phi[3:6, 8] ** 2), np.mean(np.sum(np.cross(wrong, [0, 0, 1]) ** 2, 1))
    np.testing.assert_allclose(r, size / (size + lost), rtol=0.01)
    assert 0.1 < r < 0.9
    expected = np.array(Phi)
    expected[:6, 8] *= r
    np.testing.assert_allclose(second_order(Phi, P, jnp.asarray(T))[0], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.full
def test_a_parked_vehicle_does_not_learn_its_heading():
    """Ten seconds at rest, heading sd 20 deg: the sd stays, and the errors of 16 runs are within it."""
    scenario = Scenario(
        name="parked", duration_s=10.0, imu_rate_hz=20.0, motion=Static(), imu=ImuErrors("consumer"),
        gnss=Receiver((2.0,) * 3, (0.1,) * 3),
        start=InitialErrors((2.0,) * 3, (0.1,) * 3, prior_tilt_sd_deg=1.0, prior_heading_sd_deg=20.0),
    )  # fmt: skip
    params = matched_params(scenario)
    filt = build("ekf15", history=history_for(params, 20.0, 10.0))

    @jax.jit
    @jax.vmap
    def ends(key):
        sim = simulate(key, scenario)
        initial = perturb(jax.random.fold_in(key, 1), sim.start, scenario.start)
        record = lambda step, truth: (state_error(step.info.nav, truth, filt.model.states)[8], step.info.P[8, 8])
        return run(filt, params, initial, sim.epochs, record, sim.truth)

    heading, var = ends(jax.random.split(jax.random.key(5), 16))
    assert np.sqrt(np.mean(var[:, -1])) > 18.5 * DEG
    assert np.mean(heading[:, -1] ** 2 / var[:, -1]) < 1.9  # 99 % of chi-square with 16 degrees of freedom, over 16


@pytest.mark.full
def test_a_receiver_s_fix_sees_second_order_by_lever_arm_and_age():
    """Large tilts and biases: residual minus H x of many errors, against what P adds to R; nothing without them."""
    model, frame = error_model(), FRAMES["local_level"]
    params = late(datasheet_params(GRADES["consumer"], install=mounting([1.0, -2.0, -1.5])), 0.3, 0.2)
    turning = jnp.tile(jnp.array([0.1, 0.2, -0.3]), (K, 1))
    imu = Imu(jnp.full(K, T / K), turning, jnp.tile(jnp.asarray(FORCE), (K, 1)))
    nav = initial_nav([0.7, 0.2, 100.0], [30.0, 20.0, 0.0], [0.1, -0.05, 1.0])
    nav = nav._replace(errors={"gyro_bias": jnp.zeros(3), "accel_bias": jnp.zeros(3)})
    fix = Fix(jnp.concatenate([nav.pos, jnp.zeros(3)]), jnp.full(6, 0.02), jnp.zeros(6), jnp.ones(6, bool))
    moved = jax.jit(jax.vmap(lambda x: frame.propagate(model.retract(nav, x), None, imu, 1, jnp.arange(K))[0]))
    x0 = RNG.normal(size=(3000, 15)) * np.repeat([0.0, 0.0, 0.1, 0.0, 0.3], 3)
    past = jax.tree.map(lambda a: a[0], moved(jnp.zeros((1, 15))))
    last = lambda nav: jax.tree.map(lambda a: a[-1], nav)
    others = moved(jnp.asarray(x0))
    x = np.asarray(jax.vmap(lambda n: state_error(last(past), last(n), model.states))(others))
    observe = jax.jit(lambda past, P: model.observe(params, past, fix, P))
    y, H, R = observe(past, jnp.asarray(np.cov(x.T)))
    y_of = np.asarray(jax.vmap(lambda n: model.observe(params, n, fix)[0])(others))
    first, P = np.asarray(observe(past, jnp.zeros((15, 15)))[1]), np.cov(x.T)
    for block in (slice(0, 3), slice(3, 6)):
        share = float(reliability(first[block, 6:], P)[0])
        np.testing.assert_allclose(H[block, 8], share * first[block, 8], rtol=1e-9)
        assert share < 0.99
    left = np.asarray(y) - y_of - x @ np.asarray(H).T
    added = np.asarray(R - observe(past, jnp.zeros((15, 15)))[2]) / FIXES_ALIKE
    for block in (slice(0, 3), slice(3, 6)):
        sampled = left[:, block].T @ left[:, block] / len(left)
        size = np.sqrt(np.diag(sampled))
        assert (size > 0.01).all()
        np.testing.assert_allclose(added[block, block] / np.outer(size, size), sampled / np.outer(size, size), atol=0.2)
    np.testing.assert_array_equal(observe(past, jnp.zeros((15, 15)))[2], model.observe(params, past, fix)[2])


def test_other_axes_of_attitude_turn_the_terms_along(epoch):
    """The inertial frame's attitude has other axes than its velocity: the same errors, the same terms."""
    Phi, _ = epoch
    root = RNG.normal(size=(15, 15)) * 0.1
    P, R = root @ root.T, np.asarray(rotations.to_dcm(rotations.exp(jnp.array([0.3, -1.0, 2.0]))))
    S = np.eye(15)
    S[6:9, 6:9] = R.T  # attitude in other axes: phi = R phi_other
    plain, turned = second_order(Phi, P, jnp.ones(())), second_order(Phi @ S.T, S @ P @ S.T, jnp.ones(()), 2, R)
    np.testing.assert_allclose(plain[1], turned[1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(turned[0], plain[0] @ S.T, rtol=1e-9, atol=1e-12)
    assert np.abs(plain[0] - Phi).max() > 0.1


def test_small_errors_and_empty_epochs_add_nothing(epoch):
    Phi, _ = epoch
    P = np.diag(np.repeat([1.0, 0.1, 1e-3, 1e-4, 1e-2], 3) ** 2)
    assert np.sqrt(np.diag(second_order(Phi, P, jnp.ones(()))[1])).max() < 2e-4
    same, none = second_order(jnp.eye(15), P, jnp.zeros(()))
    np.testing.assert_array_equal(same, np.eye(15))
    assert not np.asarray(none).any()
    slope = jax.grad(lambda P: sum(a.sum() for a in second_order(jnp.eye(15), P, jnp.zeros(()))))(jnp.asarray(P))
    assert np.isfinite(slope).all()


def test_the_error_left_by_a_correction_is_turned_by_half_of_it():
    """log(exp(-phi) exp(phi + e)) in e, by finite differences; the inverse by -phi."""
    phi, h = jnp.array([0.02, -0.03, 0.05]), 1e-6
    left = lambda e: rotations.log(rotations.multiply(rotations.exp(-phi), rotations.exp(phi + e)))
    J = np.stack([np.asarray(left(h * e) - left(-h * e)) / (2 * h) for e in jnp.eye(3)], 1)
    rows = reset_rows(phi, jnp.eye(12))
    assert np.abs(rows[6:9, 6:9] - J).max() < 0.05 * float(phi @ phi)
    assert np.abs(J - np.eye(3)).max() > 0.02
    rest = np.delete(np.arange(12), [6, 7, 8])
    np.testing.assert_array_equal(rows[rest], np.eye(12)[rest])
    root = jnp.asarray(RNG.normal(size=(12, 12)))
    np.testing.assert_allclose(
        reset_covariance(phi, root @ root.T), rows @ root @ root.T @ rows.T, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(reset_rows(-phi, rows), np.eye(12), atol=1e-15)
