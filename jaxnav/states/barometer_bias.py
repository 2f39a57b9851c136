"""What a barometer reads too high: weather, temperature, and the height that its own zero has."""

from jaxnav.states.state import State, state_units
from jaxnav.types import StateParams

BAROMETER_BIAS = State(
    "barometer_bias",
    ("up",),
    None,
    None,
    StateParams(sd=100.0, drive=0.03, tau=float("inf")),  # a metre in 20 minutes
    state_units("barometer_bias", "m", 1.0, 1, "m", ("barometer_bias_m_per_sqrt_s", 1.0, "m/sqrt(s)")),
)
"""m."""
