"""Android's GnssLogger: one text with rows of several kinds, IMU, magnetometer and fixes among them.

Names of the columns of each kind are in comments above; the first cell of a row is its kind.
"""

import os
import re
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.column_map import described
from jaxnav.io.files import read_bytes
from jaxnav.io.formats.sensor_logger import FLAT
from jaxnav.io.parts import Parts
from jaxnav.io.sheet import column, open_sheet
from jaxnav.types import Json

CLOCK = "elapsedRealtimeNanos"  # since the phone was switched on, of all sensors; older logs date fixes by UTC alone


def recognises(path: Path, head: bytes) -> bool:
    """Return whether comments name the columns of a gyro."""
    return bool(re.search(rb"^# ?(Uncal)?Gyro,utcTimeMillis,", head, re.MULTILINE))


def read(path: Path) -> Parts:
    """IMU, magnetometer, and fixes of the receiver, else of the phone; t since the phone was switched on, else UTC.

    Raises:
        DataError: no rows of a gyro or an accelerometer.
    """
    kinds = set(re.findall(rb"^\w+(?=,)", read_bytes(path), re.MULTILINE))
    has = lambda kind: kind.encode() in kinds
    gyro, accel, field = (f"Uncal{kind}" if has(f"Uncal{kind}") else kind for kind in ("Gyro", "Accel", "Mag"))
    name = path.name
    axes = lambda file, kind, unit: [f"{file}{kind}{axis}{unit}" for axis in "XYZ"]
    sheet = open_sheet(path, ",", only=((1, "Fix"),)) if has("Fix") else None
    by_clock = sheet is None or (CLOCK in sheet.columns and bool(np.char.str_len(column(sheet, CLOCK)).all()))
    clock, unit = (CLOCK, "ns") if by_clock else ("utcTimeMillis", "ms")
    table: Json = {
        "time": clock, "time_unit": unit, "delimiter": ",", "time_scale": "unknown" if by_clock else "utc",
        "imu": {
            "file": {"g": name, "a": name}, "where": {"g:1": gyro, "a:1": accel}, "time": f"g:{clock}", "axes": FLAT,
            "gyro": axes("g:", gyro, "RadPerSec"), "gyro_unit": "rad/s",
            "accel": axes("a:", accel, "Mps2"), "accel_unit": "m/s^2",
        },
    }  # fmt: skip
    if has(field):
        table["magnetometer"] = {"file": name, "where": {"1": field}, "value": axes("", field, "MicroT")}
    if sheet is not None:
        providers = set(column(sheet, "Provider").tolist())  # the receiver before cells and networks
        fixes: Json = {
            "file": name,
            "where": {"1": "Fix", "Provider": "GPS" if "GPS" in providers else min(providers)},
        }
        wide, high, fast = "AccuracyMeters", "VerticalAccuracyMeters", "SpeedAccuracyMps"
        stated: Json = {"sd_enu": [wide, wide, high if high in sheet.columns else wide]}
        if not by_clock:
            fixes |= {"time": "UnixTimeMillis"}
        table["position"] = {**fixes, **stated, "lla": ["LatitudeDegrees", "LongitudeDegrees", "AltitudeMeters"]}
        stated = {"sd": fast} if fast in sheet.columns else {}
        table["velocity"] = {**fixes, **stated, "speed_course": ["SpeedMps", "BearingDegrees"]}
    parts = described(table, os.fspath(path), path.parent)
    flat = finding("axes.assumed", "the phone", words=f'flat, screen up and top forward: axes = "{FLAT}"')
    return parts._replace(name=path.stem, notes=(flat, *parts.notes))
