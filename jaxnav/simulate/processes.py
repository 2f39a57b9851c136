"""Random processes that several sensors share."""

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike


def gauss_markov(white: jax.Array, dt: ArrayLike, tau: ArrayLike) -> jax.Array:
    """First-order Gauss-Markov processes of unit sd, in their steady state, from unit white noise (n, ...)."""
    share = jnp.asarray(dt / tau, float)
    decay, drive = jnp.exp(-share), jnp.sqrt(-jnp.expm1(-2 * share))

    def advance(b, w):
        b = decay * b + drive * w
        return b, b

    _, b = lax.scan(advance, white[0], white[1:])
    return jnp.concatenate([white[:1], b])
