"""Other filters as targets: noise tuned with their measurements and states, and written in their format.

Noise that was tuned with our measurements does not carry over to a filter that has others. A target says which of the
receiver's measurements the other filter takes, which states it has and which shape its processes have, so that
`tuning.tune` runs a filter like it; then it writes the result.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnav.filters.parameters import strong
from jaxnav.filters.run import track
from jaxnav.initialization.initialize import Initialization
from jaxnav.io import atomic_write
from jaxnav.io.formats.kfgins import write_kfgins_gnss, write_kfgins_imu
from jaxnav.maths import units
from jaxnav.maths.gps_time import WEEK
from jaxnav.measurements import GNSS
from jaxnav.types import DataError, ImuLog, Params, Recording, Samples, Table
from tuning.recordings import export


class Target(NamedTuple):
    """Another filter."""

    name: str
    about: str  # a similar filter, in words
    filter: str  # of the catalogue, like it
    measurements: tuple[str, ...]  # of the receiver's, those that it takes
    states: tuple[str, ...]  # in addition to the filter's
    free: tuple[str, ...]  # parameters to tune
    shaped: Callable[[Params], Params]  # a datasheet with its processes
    settings: str  # name of the file of parameters, which every tuning writes
    text: Callable[[Params, export.StatedSd], str]  # that file
    read: Callable[[str], dict[str, np.ndarray]]  # its noise, leaves in SI; KeyError for another one's file
    job: Callable[[Path, Recording, Params, Initialization], None] | None = None  # writes samples and fixes as well
    begin: str = ""  # file of the job to begin with

    @property
    def file(self) -> str:
        """Return the file to begin with."""
        return self.begin or self.settings

    def write(self, folder: Path, rec: Recording, params: Params, begin: Initialization) -> None:
        """Write a job, or the parameters where the target has none.

        Args:
            folder: an existing folder.
            rec: the recording.
            params: tuned parameters.
            begin: its start.
        """
        if self.job is not None:
            self.job(folder, rec, params, begin)
            return
        stated = export.stated_sd({stream: samples.sd for stream, samples in rec.aiding.items()})
        self.write_export(folder, f"jaxnav tune --for: {rec.name}", params, stated)

    def write_export(self, folder: Path, head: str, params: Params, stated: export.StatedSd) -> None:
        """Write the file of parameters.

        Args:
            folder: an existing folder.
            head: comment on top.
            params: tuned parameters.
            stated: sd that the receiver states.
        """
        mark = "%" if self.settings.endswith(".m") else "#"
        atomic_write(folder / self.settings, f"{mark} {head}\n{self.text(params, stated)}")


def _plain(params: Params) -> Params:
    """Biases as the datasheet has them."""
    return params


def _walks(params: Params) -> Params:
    """Biases as random walks, as autopilots have them."""
    walk = {
        name: state._replace(tau=np.full_like(np.asarray(state.tau), np.inf)) for name, state in params.states.items()
    }
    return params._replace(states=walk)


def _one_time(params: Params) -> Params:
    """Every state a Gauss-Markov process of one correlation time; a constant one may then change by its sd."""
    time, states = export.ONE_CORRELATION_TIME, {}
    for name, state in params.states.items():
        drive = np.asarray(state.driving_noise, float)
        slow = np.broadcast_to(np.asarray(state.sd) * np.sqrt(2 / time), drive.shape)
        states[name] = state._replace(
            tau=np.full_like(np.asarray(state.tau, float), time), driving_noise=np.where(drive > 0, drive, slow)
        )
    return params._replace(states=states)


def write_kfgins(folder: Path, rec: Recording, params: Params, begin: Initialization) -> None:
    """Write a job for KF-GINS, run from within the folder: ``KF-GINS kf-gins.yaml``, with samples and fixes.

    It knows no delay and no clock: the fixes' times are moved to the IMU's clock, their sd scaled.

    Raises:
        DataError: no position.
    """
    if "position" not in rec.aiding:
        raise DataError(f"{rec.name}: KF-GINS takes positions, and there are none")
    fixes = rec.aiding["position"]
    # it starts from a sample, not from the moment before the first one
    before = lambda a: np.concatenate([a[:1], a])
    t, dt, *readings = rec.imu
    times = np.concatenate([[t[0] - dt[0]], t])
    write_kfgins_imu(folder / "kfgins_imu.txt", ImuLog(times, before(dt), *(before(a) for a in readings)))
    scaled = fixes.sd * export.axes_of(params.measurements["position"].scale)
    moved = Samples(fixes.t - delay_of(params, begin, fixes.t), fixes.value, scaled, fixes.corr)
    write_kfgins_gnss(folder / "kfgins_gnss.txt", moved, float(rec.imu.t[0]))
    atomic_write(folder / "kf-gins.yaml", kfgins_config(rec, params, begin))


def delay_of(params: Params, begin: Initialization, t: np.ndarray) -> np.ndarray:
    """How late the fixes that are stamped ``t`` (K,) s are by the IMU's clock, (K,) s."""
    origin = float(np.ravel(begin.navs.origin.t)[0])
    late = float(params.mounting.time_offset) + float(params.measurements["position"].latency)
    return late + float(params.mounting.clock_drift) * (t - origin)


def kfgins_config(rec: Recording, params: Params, begin: Initialization) -> str:
    """Return the text of a kf-gins.yaml for files in the same folder: mean and sd of the initialization ``begin``."""
    first, params = track(begin.navs), begin.apply_to(params)
    week = np.floor(rec.imu.t[0] / WEEK) * WEEK
    row = lambda values: f"[{', '.join(f'{v:.12g}' for v in np.ravel(values))}]"
    ned = lambda values: row(export.axes_of(values)[[1, 0, 2]])
    lla, vel = first.lla[0] / np.array([units.DEG, units.DEG, 1.0]), first.vel[0][[1, 0, 2]] * np.array([1, 1, -1])
    prior, sd = params.prior, {name: export.axes_of(state.sd) for name, state in params.states.items()}
    zero = np.zeros(3)
    known = lambda name, unit: row(sd.get(name, zero) / unit)
    mean = lambda name, unit: row(np.asarray(begin.navs.errors[name])[0] / unit if name in begin.navs.errors else zero)
    lines = [
        "imupath: kfgins_imu.txt", "gnsspath: kfgins_gnss.txt", "outputpath: .",
        "imudatalen: 7", f"imudatarate: {round(1 / float(np.median(rec.imu.dt)))}",
        f"starttime: {begin.t - week:.9f}", "endtime: -1",
        f"initpos: {row(lla)}", f"initvel: {row(vel)}", f"initatt: {row(first.rph[0] / units.DEG)}",
        f"initgyrbias: {mean('gyro_bias', units.DEG_PER_HOUR)}  # deg/h",
        f"initaccbias: {mean('accel_bias', units.MGAL)}  # mGal",
        f"initgyrscale: {mean('gyro_scale', units.PPM)}", f"initaccscale: {mean('accel_scale', units.PPM)}",
        f"initposstd: {ned(prior.position)}", f"initvelstd: {ned(prior.velocity)}",
        f"initattstd: {ned(np.asarray(prior.attitude) / units.DEG)}",
        f"initbgstd: {known('gyro_bias', units.DEG_PER_HOUR)}  # deg/h",
        f"initbastd: {known('accel_bias', units.MGAL)}  # mGal",
        f"initsgstd: {known('gyro_scale', units.PPM)}  # ppm", f"initsastd: {known('accel_scale', units.PPM)}  # ppm",
        f"antlever: {row(params.mounting.lever_arm)}",
    ]  # fmt: skip
    scale = tuple(float(sd.get(name, zero).max()) / units.PPM for name in ("gyro_scale", "accel_scale"))
    return "\n".join(
        [f"# jaxnav tune --for kfgins: {rec.name}", *lines, export.kfgins_yaml(params, (scale[0], scale[1]))]
    )


WHITE: tuple[str, ...] = (*export.WHITE, "fixes")
ALL = (*export.DRIVEN, "fixes", "timing")
BOTH: tuple[str, ...] = ("position", "velocity")
PX4 = ("EKF2_GYR_NOISE", "EKF2_ACC_NOISE", "EKF2_GYR_B_NOISE", "EKF2_ACC_B_NOISE")
ARDUPILOT = ("EK3_GYRO_P_NSE", "EK3_ACC_P_NSE", "EK3_GBIAS_P_NSE", "EK3_ABIAS_P_NSE")
TARGETS: Table[Target] = Table.named(
    Target(
        "kfgins", "positions alone; biases and scale factors of one correlation time; 21 states", "ekf15",
        ("position",), ("gyro_scale", "accel_scale"), ALL, _one_time,
        "tuned_kfgins.yaml", lambda params, stated: export.kfgins_yaml(params), export.read_kfgins,
        write_kfgins, "kf-gins.yaml",
    ),
    Target(
        "navego", "position and velocity; biases of the datasheet's kind; 15 states", "ekf15", BOTH, (), ALL, _plain,
        "tuned_navego.m", lambda params, stated: export.navego_fields(params), export.read_navego,
    ),
    Target(
        "px4", "position and velocity; biases that walk", "ekf15", BOTH, (), ALL, _walks,
        "tuned_px4.params", export.px4_params, partial(export.read_autopilot, PX4, export.EKF2_STEP),
    ),
    Target(
        "ardupilot", "position and velocity; biases that walk", "ekf15", BOTH, (), ALL, _walks,
        "tuned_ardupilot.parm", export.ardupilot_parm, partial(export.read_autopilot, ARDUPILOT, export.EKF3_STEP),
    ),
    Target(
        "robot_localization", "position and velocity, no biases", "ekf9", BOTH, (), WHITE, _plain,
        "tuned_robot_localization.yaml", lambda params, stated: export.robot_localization_yaml(params),
        export.read_robot_localization,
    ),
)  # fmt: skip
"""Other filters that are tuned for (`tune --for`), and written and read: a new one is a row."""


def write_exports(folder: Path, head: str, params: Params, stated: export.StatedSd) -> None:
    """Write the files of parameters of all targets.

    Args:
        folder: an existing folder.
        head: comment on top of each file.
        params: tuned parameters; of a position or velocity that they lack, the defaults.
        stated: sd that the receiver states.
    """
    fixes = {m.name: strong(m.defaults) for m in GNSS}  # the other programs have both
    for target in TARGETS.values():
        target.write_export(folder, head, params._replace(measurements=fixes | params.measurements), stated)


def read_settings(path: Path) -> dict[str, np.ndarray]:
    """Return the IMU's noise, leaves in SI, of the file of another filter, as its target writes it.

    Raises:
        DataError: no target's.
    """
    text = path.read_text(errors="replace")
    for target in TARGETS.values():
        if Path(target.settings).suffix == path.suffix:
            with suppress(KeyError):
                return target.read(text)
    files = ", ".join(target.settings for target in TARGETS.values())
    raise DataError(f"{path}: no settings of another filter that are read: files like {files}")
