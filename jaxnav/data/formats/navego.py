"""The synthetic example of NaveGo: ``ref.mat``, ``gnss.mat``, ``imu1.mat`` (ADIS16405), ``imu2.mat`` (ADIS16488)."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnav.data.checks import check_recording, ned_to_enu, steps
from jaxnav.data.files import FilePath, Source
from jaxnav.data.formats.matfiles import field, read_struct
from jaxnav.types import DataError, ImuLog, Recording, Samples, Track

IMUS = ("imu1", "imu2")


class Datasheet(NamedTuple):
    """What NaveGo states about an IMU; float64 (the file stores small integers as uint8, whose squares wrap)."""

    arw: np.ndarray  # (3,) rad/s/sqrt(Hz), root PSD
    vrw: np.ndarray  # (3,) m/s^2/sqrt(Hz), root PSD
    gb_sta: np.ndarray  # (3,) rad/s, static gyro bias: the imposed one lies within 10 % of it
    ab_sta: np.ndarray  # (3,) m/s^2, static accelerometer bias
    gb_dyn: np.ndarray  # (3,) rad/s, sd of the Gauss-Markov gyro bias
    ab_dyn: np.ndarray  # (3,) m/s^2
    gb_corr: np.ndarray  # (3,) s, its correlation time; the file's gb_psd is not sqrt(2 / gb_corr) gb_dyn
    ab_corr: np.ndarray  # (3,) s
    ini_align: np.ndarray  # (3,) rad, roll, pitch, yaw at the start
    ini_align_err: np.ndarray  # (3,) rad, sd of the initial alignment


def read_navego(folder: FilePath, imu: str = "imu2") -> Recording:
    """The simulated run with one of its IMUs; t in seconds from the first row, truth exact.

    DataError names file, field and row.
    """
    folder, file = Path(folder), _imu_file(folder, imu)
    log = read_struct(file, imu)
    t = field(log, "t", file, (None,))
    source = Source(str(file))
    rates = field(log, "wb", file, (len(t), 3))
    samples = ImuLog(t, steps(t, source), rates, field(log, "fb", file, (len(t), 3)))
    gnss, ref = folder / "gnss.mat", folder / "ref.mat"
    aiding, lever_arm = _read_gnss(gnss)
    rec = Recording(f"navego_synthetic {imu}", samples, aiding, _read_truth(ref), lever_arm, "simulated by NaveGo")
    sources = {"imu": source, "position": Source(str(gnss)), "velocity": Source(str(gnss)), "truth": Source(str(ref))}
    return check_recording(rec, sources)


def read_navego_datasheet(folder: FilePath, imu: str = "imu2") -> Datasheet:
    """The datasheet of one of the two IMUs in SI units."""
    file = _imu_file(folder, imu)
    struct = read_struct(file, imu)
    return Datasheet(*(field(struct, name, file, (3,)) for name in Datasheet._fields))


def _imu_file(folder: FilePath, imu: str) -> Path:
    if imu not in IMUS:
        raise DataError(f"imu must be one of {', '.join(IMUS)}, got {imu!r}")
    return Path(folder) / f"{imu}.mat"


def _read_gnss(path: Path) -> tuple[dict[str, Samples], np.ndarray]:
    gnss = read_struct(path, "gnss")
    t = field(gnss, "t", path, (None,))
    n = len(t)
    position = np.stack([field(gnss, name, path, (n,)) for name in ("lat", "lon", "h")], axis=1)
    sd = {name: np.tile(field(gnss, name, path, (3,)), (n, 1)) for name in ("stdm", "stdv")}  # N, E, D
    none = np.zeros((n, 3))
    aiding = {
        "position": Samples(t, position, sd["stdm"][:, [1, 0, 2]], none),
        "velocity": Samples(t, ned_to_enu(field(gnss, "vel", path, (n, 3))), sd["stdv"][:, [1, 0, 2]], none),
    }
    return aiding, field(gnss, "larm", path, (3,))


def _read_truth(path: Path) -> Track:
    ref = read_struct(path, "ref")
    t = field(ref, "t", path, (None,))
    n = len(t)
    lla = np.stack([field(ref, name, path, (n,)) for name in ("lat", "lon", "h")], axis=1)
    rph = np.stack([field(ref, name, path, (n,)) for name in ("roll", "pitch", "yaw")], axis=1)
    return Track(t, lla, ned_to_enu(field(ref, "vel", path, (n, 3))), rph)
