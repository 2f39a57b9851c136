"""Sensor Logger, the app for phones: a folder with a CSV file for each sensor.

Units and axes: the app's UNITS.md and COORDINATES.md. x points right, y to the top of the phone, z out of the screen.
"""

import os
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.column_map import described, interpolated
from jaxnav.io.parts import ImuRows, Parts, TimeScale
from jaxnav.io.sheet import Sheet, column, numbers, open_sheet, times
from jaxnav.maths.units import G0
from jaxnav.types import DataError, Json, Note

FLAT = "rfu"  # screen up, top of the phone forward
GYROS = ("Gyroscope.csv", "GyroscopeUncalibrated.csv")
TOTAL, UNCALIBRATED, LINEAR, DOWN = (
    f"{name}.csv" for name in ("TotalAcceleration", "AccelerometerUncalibrated", "Accelerometer", "Gravity")
)
FIXES = ("LocationGps.csv", "Location.csv")  # the receiver's before those that the phone fuses
IN_G = 3.0  # norms below are of g, above of m/s^2


def recognises(path: Path, head: bytes) -> bool:
    """Return whether a folder or archive has a gyro's file of the app, and an accelerometer's."""
    files = _files(path)
    if not any(name in files for name in GYROS) or not _acceleration(files):
        return False
    try:
        return "seconds_elapsed" in open_sheet(path / next(name for name in GYROS if name in files)).columns
    except DataError:
        return False


def read(path: Path) -> Parts:
    """IMU, location, barometer and magnetometer; t in UTC since 1970. The phone is flat, top forward: else ``axes``.

    Specific force is the total acceleration, else the uncalibrated, else the sum of acceleration and gravity. An iPhone
    states it with the opposite sign (its Metadata.csv says whether the app has standardised that).
    """
    files = _files(path)
    notes: list[Note] = []
    gyros = open_sheet(path / next(name for name in GYROS if name in files))
    clock = times(gyros, "time", "ns")
    zero = int(np.nanmin(clock)) if np.isfinite(clock).any() else 0
    chosen = _acceleration(files)
    first = open_sheet(path / chosen[0])
    t, accel = times(first, "time", "ns", zero), _xyz(first)
    for name in chosen[1:]:
        other = open_sheet(path / name)
        more, whole = interpolated(t, times(other, "time", "ns", zero), _xyz(other))
        t, accel = t[whole], (accel + more)[whole]
    if not t.size:
        raise DataError(f"{path}: {' and '.join(chosen)}: expected samples at the same times, found none")
    if np.nanmedian(np.linalg.norm(accel, axis=1)) < IN_G:
        accel = accel * G0
    if _is_negated(path, files, chosen):
        accel = -accel
        notes.append(finding("imu.negated", chosen[0]))
    stamps, gyro = times(gyros, "time", "ns", zero), _xyz(gyros)
    accel, covered = interpolated(stamps, t, accel)
    if not covered.all():
        count = np.count_nonzero(covered)
        notes.append(finding("imu.two_clocks", "imu", words="of their own", count=count, of=covered.size))
    notes.append(finding("axes.assumed", "the phone", words=f'flat, screen up and top forward: axes = "{FLAT}"'))
    rows = ImuRows(stamps[covered], gyro[covered], accel[covered], scale=TimeScale.UTC)
    parts = described(_aiding(path, files), os.fspath(path), path)
    aiding = {
        name: stream._replace(t=stream.t - zero, turns=name == "magnetometer") for name, stream in parts.aiding.items()
    }
    lines = None if gyros.lines is None else gyros.lines[covered]
    said = finding("time.zero", words=f"{zero} s since 1970 (UTC)")
    return Parts(
        os.fspath(path), rows, aiding, notes=(*notes, *parts.notes, said), axes=FLAT,
        name=path.stem, lines=lines, zero=zero,
    )  # fmt: skip


def _files(path: Path) -> set[str]:
    """Return the names of the files in a folder."""
    return {file.name for file in path.iterdir()} if path.is_dir() else set()


def _acceleration(files: set[str]) -> tuple[str, ...]:
    """Return the files that add up to gravity and acceleration; empty where there are none."""
    for names in ((TOTAL,), (UNCALIBRATED,), (LINEAR, DOWN)):
        if files.issuperset(names):
            return names
    return ()


def _xyz(sheet: Sheet) -> np.ndarray:
    return np.stack([numbers(sheet, axis) for axis in "xyz"], axis=1)


def _is_negated(path: Path, files: set[str], chosen: tuple[str, ...]) -> bool:
    """Return whether accelerations are negative specific force, as an iPhone states: -9.8 m/s^2 along z face up."""
    if "Metadata.csv" not in files:
        return chosen[0] != TOTAL  # which an iPhone does not write
    sheet = open_sheet(path / "Metadata.csv", ",", header=True)
    said = lambda name: str(column(sheet, name)[0]).strip().lower() if name in sheet.columns else ""
    return said("platform") == "ios" and said("standardisation") != "true"


def _aiding(path: Path, files: set[str]) -> Json:
    """Return the column map of the phone's other sensors."""
    table: Json = {"time": "time", "time_unit": "ns", "time_scale": "utc"}
    file = next((name for name in FIXES if name in files), None)
    if file is not None:
        has = open_sheet(path / file).columns
        wide, high = "horizontalAccuracy", "verticalAccuracy"
        stated: Json = {"sd_enu": [wide, wide, high]} if wide in has and high in has else {}
        table["position"] = {"file": file, "lla": ["latitude", "longitude", "altitude"], **stated}
        if "speed" in has and "bearing" in has:
            stated = {"sd": "speedAccuracy"} if "speedAccuracy" in has else {}
            good = {"speed": ">=0", "bearing": ">=0"}  # -1 is none
            table["velocity"] = {"file": file, "speed_course": ["speed", "bearing"], "where": good, **stated}
    if "Barometer.csv" in files:
        table["barometer"] = {"file": "Barometer.csv", "value": "pressure", "unit": "hPa"}
    if "Magnetometer.csv" in files:
        table["magnetometer"] = {"file": "Magnetometer.csv", "value": ["x", "y", "z"]}
    return table
