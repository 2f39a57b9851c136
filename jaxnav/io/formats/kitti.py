"""KITTI's raw data: the folder ``oxts`` of a drive, one file a sample (dataformat.txt of the data set)."""

import os
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.io.sheet import date
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Track

FIELDS = 30
LLA, RPY, NORTH_EAST, UP = slice(0, 3), slice(3, 6), slice(6, 8), 10
ACCEL, GYRO, POSITION_SD, VELOCITY_SD = slice(11, 14), slice(17, 20), 23, 24


def recognises(path: Path, head: bytes) -> bool:
    """Return whether a folder is a drive, or its ``oxts``."""
    return _oxts(path) is not None


def read(path: Path) -> Parts:
    """IMU, position and velocity in vehicle axes (forward, left, up), and all with attitude as truth.

    Raises:
        DataError: a file of other than 30 numbers, or another number of files than of times.
    """
    folder = _oxts(path)
    if folder is None:
        raise DataError(f"{path}: expected a folder oxts with timestamps.txt and data")
    files = sorted((folder / "data").glob("*.txt"))
    stamps = read_bytes(folder / "timestamps.txt").decode("utf-8", "replace").splitlines()
    rows = np.array([_numbers(file) for file in files])
    all_times = np.array([date(line) for line in stamps if line.strip()])
    numbers = np.array([int(file.stem) if file.stem.isdigit() else -1 for file in files])
    if numbers.min() < 0 or numbers.max() >= all_times.size:
        raise DataError(
            f"{folder}: {len(files)} files up to {files[-1].name}, {all_times.size} lines of timestamps.txt"
        )
    t = all_times[numbers]  # a file may lack
    zero = int(np.nanmin(t)) if np.isfinite(t).any() else 0
    t = t - zero
    lla = rows[:, LLA] * [DEG, DEG, 1.0]
    vel = np.column_stack([rows[:, NORTH_EAST][:, ::-1], rows[:, UP]])
    roll, pitch, yaw = rows[:, RPY].T  # left side up, nose down, counterclockwise from east
    rph = np.column_stack([roll, -pitch, np.mod(0.5 * np.pi - yaw, 2 * np.pi)])
    each = lambda column: np.repeat(rows[:, column, None], 3, axis=1)
    aiding = {"position": Stream(t, lla, each(POSITION_SD)), "velocity": Stream(t, vel, each(VELOCITY_SD))}
    notes = (finding("truth.fused"), finding("time.zero", words=f"{zero} s since 1970 in the drive's local time"))
    imu = ImuRows(t, rows[:, GYRO], rows[:, ACCEL])
    whole = np.isfinite(t)
    truth = Track(t[whole], lla[whole], vel[whole], rph[whole])
    name = folder.parent.name or path.stem
    return Parts(os.fspath(path), imu, aiding, truth, notes=notes, axes="flu", name=name, zero=zero)


def _oxts(path: Path) -> Path | None:
    places = (path / "oxts", path)
    found = (p for p in places if (p / "timestamps.txt").is_file() and any((p / "data").glob("*.txt")))
    return next(found, None) if path.is_dir() else None


def _numbers(file: Path) -> list[float]:
    cells = read_bytes(file).split()
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        raise DataError(f"{file}: expected {FIELDS} numbers, got {cells[:3]}") from None
    if len(values) != FIELDS:
        raise DataError(f"{file}: expected {FIELDS} numbers, got {len(values)}")
    return values
