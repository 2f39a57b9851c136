"""Random processes that several sensors share."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike


def gauss_markov(white: jax.Array, dt: ArrayLike, tau: ArrayLike) -> jax.Array:
    """First-order Gauss-Markov processes of unit sd, in their steady state, from unit white noise (n, ...)."""
    share = jnp.asarray(dt / tau, float)
    decay, drive = jnp.exp(-share), jnp.sqrt(-jnp.expm1(-2 * share))

    def advance(b: jax.Array, w: jax.Array) -> tuple[jax.Array, jax.Array]:
        b = decay * b + drive * w
        return b, b

    _, b = lax.scan(advance, white[0], white[1:])
    return jnp.concatenate([white[:1], b])


def normal(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Return the numbers of ``jax.random.normal(key, shape, float)``, computed in a loop.

    Else the compiler copies the inverse of the error function, some hundred operations, into everybody who uses them.
    """
    uniform = jax.random.uniform(key, shape, float, np.nextafter(-1.0, 0.0), 1.0)
    rows = next((d for d in (2, 3, 5, 7) if uniform.size % d == 0), 1)
    return lax.map(lambda u: np.sqrt(2) * lax.erf_inv(u), uniform.reshape(rows, -1)).reshape(shape)
