"""The slow part of a receiver's position error: ionosphere, multipath, orbits, and the memory of its filter."""

import math

from jaxnav.states.state import State, UserUnit, state_units
from jaxnav.types import StateParams

SD, TAU = 1.5, 300.0  # m, s: of a single-frequency receiver, some minutes long

GNSS_POSITION_ERROR = State(
    "gnss_position_error",
    ("east", "north", "up"),
    None,
    None,
    StateParams(sd=SD, driving_noise=SD * math.sqrt(2 / TAU), tau=TAU),  # as large at the start as later
    state_units(3, UserUnit("m", 1.0, "m")),
)
"""m, ENU."""
