"""The replay format of PX4's EKF2: lines of ``time in us, sensor, values``, sensors mixed as they came."""

import os
import re
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.io.units import UNITS
from jaxnav.maths.units import DEG
from jaxnav.types import DataError

SENSORS = {"imu": 6, "gps": 6, "baro": 1, "mag": 3, "airspeed": 2, "range": 2, "flow": 7, "vio": 11, "landed": 1}


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the first lines are a whole number, the name of a sensor and numbers."""
    lines = head.split(b"\n")[:-1][:20]
    names = "|".join(SENSORS).encode()
    return bool(lines) and all(re.match(rb"\d+,(" + names + rb"),[-\d.,einfa+]+\r?$", line) for line in lines)


def read(path: Path) -> Parts:
    """IMU (accelerometer first), GNSS, barometer, magnetometer, true airspeed; t in s of the file's clock.

    DataError names the line of a row that cannot be read, where there is more than one; a cut last line is left out.
    """
    file = os.fspath(path)
    rows: dict[str, list[list[float]]] = {name: [] for name in SENSORS}
    lines = read_bytes(path).decode(errors="replace").split("\n")
    bad = []
    if lines[-1]:
        bad.append(len(lines))  # has no line end: a number of it may be cut
        lines.pop()
    for i, line in enumerate(lines, start=1):
        cells = line.strip().split(",")
        try:
            values = [float(cell) for cell in (cells[0], *cells[2:])]
            if len(values) != SENSORS[cells[1]] + 1:
                raise ValueError
            rows[cells[1]].append(values)
        except (ValueError, KeyError, IndexError):
            bad += [i] if line.strip() else []
    if len(bad) > max(2, 0.01 * len(lines)):
        raise DataError(f"{file}: line {min(bad)}: expected time, sensor and numbers; so {len(bad)} lines")
    said = [finding("file.lines", path.name, count=len(bad), why="that cannot be read", at=min(bad))] if bad else []
    tables = {name: np.array(values) for name, values in rows.items() if values}
    if "imu" not in tables:
        raise DataError(f"{file}: has no row of the imu")
    t = {name: table[:, 0] / 1e6 for name, table in tables.items()}
    imu = ImuRows(t["imu"], tables["imu"][:, 4:7], tables["imu"][:, 1:4])
    return Parts(file, imu, _aiding(t, tables), notes=tuple(said))


def _aiding(t: dict[str, np.ndarray], tables: dict[str, np.ndarray]) -> dict[str, Stream]:
    aiding = {}
    if "gps" in tables:  # mm, 1e-7 deg east, 1e-7 deg north, m/s north, east, down; polled: a fix stands until the next
        fixes = tables["gps"]
        lla = fixes[:, [3, 2, 1]] * np.array([1e-7 * DEG, 1e-7 * DEG, 1e-3])
        aiding["position"] = Stream(t["gps"], lla)
        aiding["velocity"] = Stream(t["gps"], fixes[:, [5, 4, 6]] * np.array([1.0, 1.0, -1.0]))
    if "baro" in tables:
        aiding["barometer"] = Stream(t["baro"], tables["baro"][:, 1:])
    if "mag" in tables:
        aiding["magnetometer"] = Stream(t["mag"], tables["mag"][:, 1:] * UNITS["field"]["gauss"])
    if "airspeed" in tables:
        aiding["airspeed"] = Stream(t["airspeed"], tables["airspeed"][:, 1:2])
    return aiding
