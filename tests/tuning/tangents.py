"""Likelihood and information of innovations by tangents of a run: the plain form of `tuning.likelihood`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.filters.run import FREEDOM, student_constant
from jaxnav.maths import linalg
from jaxnav.types import Info
from tuning.uncertainty import Information


def information(
    solve: Callable[[jax.Array], Info], raw: jax.Array, keep: jax.Array, block: jax.Array, count: int
) -> Information:
    """Return the information in the innovations of ``solve(raw (P,)) -> Info (E, ...)``.

    ``keep`` (E,) bool: epochs that count. ``block`` (E,) int in [0, count): group of the sandwich estimate.
    """

    def innovations(r: jax.Array) -> Any:
        info = solve(r)
        return (info.nu, info.S), (info.valid, rejected(info), info.ok)

    push = lambda v: jax.jvp(innovations, (raw,), (v,), has_aux=True)
    (nu, S), (dnu, dS), (valid, far, ok) = jax.vmap(push, out_axes=(None, 0, None))(jnp.eye(raw.size))
    nll, score, fisher = jax.vmap(gaussian, (0, 0, 0, 1, 1, 0))(nu, S, valid, dnu, dS, far)
    counts = keep & valid.any(-1)
    weigh = lambda a: jnp.where(counts.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)
    score = weigh(score)
    blocks = jnp.zeros((count, raw.size)).at[block].add(score)
    nll = jnp.where((keep & ~ok).any(), jnp.inf, weigh(nll).sum())
    return Information(nll, score.sum(0), weigh(fisher).sum(0), blocks)


def rejected(info: Info) -> jax.Array:
    """(E,) bool: epochs with a rejected channel."""
    return (info.valid & ~info.used).any(-1)


def gaussian(nu: jax.Array, S: jax.Array, valid: jax.Array, dnu: jax.Array, dS: jax.Array, heavy: Any = False) -> Any:
    """Negative log-likelihood (), score (P,) and information (P, P) of a residual nu (m,) of covariance S (m, m).

    ``dnu`` (P, m) and ``dS`` (P, m, m) are their derivatives. Missing channels have nu = 0 and an identity row in S.
    ``heavy`` () bool: a Student t of `FREEDOM` in place of the Gaussian, which gives outliers little weight.
    """
    inv = linalg.inverse(S)
    w, A, m = inv @ nu, inv @ dS, valid.sum()
    square = nu @ w
    far = 0.5 * (FREEDOM + m) * jnp.log1p(square / FREEDOM) + student_constant(m, valid.size)
    nll = jnp.where(heavy, far, 0.5 * (square + m * jnp.log(2 * jnp.pi))) + 0.5 * linalg.log_determinant(S)
    weight = jnp.where(heavy, (FREEDOM + m) / (FREEDOM + square), 1.0)
    score = 0.5 * (jnp.trace(A, axis1=1, axis2=2) - weight * (dS @ w) @ w) + weight * (dnu @ w)
    return nll, score, 0.5 * jnp.einsum("iab,jba->ij", A, A) + weight * (dnu @ inv @ dnu.T)
