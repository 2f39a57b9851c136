"""Bias of a barometric height: weather, temperature, and the reference height of the sensor."""

from jaxnav.states.state import State, UserUnit, state_units
from jaxnav.types import StateParams

BAROMETER_BIAS = State(
    "barometer_bias",
    ("up",),
    None,
    None,
    StateParams(sd=100.0, driving_noise=0.03, tau=float("inf")),  # a metre in 20 minutes
    state_units(1, UserUnit("m", 1.0, "m")),
)
"""m."""
