"""A vehicle that is parked first: its heading drifts away with the gyro's bias until motion shows it.

Hypotheses of the heading at steps of 30 deg become wide while nothing shows it, and one linear filter cannot take
in the information of its first turn. So when it moves off, hypotheses are spread over the circle once more, about the
position, velocity, tilt and biases that the standstill has left.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.core import Filter
from jaxnav.initialization.bank import with_headings
from jaxnav.initialization.initialize import ground_velocity
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.states.motion import A, P, V
from jaxnav.states.table import chosen, layout
from jaxnav.types import Info, Nav, Params, Prior, Recording

MAX_HYPOTHESIS_SD = 45 * DEG  # sd of the heading of a hypothesis, beyond which they are spread once more
MAX_PARKED_SPEED, PARKED_SIGMAS = 0.5, 4.0  # m/s, and sd of a velocity, below which a vehicle is parked
LEAD_S = 1.0  # s before its velocity says so


def moves_off(rec: Recording, begin: float) -> float | None:
    """Return when a vehicle that is parked at ``begin`` s moves off, s; None if it never does."""
    v = ground_velocity(rec)
    speed, least = (
        np.hypot(v.value[:, 0], v.value[:, 1]),
        max(MAX_PARKED_SPEED, PARKED_SIGMAS * float(np.median(v.sd[:, :2]))),
    )
    fast = (speed > least) & (v.t > begin)
    fast[:-1] &= fast[1:]  # two in a row
    return float(v.t[np.argmax(fast)]) - LEAD_S if fast.any() else None


def spread_again(filt: Filter, params: Params, info: Info, count: int) -> tuple[Params, Nav] | None:
    """Return parameters and ``count`` starts (B, ...) after the last epoch of a standstill.

    None where the heading is known better than `MAX_HYPOTHESIS_SD`.

    Args:
        filt: the filter.
        params: its parameters.
        info: (E, ...) of one hypothesis up to there.
        count: how many headings.
    """
    nav, cov = jax.tree.map(lambda a: jnp.asarray(a[-1]), info.nav), np.asarray(info.P[-1])
    sd = np.sqrt(np.diag(cov))
    if not sd[8] > MAX_HYPOTHESIS_SD:
        return None
    C, arm = rotations.to_dcm(nav.q), params.mounting.lever_arm
    heading = float(rotations.to_rph(C)[2])
    angles = heading + 2 * np.pi * np.arange(count) / count
    navs = with_headings(nav._replace(pos=earth.move(nav.pos, C @ arm)), angles, arm)
    tilt = float(sd[A][:2].max())
    attitude = jnp.asarray([tilt, tilt, 2 * np.pi / count])
    slices = layout(chosen(filt.model.states))
    states = {name: params.states[name]._replace(sd=jnp.asarray(sd[place])) for name, place in slices.items()}
    prior = Prior(jnp.asarray(sd[P]), jnp.asarray(sd[V]), attitude)
    return params._replace(prior=prior, states=params.states | states), navs
