"""The small linear algebra that every filter shares."""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve


def solve(S: jax.Array, b: jax.Array) -> jax.Array:
    """S^-1 b, shaped like b (m,) or (m, k), by Cholesky of S (m, m); nan where S is not positive definite."""
    return cho_solve(cho_factor(S, lower=True), b)


def gain(P: jax.Array, H: jax.Array, S: jax.Array) -> jax.Array:
    """Kalman gain P H' S^-1, (n, m); nan where S is not positive definite."""
    return solve(S, H @ P).T


@jax.custom_jvp
def update(P: jax.Array, H: jax.Array, R: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The Kalman gain (n, m) and the covariance (n, n) after a correction with it, in Joseph form.

    Of the covariances P (n, n) and R (m, m), symmetric, and H (m, n); nan where H P H' + R is not positive definite.
    """
    K = gain(P, H, H @ P @ H.T + R)
    return K, joseph(P, K, H, R)


@update.defjvp
def _update_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """In closed form: P after the correction does not change with the gain, which is the best one.

    Parellier, Barrau and Bonnabel (2023) walk back through the filter so; transposed, this is their step.
    """
    (P, H, R), (dP, dH, dR) = primals, tangents
    K, after = update(P, H, R)
    A = jnp.eye(P.shape[0], dtype=P.dtype) - K @ H
    AdP, KdR, KdH = A @ dP, K @ dR, K @ dH
    dK = solve(H @ P @ H.T + R, (AdP @ H.T + after @ dH.T - KdR).T).T - KdH @ K
    half = 0.5 * (AdP @ A.T + KdR @ K.T) - KdH @ after
    return (K, after), (dK, half + half.T)


def times_root(M: jax.Array, leaf: jax.Array) -> jax.Array:
    """M L, (..., m, 3), for a leaf of `Noise` that is a root L (3, 3) itself, or its diagonal () or (3,)."""
    return M @ leaf if jnp.ndim(leaf) == 2 else M * leaf


def joseph(P: jax.Array, K: jax.Array, H: jax.Array, R: jax.Array) -> jax.Array:
    """Covariance after a correction with any gain K, (I - K H) P (I - K H)' + K R K', kept symmetric.

    The short form (I - K H) P loses definiteness to rounding (and is only right for the optimal gain).
    """
    A = jnp.eye(P.shape[0], dtype=P.dtype) - K @ H
    P = A @ P @ A.T + K @ R @ K.T
    return 0.5 * (P + P.T)
