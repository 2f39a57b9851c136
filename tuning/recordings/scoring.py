"""The method of scoring: Newton's method on a likelihood, with the information in place of the Hessian.

For up to a few tens of parameters one pass of forward derivatives gives likelihood, gradient and information together,
and ten passes equal hundreds of gradient steps. Damped as by Levenberg and Marquardt; pure, so that many problems
run side by side under vmap.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.programs import stored
from tuning.fit.status import Status
from tuning.uncertainty import Information

MAX_STEP = 1.5  # of a step in any unconstrained number: a factor 4.5
MIN_GAIN = 1e-3  # gain in log-likelihood that is worth another evaluation
DAMPINGS = (1.0, 8.0, 64.0)  # relative, of trials that are valued side by side
RIDGE_SHARE = 1e-3  # of the information: as if every number were known to 30 of its units


class Search(NamedTuple):
    """Where one search stands."""

    raw: jax.Array  # (P,) the best so far
    best: Information  # there
    damping: jax.Array  # ()
    trial: jax.Array  # (P,) the next point to evaluate
    expected: jax.Array  # () decrease of the negative log-likelihood that the trial promises
    steps: jax.Array  # () accepted
    interrupted: jax.Array | bool = False  # by Ctrl-C, with the best so far


def propose(raw: jax.Array, info: Information, damping: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the next trial (P,) and the decrease that it promises.

    A step that is too long is cut number by number, so that an undetermined one holds up no other, or as a
    whole, where that promises more: the rest of numbers that only make sense together may lead uphill.
    """
    F = info.fisher
    A = F + damping * jnp.diag(jnp.diag(F)) + RIDGE_SHARE * jnp.eye(raw.size)
    step = -jnp.linalg.solve(A, info.score)
    whole = step * (MAX_STEP / jnp.maximum(jnp.abs(step).max(), MAX_STEP))
    steps = jnp.stack([jnp.clip(step, -MAX_STEP, MAX_STEP), whole])
    gain = jax.vmap(lambda s: -(info.score @ s + 0.5 * s @ F @ s))(steps)
    best = jnp.argmax(gain)
    return raw + steps[best], gain[best]


def begin(raw: jax.Array, info: Information) -> Search:
    """Return a search from ``raw`` with its information."""
    damping = jnp.full((), 1e-2)
    trial, expected = propose(raw, info, damping)
    return Search(raw, info, damping, trial, expected, jnp.zeros((), int))


def advance(search: Search, info: Information) -> Search:
    """Take or refuse the trial, given its information; a refused one is tried again shorter."""
    good = jnp.isfinite(info.nll) & jnp.isfinite(info.fisher).all() & (info.nll < search.best.nll)
    pick = lambda a, b: jax.tree.map(lambda x, y: jnp.where(good, x, y), a, b)
    raw, best = pick((search.trial, info), (search.raw, search.best))
    damping = jnp.clip(jnp.where(good, search.damping / 5, search.damping * 8), 1e-6, 1e6)
    trial, expected = propose(raw, best, damping)
    return Search(raw, best, damping, trial, expected, search.steps + good)


_BEGIN, _ADVANCE = stored(begin), stored(advance)
_PROPOSE_MANY = jax.jit(jax.vmap(propose, (None, None, 0)))
_BEGIN_MANY, _ADVANCE_MANY = jax.jit(jax.vmap(begin)), jax.jit(jax.vmap(advance))


def _best_trial(search: Search, values: Callable[[jax.Array], np.ndarray]) -> tuple[Search, bool]:
    """Return a search with the best of some trials, and whether it is better than the best so far."""
    dampings = np.asarray(search.damping) * np.array(DAMPINGS)
    trials, expected = _PROPOSE_MANY(search.raw, search.best, dampings)
    found = values(trials)
    k = int(np.argmin(np.where(np.isnan(found), np.inf, found)))
    better = bool(found[k] < search.best.nll)
    at = k if better else -1  # the next is shorter than all that were refused
    return search._replace(damping=dampings[at], trial=trials[k], expected=expected[k]), better


def converged(search: Search, tolerance: float = MIN_GAIN) -> bool:
    """Return whether the predicted decrease is below the tolerance, or the damping at its limit."""
    return not np.any((np.asarray(search.expected) > tolerance) & (np.asarray(search.damping) < 1e5))


def status(search: Search, tolerance: float = MIN_GAIN) -> Status:
    """Return how a search ended."""
    if search.interrupted:
        return Status.INTERRUPTED
    return Status.CONVERGED if converged(search, tolerance) else Status.ITERATION_LIMIT


def maximise(
    inform: Callable[[jax.Array], Information],
    raw: jax.Array,
    most: int = 40,
    tolerance: float = MIN_GAIN,
    report: Callable[[int, Search], None] = lambda i, search: None,
    values: Callable[[jax.Array], np.ndarray] | None = None,
) -> Search:
    """Search until the promised gain in log-likelihood is below ``tolerance``, or ``most`` evaluations are spent.

    ``raw`` is (P,), or (N, P) for N problems that ``inform`` evaluates together; then all go on until all are done.
    With ``values`` (T, P) -> (T,), the negative log-likelihood alone, trials of several dampings are valued first, and
    ``inform`` sees only those that are better than the best so far. Ctrl-C ends the search with the best so far.

    Raises:
        ValueError: the likelihood of the start is not finite.
    """
    clear_caches_if_needed()
    start, step = (_BEGIN_MANY, _ADVANCE_MANY) if raw.ndim == 2 else (_BEGIN, _ADVANCE)
    first = inform(raw)
    if not np.isfinite(first.nll).all():
        raise ValueError("the likelihood of the starting parameters is not finite")
    search, better = start(raw, first), True
    try:
        report(0, search)  # the start
        for i in range(1, most):
            if converged(search, tolerance):
                break
            if values is not None:
                search, better = _best_trial(search, values)
            search = step(search, inform(search.trial) if better else search.best)
            report(i, search)
    except KeyboardInterrupt:
        return search._replace(interrupted=True)
    return search
