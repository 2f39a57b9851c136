"""Searches without derivatives, to compare a gradient with at equal cost; all in the unconstrained space.

Each takes ``score(candidates (N, P)) -> (N,)``, which may run them side by side, a start (P,), the evaluations that it
may spend and a seed, and gives the lowest score after every evaluation, (evaluations,).
"""

import math
from collections.abc import Callable

import numpy as np

Score = Callable[[np.ndarray], np.ndarray]
DECADE = math.log(10.0)


def random_search(score: Score, start: np.ndarray, budget: int, seed: int, together: int = 16) -> np.ndarray:
    """Independent draws about the start with an sd of a decade; the start itself first."""
    rng, found = np.random.default_rng(seed), [score(start[None])]
    while sum(map(len, found)) < budget:
        found.append(score(start + DECADE * rng.normal(size=(together, start.size))))
    return lowest(found, budget)


def coordinate_search(
    score: Score, start: np.ndarray, budget: int, seed: int, forward: float = 1.1, backward: float = 0.5
) -> np.ndarray:
    """One number after the other: a step forward, kept if the score falls, else one backward of ``backward`` of it.

    A step that helped grows by ``forward``, one that did not shrinks; steps start at log 2. The usual tool of a tuner
    without gradients; the seed is not used.
    """
    del seed
    at, step = start.copy(), np.full(start.size, math.log(2.0))
    found = [score(at[None])]
    best = float(found[0][0])
    while sum(map(len, found)) < budget:
        for i in range(start.size):
            for move in (step[i], -step[i]):
                trial = at.copy()
                trial[i] += move
                value = score(trial[None])
                found.append(value)
                if value[0] < best:
                    at, best = trial, float(value[0])
                    step[i] = forward * move  # and its direction is the next to try
                    break
            else:
                step[i] *= backward
        if np.abs(step).max() < 1e-4:
            break
    return lowest(found, budget)


def cma(score: Score, start: np.ndarray, budget: int, seed: int) -> np.ndarray:
    """CMA-ES with its default population and a first sd of a decade; needs the package ``cma`` (extra ``compare``)."""
    import cma as library

    options = {"seed": seed + 1, "verbose": -9, "maxfevals": budget}  # seed 0 would be the clock
    search = library.CMAEvolutionStrategy(start, DECADE, options)
    found = [score(start[None])]
    while not search.stop() and sum(map(len, found)) < budget:
        points = search.ask()
        values = score(np.asarray(points))
        search.tell(points, np.where(np.isfinite(values), values, 1e9).tolist())
        found.append(values)
    return lowest(found, budget)


def lowest(found: list[np.ndarray], budget: int) -> np.ndarray:
    """The lowest score so far, after every evaluation; what is not finite counts as infinite."""
    values = np.concatenate(found)[:budget]
    return np.minimum.accumulate(np.where(np.isfinite(values), values, np.inf))
