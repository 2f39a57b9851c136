"""White and slow errors of a receiver's positions: how the variance that it states is split between them.

A receiver states how far its positions are from the truth. Most of that is slow: ionosphere, orbits, reflections and
the memory of its own filter last for minutes, so that its fixes agree with each other far better than with the Earth. A
filter that takes all of it for white noise averages the slow part away and states a tenth of its error. Here the stated
variance s^2 is split,

    white noise     sqrt(1 - share) s             slow error     sqrt(share) s, a Gauss-Markov process of time tau

so that their sum stays what the receiver states. The white part and the rate of the slow one, 2 share s^2 / tau, show
in the innovations; its size does not within minutes, and is the receiver's word.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxnav.filters.lanes import RECEIVER_ERROR
from jaxnav.types import Params, StateParams

ODDS = np.array([-2.0, -1.0, 0.0, 0.6, 1.3, 2.0, 2.7, 3.3])  # log10 of share / (1 - share), of the coarse grid
TAUS = np.log10([10.0, 40.0, 150.0, 600.0])  # log10 of s, likewise
USUAL, USUAL_SD = np.array([0.6, np.log10(150.0)]), np.array([1.5, 0.5])  # share 0.8 over 150 s; prior sd, decades
PRECISE_M, PRECISE_ODDS = 0.1, -1.0  # m, stated sd below which phases are resolved; log10 of the odds there


class Receiver(NamedTuple):
    """Errors of a receiver, horizontal and vertical separately."""

    share: np.ndarray = np.zeros(2)  # (2,) of the stated variance of positions that is slow
    tau: np.ndarray = np.full(2, 150.0)  # (2,) s, correlation time of the slow part
    velocity: float = 1.0  # factor on the stated sd of velocities
    position: float = 1.0  # on that of positions, white and slow
    sd: np.ndarray = np.ones(3)  # (3,) m, ENU, typical stated sd of positions

    def applied(self, params: Params) -> Params:
        """Return parameters with these errors; without the state of slow errors all of a position's stay white."""
        fixes, states = dict(params.measurements), dict(params.states)
        if "velocity" in fixes:
            fixes["velocity"] = fixes["velocity"]._replace(scale=jnp.asarray(fixes["velocity"].scale) * self.velocity)
        if "position" in fixes:
            fixes["position"] = fixes["position"]._replace(scale=jnp.asarray(fixes["position"].scale) * self.position)
        if RECEIVER_ERROR in states and "position" in fixes:
            share, tau = self.share[[0, 0, 1]], self.tau[[0, 0, 1]]
            slow = np.sqrt(share) * self.position * self.sd
            leaves = StateParams(slow, slow * np.sqrt(2 / tau), tau)
            states[RECEIVER_ERROR] = StateParams(*(jnp.asarray(leaf, float) for leaf in leaves))
            white = jnp.asarray(fixes["position"].scale) * np.sqrt(1 - share)
            fixes["position"] = fixes["position"]._replace(scale=white)
        return params._replace(states=states, measurements=fixes)


def receiver(numbers: np.ndarray, sd: np.ndarray) -> Receiver:
    """Return the receiver of numbers (6,).

    Log10 of the factor on the sd of velocities, of odds and s level and up, and of the factor on the sd of positions.
    """
    v, odds, tau = numbers[0], 10.0 ** numbers[[1, 3]], 10.0 ** numbers[[2, 4]]
    return Receiver(odds / (1 + odds), tau, float(10.0**v), float(10.0 ** numbers[5]), sd)


def usual(sd: np.ndarray) -> np.ndarray:
    """Return log10 of odds and correlation time (2,) that receivers of a stated sd (3,) m usually have."""
    return np.array([PRECISE_ODDS if np.max(sd[:2]) < PRECISE_M else USUAL[0], USUAL[1]])


def penalty(numbers: np.ndarray, centre: np.ndarray) -> Any:
    """Return minus the log of the prior density (...,) of log10 of odds and correlation time (..., 2)."""
    return 0.5 * (((numbers - centre) / USUAL_SD) ** 2).sum(-1)


def whole(params: Params, sd: float) -> Params:
    """Return parameters whose white noise of positions is all of a receiver's error, for filters without slow ones.

    ``sd``: m, that the receiver states.
    """
    if RECEIVER_ERROR not in params.states or "position" not in params.measurements:
        return params
    position, slow = params.measurements["position"], jnp.asarray(params.states[RECEIVER_ERROR].sd)
    if jnp.ndim(position.scale) == 2:  # correlated axes: the size of each stays the white one
        return params
    total = jnp.sqrt(jnp.asarray(position.scale) ** 2 + (slow / sd) ** 2)
    return params._replace(measurements=params.measurements | {"position": position._replace(scale=total)})
