"""Terms of the likelihood of recorded tuning: those of the traced forms, and derivatives by differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuning.tangents import gaussian
from tuning.recordings import evidence
from tuning.recordings.evidence import STEP, gated_terms, gaussian_terms

N, M, P = 7, 4, 3


@pytest.fixture(scope="module")
def drawn():
    """Residuals with missing and rejected channels, their covariances and derivatives."""
    rng = np.random.default_rng(3)
    root, slopes = rng.normal(size=(N, M, M)), rng.normal(size=(N, P, M, M))
    valid = rng.random((N, M)) < 0.8
    both = valid[:, :, None] & valid[:, None]
    S = np.where(both, root @ np.swapaxes(root, 1, 2) + np.eye(M), np.eye(M))
    dS = np.where(both[:, None], slopes + np.swapaxes(slopes, 2, 3), 0.0)
    nu = np.where(valid, 3 * rng.normal(size=(N, M)), 0.0)
    dnu = np.where(valid[:, None], rng.normal(size=(N, P, M)), 0.0)
    return nu, S, valid, dnu, dS, valid & (rng.random((N, M)) < 0.6)


def equal(found, expected):
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("heavy", [False, True])
def test_terms_are_those_of_the_traced_form(drawn, heavy):
    nu, S, valid, dnu, dS, _ = drawn
    flags = np.full(N, heavy)
    equal(gaussian_terms(nu, S, valid, dnu, dS, flags), jax.vmap(gaussian)(nu, S, valid, dnu, dS, flags))


@pytest.mark.parametrize("alone", [(), (1, 3), (0, 1, 2, 3)])
def test_rejected_channels_that_are_tested_alone_have_terms_of_their_own(drawn, alone):
    nu, S, valid, dnu, dS, used = drawn
    flags = np.isin(np.arange(M), alone)
    for n in range(N):
        out = valid[n] & ~used[n] & flags
        parts = [(np.flatnonzero(valid[n] & ~out), bool((valid[n] & ~used[n] & ~flags).any()))]
        parts += [(np.array([i]), True) for i in np.flatnonzero(out)]
        expected = [np.zeros(()), np.zeros(P), np.zeros((P, P))]
        for i, heavy in parts:
            if i.size:
                here = np.ix_(i, i)
                slopes = dnu[n][:, i], np.array([slope[here] for slope in dS[n]])
                found = gaussian(nu[n][i], S[n][here], np.ones(i.size, bool), *slopes, heavy)
                expected = [a + np.asarray(b) for a, b in zip(expected, found, strict=True)]
        one = [a[n : n + 1] for a in (nu, S, valid, used, dnu, dS)]
        equal([a[0] for a in gated_terms(*one, flags)], expected)


@pytest.mark.full
def test_scores_are_derivatives_of_the_objective(job):
    """Of J's likelihood by central differences of itself; and the differences on lanes agree with tangents."""
    mine = job[0]()
    x, h = np.asarray(mine.flat), 1e-3
    found = mine.evidence(jnp.asarray(x))
    for i in range(x.size):
        up, down = (mine.evidence(jnp.asarray(x + sign * h * np.eye(x.size)[i])) for sign in (1, -1))
        for k in (0, 1):
            slope = (up[k].value - down[k].value) / (2 * h)
            np.testing.assert_allclose(found[k].score[i], slope, rtol=2e-4, atol=1e-3)
    assert STEP < h


def test_differences_do_not_see_the_jumps_of_a_gate():
    """Of one parabola an epoch: central where both sides decide alike, else one-sided, 0 where neither does."""
    x, E = 0.7, 4
    value = lambda x: np.stack([(k + 1) * x**2 for k in range(E)])
    a = np.stack([value(x), value(x + STEP), value(x - STEP)])[None, :, :, None]
    same = np.ones((1, 3, E), bool)
    a[0, 1, 1] += 5.0  # a jump of the step above, from the second epoch on, and of that below in the last
    same[0, 1, 1:], same[0, 2, 3] = False, False
    found = evidence.differences(a, same)[:, 0, 0]
    np.testing.assert_allclose(found[:3], 2 * x * np.array([1.0, 2.0, 3.0]), rtol=2e-4)
    np.testing.assert_allclose(found[0], 2 * x, rtol=1e-9)
    assert found[3] == 0.0


@pytest.mark.full
def test_phases_of_a_long_recording_go_one_after_the_other(job, monkeypatch):
    mine = job[0]()
    together = mine.evidence(mine.flat)
    monkeypatch.setattr(evidence, "MAX_LANE_EPOCHS", 1)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), together, mine.evidence(mine.flat))
