"""Robust and adaptive rules against closed forms, and on a linear navigator whose statistics are known."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxnav import GNSS, build, initial_nav
from jaxnav.filters.core import masked
from jaxnav.filters.papers.gpid import gpid, gpid_params
from jaxnav.filters.rule import Innovation
from jaxnav.filters.rules import robust
from jaxnav.filters.rules.adaptive import fading, fading_params, iae, iae_params, sage_husa, sage_husa_params
from jaxnav.filters.rules.kalman import correct as kalman_correct
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.rules.robust import (
    gate,
    gate_params,
    huber,
    huber_params,
    inflate_block,
    inflated,
    squared_by_block,
    student_t,
    student_t_params,
)
from jaxnav.maths import linalg
from jaxnav.types import Fix
from tests.conftest import all_finite, leaves_equal

T = 1.0
H = np.eye(6, 9)
ROBUST = {
    "gate": (gate, gate_params()),
    "huber": (huber, huber_params()),
    "student": (student_t, student_t_params()),
    "sage_husa": (sage_husa, sage_husa_params()),
    "iae": (iae, iae_params()),
    "fading": (fading, fading_params()),
}
NEUTRAL = {  # parameters with which the rule is its inner rule
    "gate": gate_params(1e9),
    "huber": huber_params(1e9),
    "student": student_t_params(1e18),
    "sage_husa": sage_husa_params(1.0),
    "fading": fading_params(np.inf),
}

BLOCKS = (slice(0, 3), slice(3, 6))


def innovation(nu, valid=(True,) * 6, seed=1, T=T, age=T) -> Innovation:
    """A fix on a full covariance of position, velocity and attitude, with correlated noise."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(9, 9)) * np.repeat([1.0, 0.1, 0.01], 3)[:, None]
    R = np.diag(np.repeat([4.0, 0.01], 3))
    R[0, 1] = R[1, 0] = 1.5
    H = np.eye(6, 9) + 0.3 * np.pad(rng.normal(size=(6, 3)), ((0, 0), (6, 0)))
    valid = jnp.array(valid)
    z = masked(*(jnp.asarray(a, float) for a in (nu, H, R)), valid)
    return Innovation(*z, jnp.asarray(A @ A.T), valid, jnp.asarray(T), jnp.full(6, float(age)))


def answer(rule, theta, z, memory=None):
    memory = rule.init(9, 6) if memory is None else memory
    return rule.correct(theta, memory, z)


@pytest.fixture
def outlier():
    return innovation([30.0, 1.0, -1.0, 0.1, -0.1, 0.05])


# ------------------------------------------------------------------------------------------------ what all share


@pytest.mark.parametrize("name", NEUTRAL)
def test_neutral_parameters_are_the_inner_rule(name, outlier):
    rule = ROBUST[name][0](kalman())
    c, k = answer(rule, NEUTRAL[name], outlier), kalman_correct((), (), outlier)
    np.testing.assert_allclose(c.delta, k.delta, rtol=1e-12)
    np.testing.assert_allclose(c.P, k.P, rtol=1e-12, atol=1e-15)
    assert np.all(c.fade == 1) and np.array_equal(c.used, k.used)


@pytest.mark.parametrize("name", ROBUST)
def test_a_missing_channel_teaches_nothing(name, outlier):
    """Its memory stands still through fixes that it is not in, and through those that others are not in."""
    make, theta = ROBUST[name]
    rule = make(gpid())
    theta = theta._replace(rule=gpid_params(0.1, 0.2))
    first = answer(rule, theta, innovation([9.0, 1.0, -1.0, 0.1, -0.1, 0.05]))
    valid = (True, True, True, True, False, True)
    c = answer(rule, theta, innovation([1.0, 1.0, 2.0, 0.2, 0.0, 0.1], valid), first.memory)
    assert not c.used[4]
    own = lambda tree: [a[..., 4] for a in jax.tree.leaves(tree) if a.shape[-1:] == (6,)]
    leaves_equal(own(c.memory), own(first.memory))
    assert any(np.any(a != b) for a, b in zip(jax.tree.leaves(c.memory), jax.tree.leaves(first.memory), strict=True))


@pytest.mark.parametrize("name", [n for n in ROBUST if n != "gate"])
def test_gradients_in_the_parameters(name):
    """Against central differences, through two fixes so that memory counts; an outlier in the first."""
    make, theta = ROBUST[name]
    theta = iae_params(0.97) if name == "iae" else theta  # where the floor counts
    rule = make(kalman())
    a, b = innovation([30.0, 1.0, -1.0, 0.1, -0.1, 0.05]), innovation([1.0, -8.0, 2.0, 0.1, 0.3, 0.0], seed=2)

    @jax.jit
    def f(scale):
        scaled = jax.tree.map(lambda v: v * scale, theta)
        c = answer(rule, scaled, a)
        last = answer(rule, scaled, b._replace(P=c.fade**2 * c.P), c.memory)
        return jnp.sum(last.delta * jnp.arange(1.0, 10.0)) + jnp.trace(last.P)

    h = 1e-5
    expected = float(f(1 + h) - f(1 - h)) / (2 * h)
    assert abs(expected) > 1e-6
    assert jax.jit(jax.grad(f))(1.0) == pytest.approx(expected, rel=1e-6)


def test_inflation_keeps_correlations():
    R = innovation(np.zeros(6)).R
    wide = inflated(R, jnp.array([4.0, 9.0, 1.0, 1.0, 1.0, 1.0]))
    assert wide[0, 0] == 4 * R[0, 0] and wide[1, 1] == 9 * R[1, 1]
    assert wide[0, 1] / jnp.sqrt(wide[0, 0] * wide[1, 1]) == pytest.approx(R[0, 1] / 4)


# ------------------------------------------------------------------------------------------------ gate


def test_a_rejected_block_is_a_missing_block(outlier):
    """And the other block, alone, corrects as if nothing had happened."""
    rule = gate(kalman())
    c = answer(rule, gate_params(), outlier)
    k = kalman_correct((), (), innovation([0.0, 0.0, 0.0, *outlier.nu[3:]], (False,) * 3 + (True,) * 3))
    leaves_equal((c.delta, c.P, c.used), (k.delta, k.P, k.used))
    np.testing.assert_array_equal(c.memory.rejected, [T, 0.0])


def test_the_threshold_is_one_of_chi_square(outlier):
    """Innovations just below and just above it, which 0.1 % of sound fixes of three channels are."""
    assert gate_params().threshold == pytest.approx(chi2.ppf(0.999, 3), abs=5e-3)
    d2 = squared_by_block(outlier.nu, outlier.H @ outlier.P @ outlier.H.T + outlier.R)[0]
    for share, accepted in ((0.999, True), (1.001, False)):
        z = outlier._replace(nu=outlier.nu.at[:3].multiply(jnp.sqrt(16.27 * share / d2)))
        assert bool(answer(gate(kalman()), gate_params(), z).used[0]) is accepted


def test_nothing_accepted_changes_nothing():
    z = innovation([90.0, 0.0, 0.0, 9.0, 0.0, 0.0])
    c = answer(gate(gpid()), gate_params(rule=gpid_params(0.1, 0.2)), z)
    leaves_equal((c.delta, c.P, c.used, c.memory.rule), (jnp.zeros(9), z.P, jnp.zeros(6, bool), gpid().init(9, 6)))


def test_after_the_timeout_a_block_is_accepted(outlier):
    """Three seconds of rejected fixes, not of time: an outage in between does not count."""
    rule, theta = gate(kalman()), gate_params(timeout=3.0)
    memory, accepted, age = rule.init(9, 6), [], 0.0
    for there in (True, True, False, False, True, True, True):
        age += T
        z = outlier if there else innovation([0.0] * 3 + [0.1, 0.0, 0.0], (False,) * 3 + (True,) * 3)
        c = answer(rule, theta, z._replace(age=jnp.full(6, age)), memory)
        memory = c.memory
        accepted.append(bool(c.used[0]))
        age = 0.0 if accepted[-1] else age
    assert accepted == [False, False, False, False, False, True, False]
    assert memory.rejected[0] == T
    never = answer(rule, gate_params(timeout=np.inf), outlier, memory._replace(rejected=jnp.full(2, 1e9)))
    assert not never.used[:3].any()


def test_the_time_of_rejection_is_the_clocks(outlier):
    """Fixes of 0.2 s of which each is a millisecond late, with an empty epoch before it: 5 s are 5 s."""
    rule, memory, age = gate(kalman()), gate(kalman()).init(9, 6), 0.0
    for _ in range(25):
        age += 0.2
        memory = answer(rule, gate_params(), outlier._replace(T=jnp.array(1e-3), age=jnp.full(6, age)), memory).memory
    np.testing.assert_allclose(memory.rejected[0], 5.0, rtol=1e-12)


def test_recovery_makes_the_innovation_likely_and_leaves_the_attitude_alone(outlier):
    z = outlier
    S = z.H @ z.P @ z.H.T + z.R
    factor = squared_by_block(z.nu, S)[0] / 3
    P = inflate_block(z, S, jnp.array([factor, 1.0]), BLOCKS)
    assert np.linalg.eigvalsh(P - z.P).min() > -1e-9 * np.abs(P).max()
    wide = z.H @ P @ z.H.T + z.R
    assert squared_by_block(z.nu, wide)[0] == pytest.approx(3.0)
    np.testing.assert_allclose(P[6:, 6:], z.P[6:, 6:], rtol=0.02)
    turned, plain = (kalman_correct((), (), z._replace(P=p)).delta for p in (P, z.P))
    assert np.abs(turned[6:]).max() < 0.5 * np.abs(plain[6:]).max()  # though the position goes nearly all the way
    assert turned[0] > 0.9 * z.nu[0] > 1.2 * plain[0]
    one = inflate_block(innovation([30.0, 0, 0, 0, 0, 0], (True,) + (False,) * 5), S, jnp.array([5.0, 1.0]), BLOCKS)
    assert all_finite(one)


def test_channels_that_are_no_blocks_are_refused():
    for make in (gate, student_t):
        with pytest.raises(ValueError, match="blocks of 3"):
            make(kalman()).init(9, 4)


# ------------------------------------------------------------------------------------------------ weights


def one_axis(nu):
    """A fix of one channel, P = 3 and R = 1 there."""
    valid = jnp.arange(6) < 1
    nu, H_, R = masked(jnp.full(6, float(nu)), jnp.asarray(H), jnp.eye(6), valid)
    return Innovation(nu, H_, R, 3.0 * jnp.eye(9), valid, jnp.asarray(T), jnp.full(6, T))


def test_huber_bounds_the_correction():
    """S = 4: within 1.5 sd = 3 the Kalman gain; beyond R = |nu| / 3, so that nu P / (P + R) tends to 9."""
    delta = lambda nu: float(answer(huber(kalman()), huber_params(1.5), one_axis(nu)).delta[0])
    assert delta(-2.9) == pytest.approx(-2.9 * 3 / 4, rel=1e-12)
    for nu in (6.0, -40.0, 1e7):
        assert delta(nu) == pytest.approx(nu * 3 / (3 + abs(nu) / 3), rel=1e-12)
    assert delta(1e7) == pytest.approx(9.0, rel=1e-5)


@pytest.mark.full
def test_student_weight_is_the_fixed_point():
    """w = (dof + 1) / (dof + r^2 + P+), by bisection; large innovations are given up: the correction returns to 0."""
    rule = student_t(kalman(), iterations=60)
    corrections = []
    for nu in (0.0, 2.0, 8.0, 30.0, 1e4):

        def gap(w, nu=nu):
            R = 1 / w
            return (4 + 1) / (4 + (nu * R / (3 + R)) ** 2 + 3 * R / (3 + R)) - w

        low, high = 1e-12, 2.0
        for _ in range(200):
            low, high = ((low + high) / 2, high) if gap((low + high) / 2) > 0 else (low, (low + high) / 2)
        corrections.append(nu * 3 / (3 + 1 / low))
        c = answer(rule, student_t_params(4.0), one_axis(nu))
        assert c.delta[0] == pytest.approx(corrections[-1], rel=1e-6)
    assert corrections[2] > corrections[3] > corrections[4] and corrections[4] < 0.1


# ------------------------------------------------------------------------------------------------ a linear navigator


def phi():
    """Position, velocity and a slow third state, which is an acceleration here, three axes."""
    F = np.zeros((9, 9))
    F[:3, 3:6] = F[3:6, 6:] = np.eye(3)
    return jnp.asarray(np.eye(9) + F + F @ F / 2)


Q = jnp.diag(jnp.repeat(jnp.array([1e-4, 1e-4, 1e-8]), 3))
R = jnp.diag(jnp.repeat(jnp.array([4.0, 0.01]), 3))


@partial(jax.jit, static_argnums=0)
def navigate(rule, theta, fault, noise, push):
    """Errors (E, 9) with position and velocity ``fault`` (E, 6), their noise (E, 6) sd, an unmodelled push (E, 9)."""
    key = jax.random.split(jax.random.key(3), fault.shape[0])

    def step(carry, inputs):
        e, P, memory, age = carry
        key, fault, noise, push = inputs
        a, b = jax.random.split(key)
        e = phi() @ e + jnp.sqrt(jnp.diag(Q)) * jax.random.normal(a, (9,)) + push
        P = phi() @ P @ phi().T + Q
        nu = H @ e - fault - noise * jax.random.normal(b, (6,))
        age = age + T
        z = Innovation(nu, jnp.asarray(H), R, P, jnp.ones(6, bool), jnp.asarray(T), age)
        c = rule.correct(theta, memory, z)
        e = e - c.delta
        f = jnp.broadcast_to(c.fade, (9,))
        return (e, f[:, None] * c.P * f, c.memory, jnp.where(c.used, 0.0, age)), (e, c.used, c.memory)

    start = (jnp.zeros(9), 10 * R[0, 0] * Q, rule.init(9, 6), jnp.zeros(6))
    return jax.lax.scan(step, start, (key, fault, noise, push))[1]


E = 400
CALM = (jnp.zeros((E, 6)), jnp.broadcast_to(jnp.sqrt(jnp.diag(R)), (E, 6)), jnp.zeros((E, 9)))


def window(start, stop):
    return ((jnp.arange(E) >= start) & (jnp.arange(E) < stop))[:, None]


def rms(errors, start=0, stop=E):
    return float(np.sqrt(np.mean(np.asarray(errors)[start:stop, :3] ** 2)))


@pytest.mark.parametrize("name, low, high", [("sage_husa", 7.0, 11.0), ("iae", 6.0, 12.0)])
def test_measurement_noise_is_learnt(name, low, high):
    """Noise of three times the stated sd is a factor 9 on R, on the position alone; then it is sound again."""
    make, theta = ROBUST[name]
    noise = CALM[1] * jnp.where(window(50, 300), jnp.array([3.0] * 3 + [1.0] * 3), 1.0)
    e, used, memory = navigate(make(kalman()), theta, CALM[0], noise, CALM[2])
    factor = np.asarray(memory.learnt.mean(1) if name == "iae" else memory.learnt)
    assert low < factor[150:300, :3].mean() < high
    assert 0.8 < factor[150:300, 3:].mean() < 1.2 and 0.6 < factor[370:].mean() < 1.6
    plain = navigate(kalman(), (), CALM[0], noise, CALM[2])[0]
    assert rms(e, 100, 300) < 0.9 * rms(plain, 100, 300) and used.all()


def test_sage_husa_takes_the_mean_noise_given_the_fix():
    """P = 3 and R = 1: residual nu / 4, P+ = 3 / 4."""
    for nu in (0.0, 2.0, -10.0):
        c = answer(sage_husa(kalman()), sage_husa_params(0.9), one_axis(nu))
        assert c.memory.learnt[0] == pytest.approx(0.9 + 0.1 * (nu**2 / 16 + 0.75))


def test_a_rejected_fix_of_the_inner_rule_is_not_learnt_from():
    z = innovation([3e3, -4e3, 5e3, 0.1, -0.1, 0.05])
    # the R of iae holds this fix already, so that only a gate that takes nothing rejects it
    for make, theta, threshold in ((sage_husa, sage_husa_params(), 3.0), (iae, iae_params(), 1e-6)):
        rule = make(gate(kalman()))
        c = answer(rule, theta._replace(rule=gate_params(threshold, timeout=np.inf)), z)
        rejected = ~np.asarray(c.used)
        assert rejected[:3].all()
        np.testing.assert_array_equal(c.memory.learnt[..., rejected], 1.0)


def test_a_floor_keeps_r_from_vanishing():
    noise = 1e-3 * CALM[1]
    for make, theta in ((sage_husa, sage_husa_params(floor=0.3)), (iae, iae_params(floor=0.3))):
        e, _, memory = navigate(make(kalman()), theta, CALM[0], noise, CALM[2])
        assert all_finite(e) and all_finite(memory)
    z = innovation(np.zeros(6))
    low = iae(kalman()).init(9, 6)
    low = low._replace(learnt=low.learnt * 1e-6)
    c = answer(iae(kalman()), iae_params(0.3), z, low)
    k = kalman_correct((), (), z._replace(R=0.3 * z.R))
    np.testing.assert_allclose(c.P, k.P, rtol=1e-12, atol=1e-15)


def test_fading_ages_the_covariance():
    z = innovation(np.zeros(6))
    c = answer(fading(kalman()), fading_params(50.0), z)
    assert c.fade == pytest.approx(np.exp(0.5 * T / 50))
    twice = answer(fading(fading(kalman())), fading_params(50.0, fading_params(50.0)), z)
    assert twice.fade == pytest.approx(np.exp(T / 50))
    push = CALM[2].at[200, 6].set(0.02)  # an acceleration that Q knows nothing of
    plain, aged = (navigate(*r, *CALM[:2], push)[0] for r in ((kalman(), ()), (fading(kalman()), fading_params(30.0))))
    assert rms(aged, 230, 300) < 0.8 * rms(plain, 230, 300)


@pytest.mark.parametrize("name, bound", [("gate", 0.15), ("huber", 0.6), ("student", 0.2)])
def test_outliers_do_little(name, bound):
    """One position in twenty is 40 m off: what is left of the plain filter's RMS."""
    make, theta = ROBUST[name]
    fault = CALM[0].at[10::20, 0].set(40.0)
    robust = navigate(make(kalman()), theta, fault, *CALM[1:])
    plain = navigate(kalman(), (), fault, *CALM[1:])[0]
    excess = lambda e: np.sqrt(max(rms(e[:, :1]) ** 2 - calm**2, 0))
    calm = rms(navigate(kalman(), (), *CALM)[0][:, :1])
    assert excess(robust[0]) < bound * excess(plain)
    if name == "gate":
        assert not robust[1][10::20, :3].any() and robust[1][:, 3:].mean() > 0.99


def test_a_gate_locks_out_and_recovers():
    """A jump of the navigation itself: for ever without the timeout, over after it with one."""
    push = CALM[2].at[100, :6].set(jnp.array([30.0, 20.0, -40.0, 2.0, -1.0, 2.0]))
    for_ever, recovered = (navigate(gate(kalman()), gate_params(timeout=t), *CALM[:2], push) for t in (np.inf, 10.0))
    assert rms(for_ever[0], 150) > 100 and not for_ever[1][100:].any()
    assert not recovered[1][100:110].any() and recovered[1][150:].mean() > 0.97
    calm = rms(navigate(kalman(), (), *CALM)[0], 250)
    assert rms(recovered[0], 250) < 2 * calm + 0.1


# ------------------------------------------------------------------------------------------------ GPID


def test_the_integral_stands_still_behind_a_gate():
    """Positions 60 m off for a hundred fixes, rejected all along: velocity carries on as in a gated Kalman filter."""
    theta = gpid_params(1.0, 0.5)
    fault = CALM[0] + jnp.where(window(150, 250), jnp.array([60.0, -60.0, 60.0, 0, 0, 0]), 0.0)
    e, used, memory = navigate(gate(gpid()), gate_params(timeout=np.inf, rule=theta), fault, *CALM[1:])
    plain = navigate(gate(kalman()), gate_params(timeout=np.inf), fault, *CALM[1:])[0]
    assert not used[150:250, :3].any() and used[150:250, 3:].mean() > 0.95
    assert rms(e, 150, 250) < 2 * rms(plain, 150, 250) + 1.0
    assert rms(e, 250) < 2.0
    held = np.asarray(memory.rule.integral)[149:250, :3]
    np.testing.assert_array_equal(held, np.broadcast_to(held[0], held.shape))


def test_an_integral_survives_recoveries_from_a_lasting_fault():
    """Accepted and rejected again and again; at a recovery the gain is near 1, where the printed gains are unstable."""
    theta = gate_params(timeout=5.0, rule=gpid_params(1.5, 3.0))
    fault = 40.0 * jax.random.normal(jax.random.key(8), (E, 6)) * jnp.array([1.0, 1, 1, 0, 0, 0]) * window(100, 300)
    e, used, _ = navigate(gate(gpid()), theta, fault, *CALM[1:])
    assert 0 < used[100:300, 0].mean() < 0.5  # some are accepted
    assert rms(e, 100, 300) < 60 and rms(e, 330) < 10


def test_a_state_is_a_kalman_filters_while_its_channels_are_missing():
    """Without positions, with a position integral and old residuals; half of the axes where half of them are there."""
    rule, theta = gpid(), gpid_params(0.3, 0.2)
    memory = rule.init(9, 6)
    for i in range(3):
        memory = answer(rule, theta, innovation(np.arange(6.0) - i, seed=i), memory).memory
    for missing in ((0, 1, 2), (1,)):
        valid = np.ones(6, bool)
        valid[list(missing)] = False
        z = innovation(np.where(valid, 0.1, 0.0), valid, seed=2)
        z = z._replace(H=z.H.at[:, 6:].set(0.0))
        c, k = answer(rule, theta, z, memory), kalman_correct((), (), z)
        np.testing.assert_allclose(c.delta[jnp.array(missing)], k.delta[jnp.array(missing)], rtol=1e-12)
        np.testing.assert_array_equal(c.memory.integral[jnp.array(missing)], memory.integral[jnp.array(missing)])
        assert len(missing) == 3 or abs(c.delta[0] - k.delta[0]) > 0.01


def test_leak_and_reset_of_the_integral():
    rule, z = gpid(), innovation([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
    x = jnp.asarray(np.r_[1.0, -2.0, 3.0, np.zeros(6)])
    memory = rule.init(9, 6)._replace(integral=x)  # no residuals: what is left is the integral alone
    for leak in (0.0, 0.95, 1.0):
        c = answer(rule, gpid_params(0.5, 0.0, leak=leak), z, memory)
        np.testing.assert_array_equal(c.memory.integral, leak * x)
    full = memory._replace(last=jnp.ones(6), before=jnp.full(6, 2.0), loop=jnp.ones((9, 6)))
    old = z._replace(age=jnp.array([11.0, 11.0, 11.0, 1.0, 1.0, 1.0]))
    kept = answer(rule, gpid_params(0.5, 0.3, reset=12.0), old, full)
    leaves_equal(kept, answer(rule, gpid_params(0.5, 0.3), old, full))
    anew = answer(rule, gpid_params(0.5, 0.3, reset=10.0), old, full)
    half = full._replace(
        integral=x / 2, last=full.last.at[:3].set(0.0), before=full.before.at[:3].set(0.0),
        loop=full.loop.at[:, :3].set(0.0),
    )  # fmt: skip
    leaves_equal(anew, answer(rule, gpid_params(0.5, 0.3), old, half), 1e-15)


def test_gains_per_channel():
    """Each channel's residual enters with its own gain, by (25) and (26)."""
    rule, z = gpid(), innovation([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
    ki, kd = jnp.array([0.1, 0.2, 0.3, 0.0, 0.5, 0.6]), jnp.array([0.0, 1.0, 0.5, 0.2, 0.1, 0.0])
    last, before = jnp.arange(1.0, 7.0), jnp.arange(6.0, 0.0, -1.0)
    memory = rule.init(9, 6)._replace(last=last, before=before)
    K = linalg.update(z.P, z.H, z.R)[0]
    position = jnp.arange(9) < 3
    c = answer(rule, gpid_params(ki, kd), z, memory)
    np.testing.assert_allclose(c.memory.integral, position * (K @ (ki * last)), rtol=1e-12)
    expected = K @ z.nu + position * (K @ (ki * last + kd * (last - before)))
    np.testing.assert_allclose(c.delta, expected, rtol=1e-12)


def test_a_gate_sees_everything_with_data_and_no_constraint():
    """A wheel that spins is refused like a fix, a block of its own; a constraint is no data."""
    chosen = (*GNSS, "nonholonomic", "speed")
    nav = initial_nav([0.8, 0.1, 100.0], (0.0, 10.0, 0.0))
    value = jnp.concatenate([nav.pos, nav.vel, jnp.zeros(2), jnp.array([25.0])])
    fix = Fix(value, jnp.ones(9), jnp.zeros(9), jnp.ones(9, bool).at[6:8].set(False))
    used = {}
    for name in ("ekf15", "ekf15_gate", "ekf15_huber"):
        filt = build(name, chosen)
        params = filt.params("consumer")
        _, info = jax.jit(filt.correct)(params, filt.init(params, nav), fix)
        used[name] = np.asarray(info.used)
    assert used["ekf15_gate"][:6].all() and not used["ekf15_gate"][8]
    assert used["ekf15"][8] and used["ekf15_huber"][8]
    slid = fix._replace(value=value.at[8].set(10.0), valid=jnp.ones(9, bool).at[:6].set(False))
    filt = build("ekf15_gate", chosen)
    params = filt.params("consumer")
    east = nav._replace(vel=jnp.array([50.0, 0.0, 0.0]))  # it slides: 50 m/s to the right
    _, info = jax.jit(filt.correct)(params, filt.init(params, east), slid)
    assert np.asarray(info.used)[6:8].all()


@pytest.mark.parametrize("channels, bound", [(1, 10.828), (2, 13.816), (3, 16.266)])
def test_blocks_of_all_sizes_pass_as_many_sound_fixes(channels, bound):
    assert robust.healthy_bound(0.999, channels) == pytest.approx(bound, abs=1e-3)


def test_the_window_of_iae_has_this_fix_in_it():
    """One channel, P = R = 1, a window of four that starts out full: R becomes (1 + 1 + 1 + (nu^2 - 1)) / 4."""
    one = jnp.ones((1, 1))
    z = Innovation(jnp.array([10.0]), one, one, one, jnp.array([True]), jnp.asarray(T), jnp.ones(1))
    rule = iae(kalman(), 4)
    c = rule.correct(iae_params(), rule.init(1, 1), z)
    assert float(c.delta[0]) == pytest.approx(10.0 / (1 + (3 + 99) / 4))
