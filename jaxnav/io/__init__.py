"""Readers and writers: each reader returns host types in SI, checked; each writer leaves a whole file or none."""

from jaxnav.io.canonical import read_files, read_imu, read_recording, read_truth, write_recording
from jaxnav.io.checks import check_imu, check_recording, check_samples, check_track
from jaxnav.io.files import atomic_write
from jaxnav.io.formats.kfgins import (
    read_kfgins_gnss,
    read_kfgins_imu,
    read_kfgins_nav,
    read_rtk_track,
    write_kfgins_nav,
)
from jaxnav.io.formats.rtklib import PosFile, read_pos, write_pos
from jaxnav.io.solution import write_csv, write_geojson, write_kml, write_solution, write_tum

__all__ = [
    "PosFile",
    "atomic_write",
    "check_imu",
    "check_recording",
    "check_samples",
    "check_track",
    "read_files",
    "read_imu",
    "read_kfgins_gnss",
    "read_kfgins_imu",
    "read_kfgins_nav",
    "read_pos",
    "read_recording",
    "read_rtk_track",
    "read_truth",
    "write_csv",
    "write_geojson",
    "write_kfgins_nav",
    "write_kml",
    "write_pos",
    "write_recording",
    "write_solution",
    "write_tum",
]
