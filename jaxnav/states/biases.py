"""Biases of the inertial sensors, added to the true reading."""

from jaxnav.maths import units
from jaxnav.states.state import BODY, State, UserUnit, state_units
from jaxnav.types import StateParams

GYRO_BIAS = State(
    "gyro_bias",
    BODY,
    "gyro",
    None,
    StateParams(sd=0.5 * units.DEG, driving_noise=20 * units.DEG_PER_HOUR * (2 / 1000) ** 0.5, tau=float("inf")),
    state_units(3, UserUnit("deg_per_hour", units.DEG_PER_HOUR, "deg/h")),
)
"""rad/s, body."""

ACCEL_BIAS = State(
    "accel_bias",
    BODY,
    "accel",
    None,
    StateParams(sd=20 * units.MG, driving_noise=0.1 * units.MG * (2 / 1000) ** 0.5, tau=float("inf")),
    state_units(3, UserUnit("mg", units.MG, "mg"), noise=UserUnit("ug", units.UG, "ug")),
)
"""m/s^2, body."""
