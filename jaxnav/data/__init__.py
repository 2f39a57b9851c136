"""Readers and writers: each reader returns host types in SI, checked; each writer leaves a whole file or none."""

from jaxnav.data.canonical import read_files, read_imu, read_recording, read_truth, write_recording
from jaxnav.data.checks import check_imu, check_recording, check_samples, check_track
from jaxnav.data.datasets import DATASETS, fetch, load, locate, verify
from jaxnav.data.files import atomic_write
from jaxnav.data.formats.kfgins import (
    read_kfgins_gnss,
    read_kfgins_imu,
    read_kfgins_nav,
    read_rtk_track,
    write_kfgins_nav,
)
from jaxnav.data.formats.rtklib import PosFile, read_pos, write_pos
from jaxnav.data.solution import write_csv, write_geojson, write_kml, write_solution, write_tum

__all__ = [
    "DATASETS",
    "PosFile",
    "atomic_write",
    "check_imu",
    "check_recording",
    "check_samples",
    "check_track",
    "fetch",
    "load",
    "locate",
    "read_files",
    "read_imu",
    "read_kfgins_gnss",
    "read_kfgins_imu",
    "read_kfgins_nav",
    "read_pos",
    "read_recording",
    "read_rtk_track",
    "read_truth",
    "verify",
    "write_csv",
    "write_geojson",
    "write_kfgins_nav",
    "write_kml",
    "write_pos",
    "write_recording",
    "write_solution",
    "write_tum",
]
