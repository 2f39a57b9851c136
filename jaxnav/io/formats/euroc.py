"""EuRoC's layout (``mav0/imu0/data.csv``), which many visual-inertial data sets share: an IMU; no fixes."""

import os
import re
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.parts import ImuRows, Parts
from jaxnav.io.sheet import numbers, open_sheet, times
from jaxnav.types import DataError

COLUMNS = "timestamp gyro x y z [rad/s] accel x y z [m/s^2]"
PLACES = ("data.csv", "imu0/data.csv", "mav0/imu0/data.csv")


def recognises(path: Path, head: bytes) -> bool:
    """Return whether it is a folder with an IMU's ``data.csv``, or that file, by its first line."""
    if path.is_dir():
        file = _file(path)
        if file is None:
            return False
        with open(file, "rb") as opened:
            head = opened.read(300)
    return bool(re.match(rb"#?\s*timestamp[^,\n]*,\s*w_RS_S_x[^\n]*a_RS_S_z", head))


def read(path: Path) -> Parts:
    """Read the IMU in its axes; no file gives their directions in the body: set ``axes``; t in s since 1970."""
    file = _file(path) if path.is_dir() else path
    if file is None:
        raise DataError(f"{path}: expected one of {', '.join(PLACES)}")
    sheet = open_sheet(file, ",")
    if "7" not in sheet.columns:
        raise DataError(f"{file}: expected seven columns, {COLUMNS}")
    first = times(sheet, 1, "ns")
    zero = int(first[0]) if np.isfinite(first[0]) else 0
    gyro, accel = (np.stack([numbers(sheet, k + i) for i in range(3)], axis=1) for k in (2, 5))
    rows = ImuRows(times(sheet, 1, "ns", zero), gyro, accel)
    notes = (*sheet.notes, finding("time.zero", words=f"{zero} s since 1970"))
    return Parts(os.fspath(file), rows, notes=notes, lines=sheet.lines, zero=zero)


def _file(folder: Path) -> Path | None:
    return next((folder / place for place in PLACES if (folder / place).is_file()), None)
