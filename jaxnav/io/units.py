"""Units that files come in, by quantity: factors to SI (magnetic field: microtesla). Only for the border."""

import re

import numpy as np

from jaxnav.maths.units import DEG, G0
from jaxnav.types import DataError, Json

UNITS: dict[str, dict[str, float]] = {
    "rate": {"rad/s": 1.0, "deg/s": DEG, "mdeg/s": 1e-3 * DEG},
    "angle": {"rad": 1.0, "deg": DEG, "1e-7 deg": 1e-7 * DEG},
    "acceleration": {"m/s^2": 1.0, "g": G0, "mg": 1e-3 * G0},
    "speed": {"m/s": 1.0, "km/h": 1 / 3.6, "mm/s": 1e-3, "cm/s": 1e-2, "knots": 1852 / 3600, "mph": 0.44704},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048},
    "temperature": {"degC": 1.0},
    "field": {"uT": 1.0, "nT": 1e-3, "T": 1e6, "gauss": 100.0, "mgauss": 0.1},  # to microtesla
}
MULTIPLE = re.compile(r"(?s)(?:((?:1/)?\d+(?:\.\d*)?(?:e[+-]?\d+)?) +)?(.*)")
PRESSURE = {"Pa": 1.0, "hPa": 100.0, "kPa": 1000.0}
SEA_LEVEL = 101325.0  # Pa, standard atmosphere


def factor(table: Json, key: str, kind: str, where: str, default: str | None = None) -> float:
    """Return the factor to SI of the unit that ``key`` of a table names, "deg/s", or of a multiple: "1/131 deg/s".

    Raises:
        DataError: it names none and there is no default, or one of another quantity.
    """
    unit = table.get(key, default)
    times, name = MULTIPLE.fullmatch(str(unit)).groups()  # type: ignore[union-attr]  # it fits any text
    if name not in UNITS[kind] or (times and not number_of(times) > 0):
        known = ", ".join(UNITS[kind])
        raise DataError(f"{where}: {key}: expected one of {known}, or a multiple such as '1/131 deg/s', got {unit!r}")
    return UNITS[kind][name] * (number_of(times) if times else 1.0)


def number_of(text: str) -> float:
    """Return the number of "0.061" or "1/131"; 0 of "1/0"."""
    if not text.startswith("1/"):
        return float(text)
    return 1 / float(text[2:]) if float(text[2:]) else 0.0


def pressure_height(pressure: np.ndarray) -> np.ndarray:
    """Height in m that a pressure in Pa has in the standard atmosphere; nan where it is not positive."""
    pressure = np.where(np.asarray(pressure) > 0.0, pressure, np.nan)
    return 44330.77 * (1.0 - (pressure / SEA_LEVEL) ** 0.190263)
