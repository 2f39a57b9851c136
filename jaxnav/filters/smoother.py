"""Rauch-Tung-Striebel smoother on a closed loop: each epoch by all fixes, those after it too (Rauch et al. 1965).

A filter with feedback corrects navigation at each fix, and its error state restarts. The smoothed quantity is the
error of navigation after the feedback of epoch k: a_k is its estimate that is not fed back (zero where
all is fed back), P_k its covariance, x-_k, P-_k the prediction, x+_k the estimate before the feedback. Backward from
s = a, P at the last epoch:

    G_k   = P_k Phi_{k+1}' (P-_{k+1})^-1
    f     = x+_{k+1} - a_{k+1}
    s_k   = a_k + G_k (f + J^-1 s_{k+1} - x-_{k+1})
    P_k|N = P_k + G_k (J^-1 P_{k+1}|N J^-T - P-_{k+1}) G_k'

and smoothed navigation is retract(navigation, s_k). The feedback only moves the point that the error is counted from,
by the known f. J turns the attitude by -f_phi / 2 (`reset_rows`): an attitude error after the correction has other
axes than before. So it is the smoother of the same linear problem, linearised where the filter was, for any feed
back (docs/theory.md).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.filters.core import Filter, Step
from jaxnav.filters.programs import stored
from jaxnav.filters.run import run
from jaxnav.maths import linalg
from jaxnav.measurements import MEASUREMENTS, layout
from jaxnav.states.motion import MOTION, A, reset_covariance, reset_rows
from jaxnav.types import Epoch, Info, Nav, Params, Tree


class Forward(NamedTuple):
    """Results of an epoch that the backward pass needs."""

    nav: Nav  # after the feedback, in the filter's frame
    a: jax.Array  # (n,) estimate after it
    P: jax.Array  # (n, n) covariance
    x: jax.Array  # (n,) estimate before the feedback
    predicted: tuple[jax.Array, jax.Array]  # x- (n,), P- (n, n)
    Phi: jax.Array  # (n, n) from the epoch before


def keep(step: Step, along: Tree) -> tuple[Forward, Info]:
    """Return a record for `jaxnav.filters.run.run`."""
    after, predicted = step.after, step.predicted
    nav = jax.tree.map(lambda a: a[-1], after.past)
    forward = Forward(nav, after.x, after.P, step.corrected, (predicted.x, predicted.P), step.transition.Phi)
    return forward, step.info


def smooth(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, reach: jax.Array | None = None, most: int = 0
) -> tuple[Info, Info]:
    """Filter and smooth: the result of `run`, and the same with navigation and covariance by all fixes.

    Differentiable. Memory: 4 n^2 numbers an epoch.

    Args:
        filt: a filter whose correction is the covariance's.
        params: its parameters.
        nav: initial navigation.
        epochs: (E, ...) of one run.
        reach: (E,) int, for each epoch the last one whose fixes are used (`reach_of`): a smoother of fixed lag, as a
            live system may run it behind its filter. None: all of them.
        most: largest number of epochs of that lag.

    Returns:
        The filter's `Info`, and the smoothed one: nav (E, ...), x (E, n), the smoother's correction of navigation, and
        P (E, n, n) in local level. Its innovations are the filter's; residuals of position and velocity are of smoothed
        navigation where all of the error is fed back, but for the effect of attitude changes on the lever arm.

    Raises:
        ValueError: a filter with another correction than the covariance's.
    """
    if not filt.supports_smoothing:
        raise ValueError(
            "this filter's rule corrects by more than the covariance says, so that its steps cannot be gone back: "
            "smoothing is for Kalman, robust, adaptive and fading rules"
        )
    forward, info = run(filt, params, nav, epochs, keep)
    s, P = backward(forward) if reach is None else lagged(forward, reach, most)
    moved = jax.vmap(filt.model.retract)(forward.nav, s)
    P = jax.vmap(reset_covariance)(s[:, A], P)
    found, x, P = jax.vmap(filt.model.report)(moved, s - forward.a, P)
    _, correction, _ = jax.vmap(filt.model.report)(moved, forward.x - forward.predicted[0], P)
    residual = info.residual
    for name, place in layout(tuple(MEASUREMENTS[name] for name in filt.model.measurements)).items():
        if name in MOTION:  # a correction of navigation also leaves the residual before the correction
            taken = x[:, MOTION[name]] + correction[:, MOTION[name]]
            residual = residual.at[:, place].add(-taken)
    return info, info._replace(nav=found, x=x, P=P, residual=residual)


smooth_jit = stored(smooth, (0, 5))
"""`smooth`, compiled once for a filter and shapes."""


def backward(forward: Forward) -> tuple[jax.Array, jax.Array]:
    """Return the smoothed error s (E, n) and covariance P_k|N (E, n, n) of every epoch of `Forward`."""
    last = jax.tree.map(lambda a: a[-1], forward)
    later = jax.tree.map(lambda a: a[1:], forward)
    here = jax.tree.map(lambda a: a[:-1], forward)

    def back(carry: Tree, pair: Any) -> Any:
        found = one_back(*pair, *carry)
        return found, found

    _, (s, P) = lax.scan(back, (last.a, last.P), (here, later), reverse=True)
    return jnp.concatenate([s, last.a[None]]), jnp.concatenate([P, last.P[None]])


def one_back(now: Forward, after: Forward, s_next: jax.Array, P_next: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return s and P_k|N of an epoch from those of the next."""
    x, P = after.predicted
    G = linalg.times(now.P @ after.Phi.T, scaled_inverse(P))
    fed = after.x - after.a
    s = now.a + G @ (fed + reset_rows(-fed[A], s_next[:, None])[:, 0] - x)
    joint = now.P + G @ (reset_covariance(-fed[A], P_next) - P) @ G.T
    return s, 0.5 * (joint + joint.T)


def reach_of(t: np.ndarray, lag: float) -> tuple[np.ndarray, int]:
    """Return the last epoch within ``lag`` s of each that ends at t (E,) s, and how many epochs later at most."""
    reach = np.searchsorted(t, t + lag + 1e-6, side="right") - 1
    return reach, int((reach - np.arange(t.size)).max())


def lagged(forward: Forward, reach: jax.Array, most: int) -> tuple[jax.Array, jax.Array]:
    """As `backward`, each epoch by the fixes up to that of ``reach`` (E,) alone."""
    at = lambda i: jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, i, keepdims=False), forward)

    def epoch(k: jax.Array) -> tuple[jax.Array, jax.Array]:
        end = at(reach[k])

        def back(j: int, found: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            i = reach[k] - 1 - j  # from the end to k, and no further
            new = one_back(at(jnp.maximum(i, 0)), at(jnp.maximum(i, 0) + 1), *found)
            return jax.tree.map(lambda a, b: jnp.where(i >= k, a, b), new, found)

        return lax.fori_loop(0, most, back, (end.a, end.P))

    return lax.map(epoch, jnp.arange(reach.size))


def scaled_inverse(P: jax.Array) -> jax.Array:
    """Return P^-1 of a covariance with units of different size: of its correlations, then scaled back."""
    sd = jnp.sqrt(jnp.diag(P))
    sd = jnp.where(sd > 0, sd, 1.0)
    eye = jnp.eye(P.shape[0])
    return linalg.inverse(P / sd[:, None] / sd + 1e-14 * eye) / sd[:, None] / sd
