"""Objectives of tuning: scalars of an `Info` (fields (E, ...)), smooth, finite, with masks for omitted data.

A run that stops being finite is frozen from there on and has no innovations any more, which would look like good ones:
where an epoch that counts is frozen, an objective of an `Info` is infinite. `tuning.fit.train.fit` leaves such a run
out of the step and names it; a custom objective calls `inf_if_frozen` for that.

Objectives of one run come first, and need no truth unless they say so; then the aggregates over many runs.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis import metrics
from jaxnav.filters.run import gated_nll, negative_log_likelihood
from jaxnav.types import Info


def masked_mean(values: jax.Array, keep: jax.Array) -> jax.Array:
    """Return the mean over the entries where ``keep``; 0 if there are none.

    Args:
        values: any shape.
        keep: bool, of the same shape.
    """
    return jnp.sum(jnp.where(keep, values, 0.0)) / jnp.maximum(jnp.sum(keep), 1)


def inf_if_frozen(info: Info, keep: jax.Array, value: jax.Array) -> jax.Array:
    """Return ``value``, or inf where an epoch that counts is frozen.

    Args:
        info: of one run, (E, ...).
        keep: (E,) bool, epochs that count.
        value: an objective of the run.
    """
    return jnp.where(jnp.any(keep & ~info.ok), jnp.inf, value)


def innovation_nll(info: Info, keep: jax.Array) -> jax.Array:
    """Return the mean negative log-likelihood of the innovations per epoch, (); needs no truth.

    Args:
        info: of one run, (E, ...).
        keep: (E,) bool, epochs that count.
    """
    measured = keep & info.valid.any(-1)
    return inf_if_frozen(info, keep, masked_mean(jax.vmap(negative_log_likelihood)(info), measured))


def gated_innovation_nll(info: Info, keep: jax.Array, alone: np.ndarray) -> jax.Array:
    """Return `innovation_nll` of a filter with satellites, (), by `jaxnav.filters.run.gated_nll`.

    Args:
        info: of one run, (E, ...).
        keep: (E,) bool, epochs that count.
        alone: (m,) bool, channels that a gate tests one by one.
    """
    measured = keep & info.valid.any(-1)
    return inf_if_frozen(info, keep, masked_mean(jax.vmap(lambda row: gated_nll(row, alone))(info), measured))


def rmse(error: jax.Array, keep: jax.Array) -> jax.Array:
    """Return the root mean square per axis of an error, (a,); needs the truth.

    Args:
        error: (E, a).
        keep: (E,) or (E, a) bool.
    """
    keep = jnp.broadcast_to(keep if keep.ndim == error.ndim else keep[:, None], error.shape)
    count = jnp.maximum(keep.sum(0), 1)
    mean = jnp.sum(jnp.where(keep, error, 0.0) ** 2, axis=0) / count
    some = mean > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, mean, 1.0)), 0.0)


def outage_error(info: Info, ends: jax.Array) -> jax.Array:
    """Return the horizontal distance (m) from each hidden fix, as at a receiver's return, (W,).

    It compares at the fix's time and at the antenna, through the same measurement model as an update. inf at
    epochs that are frozen.

    Args:
        info: of one run, (E, ...).
        ends: (W,) int, last epochs of hidden windows.
    """
    east, north = info.residual[ends, 0], info.residual[ends, 1]
    d2 = east**2 + north**2
    some = d2 > 0
    return jnp.where(info.ok[ends], jnp.where(some, jnp.sqrt(jnp.where(some, d2, 1.0)), 0.0), jnp.inf)


def drift(info: Info, ends: jax.Array, keep: jax.Array) -> jax.Array:
    """Return the log of the RMS end-of-outage error over the windows that count, ().

    Args:
        info: of one run, (E, ...).
        ends: (W,) int, last epochs of hidden windows.
        keep: (W,) bool, windows that count.
    """
    return 0.5 * jnp.log(masked_mean(outage_error(info, ends) ** 2, keep) + 1e-6)


def log_mean_drift(info: Info, ends: jax.Array, keep: jax.Array) -> jax.Array:
    """Return the mean log end-of-outage error, (): every window counts alike, not the worst.

    Args:
        info: of one run, (E, ...).
        ends: (W,) int, last epochs of hidden windows.
        keep: (W,) bool, windows that count.
    """
    return masked_mean(0.5 * jnp.log(outage_error(info, ends) ** 2 + 1e-2), keep)


# ---------------------------------------------------------------------------- consistency


def channel_nis(info: Info, keep: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the mean squared normalised innovation per channel, (m,), 1 if consistent, and the number, (m,).

    Args:
        info: of one run, (E, ...).
        keep: (E,) bool, epochs that count.
    """
    used = keep[:, None] & info.valid
    square = info.nu**2 / jnp.diagonal(info.S, axis1=1, axis2=2)
    count = used.sum(0)
    return inf_if_frozen(info, keep, jnp.sum(jnp.where(used, square, 0.0), 0) / jnp.maximum(count, 1)), count


def consistency(info: Info, keep: jax.Array) -> jax.Array:
    """Return the mean over channels of log² of the normalised innovation squared, (): 0 where all are consistent.

    Times half the epochs it is near a chi-square value of one degree of freedom a channel, since the logarithm of a
    mean of n such values has variance 2 / n. Alone it is minimised by inflating R: add a likelihood.

    Args:
        info: of one run, (E, ...).
        keep: (E,) bool, epochs that count.
    """
    ratio, count = channel_nis(info, keep)
    some = (count > 0) & (ratio > 0)
    return inf_if_frozen(info, keep, masked_mean(jnp.log(jnp.where(some, ratio, 1.0)) ** 2, some))


def whiteness(info: Info, keep: jax.Array, lags: int = 5) -> jax.Array:
    """Return the mean squared autocorrelation of normalised innovations over channels and lags: 1 / epochs if white.

    Pairs with a missing measurement are left out.

    Args:
        info: of one run, (E, ...).
        keep: (E,) bool, epochs that count.
        lags: largest lag, epochs.
    """
    used = keep[:, None] & info.valid
    z = jnp.where(used, info.nu / jnp.sqrt(jnp.diagonal(info.S, axis1=1, axis2=2)), 0.0)
    mean = masked_mean(_autocorrelation(z, used, lags) ** 2, jnp.broadcast_to(used.any(0), (lags, z.shape[1])))
    return inf_if_frozen(info, keep, mean)


def _autocorrelation(z: jax.Array, used: jax.Array, lags: int) -> jax.Array:
    """Return the autocorrelation of z (E, m), zero where not used, at lags 1 ..: (lags, m)."""
    power = jnp.sum(z**2, 0) / jnp.maximum(used.sum(0), 1)
    power = jnp.where(power > 0, power, 1.0)
    pairs = [jnp.sum(used[d:] & used[:-d], 0) for d in range(1, lags + 1)]
    products = [jnp.sum(z[d:] * z[:-d], 0) for d in range(1, lags + 1)]
    return jnp.stack([a / (jnp.maximum(n, 1) * power) for a, n in zip(products, pairs, strict=True)])


def error_consistency(error: jax.Array, P: jax.Array, keep: jax.Array) -> jax.Array:
    """Return log² of the normalised estimation error squared per degree of freedom: 0 if consistent; needs the truth.

    Args:
        error: (E, a).
        P: (E, a, a), the filter's covariance of it.
        keep: (E,) bool, epochs that count.
    """
    nees = masked_mean(jax.vmap(metrics.nees)(error, P), keep) / error.shape[1]
    return jnp.log(jnp.where(nees > 0, nees, 1.0)) ** 2


# ---------------------------------------------------------------------------- over runs


@cache
def tail(share: float) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return an aggregate: the mean over the worst ``share`` of the runs, CVaR; 0 is the worst run alone.

    Of values (B,) with weights (B,); for `tuning.fit.train.fit`. Runs of weight zero do not enter.

    Args:
        share: 0 to 1.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"the share of the worst runs must be in [0, 1], got {share}")

    def aggregate(values: jax.Array, weight: jax.Array) -> jax.Array:
        order = jnp.argsort(jnp.where(weight > 0, -values, jnp.inf))
        w = weight[order]
        most = jnp.maximum(share * w.sum(), w[0])
        taken = jnp.clip(most - (jnp.cumsum(w) - w), 0.0, w)  # the last run enters in part
        return jnp.sum(jax.lax.stop_gradient(taken) * values[order]) / most

    return aggregate


def log_mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Return the mean of the logarithms of positive values, an aggregate: easy and hard scenarios count alike.

    Args:
        values: (B,), of each run.
        weight: (B,).
    """
    some = weight > 0
    return jnp.sum(jnp.where(some, weight * jnp.log(jnp.where(some, values, 1.0)), 0.0)) / weight.sum()
