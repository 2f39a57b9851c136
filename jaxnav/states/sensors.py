"""Correction of the inertial sensors' readings by the estimated errors."""

from collections.abc import Mapping

import jax

from jaxnav.states.state import Reading
from jaxnav.states.table import STATES
from jaxnav.types import Imu, Nav

OTHER = {"gyro": "accel", "accel": "gyro"}


def corrected_reading(
    reading: jax.Array,
    sensor: str,
    errors: Mapping[str, jax.Array],
    other: jax.Array,
    auxiliary: Mapping[str, jax.Array] = {},
) -> jax.Array:
    """Return the reading (..., 3) of ``sensor`` ("gyro" or "accel") without its errors, from the raw reading (..., 3).

    reading = w + sum M_i(w, o, a) s_i, solved for w; ``other`` (..., 3) is o, the reading of the other sensor, and a
    are the auxiliary values. Biases have M = I; the others' M is linear, and three rounds of
    w <- reading - sum M_i(w, o, a) s_i leave the fourth power of a scale error, 1e-10 of the reading at 3,000 ppm.
    """
    errors_of = [(STATES[name], s) for name, s in errors.items() if STATES[name].enters == sensor]
    for state, s in errors_of:
        if state.effect is None:
            reading = reading - s
    w = reading
    scaled = [(state.effect, s) for state, s in errors_of if state.effect is not None]
    for _ in range(3 if scaled else 0):
        w = reading - sum(effect(Reading(w, other, auxiliary)) @ s for effect, s in scaled)
    return w


def corrected(imu: Imu, nav: Nav) -> Imu:
    """Return samples without the estimated errors of the sensors: of the accelerometers first, which gyros may feel."""
    accel = corrected_reading(imu.accel, "accel", nav.errors, imu.gyro, nav.auxiliary)
    return imu._replace(gyro=corrected_reading(imu.gyro, "gyro", nav.errors, accel, nav.auxiliary), accel=accel)
