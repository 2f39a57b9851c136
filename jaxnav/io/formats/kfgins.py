"""KF-GINS text files: IMU increments, GNSS positions, navigation results; white space, no header."""

import os
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.checks import MAX_RATE, check_imu, check_samples, check_track, increments_to_means, ned_to_enu, steps
from jaxnav.io.files import FilePath, Source, atomic_write, read_columns
from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.maths.gps_time import WEEK, unrolled
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, ImuLog, Note, Samples, Track


def read_kfgins_imu(path: FilePath, notes: list[Note] | None = None) -> ImuLog:
    """Seconds of week, dtheta (3) rad, dvel (3) m/s over the step, FRD, to means; t in seconds of week.

    With a list of ``notes`` a cut last line is left out and said there. DataError names file and line.
    """
    table = read_columns(path, 7, notes=notes)
    t = _weeks_on(table.values[:, 0], notes)
    dt = steps(t, table.source)
    gyro, accel = (increments_to_means(table.values[:, i : i + 3], dt) for i in (1, 4))
    return check_imu(ImuLog(t, dt, gyro, accel), table.source)


def read_kfgins_gnss(path: FilePath, notes: list[Note] | None = None) -> Samples:
    """Seconds of week, lat, lon deg, h m, sd N, E, D m to a "position" stream; t in seconds of week."""
    samples, source = gnss_rows(path, notes)
    return check_samples("position", samples, source)


def gnss_rows(path: FilePath, notes: list[Note] | None = None) -> tuple[Samples, Source]:
    """Return the rows of a KF-GINS GNSS file as they stand there, repeated ones and sd of 0 too."""
    table = read_columns(path, 7, notes=notes)
    t, lla, ned = _weeks_on(table.values[:, 0], notes), table.values[:, 1:4], table.values[:, 4:]
    return Samples(t, lla * np.array([DEG, DEG, 1.0]), ned[:, [1, 0, 2]], np.zeros((len(t), 3))), table.source


def _weeks_on(t: np.ndarray, notes: list[Note] | None) -> np.ndarray:
    """Return seconds of the week that go on over its end, with a note."""
    t, falls = unrolled(t)
    if falls and notes is not None:
        notes.append(finding("clock.wraps", "the file", WEEK, words="a week"))
    return t


def read_rtk_track(path: FilePath) -> Samples:
    """Read the hour-long RTK track of KF-GINS's data (``GNSS-RTK.txt``): the format of `read_kfgins_gnss`, no IMU."""
    return read_kfgins_gnss(path)


def read_kfgins_nav(path: FilePath) -> Track:
    """Week, seconds of week, lat, lon deg, h m, v N, E, D m/s, roll, pitch, yaw deg.

    t in seconds of the first row's week; DataError names file and line.
    """
    table = read_columns(path, 11)
    x = table.values
    t = (x[:, 0] - x[0, 0]) * WEEK + x[:, 1]
    track = Track(t, x[:, 2:5] * np.array([DEG, DEG, 1.0]), ned_to_enu(x[:, 5:8]), x[:, 8:] * DEG)
    return check_track(track, table.source)


def write_kfgins_nav(path: FilePath, track: Track, week: int = 0) -> None:
    """Write a solution in the columns of `read_kfgins_nav`; it must have an attitude, since the format has no gap."""
    if np.isnan(track.rph).any():
        raise DataError(f"{os.fspath(path)}: a KF-GINS solution needs roll, pitch and heading, got nan")
    lla, rph = track.lla / np.array([DEG, DEG, 1.0]), track.rph / DEG
    columns = np.hstack([track.t[:, None], lla, ned_to_enu(track.vel), rph]).tolist()
    template = f"{week:d} %.9f %.12f %.12f %.6f %.7f %.7f %.7f %.9f %.9f %.9f"
    atomic_write(path, "".join(template % tuple(row) + "\n" for row in columns))


def write_kfgins_imu(path: FilePath, imu: ImuLog) -> None:
    """Write samples in the columns of `read_kfgins_imu`; seconds of the first sample's week."""
    rows = np.column_stack([_of_week(imu.t, imu.t[0]), imu.gyro * imu.dt[:, None], imu.accel * imu.dt[:, None]])
    template = "%.9f " + " ".join(["%.15e"] * 6)
    atomic_write(path, "".join(template % tuple(row) + "\n" for row in rows.tolist()))


def write_kfgins_gnss(path: FilePath, fixes: Samples, first: float) -> None:
    """Write positions in the columns of `read_kfgins_gnss`; seconds of the week of ``first`` s, the first sample's."""
    lla = fixes.value / np.array([DEG, DEG, 1.0])
    rows = np.column_stack([_of_week(fixes.t, first), lla, fixes.sd[:, [1, 0, 2]]])
    template = "%.9f %.12f %.12f" + 4 * " %.6f"
    atomic_write(path, "".join(template % tuple(row) + "\n" for row in rows.tolist()))


def _of_week(t: np.ndarray, first: float) -> np.ndarray:
    return t - np.floor(first / WEEK) * WEEK


def _seven(head: bytes) -> np.ndarray | None:
    """Return the complete rows of a text of seven numbers a line; None of any other."""
    rows = [line.split() for line in head.split(b"\n")[:-1]][:20]
    try:
        return np.array(rows, float) if len(rows) > 1 and all(len(row) == 7 for row in rows) else None
    except ValueError:
        return None


def is_imu(path: Path, head: bytes) -> bool:
    """Are there increments of angle and velocity, with gravity?"""
    rows = _seven(head)
    if rows is None:
        return False
    dt = np.median(np.diff(rows[:, 0]))
    if np.abs(rows[:, 1:4]).max() > MAX_RATE * dt:
        return False  # latitude and longitude
    return 0.0 < dt < 0.5 and 5.0 < np.median(np.linalg.norm(rows[:, 4:], axis=1)) / dt < 20.0  # gravity


def read_imu(path: Path) -> Parts:
    """Return the IMU."""
    notes: list[Note] = []
    imu = read_kfgins_imu(path, notes)
    return Parts(os.fspath(path), ImuRows(imu.t, imu.gyro, imu.accel, dt=imu.dt), notes=tuple(notes))


def is_gnss(path: Path, head: bytes) -> bool:
    """Are there latitudes and sd?"""
    rows = _seven(head)
    return rows is not None and bool((np.abs(rows[:, 1]) <= 90).all() and (rows[:, 4:] >= 0).all())


def read_gnss(path: Path) -> Parts:
    """Return the fixes."""
    notes: list[Note] = []
    position = Stream(*gnss_rows(path, notes)[0])
    return Parts(os.fspath(path), aiding={"position": position}, notes=tuple(notes))
