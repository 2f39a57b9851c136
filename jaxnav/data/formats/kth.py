"""The car of KTH's course in GNSS-aided INS: ``in_data`` of one MATLAB file."""

import os

import numpy as np

from jaxnav.data.checks import check_recording, steps
from jaxnav.data.files import FilePath, Source
from jaxnav.data.formats.matfiles import field, read_struct
from jaxnav.maths.units import DEG
from jaxnav.types import ImuLog, Recording, Samples

ORIGIN = np.array([59.0 * DEG, 18.0 * DEG, 0.0])  # rad, rad, m; only the latitude is known
POSITION_SD = 3.0 / np.sqrt(3.0)  # m an axis, the course's setting
SPEED_SD = 0.5  # m/s, assumed
_A, _E2 = 6378137.0, 6.69437999014e-3  # m; WGS 84 semi-major axis and squared eccentricity


def read_kth(path: FilePath, origin: np.ndarray = ORIGIN, speed_sd: float = SPEED_SD) -> Recording:
    """The drive; t as in the file (the IMU starts at 0), position, wheel speed, no truth, no velocity.

    ``pos_ned`` is taken as lengths along the meridian and the parallel of ``origin`` (lat rad, lon rad, h m); against a
    tangent plane that is off by less than 1 m over the 2 km of the drive. After the gap of the IMU at 147 s the next
    sample stands for the whole gap. DataError names file, field and row.
    """
    struct = read_struct(path, "in_data")
    parts = {name: getattr(struct, name, None) for name in ("IMU", "GNSS", "SPEEDOMETER")}
    t = field(parts["IMU"], "t", path, (None,))
    source = Source(os.fspath(path))
    gyro, accel = (field(parts["IMU"], name, path, (3, len(t))).T.copy() for name in ("gyro", "acc"))
    imu = ImuLog(t, steps(t, source), gyro, accel)
    t = field(parts["GNSS"], "t", path, (None,))
    lla = _from_ned(field(parts["GNSS"], "pos_ned", path, (3, len(t))).T, np.asarray(origin))
    aiding = {"position": Samples(t, lla, np.full((len(t), 3), POSITION_SD), np.zeros((len(t), 3)))}
    t = field(parts["SPEEDOMETER"], "t", path, (None,))
    speed = field(parts["SPEEDOMETER"], "speed", path, (len(t),))[:, None]
    aiding["speed"] = Samples(t, speed, np.full_like(speed, speed_sd), np.zeros_like(speed))
    notes = "longitude and height of the origin are assumed; heading at the start 320 deg; IMU gap of 0.53 s at 147 s"
    rec = Recording("kth_gnss_ins", imu, aiding, None, np.zeros(3), notes)
    return check_recording(rec, dict.fromkeys(("imu", "position", "speed"), source))


def _from_ned(ned: np.ndarray, origin: np.ndarray) -> np.ndarray:
    lat, lon, h = origin
    w = np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    meridian, normal = _A * (1.0 - _E2) / w**3 + h, _A / w + h
    return np.stack([lat + ned[:, 0] / meridian, lon + ned[:, 1] / (normal * np.cos(lat)), h - ned[:, 2]], axis=1)
