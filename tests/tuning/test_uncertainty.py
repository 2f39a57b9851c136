"""Intervals and identifiability against closed forms; the method of scoring against the estimates it must find."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.flatten_util import ravel_pytree

from tests.tuning.tangents import information
from tuning import uncertainty
from tuning.fit.transforms import IDENTITY, LOG, factor, join, split, tied, with_prior
from tuning.recordings import scoring


class Innovations(NamedTuple):
    """The fields of an Info that a likelihood needs."""

    nu: jax.Array
    S: jax.Array
    valid: jax.Array
    used: jax.Array
    ok: jax.Array


def white(y):
    """Independent samples of unknown log sd r[0] and mean r[1]."""

    def solve(r):
        S = jnp.broadcast_to(jnp.exp(2 * r[0]), (y.size, 1, 1))
        return Innovations((y - r[1])[:, None], S, *[jnp.ones((y.size, 1), bool)] * 2, jnp.ones(y.size, bool))

    return solve


def local_level(y):
    """Random walk of log sd r[0] seen with noise of log sd r[1]; the scalar Kalman filter."""

    def solve(r):
        q, v = jnp.exp(2 * r)

        def step(xP, yi):
            x, P = xP
            P = P + q
            S = P + v
            nu = yi - x
            return (x + P / S * nu, P * v / S), (nu[None], S[None, None])

        _, (nu, S) = lax.scan(step, (jnp.zeros(()), jnp.zeros(())), y)
        return Innovations(nu, S, *[jnp.ones((y.size, 1), bool)] * 2, jnp.ones(y.size, bool))

    return solve


def draw(key, n, q, v):
    a, b = jax.random.normal(key, (2, n), float)
    return jnp.cumsum(q * a) + v * b


def inform(solve, raw, n, per=10):
    return information(solve, raw, jnp.ones(n, bool), jnp.arange(n) // per, n // per)


def test_white_noise_has_the_textbook_information():
    n, y = 200, jnp.asarray(np.random.default_rng(0).normal(0.3, 2.0, 200))
    raw = jnp.array([0.5, 0.1])
    got = inform(white(y), raw, n)
    z = (np.asarray(y) - 0.1) / np.exp(0.5)
    np.testing.assert_allclose(got.nll, 0.5 * np.sum(z**2 + 2 * 0.5 + np.log(2 * np.pi)), rtol=1e-12)
    np.testing.assert_allclose(got.score, [np.sum(1 - z**2), -np.sum(z) / np.exp(0.5)], rtol=1e-10)
    np.testing.assert_allclose(got.fisher, [[2 * n, 0], [0, n / np.exp(1.0)]], atol=1e-9)
    np.testing.assert_allclose(got.blocks.sum(0), got.score, rtol=1e-10)
    half = information(white(y), raw, jnp.arange(n) < 100, jnp.arange(n) // 10, 20)
    assert half.fisher[0, 0] == pytest.approx(n) and not np.any(half.blocks[10:])


def test_score_is_the_gradient_and_information_its_expected_square():
    n, raw = 60, jnp.log(jnp.array([0.5, 1.0]))
    keys = jax.random.split(jax.random.key(1), 3000)

    @jax.jit
    @jax.vmap
    def many(key):
        return inform(local_level(draw(key, n, 0.5, 1.0)), raw, n)

    def nll(r, y):
        info = local_level(y)(r)
        return 0.5 * jnp.sum(info.nu[:, 0] ** 2 / info.S[:, 0, 0] + jnp.log(2 * jnp.pi * info.S[:, 0, 0]))

    got = many(keys)
    y = draw(keys[0], n, 0.5, 1.0)
    np.testing.assert_allclose(got.score[0], jax.grad(nll)(raw, y), rtol=1e-9)
    square = np.einsum("ki,kj->ij", got.score, got.score) / len(keys)
    np.testing.assert_allclose(square, got.fisher.mean(0), rtol=0.12, atol=1.5)


def test_scoring_finds_the_estimate_and_intervals_cover_the_truth():
    n, truth = 300, np.log([0.4, 1.0])
    y = jax.vmap(lambda k: draw(k, n, 0.4, 1.0))(jax.random.split(jax.random.key(2), 200))
    many = jax.jit(jax.vmap(lambda r, y: inform(local_level(y), r, n)))
    found = scoring.maximise(lambda r: many(r, y), jnp.tile(truth + np.log(10.0), (200, 1)))
    assert np.abs(found.best.score).max() < 0.5  # against an information of hundreds
    cov = [uncertainty.covariance(f, b) for f, b in zip(found.best.fisher, found.best.blocks, strict=True)]
    spec = {"noise": LOG}
    inside = [
        [i.low <= t <= i.high for i, t in zip(uncertainty.intervals(spec, {"noise": r}, c), [0.4, 1.0], strict=True)]
        for r, c in zip(found.raw, cov, strict=True)
    ]
    share = np.mean(inside, axis=0)
    assert (share > 0.92).all() and (share < 0.995).all()


def test_sandwich_sees_tails_that_the_model_does_not():
    rng, n = np.random.default_rng(3), 20_000
    y = rng.laplace(size=n)  # kurtosis 6: the variance of a log sd is (6 - 1) / 4n, not 1 / 2n
    raw = jnp.array([0.5 * np.log(np.mean(y**2)), 0.0])
    got = inform(white(jnp.asarray(y)), raw, n)
    cov = uncertainty.covariance(got.fisher, got.blocks)
    assert cov.model[0, 0] == pytest.approx(1 / (2 * n)) and cov.blocks == n // 10
    assert cov.sandwich[0, 0] == pytest.approx(5 / (4 * n), rel=0.2)
    wide = uncertainty.intervals({"a": IDENTITY}, {"a": raw}, cov)[0]
    assert wide.sd == pytest.approx(np.sqrt(5 / (4 * n)), rel=0.1)
    few = uncertainty.intervals({"a": IDENTITY}, {"a": raw}, cov._replace(blocks=11))[0]
    assert few.sd == pytest.approx(np.sqrt(1 / (2 * n)))  # too few blocks for a sandwich of two numbers


def test_intervals_of_correlations_are_fishers():
    """N samples of three axes: an sd is known to 1 / sqrt(2 N), the z of every correlation to 1 / sqrt(N)."""
    n, spec = 400, {"noise": factor(3)}
    L = np.array([[2.0, 0, 0], [3.0, 1.0, 0], [-0.5, 0.8, 0.3]])
    nu = jnp.asarray(np.random.default_rng(6).normal(size=(n, 3)) @ L.T)

    def solve(r):
        root = factor(3).forward(r)
        return Innovations(
            nu, jnp.broadcast_to(root @ root.T, (n, 3, 3)), *[jnp.ones((n, 3), bool)] * 2, jnp.ones(n, bool)
        )

    raw = factor(3).inverse(jnp.asarray(L))
    cov = uncertainty.covariance(jax.jit(lambda r: inform(solve, r, n).fisher)(raw), np.zeros((0, 6)))
    found = uncertainty.intervals(spec, {"noise": raw}, cov)
    np.testing.assert_allclose([i.sd for i in found], np.sqrt(np.repeat([1 / (2 * n), 1 / n], 3)), rtol=1e-9)
    S = L @ L.T
    assert found[5].name == "noise[2,1]" and found[5].value == pytest.approx(S[2, 1] / np.sqrt(S[1, 1] * S[2, 2]))
    z = np.arctanh([found[5].low, found[5].value, found[5].high])
    np.testing.assert_allclose(np.diff(z), 1.96 / np.sqrt(n), rtol=1e-3)
    # the correlation of 2 and 1 given 0 is not that of 2 and 1: it moves with the one of 1 and 0
    alone = uncertainty.Covariance(np.diag([0, 0, 0, 0.04, 0, 0.0]), np.zeros((6, 6)), 0)

    def correlation(step):
        S = (root := factor(3).forward(raw.at[3].add(step))) @ root.T
        return np.arctanh(S[2, 1] / np.sqrt(S[1, 1] * S[2, 2]))

    slope = abs(correlation(1e-5) - correlation(-1e-5)) / 2e-5
    got = [i.sd for i in uncertainty.intervals(spec, {"noise": raw}, alone)]
    np.testing.assert_allclose(got, [0, 0, 0, 0.2, 0, 0.2 * slope], rtol=1e-6, atol=1e-12)


def test_a_frozen_run_is_no_likely_one():
    """Epochs after a failure say nothing: fewer terms of a sum that is positive would look better."""
    y = jnp.asarray(np.random.default_rng(7).normal(size=100))

    def solve(r):  # fails at the sd that the data have
        info, fine = white(y)(r), jnp.arange(100) < jnp.where(r[0] < 0.5, 30, 100)
        return info._replace(nu=jnp.where(fine[:, None], info.nu, 0.0), valid=fine[:, None], ok=fine)

    start, of = jnp.array([1.0, 0.0]), jax.jit(lambda r: inform(solve, r, 100))
    assert np.isinf(of(jnp.zeros(2)).nll) and np.isfinite(of(start).nll)
    keep, one = jnp.arange(100) < 20, jnp.zeros(100, int)
    early = jax.jit(lambda r: information(solve, r, keep, one, 1))(jnp.zeros(2))
    assert np.isfinite(early.nll)  # where nothing after the failure counts
    found = scoring.maximise(of, start)
    assert np.isfinite(found.best.nll) and found.raw[0] >= 0.5


def test_trials_that_are_valued_first_spare_information():
    """On a narrow valley the same end, and the information only where a trial is taken."""
    start, asked = jnp.array([-1.0, 1.5]), []

    def residuals(r):
        return jnp.stack([1 - r[0], 10 * (r[1] - r[0] ** 2)])

    def of(r):
        asked.append(r)
        y, J = residuals(r), jax.jacobian(residuals)(r)
        return uncertainty.Information(0.5 * y @ y, J.T @ y, J.T @ J, jnp.zeros((1, 2)))

    plain = scoring.maximise(of, start)
    count = len(asked)
    asked.clear()
    first = scoring.maximise(of, start, values=jax.vmap(lambda r: 0.5 * residuals(r) @ residuals(r)))
    np.testing.assert_allclose(plain.raw, 1.0, atol=0.05)
    np.testing.assert_allclose(first.raw, 1.0, atol=0.05)
    assert len(asked) == 1 + int(first.steps) < count


def test_combinations_that_the_data_cannot_tell_apart_are_named():
    y = jnp.asarray(np.random.default_rng(4).normal(size=100))
    spec, only_sum = {"a": LOG, "b": LOG}, lambda r: white(y)(jnp.array([r[0] + r[1], 0.0]))
    got = inform(only_sum, jnp.zeros(2), 100)
    cov = uncertainty.covariance(got.fisher, got.blocks)
    (said,) = uncertainty.identifiability(["a", "b"], cov.model)
    assert said.code == "tune.indistinguishable" and " against " in said.message and "any amount" in said.message
    found = uncertainty.intervals(spec, {"a": jnp.zeros(()), "b": jnp.zeros(())}, cov)
    assert not any(i.identified for i in found)
    idle = inform(lambda r: white(y)(r[:1].repeat(2) * jnp.array([1.0, 0.0])), jnp.zeros(2), 100)
    (said,) = uncertainty.identifiability(["a", "b"], uncertainty.covariance(idle.fisher, idle.blocks).model)
    assert (said.code, said.subject) == ("tune.undetermined", "b")
    assert uncertainty.identifiability(["a"], np.array([[0.01]])) == []
    many = 40 * np.ones((40, 40)) + 1e-4 * np.eye(40)  # a combination of all, to which each adds a sixth of one
    (said,) = uncertainty.identifiability([f"p{i}" for i in range(40)], many)
    assert said.subject.count(", p") == uncertainty.MAX_NAMED - 2 and "not distinguishable" in said.message


def test_a_prior_determines_what_the_data_do_not():
    y = jnp.asarray(np.random.default_rng(5).normal(size=100))
    spec = {"a": LOG, "b": with_prior(LOG, 3.0, 0.5)}
    raw = {"a": jnp.zeros(()), "b": jnp.log(3.0) + 1.0}
    flat, _ = ravel_pytree(raw)
    plain = inform(lambda r: white(y)(r * jnp.array([1.0, 0.0])), flat, 100)
    got = uncertainty.with_prior(plain, spec, raw)
    assert got.score[1] == pytest.approx(1.0 / 0.25) and got.nll - plain.nll == pytest.approx(2.0)
    sd = [i.sd for i in uncertainty.intervals(spec, raw, uncertainty.covariance(got.fisher, got.blocks))]
    assert sd == pytest.approx([np.sqrt(1 / 200), 0.5], rel=1e-3)
    assert plain.fisher[0, 0] == got.fisher[0, 0]


def test_ties_and_priors_in_a_spec():
    class Leaves(NamedTuple):
        scale: jax.Array
        tau: jax.Array
        other: jax.Array

    start = Leaves(jnp.array([1.0, 4.0, 9.0]), jnp.array(5.0), jnp.array(7.0))
    spec = {"scale": tied(LOG, (0, 0, 1)), "tau": tied(LOG, (), ("other",))}
    raw = split(spec, start)
    assert raw["scale"].shape == (2,) and raw["tau"].shape == ()
    after = join(spec, raw, start)
    np.testing.assert_allclose(after.scale, [2, 2, 9])  # the mean of logarithms
    assert float(after.other) == float(after.tau) == pytest.approx(5.0)


def test_the_sandwich_counts_the_spread_of_scores_and_not_their_mean():
    """Scores that are all alike have none; those that differ have their sample variance, K times."""
    alike = uncertainty.covariance(np.eye(1), np.full((5, 1), 2.0))
    assert alike.sandwich[0, 0] == pytest.approx(0.0) and alike.blocks == 5
    scores = np.array([[1.0], [2.0], [6.0]])
    assert uncertainty.covariance(np.eye(1), scores).sandwich[0, 0] == pytest.approx(3 * np.var(scores, ddof=1))
