"""Biases of the inertial sensors: they add to what is read."""

from jaxnav.maths import units
from jaxnav.states.state import BODY, State, state_units
from jaxnav.types import StateParams

GYRO_BIAS = State(
    "gyro_bias",
    BODY,
    "gyro",
    None,
    StateParams(sd=0.5 * units.DEG, drive=20 * units.DEG_PER_HOUR * (2 / 1000) ** 0.5, tau=float("inf")),
    state_units("gyro_bias", "deg_per_hour", units.DEG_PER_HOUR, 3, "deg/h",
                ("gyro_bias_deg_per_hour_per_sqrt_s", units.DEG_PER_HOUR, "deg/h/sqrt(s)")),
)  # fmt: skip
"""rad/s, body."""

ACCEL_BIAS = State(
    "accel_bias",
    BODY,
    "accel",
    None,
    StateParams(sd=20 * units.MG, drive=0.1 * units.MG * (2 / 1000) ** 0.5, tau=float("inf")),
    state_units("accel_bias", "mg", units.MG, 3, "mg",
                ("accel_bias_ug_per_sqrt_s", units.UG, "ug/sqrt(s)")),
)  # fmt: skip
"""m/s^2, body."""
