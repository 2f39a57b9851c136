"""Errors at the instant of a late measurement, as functions of the error at the end of the epoch.

Between the instant t - a of a measurement and the end t the error x = estimate - truth moves by

    p' = v,    v' = -[f x] phi + C df,    phi' = C dw

where f is specific force in ENU, C takes the body to ENU, df and dw are the errors of the readings that navigation
uses. Integrated backwards, with A_0 = -[S_0 x], A_1 = -[S_1 x] and the moments of specific force

    S_0 = int f dtau = v(t) - v(t - a) - g a
    S_1 = int (tau - t + a) f dtau = a v(t) - (p(t) - p(t - a)) - g a^2 / 2

    phi(t - a) = phi - a C dw
    v(t - a)   = v - A_0 phi - a C df + a/2 A_0 C dw
    p(t - a)   = p - a v + A_1 phi + a^2 (C(t - a) + 2 C(t)) / 6 df - a/3 A_1 C dw

S_0 and S_1 are differences of navigation, so the noise of single accelerometer samples does not enter. Earth rate,
transport rate and Coriolis acceleration are neglected: 1e-4 of an entry for an age of a second.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import earth, rotations
from jaxnav.states.sensors import OTHER
from jaxnav.states.state import Reading, State
from jaxnav.types import Nav


class Interval(NamedTuple):
    """Motion between the instant of a measurement and the end of the epoch, local level."""

    age: jax.Array  # () s
    S0: jax.Array  # (3,) m/s, integral of specific force, ENU
    S1: jax.Array  # (3,) m, its first moment about the instant of the measurement
    q_then: jax.Array  # (4,) body -> ENU at that instant
    q_now: jax.Array  # (4,) at the end
    auxiliary: dict[str, jax.Array] = {}  # () each, at the end


def interval(then: Nav, now: Nav, age: jax.Array) -> Interval:
    """Return the motion over ``age`` s from ``then`` to ``now``, both local level."""
    up = jnp.array([0.0, 0.0, 1.0]) * earth.gravity(now.pos[0], now.pos[2])
    displacement = earth.enu_difference(now.pos, then.pos)
    return Interval(
        age,
        now.vel - then.vel + age * up,
        age * now.vel - displacement + 0.5 * age**2 * up,
        then.q,
        now.q,
        now.auxiliary,
    )


def error_then(between: Interval, states: Sequence[State]) -> jax.Array:
    """Return d(error at the earlier instant) / d(error now), (9, n).

    Args:
        between: motion from the instant of the measurement to the end of the epoch.
        states: the k optional states of the filter, in their order; n = 9 plus their sizes.

    Returns:
        Rows: position (m), velocity (m/s) and attitude (rad) error in ENU at the earlier instant. Columns: the same and
        the optional states at the end.
    """
    age, S0, S1, q_then, q_now, auxiliary = between
    C_then, C_now = rotations.to_dcm(q_then), rotations.to_dcm(q_now)
    eye, zero = jnp.eye(3), jnp.zeros((3, 3))
    A0, A1 = -rotations.skew(S0), -rotations.skew(S1)
    motion = jnp.block([[eye, -age * eye, A1], [zero, eye, -A0], [zero, zero, eye]])
    C = 0.5 * (C_then + C_now)
    # per second of age, for an error of the body rate or of specific force, (9, 3)
    through = {
        "gyro": jnp.concatenate([-A1 @ C / 3, 0.5 * A0 @ C, -C]),
        "accel": jnp.concatenate([age / 6 * (C_then + 2 * C_now), -C, zero]),
    }
    # integrals of the readings over the interval: M is linear in them, so M of these is age times M of the mean
    readings = {"accel": C.T @ S0}
    if any(state.effect is not None for state in states):
        readings["gyro"] = rotations.log(rotations.multiply(rotations.conjugate(q_then), q_now))
    held = {name: age * value for name, value in auxiliary.items()}
    columns = [motion]
    for state in states:
        if state.enters is None:
            columns.append(jnp.zeros((9, state.size)))
        else:
            this, other = state.enters, OTHER[state.enters]
            M = age * eye if state.effect is None else state.effect(Reading(readings[this], readings[other], held))
            columns.append(-through[state.enters] @ M)  # an error of the state lowers the reading that is used
    return jnp.concatenate(columns, 1)
