"""Racelogic VBO: minutes of arc with longitude to the west, km/h, and the IMU of an inertial module."""

import datetime
import os
import re
from pathlib import Path

from jaxnav.io.column_map import described
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import Parts
from jaxnav.io.sheet import open_sheet
from jaxnav.types import DataError, Json

CREATED = re.compile(rb"File created on (\d\d)/(\d\d)/(\d{4})")
GYRO, ACCEL = ("roll_?rate", "pitch_?rate", "yaw_?rate"), ("x_?acc(el)?", "y_?acc(el)?", "z_?acc(el)?")
FIX = {"lat": "lat", "lon": "long", "height": "height", "speed": "velocity", "course": "heading"}


def recognises(path: Path, head: bytes) -> bool:
    """Return whether it has the sections of such a file."""
    return b"[column names]" in head and b"[header]" in head


def read(path: Path) -> Parts:
    """Position, and velocity by speed and course; gyro (deg/s) and accelerometer (g) of an IMU module with six axes.

    Times are UTC of the day on which the file was created, else of 1970.

    Raises:
        DataError: no column of the time, latitude, longitude or height.
    """
    names = [name for name in open_sheet(path).columns if not name.isdigit()]
    axes = [next((name for name in names if re.fullmatch(pattern, name, re.I)), None) for pattern in GYRO + ACCEL]
    if lacking := {"time", *list(FIX.values())[:3]} - set(names):
        raise DataError(f"{path}: no column {', '.join(sorted(lacking))}: it has {', '.join(names)}")
    created = CREATED.search(read_bytes(path))
    day, month, year = (1, 1, 1970) if created is None else map(int, created.groups())
    midnight = datetime.datetime(year, month, day, tzinfo=datetime.UTC).timestamp()
    table: Json = {
        "file": path.name,
        "time": "time",
        "time_unit": "%H%M%S.%f",
        "time_scale": "utc",
        "time_shift_s": midnight,
        "position": {"lla": [FIX["lat"], f"-{FIX['lon']}", FIX["height"]], "unit": "1/60 deg"},
    }
    if {FIX["speed"], FIX["course"]} <= set(names):
        table["velocity"] = {"speed_course": [FIX["speed"], FIX["course"]], "unit": "km/h"}
    if None not in axes:
        table["imu"] = {"gyro": axes[:3], "gyro_unit": "deg/s", "accel": axes[3:], "accel_unit": "g"}
    return described(table, os.fspath(path), path.parent)
