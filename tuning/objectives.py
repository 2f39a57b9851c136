"""What tuning minimises: scalars of an `Info` (fields (E, ...)), smooth, finite, with data to leave out as masks."""

import jax
import jax.numpy as jnp

from jaxnav import metrics
from jaxnav.types import Info


def masked_mean(values: jax.Array, keep: jax.Array) -> jax.Array:
    """Mean over the entries where ``keep``; 0 if there are none."""
    return jnp.sum(jnp.where(keep, values, 0.0)) / jnp.maximum(jnp.sum(keep), 1)


def innovation_nll(info: Info, keep: jax.Array) -> jax.Array:
    """Mean negative log-likelihood of the innovations per epoch; ``keep`` (E,) bool. Needs no truth."""
    measured = keep & info.valid.any(-1)
    return masked_mean(jax.vmap(metrics.negative_log_likelihood)(info), measured)


def rmse(error: jax.Array, keep: jax.Array) -> jax.Array:
    """Root mean square per axis of an error (E, a) over ``keep`` (E,) or (E, a): supervised, (a,)."""
    keep = jnp.broadcast_to(keep if keep.ndim == error.ndim else keep[:, None], error.shape)
    count = jnp.maximum(keep.sum(0), 1)
    mean = jnp.sum(jnp.where(keep, error, 0.0) ** 2, axis=0) / count
    some = mean > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, mean, 1.0)), 0.0)


def outage_error(info: Info, ends: jax.Array) -> jax.Array:
    """Horizontal distance (m) from each hidden fix at ``ends`` (W,) int: what a receiver's return would show, (W,).

    It compares at the fix's own time and at the antenna, through the same measurement model as an update.
    """
    east, north = info.residual[ends, 0], info.residual[ends, 1]
    d2 = east**2 + north**2
    some = d2 > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, d2, 1.0)), 0.0)


def drift(info: Info, ends: jax.Array, keep: jax.Array) -> jax.Array:
    """Log of the RMS end-of-outage error over the windows where ``keep`` (W,)."""
    return 0.5 * jnp.log(masked_mean(outage_error(info, ends) ** 2, keep) + 1e-6)


def log_mean_drift(info: Info, ends: jax.Array, keep: jax.Array) -> jax.Array:
    """Mean log end-of-outage error over the windows where ``keep`` (W,): every window counts alike, not the worst."""
    return masked_mean(0.5 * jnp.log(outage_error(info, ends) ** 2 + 1e-2), keep)
