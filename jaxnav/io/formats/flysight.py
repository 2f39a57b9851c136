"""FlySight 2: SENSOR.CSV and TRACK.CSV, whose rows are of several kinds, in one folder."""

import os
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.column_map import described
from jaxnav.io.parts import Parts
from jaxnav.io.sheet import numbers, open_sheet
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.types import DataError, Json

MARK = b"$FLYS"
SENSORS, TRACK = "SENSOR.CSV", "TRACK.CSV"


def recognises(path: Path, head: bytes) -> bool:
    """Return whether it is one of the two files, or a folder with one."""
    if not path.is_dir():
        return head.startswith(MARK)
    return any((path / name).is_file() and (path / name).read_bytes().startswith(MARK) for name in (SENSORS, TRACK))


def read(path: Path) -> Parts:
    """IMU and barometer by the time of the receiver in $TIME, and fixes; of one file those alone.

    Raises:
        DataError: sensors without a $TIME, which alone dates them, or columns in another order.
    """
    folder = path if path.is_dir() else path.parent
    table: Json = {"delimiter": ",", "header": False}
    rows = lambda kind, name: {"file": name, "where": {"1": f"${kind}"}, "time": 2}
    if (folder / SENSORS).is_file() and path.name != TRACK:
        ticks = open_sheet(folder / SENSORS, ",", False, only=((1, "$TIME"),))
        counter, tow, week = (numbers(ticks, number) for number in (2, 3, 4))
        if not np.isfinite(counter + tow + week).any():
            raise DataError(f"{folder / SENSORS}: has no row $TIME with a week: the receiver had no fix")
        shift = float(np.nanmedian(GPS_EPOCH + week * WEEK + tow - counter))
        dated = {"time_shift_s": shift, "time_scale": "gps"}
        table["imu"] = {**rows("IMU", SENSORS), **dated, "gyro": [3, 4, 5], "gyro_unit": "deg/s",
                        "accel": [6, 7, 8], "accel_unit": "g", "axes": "flu"}  # fmt: skip
        table["barometer"] = {**rows("BARO", SENSORS), **dated, "value": 3, "unit": "Pa"}
    if (folder / TRACK).is_file() and path.name != SENSORS:
        fix = {**rows("GNSS", TRACK), "time_unit": "iso", "time_scale": "utc"}
        table["position"] = {**fix, "lla": [3, 4, 5], "sd_enu": ["9", "9", "10"]}
        table["velocity"] = {**fix, "ned": [6, 7, 8], "sd": "11"}
    parts = described(table, os.fspath(path), folder)
    worn = finding("axes.assumed", "the unit", words='to be worn forward, left, up: axes = "flu"')
    return parts._replace(notes=(*parts.notes, worn)) if parts.imu is not None else parts
