"""Lanes: runs of one filter side by side, each with its parameters, its start and its mask of fixes.

Noise scan, choice of a heading, hidden windows, tuning and calibration ask one question many times: how well do these
parameters explain the fixes that the filter uses, and predict those that it does not? `lanes` answers it for any number
of candidates by one program of `LANES` runs over `CHUNK` epochs, so that neither the number of candidates nor the
length of a recording compiles anything new. It keeps innovations, residuals and their covariances; likelihoods,
drifts and consistency are numpy on them (`jaxnav.filters.scores`).
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters import epochs as ep
from jaxnav.filters.core import Filter, FilterState, Step
from jaxnav.filters.programs import stored
from jaxnav.filters.run import prepare, require_params, require_shapes, require_x64, resume
from jaxnav.measurements import MEASUREMENTS
from jaxnav.measurements.measurement import layout
from jaxnav.states import table
from jaxnav.types import Array, Epoch, Nav, Params, Tree

LANES, CHUNK = 16, 64  # runs and epochs of one call of the program
MAX_THREADS = 8  # of calls side by side
RECEIVER_ERROR = "gnss_position_error"  # state that a measured position has more than the true one


class LaneRecord(NamedTuple):
    """Record of runs, each field with a leading (L, E): L lanes of E epochs, of a filter with m channels."""

    nu: Array  # (m,) innovation, 0 on missing channels
    S: Array  # (m, m) its covariance, identity rows on missing channels
    valid: Array  # (m,) bool, channels that had a measurement which was not hidden
    used: Array  # (m,) bool, those the rule accepted
    nis: Array  # () nu' S^-1 nu
    log_det: Array  # () log |S|
    residual: Array  # (3,) m, ENU, predicted minus measured position, hidden ones too
    P: Array  # (3, 3) m^2 covariance of that, without the fix's white noise
    velocity: Array  # (3,) m/s, ENU, the same of a velocity; None of a filter that takes none
    velocity_P: Array  # (3, 3) (m/s)^2 its covariance, without the fix's white noise
    ok: Array  # () bool, False from the first epoch that was not finite on


def lanes(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, valid: np.ndarray, cut: np.ndarray | None = None
) -> LaneRecord:
    """Run a filter for L candidates.

    Args:
        filt: the filter, its first measurement the position.
        params: (L, ...) parameters of each, see `stacked`.
        nav: (L, ...) start of each.
        epochs: (E, ...) from `ready`, or several cuts of a recording (B, E, ...).
        valid: (L, E, m) bool, fixes that each sees.
        cut: (L,) int, the cut of each; None where there is one.

    Returns:
        The record (L, E, ...), on the host.
    """
    count, size = valid.shape[:2]
    cuts = jax.tree.map(lambda a: np.asarray(a)[None], epochs) if cut is None else epochs
    cut = np.zeros(count, int) if cut is None else cut
    groups = [np.minimum(np.arange(i, i + LANES), count - 1) for i in range(0, count, LANES)]  # the last lane again
    starts = range(0, size, CHUNK)

    def advanced(lane: np.ndarray, state: FilterState, i: int) -> tuple[FilterState, LaneRecord]:
        here = slice(i, i + CHUNK)
        part = taken(cuts, (cut[lane], here))
        part = part._replace(fix=part.fix._replace(valid=valid[lane, here]))
        state, record = _chunk(filt, taken(params, lane), state, part)
        return state, jax.device_get(record)

    def whole(lane: np.ndarray) -> LaneRecord:
        state, records = (first[0], [first[1]]) if lane is groups[0] else (started(lane), [])
        for i in starts[len(records) :]:
            state, record = advanced(lane, state, i)
            records.append(record)
        return jax.tree.map(lambda *a: np.concatenate(a, 1), *records)

    started = lambda lane: _begin(filt, taken(params, lane), taken(nav, lane))
    first = advanced(groups[0], started(groups[0]), 0)  # compiles, so that threads do not
    if len(groups) == 1 or threads() == 1:
        found = [whole(lane) for lane in groups]
    else:
        with ThreadPoolExecutor(threads()) as pool:
            found = list(pool.map(whole, groups))
    return taken(jax.tree.map(lambda *a: np.concatenate(a), *found), slice(count))


def threads() -> int:
    """Return how many calls run side by side: a processor computes one call by one core.

    Double precision of this thread alone is not that of others.
    """
    alone = jax.default_backend() != "cpu" or not jax.config.values["jax_enable_x64"]
    return 1 if alone else min(os.cpu_count() or 1, MAX_THREADS)


def taken(tree: Tree, rows: Any) -> Any:
    """Return some rows of each leaf, on the host."""
    return jax.tree.map(lambda a: np.asarray(a)[rows], tree)


def stacked(candidates: Sequence[Any]) -> Any:
    """Return pytrees of one structure, such as parameters, as one with a leading axis."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(a, float) for a in leaves]), *candidates)


def repeated(tree: Tree, count: int) -> Any:
    """Return a pytree with a leading axis of ``count`` equal elements."""
    return jax.tree.map(lambda a: np.broadcast_to(np.asarray(a), (count, *np.shape(a))), tree)


def padded_shape(epochs: Epoch) -> tuple[int, int]:
    """Return epochs and samples that `ready` pads epochs (E, K, ...) to."""
    size, samples = epochs.imu.dt.shape
    return -(-size // CHUNK) * CHUNK, ep.bucket_size(samples)


def ready(filt: Filter, params: Params, nav: Nav, epochs: Epoch, shape: tuple[int, int] | None = None) -> Epoch:
    """Return epochs (E, ...) of a run, checked, padded to a multiple of `CHUNK` and prepared for a filter, on the host.

    Args:
        filt: the filter.
        params: parameters of one candidate.
        nav: the start of one.
        epochs: (E, ...) as they were cut.
        shape: epochs and samples, not below `padded_shape`, which it is by default.

    Raises:
        DataError: float32 input.
        ValueError: parameters, start or epochs that are not the filter's.
    """
    require_x64(params, nav, epochs)
    require_params(filt, params)
    require_shapes(filt, nav, epochs)
    size, samples = shape or padded_shape(epochs)
    epochs = ep.pad_epochs(epochs, size, samples)
    before = jax.tree.map(lambda a: np.repeat(a[:1, :1], a.shape[1], 1), epochs.imu)  # `prepare` looks at one sample
    imu = jax.tree.map(lambda *a: np.concatenate(a), before, epochs.imu)
    wide = jax.tree.map(lambda a: np.concatenate([a[:1], a]), epochs)._replace(imu=imu)
    parts = [taken(prepare(filt, taken(wide, slice(i, i + CHUNK + 1))), slice(1, None)) for i in range(0, size, CHUNK)]
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


@partial(stored, static_argnums=(0,))
def _begin(filt: Filter, params: Params, nav: Nav) -> FilterState:
    return jax.vmap(filt.init)(params, nav)


@partial(stored, static_argnums=(0,))
def _chunk(filt: Filter, params: Params, state: FilterState, epochs: Epoch) -> tuple[FilterState, LaneRecord]:
    keep = partial(_keep, slow_errors(filt), velocity_channels(filt))
    return jax.vmap(lambda params, state, epochs: resume(filt, params, state, epochs, keep))(params, state, epochs)


def _keep(slow: slice | None, velocity: slice | None, step: Step, along: Tree) -> LaneRecord:
    i = step.info
    P = seen_by_position(i.P, slow)
    v, Pv = (None, None) if velocity is None else (i.residual[velocity], i.P[3:6, 3:6])
    return LaneRecord(i.nu, i.S, i.valid, i.used, i.nis, i.log_det, i.residual[:3], P, v, Pv, i.ok)


def velocity_channels(filt: Filter) -> slice | None:
    """Return the channels of a filter's velocity, None where it takes none."""
    return layout(MEASUREMENTS[name] for name in filt.model.measurements).get("velocity")


def slow_errors(filt: Filter) -> slice | None:
    """Return where a filter's covariance has the slow errors of a receiver, None where it has none."""
    return table.layout(table.chosen(filt.model.states)).get(RECEIVER_ERROR)


def relative_variance(P: jax.Array, slow: slice | None) -> jax.Array:
    """Variance (..., 3) m^2, ENU, of a position whose slow error were known: that from second to second."""
    if slow is None:
        return jnp.diagonal(P[..., :3, :3], axis1=-2, axis2=-1)
    cross = P[..., :3, slow]
    S = P[..., slow, slow] + 1e-12 * jnp.eye(3)  # a state of sd 0 explains nothing
    explained = cross @ jnp.linalg.solve(S, jnp.swapaxes(cross, -1, -2))
    return jnp.maximum(jnp.diagonal(P[..., :3, :3] - explained, axis1=-2, axis2=-1), 0.0)


def seen_by_position(P: jax.Array, slow: slice | None) -> jax.Array:
    """Covariance (..., 3, 3) m^2, ENU, of a predicted fix without its noise: position and the receiver's slow error."""
    if slow is None:
        return P[..., :3, :3]
    cross = P[..., :3, slow]
    return P[..., :3, :3] + cross + jnp.swapaxes(cross, -1, -2) + P[..., slow, slow]
