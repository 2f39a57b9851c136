"""Flight 75 of the UAV Thor (UMN UAV Lab): ``flight_data`` of one MATLAB file."""

import os

import numpy as np

from jaxnav.data.checks import check_recording, ned_to_enu, steps
from jaxnav.data.files import FilePath, Source
from jaxnav.data.formats.matfiles import field, read_struct
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, ImuLog, Recording, Samples, Track

PLACEHOLDER = (45.0, -93.0)  # deg, what stands in lat and lon before the first fix
POSITION_SD = np.array([2.0, 2.0, 4.0])  # m, ENU: the file states none
VELOCITY_SD = np.array([0.2, 0.2, 0.2])  # m/s, ENU


def read_umn(path: FilePath) -> Recording:
    """The flight; t is the file's ``time`` in seconds, which starts with the logger.

    The GNSS columns stand on every row and are new where ``GPS_TOW`` changes; a fix has its row's ``time`` (``GPS_TOW``
    drifts by 0.14 s against it). ``truth`` is the filter on board (rows with ``navValid`` 0, which means valid): it saw
    the same sensors and is no independent truth. DataError names file, field and row.
    """
    struct = read_struct(path, "flight_data")
    time = field(struct, "time", path, (None,))
    n = len(time)
    if n < 3:
        raise DataError(f"{os.fspath(path)}: field time: expected three rows or more, got {n}")

    def columns(*names: str) -> np.ndarray:
        return np.stack([field(struct, name, path, (n,)) for name in names], axis=1)

    source = Source(os.fspath(path))
    dt = steps(time, source)
    # row 0 holds zeros instead of samples
    imu = ImuLog(time[1:], dt[1:], columns("p", "q", "r")[1:], columns("ax", "ay", "az")[1:])
    geodetic = columns("lat", "lon", "alt")
    tow = field(struct, "GPS_TOW", path, (n,))
    new = np.r_[False, np.diff(tow) != 0.0] & ~(geodetic[:, :2] == PLACEHOLDER).all(axis=1)
    k = int(new.sum())
    position = geodetic[new] * np.array([DEG, DEG, 1.0])
    none = np.zeros((k, 3))
    aiding = {
        "position": Samples(time[new], position, np.tile(POSITION_SD, (k, 1)), none),
        "velocity": Samples(time[new], ned_to_enu(columns("vn", "ve", "vd")[new]), np.tile(VELOCITY_SD, (k, 1)), none),
    }
    valid = (field(struct, "navValid", path, (n,)) == 0.0) & (np.arange(n) > 0)
    truth = Track(
        time[valid],
        columns("navlat", "navlon", "navalt")[valid],  # radians, unlike the GNSS
        ned_to_enu(columns("navvn", "navve", "navvd")[valid]),
        columns("phi", "theta", "psi")[valid],
    )
    notes = "truth is the filter on board, which is not independent; sd of the fixes and zero lever arm are assumed"
    rec = Recording("umn_thor75", imu, aiding, truth, np.zeros(3), notes)
    return check_recording(rec, dict.fromkeys(("imu", "position", "velocity", "truth"), source))
