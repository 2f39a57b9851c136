"""The nine error states that every filter has, x = estimate - truth, and where they stand."""

import jax
import jax.numpy as jnp

from jaxnav.types import Prior

MOTION = {
    "position": slice(0, 3),  # m
    "velocity": slice(3, 6),  # m/s
    "attitude": slice(6, 9),  # rad, C_est = exp([phi x]) C_true
}
P, V, A = MOTION.values()


def prior_sd(prior: Prior) -> jax.Array:
    """The prior's standard deviations side by side, (9,)."""
    own = (prior.position, prior.velocity, prior.attitude)
    return jnp.concatenate([jnp.broadcast_to(sd, (3,)) for sd in own])
