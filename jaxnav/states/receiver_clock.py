"""Errors of raw ranges: the receiver's clock, clocks of further constellations, the slow error of each satellite."""

import math

from jaxnav.states.state import State, UserUnit, constant, state_units
from jaxnav.types import StateParams

M, MPS = UserUnit("m", 1.0, "m"), UserUnit("mps", 1.0, "m/s")

RECEIVER_CLOCK_BIAS = State(
    "receiver_clock_bias",
    ("late",),
    None,
    None,
    StateParams(sd=30.0, driving_noise=0.3, tau=float("inf")),
    state_units(1, M),
)
"""m, light: every pseudorange is too long by that."""
RECEIVER_CLOCK_DRIFT = State(
    "receiver_clock_drift",
    ("fast",),
    None,
    None,
    StateParams(sd=3.0, driving_noise=0.3, tau=float("inf")),
    state_units(1, MPS),
    rate_of="receiver_clock_bias",
)
"""m/s: every range rate is too large by that, and the bias grows by it."""
INTER_SYSTEM_BIAS = constant("inter_system_bias", ("galileo", "beidou", "glonass"), 10.0, M)
"""m, light: pseudoranges of a further constellation are too long by that, in addition to the receiver's clock."""

SLOTS = 14
"""Satellites of one epoch: a slot holds one satellite while it is in view."""
SD, TAU = 3.0, 60.0  # m, s: of a receiver among houses; under an open sky 1.5 m over some minutes
RANGE_ERROR = State(
    "range_error",
    tuple(f"slot_{i + 1}" for i in range(SLOTS)),
    None,
    None,
    StateParams(sd=SD, driving_noise=SD * math.sqrt(2 / TAU), tau=TAU),
    state_units(SLOTS, M),
)
"""m, of each satellite: atmosphere, orbit, reflections. White noise alone averages out, these errors do not."""
