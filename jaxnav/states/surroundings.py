"""Errors by the surroundings of the vehicle: the magnetic field that its iron bends, wind, and the ground."""

from jaxnav.maths import units
from jaxnav.states.state import BODY, State, UserUnit, constant

MAGNETOMETER_BIAS = constant("magnetometer_bias", BODY, 5.0, UserUnit("ut", 1.0, "uT"))
"""uT, body: hard iron, the bias of a magnetometer."""
DECLINATION_ERROR = constant("declination_error", ("east",), 3.0, UserUnit("deg", units.DEG, "deg"))
"""rad: the field points further east by that, on top of the magnetometer's ``declination``."""
_CALM: State = constant("wind", ("east", "north"), 5.0, UserUnit("mps", 1.0, "m/s"))
WIND = _CALM._replace(defaults=_CALM.defaults._replace(driving_noise=0.1))
"""m/s: where the air moves to, level; a walk, of half a metre per second in half a minute."""
_FLAT: State = constant("ground_height", ("up",), 100.0, UserUnit("m", 1.0, "m"))
GROUND_HEIGHT = _FLAT._replace(defaults=_FLAT.defaults._replace(driving_noise=0.3))
"""m: the ground below is higher than the rangefinder's ``ground``; a walk, of a metre in ten seconds."""
