"""The nine error states that every filter has, x = estimate - truth, and where they stand."""

import jax
import jax.numpy as jnp

from jaxnav.maths import linalg, rotations
from jaxnav.types import Prior

MOTION = {
    "position": slice(0, 3),  # m
    "velocity": slice(3, 6),  # m/s
    "attitude": slice(6, 9),  # rad, C_est = exp([phi x]) C_true
}
P, V, A = MOTION.values()


def prior_sd(prior: Prior) -> jax.Array:
    """Return the prior's standard deviations side by side, (9,)."""
    blocks = (prior.position, prior.velocity, prior.attitude)
    return jnp.concatenate([jnp.broadcast_to(sd, (3,)) for sd in blocks])


def reset_rotation(phi: jax.Array) -> jax.Array:
    """Return J on attitude, (3, 3), of the error that is left after a correction by a rotation vector.

    The error e that is left of phi + e is log(exp(-phi) exp(phi + e)), which is (I - [phi x] / 2 + ...) e (Sola 2017,
    section 6.3). J is the rotation by -phi / 2 on the rows of attitude, the same but for phi^2 / 24, and the identity
    elsewhere.

    Args:
        phi: (3,) rad, the correction, in the axes of the error; its negative gives the inverse.
    """
    return rotations.to_dcm(rotations.exp(-0.5 * phi))


def reset_rows(phi: jax.Array, M: jax.Array) -> jax.Array:
    """Return J M, (n, k), of rows M (n, k) of position, velocity, attitude and the optional states."""
    return M.at[A].set(reset_rotation(phi) @ M[A])


def reset_covariance(phi: jax.Array, P: jax.Array) -> jax.Array:
    """Return J P J', (n, n): the covariance about an attitude that was corrected by ``phi`` (3,) rad."""
    J = jnp.eye(P.shape[0]).at[A, A].set(reset_rotation(phi))
    return linalg.sandwich(J, P)
