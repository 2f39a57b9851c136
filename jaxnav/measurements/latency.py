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

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import earth, rotations
from jaxnav.maths.components import add, cross, rotate, scale, split
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
    age, S0, S1, q_then, q_now, _ = between
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
    columns = [motion]
    for state in states:
        if state.enters is None:
            columns.append(jnp.zeros((9, state.size)))
        else:
            M = age * eye if state.effect is None else _integral(between, state)
            columns.append(-through[state.enters] @ M)  # an error of the state lowers the reading that is used
    return jnp.concatenate(columns, 1)


def _integral(between: Interval, state: State) -> jax.Array:
    """Return the integral of a state's effect M over the interval, (3, size).

    M is linear in the readings, so that M of their integrals is the age times M of their means.
    """
    assert state.enters is not None and state.effect is not None
    age, S0, _, q_then, q_now, auxiliary = between
    C = 0.5 * (rotations.to_dcm(q_then) + rotations.to_dcm(q_now))
    turned = rotations.log(rotations.multiply(rotations.conjugate(q_then), q_now))
    readings = {"gyro": turned, "accel": C.T @ S0}
    held = {name: age * value for name, value in auxiliary.items()}
    return state.effect(Reading(readings[state.enters], readings[OTHER[state.enters]], held))


def earlier_error(between: Interval, states: Sequence[State]) -> Callable[[jax.Array], jax.Array]:
    """Return the function x (n,) -> `error_then` x, (9,): the equations by components, for many instants at once.

    Args:
        between: motion from that instant to the end of the epoch.
        states: the optional states of the filter, in their order.
    """
    age, S0, S1, q_then, q_now, _ = between
    s0, s1, then, now = map(split, (S0, S1, q_then, q_now))
    stops = np.cumsum([9, *(state.size for state in states)])

    def apply(x: jax.Array) -> jax.Array:
        p, v, phi = split(x[:3]), split(x[3:6]), split(x[6:9])
        lost = {"gyro": jnp.zeros(3), "accel": jnp.zeros(3)}  # age dw and age df: what the readings are lowered by
        for state, i, j in zip(states, stops[:-1], stops[1:], strict=True):
            if state.enters is not None:
                lost[state.enters] -= _integral(between, state) @ x[i:j] if state.effect else age * x[i:j]
        dw, df = split(lost["gyro"]), split(lost["accel"])
        turn, early, late = scale(0.5, add(rotate(then, dw), rotate(now, dw))), rotate(then, df), rotate(now, df)
        return jnp.stack(
            [
                *add(
                    p, scale(-age, v), cross(add(phi, scale(-1 / 3, turn)), s1), scale(age / 6, add(early, late, late))
                ),
                *add(v, cross(s0, add(phi, scale(-0.5, turn))), scale(-0.5, add(early, late))),
                *add(phi, scale(-1.0, turn)),
            ]
        )

    return apply
