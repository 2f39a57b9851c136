"""Large attitude errors in second order: the noise that they add, and derivatives that are in error themselves.

Specific force in navigation axes is wrong by phi x (S + C e_a) - phi x (phi x S) / 2 - C e_a, with S = C f and an
accelerometer error e_a. In first order that is L (phi, s), with the columns of Phi; the rest is -phi x w with

    w = L (phi / 2, s).

The columns of L come from S as it is estimated, which has an error of covariance W = L P L' itself: while a vehicle
stands with a tilt of a degree, 0.17 m/s^2 of gravity looks like an acceleration that shows the heading.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import linalg, rotations

SECOND_ORDER_S = 2.0  # s, how long a large error lasts before fixes show it: from `benchmarks consistency`
LARGEST = 0.7  # rad, of an attitude error that has an expansion to second order: its sd on all axes together


def second_order(
    Phi: jax.Array, P: jax.Array, T: jax.Array, vertical: int = 2, axes: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Return the transition and the noise of position and velocity with large attitude errors.

    phi and s last longer than an epoch, so their second-order effect is correlated from epoch to epoch: as white
    noise of acceleration with the same power at low frequencies it counts 2 tau / T times, with tau =
    `SECOND_ORDER_S`.

    Args:
        Phi: (n, n) transition of the epoch.
        P: (n, n) covariance at its start.
        T: () s, its length.
        vertical: index of the vertical axis of velocity.
        axes: (3, 3) rotation from the axes of attitude to those of velocity; None where they are the same.

    Returns:
        Phi (n, n) with the heading's effect on position and velocity reduced, see `reliability`, and the noise (6, 6).
    """
    reliable, moment = reliability(Phi[3:6, 6:], P, vertical, axes)
    psd = 2 * SECOND_ORDER_S * moment / jnp.where(T > 0, T, 1.0) ** 2
    noise = jnp.block([[T**3 / 3 * psd, T**2 / 2 * psd], [T**2 / 2 * psd, T * psd]])
    up = _up(vertical, axes)
    return Phi.at[:6, 6:9].add((reliable - 1) * jnp.outer(Phi[:6, 6:9] @ up, up)), noise


def _up(vertical: int, axes: jax.Array | None) -> jax.Array:
    """Return the vertical in the axes of attitude, (3,)."""
    return jnp.asarray(np.eye(3)[vertical]) if axes is None else axes[vertical]


def reliability(
    L: jax.Array, P: jax.Array, vertical: int = 2, axes: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Return the reliability ratio of the heading's column, (), and the second moment of the rest, (3, 3).

    A column l with an error e counts r = |l|^2 / (|l|^2 + E|e|^2) times, as a regressor that is measured with errors
    does (Fuller 1987, section 1.1). Only the heading's: gravity makes the other columns large. The rest, (1 - r) l, is
    noise, and so is the `cross_moment`.

    Args:
        L: (3, n - 6) derivative of a vector by the errors of attitude phi and by the optional states s.
        P: (n, n) covariance; of a phi beyond `LARGEST` the moment is bounded.
        vertical: index of the vertical axis of the vector.
        axes: (3, 3) rotation from the axes of phi to those of the vector; None where they are the same.
    """
    up = _up(vertical, axes)
    column, W = L[:, :3] @ up, linalg.sandwich(L, P[6:, 6:])
    # an error S of the vector gives the column the error S x up
    size, wrong = column @ column, jnp.sum(W * np.diag(np.arange(3) != vertical))
    reliable = jnp.where(size > 0, size / jnp.where(size > 0, size + wrong, 1.0), 1.0)
    rest = (1 - reliable) * column
    A = P[6:9, 6:9]
    bound = LARGEST**2 / jnp.maximum(linalg.trace(A), LARGEST**2)
    return reliable, bound * (cross_moment(L, P, axes) + (up @ A @ up) * jnp.outer(rest, rest))


def cross_moment(L: jax.Array, P: jax.Array, axes: jax.Array | None = None) -> jax.Array:
    """Return E[(phi x w) (phi x w)'], (3, 3), with w = L (phi / 2, s), for Gaussian errors of covariance P.

    With A = E[phi phi'], X = E[phi w'] and W = E[w w'] the fourth moments are products of second ones (Isserlis 1918):
    of A and W, of X and X, and the square of the mean E[phi x w] (Jazwinski 1970, section 9.3: the Gaussian
    second-order filter).

    Args:
        L: (3, n - 6) derivative of a vector by the errors of attitude phi and by the optional states s.
        P: (n, n) covariance.
        axes: (3, 3) rotation from the axes of phi to those of the vector; None where they are the same.
    """
    L = L * np.concatenate([np.full(3, 0.5), np.ones(P.shape[0] - 9)])
    PL = linalg.times(P[6:, 6:], L.T)
    A, X, W = P[6:9, 6:9], PL[:3], linalg.times(L, PL)
    if axes is not None:
        A, X = axes @ A @ axes.T, axes @ X
    mean = rotations.axial(X)
    a, x, w = linalg.trace(A), linalg.trace(X), linalg.trace(W)
    AW, XX = A @ W, X @ X.T + X.T @ X
    scalar = a * w - linalg.trace(AW) + 0.5 * linalg.trace(XX) - x**2
    return scalar * np.eye(3) - w * A - a * W + AW + AW.T - XX + x * (X + X.T) + jnp.outer(mean, mean)
