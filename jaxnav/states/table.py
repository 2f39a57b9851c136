"""STATES: every optional error state by name; a new one is a file in this folder and a line here."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.states.barometer_bias import BAROMETER_BIAS
from jaxnav.states.biases import ACCEL_BIAS, GYRO_BIAS
from jaxnav.states.g_sensitivity import GYRO_G_SENSITIVITY
from jaxnav.states.gnss_position_error import GNSS_POSITION_ERROR
from jaxnav.states.installation import CLOCK_OFFSET, LEVER_ARM_ERROR, ODOMETER_SCALE, VEHICLE_AXES, WHEEL_ARM_ERROR
from jaxnav.states.misalignment import ACCEL_MISALIGNMENT, GYRO_MISALIGNMENT
from jaxnav.states.motion import MOTION
from jaxnav.states.receiver_clock import INTER_SYSTEM_BIAS, RANGE_ERROR, RECEIVER_CLOCK_BIAS, RECEIVER_CLOCK_DRIFT
from jaxnav.states.scale_factors import ACCEL_SCALE, GYRO_SCALE
from jaxnav.states.state import State
from jaxnav.states.surroundings import DECLINATION_ERROR, GROUND_HEIGHT, MAGNETOMETER_BIAS, WIND
from jaxnav.types import Table, nearest

STATES: Table[State] = Table.named(
    GYRO_BIAS,
    ACCEL_BIAS,
    GYRO_SCALE,
    ACCEL_SCALE,
    GYRO_MISALIGNMENT,
    ACCEL_MISALIGNMENT,
    GYRO_G_SENSITIVITY,
    LEVER_ARM_ERROR,
    CLOCK_OFFSET,
    BAROMETER_BIAS,
    GNSS_POSITION_ERROR,
    ODOMETER_SCALE,
    VEHICLE_AXES,
    WHEEL_ARM_ERROR,
    MAGNETOMETER_BIAS,
    DECLINATION_ERROR,
    WIND,
    GROUND_HEIGHT,
    RECEIVER_CLOCK_BIAS,
    RECEIVER_CLOCK_DRIFT,
    INTER_SYSTEM_BIAS,
    RANGE_ERROR,
)
BIASES = ("gyro_bias", "accel_bias")
"""The optional states of a filter of 15."""


def chosen(names: Iterable[str]) -> tuple[State, ...]:
    """Return the rows of these names, in their order.

    Raises:
        ValueError: a name that is not in `STATES`, or one that comes twice.
    """
    names = tuple(names)
    for name in names:
        if name not in STATES:
            raise ValueError(f"no state {name!r}: {nearest(name, STATES)}")
        if names.count(name) > 1:
            raise ValueError(f"state {name!r} comes twice in {list(names)}")
    return tuple(STATES[name] for name in names)


def layout(states: Iterable[State]) -> dict[str, slice]:
    """Where each state stands in the error vector, behind the nine of position, velocity and attitude."""
    states = tuple(states)
    stops = np.cumsum([9, *(s.size for s in states)]).tolist()
    return {s.name: slice(a, b) for s, a, b in zip(states, stops[:-1], stops[1:], strict=True)}


def mask(*names: str, states: Iterable[str] = ()) -> np.ndarray:
    """1.0 on the named states and 0.0 elsewhere, (n,), of a filter with these optional states.

    Raises:
        ValueError: a state that the filter has not.
    """
    places = MOTION | layout(chosen(states))
    m = np.zeros(max(place.stop for place in places.values()))
    for name in names:
        if name not in places:
            raise ValueError(f"a filter of {m.size} states has no {name}; it has {list(places)}")
        m[places[name]] = 1.0
    return m


def zeros(names: Iterable[str]) -> dict[str, jax.Array]:
    """Estimates of zero, by name."""
    return {s.name: jnp.zeros(s.size) for s in chosen(names)}
