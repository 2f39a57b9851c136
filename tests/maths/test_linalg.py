"""Gain, covariance and their derivatives: definite where the short form is not, and against plain formulas."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.maths import linalg
from tests.conftest import all_finite


def test_joseph_keeps_the_covariance_definite():
    """Ten thousand precise fixes of a huge prior: the short form goes indefinite on the way, this one never."""
    rng = np.random.default_rng(5)
    H = jnp.asarray(rng.normal(size=(3, 9)))
    Phi = jnp.eye(9) + 0.01 * jnp.asarray(rng.normal(size=(9, 9)))
    Phi = Phi / jnp.linalg.norm(Phi, 2)
    R = 1e-8 * jnp.eye(3)

    def step(P, _, short):
        K = linalg.update(P, H, R)[0]
        P = (jnp.eye(9) - K @ H) @ P if short else linalg.joseph(P, K, H, R)
        return Phi @ P @ Phi.T + 1e-12 * jnp.eye(9), jnp.stack(
            [jnp.linalg.eigvalsh(0.5 * (P + P.T))[0], jnp.abs(P - P.T).max()]
        )

    P0 = jnp.diag(10.0 ** jnp.linspace(-4, 8, 9))
    P, (least, skew) = jax.jit(
        lambda: (lambda p, s: (p, s.T))(*jax.lax.scan(partial(step, short=False), P0, length=10_000))
    )()
    assert least.min() > 0 and not skew.any() and all_finite(P)
    short = jax.jit(lambda: jax.lax.scan(partial(step, short=True), P0, length=100)[1])()
    assert not (short[:, 0].min() > 0)


def test_gain_is_the_kalman_gain_and_nan_where_there_is_none():
    rng = np.random.default_rng(6)
    A, H = rng.normal(size=(6, 6)), rng.normal(size=(2, 6))
    P, R = A @ A.T, np.diag([0.5, 2.0])
    S = H @ P @ H.T + R
    K, _ = linalg.update(*map(jnp.asarray, (P, H, R)))
    np.testing.assert_allclose(K, P @ H.T @ np.linalg.inv(S), rtol=1e-12)
    np.testing.assert_allclose(linalg.joseph(*map(jnp.asarray, (P, K, H, R))), (np.eye(6) - K @ H) @ P, atol=1e-10)
    assert np.isnan(np.asarray(linalg.update(jnp.asarray(-P), jnp.asarray(H), -jnp.asarray(R))[0])).all()


def test_inverse_and_determinant_of_a_covariance_in_many_units():
    """Rotations of known variances, scaled by 1e-6 to 1e6: every entry is right in its own units."""
    rng = np.random.default_rng(8)
    Q, variances, units = np.linalg.qr(rng.normal(size=(15, 15)))[0], np.logspace(-2, 2, 15), np.logspace(-6, 6, 15)
    S = jnp.asarray((Q * variances) @ Q.T * np.outer(units, units))
    found = np.asarray(linalg.inverse(S)) * np.outer(units, units)
    np.testing.assert_allclose(found, (Q / variances) @ Q.T, rtol=0, atol=1e-10)
    assert linalg.log_determinant(S) == pytest.approx(np.log(variances).sum() + 2 * np.log(units).sum(), abs=1e-10)
    one_negative = (Q * np.where(np.arange(15) == 7, -1.0, variances)) @ Q.T
    assert np.isnan(linalg.inverse(jnp.asarray(one_negative))).all()
    assert np.isnan(linalg.log_determinant(jnp.asarray(one_negative)))


def stepwise(P, H, R):
    K = jnp.linalg.solve(H @ P @ H.T + R, H @ P).T
    return K, linalg.joseph(P, K, H, R)


PLAIN = {
    linalg.update: stepwise,
    linalg.times: lambda A, B: A @ B,
    linalg.sandwich: lambda A, P: A @ P @ A.T,
    linalg.square: lambda W: W @ W.T,
    linalg.normalized: lambda v, S: v @ jnp.linalg.solve(S, v),
    linalg.inverse: jnp.linalg.inv,
    linalg.log_determinant: lambda S: jnp.linalg.slogdet(S)[1],
}
SHAPES = {
    linalg.update: [(5, 5), (2, 5), (2, 2)],
    linalg.times: [(2, 5), (5, 3)],
    linalg.sandwich: [(2, 5), (5, 5)],
    linalg.square: [(3, 5)],
    linalg.normalized: [(3,), (3, 3)],
    linalg.inverse: [(5, 5)],
    linalg.log_determinant: [(5, 5)],
}


@pytest.mark.full
@pytest.mark.parametrize("form", PLAIN, ids=lambda form: form.__name__)
def test_derivatives_in_closed_form(form):
    """First and second ones, backward and forward, against those of the plain formulas step by step."""
    rng = np.random.default_rng(7)
    x = [jnp.asarray(rng.normal(size=shape)) for shape in SHAPES[form]]

    def symmetric(a):  # those that are square stay covariances
        return a @ a.T + jnp.eye(len(a)) if a.ndim == 2 and a.shape[0] == a.shape[1] else a

    def slopes(form):
        def loss(x):
            leaves = jax.tree.leaves(form(*map(symmetric, x)))
            return sum(jnp.sum(jnp.sin(a) * jnp.arange(1.0, 1 + a.size).reshape(a.shape)) for a in leaves)

        along = lambda x: jax.jvp(loss, (x,), (jax.tree.map(jnp.sin, x),))[1]
        return loss(x), jax.grad(loss)(x), along(x), jax.grad(along)(x)

    assert "lapack" not in jax.jit(partial(slopes, form)).lower().as_text()
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9), slopes(form), slopes(PLAIN[form]))
