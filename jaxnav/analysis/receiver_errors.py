"""White and slow errors of a receiver's positions: how the variance that it states is split between them.

A receiver states how far its positions are from the truth. Most of that is slow: ionosphere, orbits, reflections and
the memory of the receiver's filter last for minutes, so that fixes agree with each other far better than with the
Earth. A filter that takes all of it for white noise averages the slow part away and states a tenth of its error. Here
the stated variance s^2 is split,

    white noise     sqrt(1 - share) s             slow error     sqrt(share) s, a Gauss-Markov process of time tau

so that their sum stays what the receiver states. The white part and the rate of the slow one, 2 share s^2 / tau, show
in the innovations; its size does not within minutes, and is the receiver's word.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxnav.analysis.boxes import SQUARE, climb, vertex
from jaxnav.filters.lanes import RECEIVER_ERROR
from jaxnav.types import Params, StateParams

ODDS = np.array([-2.0, -1.0, 0.0, 0.6, 1.3, 2.0, 2.7, 3.3])  # log10 of share / (1 - share), of the coarse grid
TAUS = np.log10([10.0, 40.0, 150.0, 600.0])  # log10 of s, likewise
USUAL, USUAL_SD = np.array([0.6, np.log10(150.0)]), np.array([1.5, 0.5])  # share 0.8 over 150 s; prior sd, decades
VELOCITIES, VELOCITY_SD = (
    np.arange(-0.75, 1.0, 0.25),
    0.5,
)  # log10 of the factor on the sd of velocities; prior, decades
FACTORS, FACTOR_SD = np.arange(-4, 5) / 4, 0.3  # the same of the sd of positions
RECEIVER_BOX = np.array([0.5, 0.3])  # steps of a box: log10 of odds and s
MAX_DRIFT_RATIO = 1.05  # of the drift over hidden windows with white errors as stated, up to which others are taken
MIN_GAIN = 1.0  # of J, from which on others than the usual ones are taken
WHITE = np.array([0.0, -9.0, TAUS[2], -9.0, TAUS[2], 0.0])
"""Numbers of `receiver` whose errors are white, as stated."""
PRECISE_M, PRECISE_ODDS = 0.1, -1.0  # m, stated sd below which phases are resolved; log10 of the odds there


class ReceiverErrors(NamedTuple):
    """Errors of a receiver, horizontal and vertical separately."""

    share: np.ndarray = np.zeros(2)  # (2,) of the stated variance of positions that is slow
    tau: np.ndarray = np.full(2, 150.0)  # (2,) s, correlation time of the slow part
    velocity: float = 1.0  # factor on the stated sd of velocities
    position: float = 1.0  # on that of positions, white and slow
    sd: np.ndarray = np.ones(3)  # (3,) m, ENU, typical stated sd of positions

    def applied(self, params: Params) -> Params:
        """Return parameters with these errors; without the state of slow errors all of a position's stay white.

        A state that is known otherwise stays where no share is slow.
        """
        fixes, states = dict(params.measurements), dict(params.states)
        if "velocity" in fixes:
            fixes["velocity"] = fixes["velocity"]._replace(scale=jnp.asarray(fixes["velocity"].scale) * self.velocity)
        if "position" in fixes:
            fixes["position"] = fixes["position"]._replace(scale=jnp.asarray(fixes["position"].scale) * self.position)
        if RECEIVER_ERROR in states and "position" in fixes and self.share.any():
            share, tau = self.share[[0, 0, 1]], self.tau[[0, 0, 1]]
            slow = np.sqrt(share) * self.position * self.sd
            leaves = StateParams(slow, slow * np.sqrt(2 / tau), tau)
            states[RECEIVER_ERROR] = StateParams(*(jnp.asarray(leaf, float) for leaf in leaves))
            white = jnp.asarray(fixes["position"].scale) * np.sqrt(1 - share)
            fixes["position"] = fixes["position"]._replace(scale=white)
        return params._replace(states=states, measurements=fixes)


def receiver(numbers: np.ndarray, sd: np.ndarray) -> ReceiverErrors:
    """Return the receiver of numbers (6,).

    Log10 of the factor on the sd of velocities, of odds and s level and up, and of the factor on the sd of positions.
    """
    v, odds, tau = numbers[0], 10.0 ** numbers[[1, 3]], 10.0 ** numbers[[2, 4]]
    return ReceiverErrors(odds / (1 + odds), tau, float(10.0**v), float(10.0 ** numbers[5]), sd)


def usual(sd: np.ndarray) -> np.ndarray:
    """Return log10 of odds and correlation time (2,) that receivers of a stated sd (3,) m usually have."""
    return np.array([PRECISE_ODDS if np.max(sd[:2]) < PRECISE_M else USUAL[0], USUAL[1]])


def stated(sd: np.ndarray) -> np.ndarray:
    """Return the numbers (6,) of a receiver with the `usual` slow errors and all else as it states."""
    return np.concatenate([[0.0], usual(sd), usual(sd), [0.0]])


def on_top(sd: np.ndarray) -> np.ndarray:
    """Return the numbers (6,) of a receiver with white errors as it states, and the `usual` slow ones on top of them.

    Slow errors that are not split off leave the solution as it is, and state its error on the Earth.
    """
    odds, tau = usual(sd)
    slow = 1.0 / (1.0 + 10.0**-odds)  # of the stated variance, in addition to it
    each = [np.log10(slow), tau]
    return np.array([0.0, *each, *each, 0.5 * np.log10(1.0 + slow)])


def best_errors(
    score: Callable[[np.ndarray, int | None], np.ndarray], sd: np.ndarray, assumed_sd: bool, velocities: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (6,) of `receiver` at the maximum of likelihood and priors, and which axes are assumed (2,).

    A grid of equal share and time level and up, a line over the sd of velocities, boxes about the best shares and
    times, and a line over the sd of positions.

    Args:
        score: from numbers (P, 6) and a number of phases of hidden windows (None: all) to the log-likelihood, of all
            channels but the height and of the height, and the drift, m, (P, 3).
        sd: (3,) m, ENU, typical stated sd of positions.
        assumed_sd: it is a table's, so that the total may be smaller as well.
        velocities: there are some.
    """
    centre, most = usual(sd), np.inf

    def at(numbers: np.ndarray, phases: int | None) -> np.ndarray:
        """Return J (P, 2), level and up, -inf where the drift exceeds ``most`` m."""
        return posterior(numbers, score(numbers, phases), most)

    def posterior(numbers: np.ndarray, found: np.ndarray, most: float) -> np.ndarray:
        J = found[:, :2] - np.stack([penalty(numbers[:, k : k + 2], centre) for k in (1, 3)], 1)
        J[:, 0] -= 0.5 * (numbers[:, 0] / VELOCITY_SD) ** 2 + 0.5 * (numbers[:, 5] / FACTOR_SD) ** 2
        return np.where((np.isfinite(J).all(1) & (found[:, 2] <= most))[:, None], J, -np.inf)

    def along(best: np.ndarray, number: int, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the best numbers with one of them at the maximum over equidistant values, and the gain over 0."""
        line = np.tile(best, (len(values), 1))
        line[:, number] = values
        J = at(line, 1).sum(1)
        if not np.isfinite(J.max()):
            return best, 0.0
        i = int(np.clip(np.argmax(J), 1, len(values) - 2))
        near, step = slice(i - 1, i + 2), np.array([values[1] - values[0], 0.0, 0.0])
        points = np.column_stack([values[near], np.zeros((3, 2)), J[near]])
        top, zero = vertex(points, np.array([values[i], 0.0, 0.0]), step)[0], J[np.argmin(np.abs(values))]
        return np.where(np.arange(best.size) == number, top, best), float(J.max() - zero)

    grid = np.stack(np.meshgrid(ODDS, TAUS, indexing="ij"), -1).reshape(-1, 2)
    tried = np.vstack([stated(sd), np.column_stack([np.zeros(len(grid)), grid, grid, np.zeros(len(grid))])])
    found = score(np.vstack([WHITE, tried]), 1)
    most = MAX_DRIFT_RATIO * found[0, 2]
    level, up = np.argmax(posterior(tried, found[1:], most), 0)
    best = np.concatenate([[0.0], tried[level, 1:3], tried[up, 3:5], [0.0]])
    if velocities:
        best, _ = along(best, 0, VELOCITIES)
    most = MAX_DRIFT_RATIO * score(WHITE[None], None)[0, 2]
    best, gain = _climbed(at, best, centre)
    wider, more = along(best, 5, FACTORS if assumed_sd else FACTORS[FACTORS >= 0])
    if more >= MIN_GAIN:
        best, gain = _climbed(at, wider, centre)
    assumed = gain < MIN_GAIN
    best[1:5] = np.where(np.repeat(assumed, 2), np.tile(centre, 2), best[1:5])
    return best, assumed


def _climbed(
    at: Callable[[np.ndarray, int | None], np.ndarray], best: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers (6,) with odds and times at the maxima of J about ``best``, and the gain (2,) over ``centre``.

    The vertical ones are of the last box about the start.
    """
    tried = np.vstack([RECEIVER_BOX * SQUARE, np.zeros((1, 2))])
    J = np.zeros((0, 2))

    def box(middle: np.ndarray) -> np.ndarray:
        nonlocal J
        numbers = np.tile(best, (len(tried), 1))
        numbers[:, 1:5] = np.column_stack([middle[:2] + tried, best[3:5] + tried])
        numbers[-1, 1:5] = [*centre, *centre]
        J = at(numbers, None)
        return np.column_stack([numbers[:-1, 1:3], np.zeros(len(SQUARE)), J[:-1, 0]])

    steps = np.append(RECEIVER_BOX, 0.0)
    middle, points = climb(box, np.append(best[1:3], 0.0))
    rise = np.column_stack([best[3:5] + tried[:-1], np.zeros(len(SQUARE)), J[:-1, 1]])
    up = vertex(rise, np.append(best[3:5], 0.0), steps)[:2]
    gain = np.maximum(J[:-1].max(0), -1e300) - np.maximum(J[-1], -1e300)  # where nothing is allowed: no gain
    return np.array([best[0], *vertex(points, middle, steps)[:2], *up, best[5]]), gain


def penalty(numbers: np.ndarray, centre: np.ndarray) -> Any:
    """Return minus the log of the prior density (...,) of log10 of odds and correlation time (..., 2)."""
    return 0.5 * (((numbers - centre) / USUAL_SD) ** 2).sum(-1)


def without_slow_errors(params: Params) -> Params:
    """Return parameters whose state of slow errors is none: all that the receiver states is white noise."""
    if RECEIVER_ERROR not in params.states:
        return params
    none = StateParams(jnp.zeros(3), jnp.zeros(3), jnp.full(3, 150.0, float))
    return params._replace(states=params.states | {RECEIVER_ERROR: none})


def alike(each: Sequence[ReceiverErrors]) -> list[ReceiverErrors]:
    """Return receivers with one share, time and factor, the means: recordings that are tuned together share a scale."""
    share = np.mean([r.share for r in each], 0)
    tau, position = (
        np.exp(np.mean([np.log(value) for value in values], 0))
        for values in ([r.tau for r in each], [r.position for r in each])
    )
    return [r._replace(share=share, tau=tau, position=float(position)) for r in each]


def whole(params: Params, sd: np.ndarray) -> Params:
    """Return parameters whose white noise of positions is all of a receiver's error, for filters without slow ones.

    Args:
        params: parameters of a filter.
        sd: (3,) m, ENU, that the receiver states.
    """
    if RECEIVER_ERROR not in params.states or "position" not in params.measurements:
        return params
    position, slow = params.measurements["position"], jnp.asarray(params.states[RECEIVER_ERROR].sd)
    if jnp.ndim(position.scale) == 2:  # correlated axes: the size of each stays the white one
        return params
    total = jnp.sqrt(jnp.asarray(position.scale) ** 2 + (slow / sd) ** 2)
    return params._replace(measurements=params.measurements | {"position": position._replace(scale=total)})
