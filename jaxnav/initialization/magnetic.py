"""The Earth's magnetic field where a recording begins, by the World Magnetic Model (package ``pygeomag``)."""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.maths.units import DEG
from jaxnav.measurements.magnetometer import MAGNETOMETER
from jaxnav.types import Finding, Params

MODEL_YEAR = 2025.0  # of the field: declination changes by 0.2 deg a year at most, far from the poles
UNKNOWN_DECLINATION_SD = 10 * DEG  # sd of an unknown declination, away from the poles
INSTALL = (
    "pip install 'jaxnav[magnetic]', or set [measurements.magnetometer] declination_deg, inclination_deg, strength_ut"
)


class Field(NamedTuple):
    """The field at a place."""

    declination: float  # rad, from north to east
    inclination: float  # rad, below the horizon
    strength: float  # uT
    sd: float  # rad, of the declination
    about: Finding | None = None  # where it is the model's, or unknown


@cache
def _model() -> Any:
    """Return the model's newest coefficients; None where the package is not installed."""
    try:
        from pygeomag import GeoMag
    except ImportError:
        return None
    return GeoMag()


def field_at(lla: np.ndarray, year: float = MODEL_YEAR) -> Field | None:
    """Return the model's field at (3,) rad, rad, m; None where the package is not installed."""
    model = _model()
    if model is None:
        return None
    lat, lon, height = float(lla[0]) / DEG, float(lla[1]) / DEG, float(lla[2])
    found = model.calculate(glat=lat, glon=(lon + 180) % 360 - 180, alt=height / 1e3, time=year)
    about = finding("start.field", value=float(found.d), inclination=float(found.i), strength=float(found.f) / 1e3)
    return Field(found.d * DEG, found.i * DEG, found.f / 1e3, 1 * DEG, about)


def field_of(params: Params, lla: np.ndarray) -> Field:
    """Return the field in ``params``; where they hold the row's defaults, the model's at ``lla``."""
    default = MAGNETOMETER.defaults
    stated = params.measurements.get("magnetometer", default)
    values = float(stated.declination), float(stated.inclination), float(stated.strength)
    if not np.allclose(values, [default.declination, default.inclination, default.strength], rtol=1e-12):
        return Field(*values, 1 * DEG)
    found = field_at(lla)
    if found is not None:
        return found
    return Field(*values, UNKNOWN_DECLINATION_SD, finding("start.no_field", install=INSTALL))


def heading_of(field: np.ndarray, roll: float, pitch: float, known: Field) -> tuple[float, float, float]:
    """Heading (rad) that a field (3,) uT, body, shows at a roll and pitch (rad); its level part, how bent it is (uT).

    Hard iron of b uT turns the heading by b over the level part. Bent is the difference of level and downward part
    from those of the ``known`` field.
    """
    x, y, z = field
    below = y * math.sin(roll) + z * math.cos(roll)
    forward, down = x * math.cos(pitch) + below * math.sin(pitch), below * math.cos(pitch) - x * math.sin(pitch)
    right = y * math.cos(roll) - z * math.sin(roll)
    level = math.hypot(forward, right)
    bent = math.hypot(
        level - known.strength * math.cos(known.inclination), down - known.strength * math.sin(known.inclination)
    )
    return math.atan2(-right, forward) + known.declination, level, bent
