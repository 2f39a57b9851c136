"""GIP-KF against loops in numpy, its structure, and gradients of whole runs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.papers import nine_states
from benchmarks.papers.gipkf_study import reset_balanced
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.error_model import error_model
from jaxnav.filters.papers import gip_kf
from jaxnav.filters.papers.gip_kf import gip_kf_params
from jaxnav.filters.parameters import datasheet_params, get, prior, put
from jaxnav.filters.rule import Innovation, only_if
from jaxnav.filters.run import run
from jaxnav.maths import earth, rotations
from jaxnav.measurements import GNSS
from jaxnav.states.motion import A, P, V
from jaxnav.states.table import BIASES, zeros
from jaxnav.strapdown.tangent_frame import enter
from jaxnav.types import Epoch, Params
from tests.conftest import GRADE, all_finite, leaves_equal

H3 = np.concatenate([np.eye(6), np.zeros((6, 3))], axis=1)


def random_theta(seed=0, n=9, m=6, kappa=0.0):
    rng = np.random.default_rng(seed)
    draw = lambda size: jnp.asarray(0.5 * rng.normal(size=size))
    theta = gip_kf_params(kappa=kappa)
    return theta._replace(
        log_rl=draw(m), rl_lower=draw(m * (m - 1) // 2), log_rm=draw(n), rm_lower=draw(n * (n - 1) // 2)
    )


def an_innovation(seed=0, valid=None):
    """Random and well conditioned; rows of missing channels are zero in nu and H as core leaves them."""
    rng = np.random.default_rng(seed)
    valid = np.ones(6, bool) if valid is None else np.asarray(valid)
    B = rng.normal(size=(9, 9))
    H, R = np.where(valid[:, None], H3, 0.0), np.diag(rng.uniform(1, 2, 6))
    parts = (np.where(valid, rng.normal(size=6), 0.0), H, R, B @ B.T + np.eye(9), valid, 0.5, np.zeros(6))
    return Innovation(*map(jnp.asarray, parts))


def numpy_weight(log, lower):
    L = np.eye(log.size)
    L[np.tril_indices(log.size, -1)] = lower
    return L @ np.diag(np.exp(log)) @ L.T


def numpy_gain(theta, H, valid):
    """G by the normal equations of eq. 32 over the channels that are there."""
    R_l, R_m = numpy_weight(theta.log_rl, theta.rl_lower), numpy_weight(theta.log_rm, theta.rm_lower)
    i = np.flatnonzero(valid)
    G = np.zeros((9, 6))
    root = np.linalg.cholesky(R_l[np.ix_(i, i)]).T
    stacked = np.concatenate([root @ H[i], np.linalg.cholesky(R_m).T])
    G[:, i] = np.linalg.lstsq(stacked, np.concatenate([root, np.zeros((9, i.size))]), rcond=None)[0]
    return G


# ------------------------------------------------------------------------------------------------ structure


def test_weights_are_positive_definite_whatever_the_numbers():
    for seed in range(5):
        theta = random_theta(seed)
        for log, lower in ((theta.log_rl, theta.rl_lower), (theta.log_rm, theta.rm_lower)):
            W = np.asarray(gip_kf.weight(4 * log, 4 * lower))
            assert np.linalg.eigvalsh(W).min() > 0
            np.testing.assert_allclose(W, numpy_weight(4 * np.asarray(log), 4 * np.asarray(lower)), rtol=1e-12)


@pytest.mark.parametrize("valid", [[1, 1, 1, 1, 1, 1], [0, 0, 0, 1, 1, 1], [1, 0, 1, 0, 1, 1]])
def test_the_increment_minimises_the_cost_of_the_channels_that_are_there(valid):
    theta, valid = random_theta(), np.array(valid, bool)
    H = np.where(valid[:, None], H3, 0.0)
    G = np.asarray(gip_kf.gain(theta, jnp.asarray(H), jnp.asarray(valid)))
    np.testing.assert_allclose(G, numpy_gain(jax.tree.map(np.asarray, theta), H, valid), atol=1e-12)
    assert not G[:, ~valid].any()


def test_diagonal_weights_take_a_share_of_position_and_velocity_and_nothing_of_attitude():
    theta = random_theta()._replace(rl_lower=jnp.zeros(15), rm_lower=jnp.zeros(36))
    G = np.asarray(gip_kf.gain(theta, jnp.asarray(H3), jnp.ones(6, bool)))
    R_l, R_m = np.exp(theta.log_rl), np.exp(theta.log_rm[:6])
    np.testing.assert_allclose(G[:6], np.diag(R_l / (R_l + R_m)), rtol=0, atol=1e-15)
    assert not G[6:].any()
    hand = gip_kf.gain(gip_kf_params(0.01, 0.2), jnp.asarray(H3), jnp.ones(6, bool))
    np.testing.assert_allclose(np.diag(hand), [0.01] * 3 + [0.2] * 3, rtol=1e-13)


def test_only_the_ratios_of_the_weights_matter():
    theta, z = gip_kf_params(0.1, 0.3), an_innovation()
    theta = theta._replace(log_rl=jnp.linspace(-1.0, 1.0, 6))
    gradient = jax.grad(lambda t: jnp.sum(jnp.sin(gip_kf.correct(t, 0.0, z).delta)))(theta)
    np.testing.assert_allclose(gradient.log_rl + gradient.log_rm[:6], 0, atol=1e-15)
    assert np.abs(gradient.log_rl).min() > 1e-4
    assert not gradient.log_rm[A].any()


# ------------------------------------------------------------------------------------------------ recursions

F = np.eye(9)
F[:3, 3:6], F[3:6, 6:9], F[6:9, 6:9] = 0.5 * np.eye(3), 0.3 * np.eye(3), 0.95 * np.eye(3)
Q, R = 0.01 * np.eye(9), np.diag([1.0, 1, 2, 0.1, 0.1, 0.2])
OUTAGE = np.array([0, 0, 0, 0, 1, 1, 0, 0, 0, 0], bool)
FIXES = np.random.default_rng(5).normal(size=(10, 6))


def our_literal(theta):
    """x (10, 9) of the rule on a linear system, in open loop, in the order of calls that core has."""
    rule = gip_kf.literal()
    x, cov, memory, out = jnp.zeros(9), jnp.eye(9), rule.init(9, 6), []
    for y, hidden in zip(FIXES, OUTAGE, strict=True):
        predicted, cov = F @ x, F @ cov @ F.T + Q
        x, memory = rule.extrapolate(theta, memory, x, predicted)
        valid = jnp.full(6, not hidden)
        H = jnp.where(valid[:, None], H3, 0.0)
        nu = jnp.where(valid, y, 0.0) - H @ x
        z = Innovation(nu, H, jnp.asarray(R), cov, valid, jnp.asarray(0.5), jnp.zeros(6))
        c = only_if(valid.any(), rule.correct(theta, memory, z), z, memory)
        x, cov, memory = x + c.delta, c.P, c.memory
        out.append(x)
    return np.array(out)


def test_literal_recursion_is_the_papers():
    """Eqs. 33-36 written with both past states, as printed."""
    theta = random_theta()
    G = numpy_gain(jax.tree.map(np.asarray, theta), H3, np.ones(6, bool))
    now, before, cov, expected = np.zeros(9), np.zeros(9), np.eye(9), []
    for y, hidden in zip(FIXES, OUTAGE, strict=True):
        predicted = (np.eye(9) + F) @ now - F @ before
        cov = F @ cov @ F.T + Q
        if not hidden:
            predicted = predicted + G @ (y - H3 @ (np.eye(9) + F) @ now + H3 @ F @ before)
            K = cov @ H3.T @ np.linalg.inv(H3 @ cov @ H3.T + R)
            cov = (np.eye(9) - K @ H3) @ cov
            predicted = predicted + K @ (y - H3 @ predicted)
        now, before = predicted, now
        expected.append(now)
    np.testing.assert_allclose(our_literal(theta), expected, rtol=0, atol=1e-10)


def test_working_form_feeds_the_increment_to_the_sensors():
    theta, z = random_theta(kappa=0.2), an_innovation()
    c = jax.jit(gip_kf.gip_kf().correct)(theta, 50.0, z)
    nu, H, cov = (np.asarray(a) for a in (z.nu, z.H, z.P))
    dm = numpy_gain(jax.tree.map(np.asarray, theta), H, np.ones(6, bool)) @ nu
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.asarray(z.R))
    np.testing.assert_allclose(c.delta, dm + K @ (nu - H @ dm), atol=1e-11)
    np.testing.assert_allclose(c.P, (np.eye(9) - K @ H) @ cov, atol=1e-11)
    np.testing.assert_allclose(c.drive.accel, dm[V] / 0.5, atol=1e-11)
    assert np.abs(dm[A]).max() > 1e-3  # of weights that couple
    np.testing.assert_allclose(c.drive.omega, (0.2 * c.delta[A] + dm[A]) / 0.5, atol=1e-11)
    assert all_finite(gip_kf.correct(theta, 0.0, an_innovation(valid=[0] * 6)._replace(T=jnp.zeros(()))))


def test_weights_change_as_biases_are_learnt():
    """After t s with fixes the increment is that of R_m (1 + growth t), and less noise is added to the attitude."""
    theta, z = gip_kf_params(0.01, 0.2, growth=0.05, unlearnt=(0.2, 0.3)), an_innovation()
    rule = gip_kf.gip_kf()
    for t, pad_epochs in ((0.0, 1.0), (40.0, 3.0), (gip_kf.LEARNT, 31.0), (2 * gip_kf.LEARNT, 31.0)):
        c = jax.jit(rule.correct)(theta, t, z)
        share = 1 / (1 + pad_epochs * (1 / 0.2 - 1))
        np.testing.assert_allclose(c.drive.accel, share * z.nu[V] / 0.5, rtol=1e-12)
        K = z.P @ H3.T @ np.linalg.inv(H3 @ z.P @ H3.T + z.R)
        extra = np.diag([0.0] * 3 + [(0.2 / pad_epochs) ** 2 * 0.5] * 3 + [(0.3 / pad_epochs) ** 2 * 0.5] * 3)
        np.testing.assert_allclose(c.P, (np.eye(9) - K @ H3) @ z.P + extra, atol=1e-11)
        assert c.memory == t + 0.5
    second, least = (rule.correct(theta, 40.0, z._replace(T=jnp.asarray(T))) for T in (0.0, 1e-12))
    assert second.memory == 40.0  # another fix of the same moment
    np.testing.assert_allclose(second.P, least.P, atol=1e-11)
    still = z._replace(valid=jnp.zeros(6, bool))
    assert only_if(still.valid.any(), rule.correct(theta, 40.0, still), still, 40.0).memory == 40.0


def test_nine_states_are_a_kalman_filter_of_the_horizontal_velocity_and_gains():
    rng, theta = np.random.default_rng(2), nine_states.nine_params(0.2, 3.0, (0.1, 0.3, 0.02), 0.01, 0.5, 4.0, 0.2, 6.0)
    B15, H = rng.normal(size=(15, 15)), np.eye(6, 15)[[2, 0, 1, 5, 3, 4]]  # channels E, N, U of axes north, up, east
    cov, R, nu = B15 @ B15.T, np.diag(rng.uniform(1, 2, 6)), rng.normal(size=6)
    z = Innovation(*map(jnp.asarray, (nu, H, R, cov, np.ones(6, bool), 2.0, np.full(6, 6.0))))
    c = jax.jit(nine_states.nine_states().correct)(theta, (jnp.asarray(8.0), jnp.asarray(0.7)), z)
    kept = nine_states.KEPT
    P9, H9 = cov[np.ix_(kept, kept)], H[3:5][:, kept]
    K = P9 @ H9.T @ np.linalg.inv(H9 @ P9 @ H9.T + R[3:5, 3:5])
    np.testing.assert_allclose(c.delta[kept], K @ nu[3:5], atol=1e-11)
    np.testing.assert_allclose(c.P[np.ix_(kept, kept)], (np.eye(9) - K @ H9) @ P9, atol=1e-11)
    assert np.count_nonzero(c.P) <= 81
    spread = 0.7 + 0.2 * (6 / 2) ** 2
    share, gap, dv = spread / (1 + spread), 3.0 + 0.5 * (6 - 2), np.asarray(c.delta[V])
    expected = [share * nu[1] + gap * dv[0], 0.1 * nu[2], share * nu[0] + gap * dv[2], 0.3 * nu[5]]
    np.testing.assert_allclose(c.delta[np.array([0, 1, 2, 4])], expected, atol=1e-12)
    np.testing.assert_allclose(c.memory, [9.0, (1 - share) * spread], rtol=1e-12)
    np.testing.assert_allclose(c.drive.accel, [0, 0.02 * nu[5] / 2, 0], atol=1e-15)
    np.testing.assert_allclose(c.drive.omega, [0, (0.01 + 0.5 / 12) * c.delta[7] / 2, 0], atol=1e-15)
    blind = z._replace(H=jnp.zeros((6, 15)), nu=jnp.zeros(6), T=jnp.zeros(()))
    assert all_finite(nine_states.correct_nine(theta, (jnp.zeros(()), jnp.ones(())), blind))


def test_weights_of_another_size_are_refused():
    with pytest.raises(ValueError, match="6 and 9 entries for 6 channels and 15 states"):
        gip_kf.gain(gip_kf_params(), jnp.zeros((6, 15)), jnp.ones(6, bool))
    with pytest.raises(ValueError, match="position.*between 0 and 1"):
        gip_kf_params(position=1.0)
    with pytest.raises(ValueError, match="growth.*-0.1"):
        gip_kf_params(growth=-0.1)


# ------------------------------------------------------------------------------------------------ whole runs


def test_an_accelerometer_bias_is_found_in_body_axes(case):
    """On a winding drive with a bias and no other error: nine states, and the rule still learns it.

    But for the lateral one, which a tilt can stand for.
    """
    bias = np.array([0.05, -0.04, 0.06])
    epochs = case.packed.epochs
    epochs = epochs._replace(imu=epochs.imu._replace(accel=epochs.imu.accel + bias))
    params = case.params._replace(rule=gip_kf_params(0.002, 0.05), prior=prior(2.0, 0.1, 0.005))
    info = jax.jit(lambda e: run(build("gipkf", cov_stride=20), params, case.nav, e))(epochs)
    assert np.abs(info.nav.errors["accel_bias"][-1] - bias)[[0, 2]].max() < 0.012
    assert np.abs(info.nav.errors["gyro_bias"]).max() < 1e-12  # rad/s, rounding


#: leaves, and steps large enough for central differences; the EKF's noise, prior and R, and both weights of the paper
STEPS = {"noise.accel": 1e-4, "measurements.position.scale": 1e-3, "prior.attitude": 1e-5, "rule.log_rl": 1e-3,
         "rule.log_rm": 1e-3, "rule.rm_lower": 1e-3, "rule.kappa": 1e-5, "rule.growth": 1e-4,
         "rule.unlearnt": 1e-6}  # fmt: skip


class Setting(NamedTuple):
    loss: object
    gradient: object
    params: Params
    epochs: Epoch


@pytest.fixture(scope="module")
def setting(fine_case):
    case = fine_case
    params = datasheet_params(GRADE, tilt_sd=0.01, heading_sd=0.05,
                              rule=gip_kf_params(0.01, 0.05, 0.02, growth=0.05, unlearnt=(1e-2, 1e-3)))  # fmt: skip
    params = put(params, "noise.accel", jnp.array([2e-2, 3e-2, 4e-2]))
    params = put(params, "noise.gyro", jnp.asarray(3e-3))
    pos = earth.move(case.nav.pos, jnp.array([2.0, -3.0, 2.0]))
    nav = case.nav._replace(pos=pos, vel=case.nav.vel + jnp.array([0.1, -0.1, 0.05]))
    filt, truth = build("gipkf_mix", cov_stride=20), jnp.asarray(case.truth.lla[20 * 20])

    def loss(params, epochs):
        """Squared error at the end of an outage of 8 s."""
        info = run(filt, params, nav, epochs)
        return jnp.sum(earth.enu_difference(info.nav.pos[-1], truth)[:2] ** 2)

    epochs = jax.tree.map(lambda a: a[:20], case.packed.epochs)
    valid = epochs.fix.valid.at[12:].set(False)
    epochs = epochs._replace(fix=epochs.fix._replace(valid=valid))
    return Setting(jax.jit(loss), jax.jit(jax.grad(loss)), params, epochs)


@pytest.mark.full
def test_gradients_of_an_outages_end(setting):
    gradient = setting.gradient(setting.params, setting.epochs)
    assert all_finite(gradient)
    for name, h in STEPS.items():
        value, analytic = get(setting.params, name), np.asarray(get(gradient, name)).ravel()
        for i in [i for i in (0, 2, 4) if i < value.size]:
            step = h * np.eye(value.size)[i].reshape(value.shape)
            ahead, behind = (setting.loss(put(setting.params, name, value + s), setting.epochs) for s in (step, -step))
            numeric = (ahead - behind) / (2 * h)
            assert abs(analytic[i] - numeric) <= 1e-4 * max(abs(numeric), 0.1 * np.abs(analytic).max()), (name, i)
    # one common factor on all weights changes nothing; without a lever arm the attitude's weight is nobody's
    assert abs(gradient.rule.log_rl.sum() + gradient.rule.log_rm.sum()) < 1e-9 * np.abs(gradient.rule.log_rl).max()
    assert np.abs(gradient.rule.log_rm[A]).max() < 1e-9 * np.abs(gradient.rule.log_rm[P]).max()


def test_balanced_feedback_keeps_tilt_and_bias_in_balance(case):
    """Of a start that was levelled with 0.3 m/s^2 of bias; for small errors it is the plain reset."""
    nav, retract = enter(case.nav)._replace(errors=zeros(BIASES)), error_model("tangent").retract
    up, C = np.array([0.0, earth.gravity(nav.origin.lla[0], nav.origin.lla[2]), 0.0]), rotations.to_dcm(nav.q)
    phi = np.array([0.03, 0.05, -0.02])
    x = jnp.zeros(15).at[A].set(phi).at[12:15].set(C.T @ np.cross(phi, up))  # the linear balance
    both = jax.jit(lambda x: (reset_balanced((), retract, nav, x, 1.0)[0], retract(nav, x)))
    felt = lambda nav: np.asarray(rotations.to_dcm(nav.q).T @ up + nav.errors["accel_bias"])
    balanced, linear = both(x)
    np.testing.assert_allclose(felt(balanced), felt(nav), rtol=0, atol=1e-12)
    assert np.linalg.norm(felt(linear) - felt(nav)) > 4e-3
    balanced, linear = both(1e-4 * x)
    np.testing.assert_allclose(balanced.errors["accel_bias"], linear.errors["accel_bias"], rtol=0, atol=1e-9)
    leaves_equal(balanced._replace(errors=linear.errors), linear, atol=0)


def test_forms_of_the_paper_are_in_the_catalogue():
    assert FILTERS["gipkf_literal"].rule(GNSS) is FILTERS["gipkf_literal_shift"].rule(GNSS) is gip_kf.literal()
    assert FILTERS["gipkf"].rule(GNSS) is FILTERS["gipkf_learning"].rule(GNSS) is gip_kf.gip_kf()
    assert {FILTERS[name].frame for name in FILTERS if name.startswith("gipkf")} == {"tangent"}
