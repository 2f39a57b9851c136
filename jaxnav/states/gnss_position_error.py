"""The slow part of a receiver's position error: ionosphere, multipath, orbits, and what its own filter keeps."""

import math

from jaxnav.states.state import State, state_units
from jaxnav.types import StateParams

SD, TAU = 1.5, 300.0  # m, s: of a single-frequency receiver, some minutes long

GNSS_POSITION_ERROR = State(
    "gnss_position_error",
    ("east", "north", "up"),
    None,
    None,
    StateParams(sd=SD, drive=SD * math.sqrt(2 / TAU), tau=TAU),  # as large at the start as later
    state_units(
        "gnss_position_error", "m", 1.0, 3, "m", ("gnss_position_error_m_per_sqrt_s", 1.0, "m/sqrt(s)")
    ),
)  # fmt: skip
"""m, ENU."""
