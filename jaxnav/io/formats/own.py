"""The project's formats: a folder of CSV files, an .npz, an imu.csv alone."""

import os
import re
from pathlib import Path

from jaxnav.io import canonical
from jaxnav.io.files import HEAD
from jaxnav.io.parts import ImuRows, Parts, parts_of
from jaxnav.types import Note


def is_folder(path: Path, head: bytes) -> bool:
    """Is it a folder with an imu.csv?"""
    return (path / "imu.csv").is_file()


def read_folder(path: Path) -> Parts:
    """Return the streams of a folder."""
    notes: list[Note] = []
    rec = canonical.read_folder(path, notes)
    parts = parts_of(rec, os.fspath(path))
    return parts._replace(notes=parts.notes + tuple(notes))


def is_npz(path: Path, head: bytes) -> bool:
    """Is it an archive with an IMU and aiding?"""
    return head.startswith(b"PK\x03\x04") and b"aiding/" in head + _tail(path) and b"imu/" in head + _tail(path)


def read_npz(path: Path) -> Parts:
    """Return the streams of an archive."""
    return parts_of(canonical.read_recording(path), os.fspath(path))


def _tail(path: Path) -> bytes:
    """Return the end of a zip archive, which lists its members."""
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - HEAD))
        return file.read()


def is_imu_csv(path: Path, head: bytes) -> bool:
    """Are there our columns of an IMU?"""
    names = re.split(rb"[,\r\n]", head.split(b"\n")[0])
    return b"t_s" in names and any(name.startswith((b"gyro_x_", b"dtheta_x_")) for name in names)


def read_imu_csv(path: Path) -> Parts:
    """Return the IMU alone."""
    notes: list[Note] = []
    imu, source = canonical.read_imu(path, notes)
    return Parts(
        os.fspath(path), ImuRows(imu.t, imu.gyro, imu.accel, dt=imu.dt), notes=tuple(notes), lines=source.lines
    )
