"""The solution at every sample of the IMU, as filtered or by all fixes.

Between two fixes navigation is the mechanization's. The error estimate of filter or smoother at both ends of
an epoch is carried through it in a straight line: over a second the error of an INS bends by millimetres.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters import smoother
from jaxnav.filters.catalogue import with_history
from jaxnav.filters.core import Filter, FilterState, Step
from jaxnav.filters.programs import stored
from jaxnav.filters.run import run, track
from jaxnav.measurements import clock_offset
from jaxnav.states.motion import A, reset_covariance
from jaxnav.types import Epoch, Nav, Params, Track, Tree


def dense(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, smooth: bool = False, lag: float = 0.0
) -> tuple[Track, np.ndarray]:
    """Navigation at the end of every sample of a run (E, K, ...), in GNSS time, and its sd (N, 9), ENU.

    At the end of an epoch it is corrected by its fix. ``smooth``: by all fixes (`jaxnav.filters.smoother`). ``lag``: s,
    by those of the next seconds alone.

    Raises:
        ValueError: smoothing with a rule that has no way back.
    """
    if (smooth or lag) and not filt.supports_smoothing:
        raise ValueError("this filter's rule corrects by more than the covariance says: it cannot be smoothed")
    held = jax.eval_shape(filt.init, params, nav).past.t.shape[0]
    filt = with_history(filt, max(int(epochs.imu.dt.shape[1]), held))
    ends = float(nav.t) + np.cumsum(np.asarray(epochs.imu.dt).sum(1))
    within = smoother.reach_of(ends, lag) if lag and not smooth else (None, 0)
    reported, variance, in_epoch = jax.device_get(_dense(filt, params, nav, epochs, smooth or lag > 0, *within))
    flat = lambda a: a.reshape(-1, *a.shape[2:])[in_epoch.ravel()]
    reported, variance = jax.tree.map(flat, reported), flat(variance)
    found = track(reported)
    return found._replace(t=found.t + np.asarray(clock_offset(params.mounting, reported))), np.sqrt(variance)


def _keep(step: Step, along: Tree) -> tuple[smoother.Forward, FilterState]:
    return smoother.keep(step, along)[0], step.predicted


@partial(stored, static_argnums=(0, 4, 6))
def _dense(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, smooth: bool, reach: jax.Array | None, most: int
) -> tuple[Nav, jax.Array, jax.Array]:
    """Navigation (E, w, ...), variances (E, w, 9), and which of them are samples of the epoch (E, w)."""
    model = filt.model
    forward, predicted = run(filt, params, nav, epochs, _keep)
    first = filt.init(params, nav)
    before = lambda first, a: jnp.concatenate([first[None], a[:-1]])
    if smooth:
        s, P = smoother.backward(forward) if reach is None else smoother.lagged(forward, reach, most)
        P = jax.vmap(reset_covariance)(s[:, A], P)
        end = forward.x + s - forward.a
        begin, last = before(end[0], s), end
        P0, P1, P2 = before(P[0], P), P, P
    else:
        begin, end, last = before(first.x, forward.a), predicted.x, forward.x
        P0, P1, P2 = before(first.P, forward.P), predicted.P, forward.P

    def epoch(
        past: Nav, t0: jax.Array, begin: jax.Array, end: jax.Array, last: jax.Array, P0: jax.Array, P1: jax.Array,
        P2: jax.Array,
    ) -> tuple[Nav, jax.Array, jax.Array]:  # fmt: skip
        in_epoch = past.t > t0 + 1e-9
        share = jnp.clip((past.t - t0) / jnp.maximum(past.t[-1] - t0, 1e-9), 0.0, 1.0)
        final = jnp.arange(past.t.size) == past.t.size - 1
        x = jnp.where(final[:, None], last, begin + share[:, None] * (end - begin))
        P = jnp.where(final[:, None, None], P2, P0 + share[:, None, None] * (P1 - P0))
        reported, _, P = jax.vmap(model.report)(jax.vmap(model.retract)(past, x), jnp.zeros_like(x), P)
        return reported, jnp.diagonal(P, axis1=1, axis2=2)[:, :9], in_epoch

    t0 = before(first.past.t[-1], predicted.past.t[:, -1])
    return jax.vmap(epoch)(predicted.past, t0, begin, end, last, P0, P1, P2)
