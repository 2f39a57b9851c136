"""The rule that chooses between fading and a new R: what its inputs tell apart, and what it then does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.papers.learned import learned, learned_params
from jaxnav.filters.papers.fuzzy_combined import CombinedMemory, combined_params, deciding, fuzzy_combined, inputs
from jaxnav.filters.papers.fwekf import Window
from jaxnav.filters.rule import Innovation
from jaxnav.filters.rules.kalman import kalman
from tests.conftest import leaves_equal

SD = np.repeat([10.0, 0.2], 3)  # what the fixes say of themselves
THETA, N = combined_params(), 20
RULE = fuzzy_combined(N)
correct, see = jax.jit(RULE.correct), jax.jit(inputs, static_argnums=4)


def innovation(nu, valid=None, sd=SD):
    """A filter that has converged: its P is small beside R."""
    valid = jnp.ones(6, bool) if valid is None else valid
    H, P = jnp.eye(6, 9), jnp.diag(jnp.asarray(np.r_[0.1 * SD, np.full(3, 1e-3)]) ** 2)
    return Innovation(jnp.where(valid, nu, 0.0), jnp.where(valid[:, None], H, 0.0), jnp.diag(jnp.asarray(sd) ** 2), P,
                      valid, jnp.ones(()), jnp.ones(6))  # fmt: skip


def after(residuals):
    """The correction after these residuals (K, 6)."""
    memory = RULE.init(9, 6)
    for nu in jnp.asarray(residuals):
        c = correct(THETA, memory, innovation(nu))
        memory = c.memory
    return c


def residuals(K=60, scale=(1.0, 1.0), bias=(0.0, 0.0), seed=0):
    z = np.random.default_rng(seed).normal(size=(K, 6))
    return SD * (z * np.repeat(scale, 3) + np.repeat(bias, 3))


def test_inputs_tell_a_wrong_model_from_a_wrong_receiver():
    z = innovation(jnp.zeros(6))
    for bias, m_expected in (((0.0, 0.0), 0.0), ((3.0, 0.0), 0.0), ((0.0, 3.0), 0.85), ((3.0, 3.0), 0.85)):
        many = [residuals(N, bias=bias, seed=s) for s in range(200)]
        m, e, square = jax.vmap(lambda r: see(jnp.asarray(5.0), Window(r, jnp.ones((N, 6), bool)), z, z.R, -1))(
            jnp.asarray(np.stack(many))
        )
        np.testing.assert_allclose(m.mean(), m_expected, atol=0.13)
        expected = np.log10(1 + (N * (1 + np.square(bias)) / 1.01 + 5) / (N + 5))
        np.testing.assert_allclose(e.mean(0), expected, atol=0.03)
        np.testing.assert_allclose(
            np.sqrt(square.mean(0)[1]), 0.2 * np.sqrt((N * (1 + bias[1] ** 2) + 5) / (N + 5)), rtol=0.03
        )


def test_it_does_what_the_case_needs():
    healthy, jump, biased = (after(residuals(bias=b)) for b in ((0.0, 0.0), (3.0, 0.0), (0.0, 3.0)))
    assert np.abs(np.asarray(healthy.fade) - 1).max() < 5e-3
    np.testing.assert_allclose(healthy.memory.log_factor, 0, atol=0.5)
    # fixes off in position alone: their R grows, nothing fades, velocity keeps its R
    np.testing.assert_allclose(np.exp(jump.memory.log_factor), [10, 1], rtol=0.5)
    assert np.abs(np.asarray(jump.fade) - 1).max() < 0.01
    # a mean in velocity is the model's: it fades, and R stays
    assert float(biased.fade[0]) > 1.02
    assert float(biased.memory.log_factor[1]) < 1.2 < np.log(10) / 1.5  # what a while of doubt has let through
    # a receiver five times worse, or ten times better, than it says
    np.testing.assert_allclose(np.exp(after(residuals(scale=(5.0, 5.0))).memory.log_factor), 25, rtol=0.5)
    better = np.exp(after(residuals(scale=(0.3, 0.3))).memory.log_factor)
    assert (better < 0.3).all() and (better > 0.05).all()


def test_a_missing_block_keeps_its_factor_and_says_nothing():
    c = after(residuals(bias=(3.0, 0.0)))
    gone = jnp.array([False] * 3 + [True] * 3)
    d = correct(THETA, c.memory, innovation(jnp.asarray(SD), gone))
    assert float(d.memory.log_factor[0]) == float(c.memory.log_factor[0])
    np.testing.assert_array_equal(d.delta[:3], 0)
    finite = jax.jit(
        jax.grad(lambda theta: RULE.correct(theta, c.memory, innovation(jnp.zeros(6), jnp.zeros(6, bool))).P.sum())
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(finite(THETA)))


def test_with_both_answers_shut_it_is_the_kalman_filter():
    shut = lambda s, v: s._replace(bounds=jnp.full(2, v))
    theta = THETA._replace(fade=shut(THETA.fade, 1.0), adapt=shut(THETA.adapt, 0.0))
    z = innovation(jnp.asarray(residuals(1)[0]))
    c, plain = correct(theta, RULE.init(9, 6), z), kalman().correct((), (), z)
    leaves_equal((c.delta, c.P, c.fade), (plain.delta, plain.P, np.ones(9)), 1e-12)


def test_channels_come_in_blocks():
    with pytest.raises(ValueError, match="blocks of 3"):
        RULE.init(9, 8)
    assert isinstance(RULE.init(9, 6), CombinedMemory)


def test_deciding_for_nothing_is_the_kalman_filter_and_a_network_at_its_start_for_the_same_everywhere():
    """a = 1 and no way to a new R; random features of the inputs of which nothing is made yet."""
    z = Innovation(jnp.arange(1.0, 7.0), jnp.eye(6, 9), jnp.eye(6), 2 * jnp.eye(9), jnp.ones(6, bool), jnp.ones(()),
                   jnp.ones(6))  # fmt: skip
    nothing = deciding(lambda theta, m, e: (jnp.ones(()), jnp.zeros(2)), 20, -1)
    theta = learned_params()
    c = nothing.correct(theta, nothing.init(9, 6), z)
    plain = kalman().correct((), (), z)
    np.testing.assert_allclose(c.delta, plain.delta, atol=1e-12)
    np.testing.assert_allclose(c.P, plain.P, atol=1e-12)
    rule = learned()
    small, large = (rule.correct(theta, rule.init(9, 6), z._replace(nu=k * z.nu)) for k in (1e-3, 1e3))
    np.testing.assert_allclose(small.fade, large.fade, rtol=1e-6)  # but for what a limit takes of a large P
    assert 1.0 < float(small.fade.max()) < 1.001
    moved = theta._replace(net=theta.net._replace(out=theta.net.out.at[0].set(1.0)))
    small, large = (rule.correct(moved, rule.init(9, 6), z._replace(nu=k * z.nu)) for k in (1e-3, 1e3))
    assert abs(float(small.fade.max() - large.fade.max())) > 1e-5
