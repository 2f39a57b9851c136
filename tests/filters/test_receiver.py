"""Hypotheses of a receiver: Bayes' rule by hand, a Kalman filter where nothing goes wrong, faults, no lock-out."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from benchmarks.simulated.faults import SEEN, spoilt
from jaxnav import build
from jaxnav.analysis import metrics
from jaxnav.filters.rule import Innovation, Transition
from jaxnav.filters.rules.kalman import correct as kalman
from jaxnav.filters.rules.receiver import FAULT_MODELS, OFFSET, Hypotheses, receiver, receiver_params
from jaxnav.filters.rules.robust import gate
from jaxnav.filters.run import run
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params, simulate

N, T, NAMES = 9, 0.2, ("healthy", "noisy", *FAULT_MODELS)
RULE, THETA = receiver(), receiver_params()


def innovation(nu, seed=0) -> Innovation:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(N, N)) * np.repeat([1.0, 0.1, 0.01], 3)[:, None]
    R = np.diag(np.repeat([4.0, 0.01], 3))
    return Innovation(
        jnp.asarray(nu, float), jnp.eye(6, N), jnp.asarray(R), jnp.asarray(A @ A.T), jnp.ones(6, bool), jnp.asarray(T),
        jnp.full(6, T),
    )  # fmt: skip


def after_a_while(seed=0) -> Hypotheses:
    """A memory as it may be: everything different, the weights a distribution."""
    rng = np.random.default_rng(seed)
    M, size = len(NAMES), N + OFFSET
    scale = np.repeat([1.0, 0.1, 0.01, 3.0, 0.3], 3)
    root = rng.normal(size=(M, size, size)) * scale[:, None]
    weight = np.log(rng.dirichlet(np.ones(M)))
    return Hypotheses(*(jnp.asarray(a) for a in (
        rng.normal(size=(M, size)) * scale, root @ root.transpose(0, 2, 1) / size, weight, rng.uniform(0, 90, M), T,
        np.array([1.0, 2.0, 3.0, 30.0]),  # navigation is held to be lost at this fix, if at all
    )))  # fmt: skip


@pytest.mark.full
def test_a_receiver_that_is_never_wrong_is_a_kalman_filters():
    sound = THETA._replace(wrong=jnp.zeros(()))
    z = innovation([3.0, -2.0, 1.0, 0.1, 0.0, -0.2])
    c, k = RULE.correct(sound, RULE.init(N, 6), z), kalman((), (), z)
    np.testing.assert_allclose(c.delta, k.delta, rtol=1e-10)
    np.testing.assert_allclose(c.P, k.P, rtol=1e-9, atol=1e-12)
    assert c.used.all()


def test_weights_are_bayes_rule_on_a_jump_process():
    """What comes into the healthy and into a jumped receiver, one density after the other, by scipy."""
    memory, z = after_a_while(), innovation([6.0, -3.0, 2.0, 0.5, -0.1, 0.3])
    c = jax.jit(RULE.correct)(THETA, memory, z)
    H = np.concatenate([np.eye(6, N), np.eye(6)], 1)
    old = np.exp(memory.weight)

    def density(dev, P):
        return multivariate_normal(H @ dev, H @ P @ H.T + np.asarray(z.R)).pdf(np.asarray(z.nu))

    bare = np.arange(N + OFFSET) < N
    dev0, P0 = np.where(bare, memory.dev, 0.0), np.where(bare[:, None] & bare, memory.P, 0.0)
    far = np.clip((np.asarray(memory.age) - 65.0) / 10.0, 0.0, 1.0)  # as the defaults have it
    ends, lost, fades = 0.01 * T * (1 - far), 0.5 * far, np.clip(0.01 * T * (1 - far) + 2.0 * T * far, 0.0, 0.9)
    wide = np.diag(np.r_[np.repeat([200.0**2, 15.0**2], 3), np.zeros(9)])
    healthy = old[0] * density(dev0[0], P0[0])
    for i in range(1, len(NAMES)):
        healthy += old[i] * max(ends[i], 1e-300) * density(dev0[i], P0[i])
        healthy += old[i] * max(lost[i], 1e-300) * density(dev0[i], P0[i] + wide)
    i = NAMES.index("jump")
    opened = np.diag(np.r_[np.zeros(N), np.repeat([60.0**2, 10.0**2], 3)])
    jumped = old[i] * (1 - fades[i]) * density(np.asarray(memory.dev[i]), np.asarray(memory.P[i]))
    jumped += old[0] * 1e-3 * T * density(dev0[0], P0[0] + opened)
    assert c.memory.weight[i] - c.memory.weight[0] == pytest.approx(np.log(jumped / healthy), rel=1e-9)
    assert np.exp(c.memory.weight).sum() == pytest.approx(1.0)


def test_the_answer_is_the_mixtures_mean_and_covariance():
    memory = after_a_while(1)
    c = jax.jit(RULE.correct)(THETA, memory, innovation([6.0, -3.0, 2.0, 0.5, -0.1, 0.3], 1))
    share = np.exp(c.memory.weight)
    np.testing.assert_allclose(share @ np.asarray(c.memory.dev)[:, :N], np.zeros(N), atol=1e-12)  # about it
    dev, P = np.asarray(c.memory.dev)[:, :N], np.asarray(c.memory.P)[:, :N, :N]
    spread = np.einsum("m,mij->ij", share, P) + np.einsum("m,mi,mj->ij", share, dev, dev)
    np.testing.assert_allclose(c.P, spread, rtol=1e-9, atol=1e-12)


def test_hypotheses_move_with_the_error_state():
    """Samples of x' = Phi x + w, o' a walk, o its integral: mean and covariance of a slide after an epoch."""
    rng = np.random.default_rng(0)
    Phi, L = np.eye(N) + 0.1 * rng.normal(size=(N, N)), 0.1 * rng.normal(size=(N, N))
    memory = after_a_while()
    moved = Transition(jnp.asarray(Phi), jnp.asarray(L @ L.T), jnp.zeros(N))
    after = RULE.transport(THETA, memory, moved, jnp.asarray(T))
    A, Q = np.eye(N + OFFSET), np.zeros((N + OFFSET, N + OFFSET))
    A[:N, :N], Q[:N, :N] = Phi, L @ L.T
    A[N : N + 3, N + 3 :] = T * np.eye(3)
    walk = 2.0**2 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    Q[N:, N:] = np.kron(walk, np.eye(3))
    i = NAMES.index("ramp")
    np.testing.assert_allclose(after.dev[i], A @ np.asarray(memory.dev[i]), rtol=1e-12)
    np.testing.assert_allclose(after.P[i], A @ np.asarray(memory.P[i]) @ A.T + Q, rtol=1e-9, atol=1e-12)
    A[N : N + 3, N + 3 :] = 0.0
    i = NAMES.index("independent jumps")
    np.testing.assert_allclose(after.dev[i], A @ np.asarray(memory.dev[i]), rtol=1e-12)
    assert after.age[0] == memory.age[0] and after.age[1] == memory.age[1] + T and after.since == 2 * T


def test_it_can_be_in_no_other_rule():
    with pytest.raises(ValueError, match="cannot be inside of another"):
        gate(RULE)
    with pytest.raises(ValueError, match="needs its position"):
        build("ekf15_receiver", ("velocity",))


# ---------------------------------------------------------------------------- drives


@pytest.fixture(scope="module")
def drives():
    """Two drives of 180 s, 5 Hz of fixes, and the filter's errors on them by fixes of one's own."""
    urban = SCENARIOS["urban_short"]
    what = urban._replace(
        duration_s=180.0, imu_rate_hz=25.0, gnss_rate_hz=5.0, gnss=urban.gnss._replace(outages_s=()),
        imu=urban.imu._replace(grade="consumer"),
    )  # fmt: skip
    filt = build("ekf15_receiver", cov_stride=5)
    params = matched_params(what)._replace(rule=THETA)
    keys = jax.random.split(jax.random.key(3), 2)
    sims = jax.jit(jax.vmap(partial(simulate, scenario=what)))(keys)

    @jax.jit
    def errors(value):
        def one(sim, value):
            info = run(filt, params, sim.initial, sim.epochs._replace(fix=sim.epochs.fix._replace(value=value)))
            off = jax.vmap(metrics.position_error)(info.nav, sim.truth.pos)
            return jnp.hypot(off[:, 0], off[:, 1]), info.used[:, 0], info.ok

        return jax.vmap(one)(sims, value)

    return sims, keys, errors


@pytest.mark.full
def test_without_faults_it_costs_nothing_and_with_one_it_holds(drives):
    sims, keys, errors = drives
    clean, used, ok = errors(sims.epochs.fix.value)
    assert ok.all() and used.mean() > 0.999
    for kind in ("slide of 60 m and back, 8 s", "step of 60 m, 3 s", "velocity off by 5 m/s, 15 s"):
        value, wrong = spoilt(SEEN[kind], sims, keys)
        off, used, ok = errors(value)
        assert ok.all() and off[:, 250:].max() < 3.0, kind  # plain filters are off by 10 to 70 m
        assert not used[:, wrong][:, 5:].any() or "step" not in kind
        assert used[:, -50:].mean() > 0.99, kind


@pytest.mark.full
def test_hypotheses_turn_with_the_attitude_at_a_reset():
    """With a healthy receiver for certain and a large attitude error, P is the Kalman filter's after every fix."""
    what = SCENARIOS["urban_short"]._replace(duration_s=10.0, imu_rate_hz=25.0, gnss_rate_hz=5.0)
    sim = simulate(jax.random.key(0), what)
    params = matched_params(what)
    params = params._replace(prior=params.prior._replace(attitude=jnp.array([0.05, 0.05, 0.4])))
    sound = THETA._replace(wrong=jnp.zeros(()))
    P = [
        run(build(name, cov_stride=5), params._replace(rule=rule), sim.initial, sim.epochs).P
        for name, rule in (("ekf15", ()), ("ekf15_receiver", sound))
    ]
    sd = np.sqrt(np.einsum("eii->ei", P[0]))
    np.testing.assert_allclose(P[1] / sd[:, :, None] / sd[:, None], P[0] / sd[:, :, None] / sd[:, None], atol=1e-6)


@pytest.mark.full
def test_it_recovers_from_a_slow_drag_off(drives):
    """A slide of 30 m in a minute looks like an accelerometer bias until it ends by a jump; at 151 s it is over."""
    sims, keys, errors = drives
    value, _ = spoilt(SEEN["slide of 30 m, 60 s, then a jump back"], sims, keys)
    off, used, ok = errors(value)
    assert ok.all() and off[:, 800:].max() < 2.0  # without the hypotheses `drag-off` 10 to 30 m
    assert used[:, -50:].mean() > 0.99


@pytest.mark.full
def test_it_does_not_lock_out_for_ever(drives):
    """A receiver that jumps and stays there is not believed for a minute, and is in the end."""
    sims, keys, errors = drives
    value, _ = spoilt((SEEN["step of 60 m, 3 s"][0]._replace(start_s=60.0, stop_s=1e9),), sims, keys)
    off, used, _ = errors(value)
    assert not used[:, 310:500].any() and used[:, -50:].all()
    assert np.abs(np.asarray(off)[:, -50:] - 76.8).max() < 5.0  # 60 m east and 48 m north
