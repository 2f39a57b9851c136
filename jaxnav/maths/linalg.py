"""The small linear algebra that every filter shares."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


def _with_rows(A: jax.Array, B: jax.Array) -> jax.Array:
    """Return A B'; a gradient multiplies by B in its memory layout."""
    return lax.dot_general(A, B, (((1,), (1,)), ((), ())))


def _applied(A: jax.Array, B: jax.Array) -> jax.Array:
    """Return A B; a gradient multiplies by A' in a new layout: a batch is slow at products over first axes."""
    return lax.dot_general(A.T, B, (((0,), (0,)), ((), ())))


@jax.custom_jvp
def times(A: jax.Array, B: jax.Array) -> jax.Array:
    """Return A B, (n, m); in a batch its gradient takes half the time that of ``A @ B`` does."""
    return A @ B


@times.defjvp
def _times_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    (A, B), (dA, dB) = primals, tangents
    return A @ B, dA @ B + _applied(A, dB)


@jax.custom_jvp
def sandwich(A: jax.Array, P: jax.Array) -> jax.Array:
    """Return A P A', (m, m), of A (m, n) and a symmetric P (n, n); its gradient takes fewer products than two."""
    return A @ P @ A.T


@sandwich.defjvp
def _sandwich_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    (A, P), (dA, dP) = primals, tangents
    AP = A @ P
    half = _with_rows(dA, AP)
    return AP @ A.T, half + half.T + _applied(A, _with_rows(dP, A))


@jax.custom_jvp
def square(W: jax.Array) -> jax.Array:
    """W W', (n, n), of a root W (n, k)."""
    return W @ W.T


@square.defjvp
def _square_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    half = _with_rows(*tangents, *primals)
    return square(*primals), half + half.T


def trace(M: jax.Array) -> jax.Array:
    """Return the sum of the diagonal of M (n, n), ()."""
    return jnp.sum(M * np.eye(M.shape[0]))


UNROLLED = 12  # rows, above which a loop sweeps: the program of 28 unrolled ones compiles for minutes


def _sweep(k: jax.Array | int, S: jax.Array, log_det: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sweep row k of S (m, m)."""
    diagonal = (np if isinstance(k, int) else jnp).arange(S.shape[0]) == k  # a constant where the loop is unrolled
    pivot = jnp.where(S[k, k] > 0, S[k, k], jnp.nan)
    row = S[k] / pivot
    rest = S - S[:, k, None] * row
    here, row_k, column_k = diagonal[:, None] & diagonal, diagonal[:, None], diagonal
    S = jnp.where(here, -1 / pivot, jnp.where(row_k, row, jnp.where(column_k, row[:, None], rest)))
    return S, log_det + jnp.log(pivot)


class Swept(NamedTuple):
    """Inverse and determinant of a covariance S (m, m)."""

    inverse: jax.Array  # (m, m) S^-1
    log_det: jax.Array  # () log |S|


@jax.custom_jvp
def swept(S: jax.Array) -> Swept:
    """Sweep a covariance S (m, m), symmetric, one row after the other (Goodnight 1979); nan if not positive definite.

    In plain operations, which a batch does side by side. LAPACK's are run by as many threads as there are; two at the
    same time may wait for each other for ever on a machine of two processors (jaxlib 0.10).
    """
    m, log_det = S.shape[0], jnp.zeros((), S.dtype)
    if m > UNROLLED:
        S, log_det = lax.fori_loop(0, m, lambda k, swept: _sweep(k, *swept), (S, log_det))
    else:
        for k in range(m):
            S, log_det = _sweep(k, S, log_det)
    return Swept(-S, log_det)


@swept.defjvp
def _swept_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Swept, Swept]:
    (S,), (dS,) = primals, tangents
    inv, log_det = swept(S)
    return Swept(inv, log_det), Swept(-_applied(inv, _with_rows(dS, inv)), jnp.sum(inv * dS))


def inverse(S: jax.Array) -> jax.Array:
    """S^-1 of a covariance S (m, m), symmetric; nan where S is not positive definite."""
    return swept(S).inverse


def log_determinant(S: jax.Array) -> jax.Array:
    """Logarithm of |S|, (), of a covariance S (m, m), symmetric; nan where S is not positive definite."""
    return swept(S).log_det


def solve(S: jax.Array, b: jax.Array) -> jax.Array:
    """S^-1 b, shaped like b (m,) or (m, k), for a covariance S (m, m); nan where S is not positive definite."""
    return inverse(S) @ b


def normalized(v: jax.Array, S: jax.Array, inv: jax.Array | None = None) -> jax.Array:
    """Return the square of v (m,) in units of its covariance S (m, m), v' S^-1 v, (): the NIS of an innovation.

    ``inv``: S^-1, where S was `swept` already.
    """
    return _normalized(v, S, swept(S).inverse if inv is None else inv)


@jax.custom_jvp
def _normalized(v: jax.Array, S: jax.Array, inv: jax.Array) -> jax.Array:
    return v @ inv @ v


@_normalized.defjvp  # inv moves with S: that is in the rule
def _normalized_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    (v, _, inv), (dv, dS, _) = primals, tangents
    w = inv @ v
    return v @ w, w @ (2 * dv - dS @ w)


def update(P: jax.Array, H: jax.Array, R: jax.Array, inv: jax.Array | None = None) -> tuple[jax.Array, jax.Array]:
    """Return the Kalman gain (n, m) and the covariance (n, n) after a correction with it, in Joseph form.

    Of the covariances P (n, n) and R (m, m), symmetric, and H (m, n); nan where H P H' + R is not positive definite.
    ``inv``: the inverse of H P H' + R, where it was `swept` already.
    """
    return _update(P, H, R, swept(sandwich(H, P) + R).inverse if inv is None else inv)


@jax.custom_jvp
def _update(P: jax.Array, H: jax.Array, R: jax.Array, inv: jax.Array) -> tuple[jax.Array, jax.Array]:
    K = (inv @ (H @ P)).T
    return K, joseph(P, K, H, R)


@_update.defjvp  # inv moves with the others: that is in the rule
def _update_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """In closed form: P after the correction does not change with the gain, which is the best one.

    Parellier, Barrau and Bonnabel (2023) walk back through the filter so; transposed, this is their step.
    """
    (P, H, R, inv), (dP, dH, dR, _) = primals, tangents
    K, after = _update(P, H, R, inv)
    A = jnp.eye(P.shape[0], dtype=P.dtype) - K @ H
    AdP, KdR, dHP = _applied(A, dP), _applied(K, dR), dH @ after
    dK = _with_rows(_with_rows(AdP, H) - KdR + dHP.T, inv) - _applied(K, dH @ K)
    half = 0.5 * (_with_rows(AdP, A) + _with_rows(KdR, K)) - _applied(K, dHP)
    return (K, after), (dK, half + half.T)


def times_root(M: jax.Array, leaf: jax.Array) -> jax.Array:
    """M L, (..., m, k), for a leaf of `Noise` that is a root L (3, k) itself, or its diagonal () or (3,)."""
    return M @ leaf if jnp.ndim(leaf) == 2 else M * leaf


def joseph(P: jax.Array, K: jax.Array, H: jax.Array, R: jax.Array) -> jax.Array:
    """Covariance after a correction with any gain K, (I - K H) P (I - K H)' + K R K', kept symmetric.

    The short form (I - K H) P loses definiteness to rounding (and is only right for the optimal gain).
    """
    A = jnp.eye(P.shape[0], dtype=P.dtype) - K @ H
    P = A @ P @ A.T + K @ R @ K.T
    return 0.5 * (P + P.T)
