"""Datasheet units in SI, for the border (files, scenarios, command line, plots); inside everything is SI and radians.

``0.2 * DEG_PER_SQRT_HOUR`` is an angular random walk in rad/sqrt(s); divide to go back.
"""

import math
from typing import NamedTuple

DEG = math.pi / 180.0  # rad
HOUR = 3600.0  # s
TICK = 1e-6  # s: times closer than this are one
DEG_PER_HOUR = DEG / HOUR  # rad/s
DEG_PER_SQRT_HOUR = DEG / math.sqrt(HOUR)  # rad/sqrt(s), a root PSD of rate
G0 = 9.80665  # m/s^2, standard gravity: the unit g of datasheets, not the local gravity
MG = 1e-3 * G0  # m/s^2
UG = 1e-6 * G0  # m/s^2; UG per sqrt(Hz) is a root PSD in m/s^2/sqrt(Hz)
MGAL = 1e-5  # m/s^2
MPS_PER_SQRT_HOUR = 1.0 / math.sqrt(HOUR)  # m/s/sqrt(s)
PPM = 1e-6
MRAD = 1e-3


class Unit(NamedTuple):
    """How a user states a parameter, in configurations, tuned.toml and reports: the key is ``NAME_SUFFIX``."""

    suffix: str = ""  # the unit as the key ends; empty: a plain number
    factor: float = 1.0  # the user's unit in SI
    shape: tuple[int, ...] = ()  # of one value an axis
    text: str = ""  # the unit in words
    step: float | None = None  # SI, value of a tuner's step of 1; None: positive, a step is a factor e
    root: bool = False  # may also be a lower triangular matrix, for noise that is correlated between the axes
    endless: bool = False  # may be inf
    zero: bool = False  # of a positive one: may be 0
    most: float = math.inf  # largest magnitude, in the unit


DELAY = Unit("s", text="s", step=0.1, most=10.0)
"""Delays of measurements."""
