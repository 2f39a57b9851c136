"""MEASUREMENTS: every kind of measurement by name; a new one is a file in this folder and a line here."""

from jaxnav.measurements.air import AIRSPEED, SIDESLIP
from jaxnav.measurements.auxiliary import AUXILIARY, Auxiliary
from jaxnav.measurements.barometer import BAROMETER
from jaxnav.measurements.body_velocity import BODY_VELOCITY
from jaxnav.measurements.direction import BASELINE, COURSE, HEADING, YAW_RATE
from jaxnav.measurements.gnss import POSITION, VELOCITY
from jaxnav.measurements.ground import RANGEFINDER
from jaxnav.measurements.magnetometer import MAGNETOMETER
from jaxnav.measurements.measurement import Measurement, clock_offset, counted_from, layout
from jaxnav.measurements.satellites import PSEUDORANGE, RANGE_RATE
from jaxnav.measurements.standstill import ZERO_RATE, ZERO_VELOCITY
from jaxnav.measurements.vehicle import LEVEL, NONHOLONOMIC, SPEED, WHEELS
from jaxnav.types import Table

MEASUREMENTS: Table[Measurement] = Table.named(
    POSITION,
    VELOCITY,
    PSEUDORANGE,
    RANGE_RATE,
    ZERO_VELOCITY,
    ZERO_RATE,
    NONHOLONOMIC,
    LEVEL,
    SPEED,
    WHEELS,
    BODY_VELOCITY,
    BAROMETER,
    RANGEFINDER,
    MAGNETOMETER,
    HEADING,
    BASELINE,
    COURSE,
    YAW_RATE,
    AIRSPEED,
    SIDESLIP,
)
GNSS = (POSITION, VELOCITY)


def with_data() -> dict[str, Measurement | Auxiliary]:
    """Return the rows with a stream in a recording, by name: measurements, and auxiliary values of optional states."""
    return {name: each for name, each in MEASUREMENTS.items() if each.columns} | AUXILIARY


__all__ = [
    "AUXILIARY", "BAROMETER", "GNSS", "MEASUREMENTS", "NONHOLONOMIC", "POSITION", "PSEUDORANGE", "RANGE_RATE", "SPEED",
    "VELOCITY", "ZERO_RATE", "ZERO_VELOCITY", "Measurement", "clock_offset", "counted_from", "layout", "with_data",
]  # fmt: skip
