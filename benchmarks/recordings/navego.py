"""NaveGo's synthetic data (ADIS16405, ADIS16488) through the 15-state filter, against an independent filter's figures.

The reference is python-ins 1.0.1 on imu2 with the same start, noise and measurement sd. Its figures were made by
reading the IMU samples as instantaneous values; the data hold means over each sample, which is the default reading of
this package and gives a better heading. The headline figures use the reference's reading, the others follow it.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import common
from jaxnav import reading
from jaxnav.analysis import metrics
from jaxnav.filters import epochs
from jaxnav.filters.catalogue import build
from jaxnav.filters.parameters import change, datasheet_params
from jaxnav.filters.run import initial_nav, run_jit, track
from jaxnav.io.formats.matfiles import field, read_struct
from jaxnav.states.grades import GRADES
from jaxnav.types import ImuLog, Nav, Params, Recording

KEYS = ("north_m", "east_m", "down_m", "vn_mps", "ve_mps", "vd_mps", "roll_deg", "pitch_deg", "heading_deg")
REFERENCE = dict(zip(KEYS, (0.2306, 0.3606, 0.5134, 0.01659, 0.01215, 0.006586, 0.01743, 0.03459, 0.1271), strict=True))
SETTLED = 60.0  # s


class Datasheet(NamedTuple):
    """NaveGo's data on an IMU; float64 (the file stores small integers as uint8, whose squares wrap)."""

    arw: np.ndarray  # (3,) rad/s/sqrt(Hz), root PSD
    vrw: np.ndarray  # (3,) m/s^2/sqrt(Hz), root PSD
    gb_sta: np.ndarray  # (3,) rad/s, static gyro bias; the simulated one is within 10 % of it
    ab_sta: np.ndarray  # (3,) m/s^2, static accelerometer bias
    gb_dyn: np.ndarray  # (3,) rad/s, sd of the Gauss-Markov gyro bias
    ab_dyn: np.ndarray  # (3,) m/s^2
    gb_corr: np.ndarray  # (3,) s, its correlation time; the file's gb_psd is not sqrt(2 / gb_corr) gb_dyn
    ab_corr: np.ndarray  # (3,) s
    ini_align_err: np.ndarray  # (3,) rad, sd of the initial alignment


def datasheet(folder: Path, imu: str) -> Datasheet:
    """Return the datasheet of "imu1" or "imu2" in SI units."""
    file = folder / f"{imu}.mat"
    struct = read_struct(file, imu)
    return Datasheet(*(field(struct, name, file, (3,)) for name in Datasheet._fields))


def parameters(folder: Path, imu: str) -> Params:
    """The noise that made the data: start at truth with sd 5 m, 0.1 m/s and the alignment error of the data set."""
    sheet = datasheet(folder, imu)
    params = datasheet_params(GRADES["adis16488"], 5.0, 0.1)
    return change(
        params,
        {
            "noise.gyro": sheet.arw,
            "noise.accel": sheet.vrw,
            "prior.attitude": sheet.ini_align_err,
            "states.gyro_bias.sd": sheet.gb_sta,
            "states.gyro_bias.driving_noise": sheet.gb_dyn * np.sqrt(2 / sheet.gb_corr),
            "states.accel_bias.sd": sheet.ab_sta,
            "states.accel_bias.driving_noise": sheet.ab_dyn * np.sqrt(2 / sheet.ab_corr),
        },
    )


def from_instantaneous(imu: ImuLog) -> ImuLog:
    """Means by the trapezoid from samples that are instantaneous values at ``t``; one row less."""
    return ImuLog(imu.t[1:], imu.dt[1:], 0.5 * (imu.gyro[1:] + imu.gyro[:-1]), 0.5 * (imu.accel[1:] + imu.accel[:-1]))


def cut(rec: Recording, instantaneous: bool) -> tuple[epochs.Packed, Nav]:
    """The epochs of 0.2 s, and the start at truth."""
    imu = from_instantaneous(rec.imu) if instantaneous else rec.imu
    start = float(rec.aiding["position"].t[0])
    i = int(np.argmin(np.abs(rec.truth.t - start)))
    nav = initial_nav(rec.truth.lla[i], rec.truth.vel[i], rec.truth.rph[i], t=start)
    return epochs.pack(imu, rec.aiding, 0.2, start=start), nav


def solve(rec: Recording, params: Params, instantaneous: bool) -> tuple[dict, list]:
    """RMSE after 60 s by name, and the RMS of the normalised innovations of the six channels."""
    packed, nav = cut(rec, instantaneous)
    info = run_jit(build("ekf15"), params, nav, packed.epochs)
    error = metrics.errors(track(info.nav), rec.truth)
    late = packed.t > SETTLED
    ned = lambda e: metrics.rms(np.asarray(e)[late])[[1, 0, 2]]
    values = (*ned(error.position), *ned(error.velocity), *np.rad2deg(metrics.rms(error.attitude[late])))
    rmse = {key: float(value) for key, value in zip(KEYS, values, strict=True)}
    return rmse, metrics.rms(metrics.normalized_innovations(info)[late]).tolist()


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("navego", __doc__.splitlines()[0])
    parser.add_argument("--imu", choices=("imu1", "imu2"), default="imu2")
    args = parser.parse_args(argv)
    folder = reading.verify("navego_synthetic")
    rec, params = reading.load("navego_synthetic", imu=args.imu), parameters(folder, args.imu)
    rmse, innovation = solve(rec, params, instantaneous=True)
    rmse_means, innovation_means = solve(rec, params, instantaneous=False)
    reference = REFERENCE if args.imu == "imu2" else None
    print(f"NaveGo {args.imu}, RMSE after {SETTLED:g} s   (samples read as instantaneous | as means)")
    for key in KEYS:
        ratio = f"   reference {reference[key]:9.5f}   ratio {rmse[key] / reference[key]:.3f}" if reference else ""
        print(f"  {key:12} {rmse[key]:9.5f} | {rmse_means[key]:9.5f}{ratio}")
    print("  normalised innovations (lat/lon/h as E N U, then velocity):", np.round(innovation, 3))
    result = {"imu": args.imu, "rmse": rmse, "innovation_rms": innovation, "reference": reference}
    result |= {"rmse_samples_as_means": rmse_means, "innovation_rms_samples_as_means": innovation_means}
    common.write_json(args.json, result)
