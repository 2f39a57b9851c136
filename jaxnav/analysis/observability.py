"""Observability of a filter's states in a motion: gain of each by a window of fixes, and the number of directions.

Over a window, with Phi the transition since its first epoch and H, R the model of each fix, the information of fixes

    G = sum Phi' H' R^-1 H Phi

on the error at the window's start (the observability Gramian; Maybeck 1979, section 5.7). In units of the prior sd,
S = diag(sd), an eigenvalue of S G S above one is a direction that the window knows better than the prior does.
Process noise is left out, so that a direction unobserved here is unobservable.
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from jaxnav.filters.core import Filter, Step, masked
from jaxnav.filters.programs import stored
from jaxnav.filters.run import run
from jaxnav.findings import finding
from jaxnav.maths import linalg
from jaxnav.states.motion import MOTION
from jaxnav.states.table import chosen
from jaxnav.types import DataError, Epoch, Finding, Info, Nav, Params, StateParams

MAX_STATE_SIGMAS = 3.5  # sd that a state may go from where it started without a sentence
UNOBSERVED_SD_RATIO = 0.9  # of the prior sd: the posterior of a nearly unobserved state
ENU = ("east", "north", "up")


class Observability(NamedTuple):
    """Observability in W windows, one after the other."""

    names: tuple[str, ...]  # (n,) of the states' components
    start: np.ndarray  # (W,) s
    left: np.ndarray  # (W, n) sd after the window over the sd before it
    rank: np.ndarray  # (W,) int, directions that it shows
    condition: np.ndarray  # (W,) sd of the worst of these over that of the best, in units of the prior; nan of none


def state_names(filt: Filter) -> tuple[str, ...]:
    """Return a name for each component of the error state."""
    motion = [f"{name} {axis}" for name in MOTION for axis in ENU]
    optional = [f"{s.name} {axis}" if s.size > 1 else s.name for s in chosen(filt.model.states) for axis in s.axes]
    return (*motion, *optional)


@partial(stored, static_argnums=(0,), once=True)
def _seen(filt: Filter, params: Params, nav: Nav, epochs: Epoch) -> tuple[jax.Array, jax.Array]:
    """Phi (E, n, n) of each epoch, and H' R^-1 H (E, n, n) of its fixes."""

    def record(step: Step, epoch: Epoch) -> tuple[jax.Array, jax.Array]:
        _, H, R = masked(*filt.model.observe(params, step.predicted.past, epoch.fix), epoch.fix.valid)
        return step.transition.Phi, H.T @ linalg.inverse(R) @ H

    return run(filt, params, nav, epochs, record, epochs)


def observability(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, t: np.ndarray, window: float = 30.0
) -> Observability:
    """How windows of ``window`` s see the states of a filter on the run from ``nav`` over ``epochs`` (E, ...).

    ``t`` (E,) s are the epochs' ends; the prior is the diagonal of the filter's P at the start.

    The names are of local level; in another frame its first, second and third axis stand for east, north and up.

    Raises:
        DataError: data shorter than a window.
    """
    edges = np.searchsorted(t, np.arange(t[0], t[-1] + 1e-6, window))
    if edges.size < 2:
        raise DataError(f"data of {t[-1] - t[0]:.0f} s hold no window of {window:g} s")
    Phi, information = map(np.asarray, _seen(filt, params, nav, epochs))
    sd = np.sqrt(np.diag(np.asarray(filt.model.covariance(params, filt.model.enter(nav)))))
    left, rank, condition = [], [], []
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        since, G = np.eye(sd.size), np.zeros((sd.size, sd.size))
        for i in range(first, last):
            since = Phi[i] @ since if i > first else since
            G += since.T @ information[i] @ since
        scaled = G * np.outer(sd, sd)
        values = np.linalg.eigvalsh(0.5 * (scaled + scaled.T))
        above = values[values > 1.0]
        left.append(np.sqrt(np.diag(np.linalg.inv(np.eye(sd.size) + scaled))))
        rank.append(above.size)
        condition.append(np.sqrt(above.max() / above.min()) if above.size else np.nan)
    return Observability(state_names(filt), t[edges[:-1]], np.array(left), np.array(rank), np.array(condition))


def observability_findings(found: Observability, window: float = 30.0) -> list[Finding]:
    """Return how many directions the windows observe, and which components none, or few, of them do."""
    n, least = len(found.names), found.left.min(0)
    span = " to ".join(str(r) for r in sorted({int(found.rank.min()), int(found.rank.max())}))
    median, count = float(np.median(found.rank)), found.start.size
    out = [finding("observability.rank", value=median, count=count, window=window, span=span, n=n)]
    unseen = [name for name, share in zip(found.names, least, strict=True) if share > UNOBSERVED_SD_RATIO]
    seldom = [
        f"{name} ({int((share < UNOBSERVED_SD_RATIO).sum())})"
        for name, share, best in zip(found.names, found.left.T, least, strict=True)
        if best <= UNOBSERVED_SD_RATIO and (share < UNOBSERVED_SD_RATIO).mean() < 0.25
    ]
    out += [finding("observability.never", ", ".join(unseen))] if unseen else []
    return out + ([finding("observability.seldom", ", ".join(seldom))] if seldom else [])


def _grown(rate: StateParams, T: float) -> np.ndarray:
    """Return the variance of the integral of a walk of this prior over T s."""
    return (T * np.asarray(rate.sd)) ** 2 + np.asarray(rate.driving_noise) ** 2 * T**3 / 3


def state_findings(filt: Filter, params: Params, nav: Nav, info: Info) -> list[Finding]:
    """Return the optional states of a run, ``info`` (E, ...) from ``nav``, unobserved or far from their prior."""
    states, names = chosen(filt.model.states), state_names(filt)[9:]
    if not states:
        return []
    each = lambda value: np.concatenate([np.broadcast_to(value(s.name), (s.size,)) for s in states])
    before = each(lambda name: np.asarray(params.states[name].sd))
    after = np.sqrt(np.diagonal(np.asarray(info.P[-1])))[9:]
    went = np.abs(each(lambda name: np.asarray(info.nav.errors[name])[-1] - np.asarray(nav.errors.get(name, 0.0))))
    T = float(info.nav.t[-1] - nav.t)
    rates = {s.rate_of: params.states[s.name] for s in states if s.rate_of}
    grown = each(lambda name: _grown(rates[name], T) if name in rates else 0.0)  # of a state that grows by another one
    possible = np.sqrt(before**2 + each(lambda name: _driven(params.states[name], T)) + grown)
    out = []
    unseen = [name for name, was, now in zip(names, before, after, strict=True) if now > UNOBSERVED_SD_RATIO * was > 0]
    if unseen:
        out.append(finding("state.unobserved", ", ".join(unseen)))
    far = [
        f"{name} ({x / sd:.0f} sigma)"
        for name, x, sd in zip(names, went, possible, strict=True)
        if x > MAX_STATE_SIGMAS * sd > 0
    ]
    if far:
        out.append(finding("state.unexpected", ", ".join(far)))
    return out


def _driven(state: StateParams, T: float) -> np.ndarray:
    """Variance by which a Gauss-Markov process has spread after T s."""
    drive, tau = np.asarray(state.driving_noise), np.asarray(state.tau)
    size = np.linalg.norm(drive, axis=1) if drive.ndim == 2 else drive
    return size**2 * np.minimum(T, tau / 2)
