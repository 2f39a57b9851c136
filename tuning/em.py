"""Noise by expectation and maximisation: a run forth and back says how large each noise has been.

The smoother gives the error of every epoch by all fixes, and with it the noise that has driven it (Koopman and Shephard
1992: the disturbance smoother). With x-, P- the prediction, x_N, P_N the smoothed error before the feedback, nu the
innovation and H, R its model,

    r = (P-)^-1 (x_N - x-),     N = (P-)^-1 (P- - P_N) (P-)^-1
    v = nu - H (x_N - x-),      V = v v' + H P_N H'

are all that the likelihood's derivative by a number that scales noise takes: no derivative of the filter,

    dL / dtheta = 1/2 sum [ r' dQ r - tr(N dQ) + tr(R^-1 dR R^-1 (V - R)) ].

Of n independent draws of unit noise that theta = log sd scales the smoothed sum of squares is n + dL/dtheta, and EM
takes theta to theta + 1/2 log(1 + (dL/dtheta) / n) (Shumway and Stoffer 1982). No step is chosen, no number turns
negative, and the likelihood does not fall but for what feedback does to the path that the filter is linear about; there
it ends. It is slow where fixes hardly show a noise.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.filters.core import Filter, Step, masked
from jaxnav.filters.run import negative_log_likelihood, run
from jaxnav.filters.smoother import Forward, backward, keep, scaled_inverse
from jaxnav.maths import linalg
from jaxnav.types import Epoch, Info, Nav, Params
from tuning.transforms import LOG, Spec

ENDS = {"noise": ("gyro", "accel"), "states": ("drive",), "measurements": ("scale", "sd_scale", "sd")}
"""Last names of the leaves that scale noise, by the part of `Params`; those that may be negative are none of them."""
RANK = 1e-9  # of the largest eigenvalue of a noise's share of Q: below, it is rounding


class Expected(NamedTuple):
    """What a run forth and back says of the free numbers (P,)."""

    nll: jax.Array  # () of the innovations
    score: jax.Array  # (P,) its derivative
    draws: jax.Array  # (P,) of noise that each scales


def check(spec: Spec, params: Params) -> None:
    """Refuse what EM has no step for.

    Raises:
        ValueError: a rule that changes R or P by itself, a leaf that does not scale noise, or one with a prior.
    """
    if jax.tree.leaves(params.rule) or jax.tree.leaves(params.feedback):
        raise ValueError("em is for ekf9 and ekf15: other rules change the noise that they use by themselves")
    for name, transform in spec.items():
        scales = name.rpartition(".")[2] in ENDS.get(name.partition(".")[0], ())
        if not scales or transform.forward is not LOG.forward or transform.axes:
            raise ValueError(f"em tunes what scales noise (noise.*, states.*.drive, sd of measurements), not {name}")
        if transform.belief is not None:
            raise ValueError(f"em takes no priors, {name} has one")


def _record(step: Step, epoch: Epoch) -> tuple[Forward, Info, Any, Any]:
    return *keep(step, None), step.before, step.predicted.past


def expected(
    filt: Filter, params_of: Callable[[jax.Array], Params], flat: jax.Array, nav: Nav, epochs: Epoch
) -> Expected:
    """Of one run of a filter with Kalman's rule, at the free numbers (P,) that ``params_of`` makes parameters of."""
    here = params_of(flat)
    forward, info, before, past = run(filt, here, nav, epochs, _record, epochs)
    s, P = backward(forward)
    x, P_predicted = forward.predicted
    off = forward.x + s - forward.a - x

    def shares(epoch):
        """What is to be contracted with dQ and dR, of one epoch."""
        off, x, P_predicted, P, info, past, fix = epoch
        inverse = scaled_inverse(P_predicted)
        r = inverse @ off
        of_Q = jnp.outer(r, r) - inverse @ (P_predicted - P) @ inverse
        y, H, R = masked(*filt.model.observe(here, past, fix), fix.valid)
        v = info.nu - H @ off
        weight = linalg.inverse(R)
        of_R = weight @ (jnp.outer(v, v) + H @ P @ H.T - R) @ weight
        return of_Q, of_R, weight

    of_Q, of_R, weight = lax.map(shares, (off, x, P_predicted, P, info, past, epochs.fix))

    def noises(r, before, past, epoch):
        """Q and R of one epoch, as functions of the free numbers alone: where the filter was stays."""
        own = params_of(r)
        Q = filt.advance(own, before, epoch).transition.Q
        return Q, masked(*filt.model.observe(own, past, epoch.fix), epoch.fix.valid)[2]

    def slopes(each):
        """What one epoch adds to dL / d theta, and to the draws of R; how many Q takes."""
        (of_Q, of_R, weight), epoch = each
        dQ, dR = jax.jacfwd(noises)(flat, *epoch)
        half = lambda a, b: 0.5 * jnp.tensordot(a, b, 2)
        size = jnp.sqrt(jnp.maximum(jnp.diagonal(dQ), 0.0))  # (P, n) sd of what each does
        unit = jnp.moveaxis(dQ, -1, 0) / jnp.where(size > 0, size, jnp.inf)[:, :, None]
        unit = unit / jnp.where(size > 0, size, jnp.inf)[:, None, :]
        values = jnp.linalg.eigvalsh(unit)
        rank = jnp.sum(values > RANK * values.max(1, keepdims=True), 1)
        return half(of_Q, dQ) + half(of_R, dR), half(weight, dR) + jnp.where(size.any(1), rank, 0)

    score, draws = lax.map(slopes, ((of_Q, of_R, weight), (before, past, epochs)))
    each = jax.vmap(negative_log_likelihood)(info)
    nll = jnp.where(info.ok.all(), jnp.sum(jnp.where(info.valid.any(-1), each, 0.0)), jnp.inf)
    return Expected(nll, -score.sum(0), draws.sum(0))


class Ended(NamedTuple):
    """Where EM stopped."""

    flat: jax.Array  # (P,)
    at: Expected
    done: bool  # the next step promised less than the tolerance
    interrupted: bool  # by Ctrl-C


def em(
    inform: Callable[[jax.Array], Expected], flat: jax.Array, steps: int, tolerance: float = 1e-3,
    report: Callable[[int, jax.Array, Expected], None] = lambda i, flat, at: None,
) -> Ended:  # fmt: skip
    """Steps of EM from ``flat`` (P,) until one promises less than ``tolerance`` of log-likelihood.

    ``inform``: `expected`, or its sum over runs; ``steps``: how often it is asked at most.

    Raises:
        ValueError: the likelihood of the start is not finite.
    """
    at, done = inform(flat), False
    if not np.isfinite(at.nll):
        raise ValueError("the likelihood of the starting parameters is not finite")
    try:
        for i in range(1, steps):
            # a number of which nothing was drawn stays; rounding may leave less than nothing of a sum of squares
            grown = jnp.maximum(1 - at.score / jnp.maximum(at.draws, 1.0), 1e-6)
            step = jnp.where(at.draws > 0, 0.5 * jnp.log(grown), 0.0)
            done = -float(at.score @ step) < tolerance
            then = at if done else inform(flat + step)
            done = done or not float(then.nll) < float(at.nll)  # feedback moves the path that all is linear about
            if done:
                break
            flat, at = flat + step, then
            report(i, flat, at)
    except KeyboardInterrupt:
        return Ended(flat, at, done, True)
    return Ended(flat, at, done, False)
