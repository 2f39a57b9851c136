"""Parameters in the words of other software: KF-GINS, NaveGo, PX4, ArduPilot, robot_localization.

A remark on each number says whether the target wants a density or a value per step; the last one lists values without
counterpart.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxnav.maths import units
from jaxnav.measurements import Measurement
from jaxnav.types import Fix, Json, Params, StateParams

ONE_CORRELATION_TIME = 4 * units.HOUR  # s, in place of a random walk where a target has Gauss-Markov processes alone


def axes_of(value: Any) -> np.ndarray:
    """Return one number per axis; for the root of a correlated noise, the norms of its rows.

    Args:
        value: (), (3,) or a lower triangular root (3, 3).
    """
    value = np.asarray(value, float)
    return np.linalg.norm(value, axis=1) if value.ndim == 2 else np.broadcast_to(value, (3,))


def _remark(leaves: Mapping[str, Any], mark: str) -> list[str]:
    """Return a comment line, where some of the leaves are correlated between the axes."""
    correlated = [name for name, value in leaves.items() if np.any(np.tril(np.atleast_2d(value), -1))]
    return [f"{mark} correlations between the axes are left out of {', '.join(correlated)}"] if correlated else []


def _sensors(params: Params) -> Json:
    """White noise and driving noise of the biases, by name; zero where the filter has no biases."""
    still = StateParams(0.0, 0.0, np.inf)
    drives = {name: params.states.get(name, still).driving_noise for name in ("gyro_bias", "accel_bias")}
    return {"gyro": params.noise.gyro, "accel": params.noise.accel, **drives}


def _tau(params: Params, name: str) -> np.ndarray:
    return axes_of(params.states[name].tau if name in params.states else np.inf)


def kfgins_yaml(params: Params, scale_ppm: tuple[float, float] | None = None) -> str:
    """Return the ``imunoise`` of a KF-GINS yaml: deg/sqrt(h), m/s/sqrt(h), deg/h, mGal, ppm, h; body FRD as here.

    A Gauss-Markov bias of root PSD q and time T has the sd q sqrt(T / 2). KF-GINS has one T for all: the gyro's, and
    the sd of the accelerometers keep their q with it. A random walk is written as a process of 4 h, with the same
    driving noise over shorter times. KF-GINS has no correlation between axes; where there is some, the axes' sd are
    written, and a comment says so.

    Args:
        params: tuned parameters.
        scale_ppm: sd of gyro and accelerometer scale errors, ppm; None: what ``params`` take for noise of both.
    """
    scale_ppm = (float(params.noise.scale) / units.PPM,) * 2 if scale_ppm is None else scale_ppm
    tau, sensors = _tau(params, "gyro_bias"), _sensors(params)
    time = float(tau[0]) if np.isfinite(tau).all() and np.ptp(tau) == 0 else ONE_CORRELATION_TIME
    sd = lambda drive: axes_of(drive) * np.sqrt(time / 2)
    rows = {
        "arw": (axes_of(sensors["gyro"]) / units.DEG_PER_SQRT_HOUR, "deg/sqrt(h)"),
        "vrw": (axes_of(sensors["accel"]) / units.MPS_PER_SQRT_HOUR, "m/s/sqrt(h)"),
        "gbstd": (sd(sensors["gyro_bias"]) / units.DEG_PER_HOUR, "deg/h"),
        "abstd": (sd(sensors["accel_bias"]) / units.MGAL, "mGal"),
        "gsstd": (axes_of(scale_ppm[0]), "ppm"),
        "asstd": (axes_of(scale_ppm[1]), "ppm"),
    }
    lines = [f"  {name}: [{', '.join(f'{v:.6g}' for v in value)}]  # {unit}" for name, (value, unit) in rows.items()]
    head = [*_remark(sensors, "#"), "imunoise:"]
    return "\n".join([*head, *lines, f"  corrtime: {time / units.HOUR:.6g}  # h", ""])


def navego_fields(params: Params) -> str:
    """Return assignments of NaveGo's ``imu`` struct in SI, and factors on the receiver's ``stdm`` and ``stdv``.

    ``gb_psd`` and ``ab_psd`` are the root PSD of the biases' driving noise, as its filter takes them; ``gb_dyn`` is
    the sd of a Gauss-Markov bias. Receiver axes are north, east, down. Correlations between axes as in `kfgins_yaml`.

    Args:
        params: tuned parameters.
    """
    sensors = _sensors(params)
    fields = {"arw": axes_of(sensors["gyro"]), "vrw": axes_of(sensors["accel"])}
    for name, state in (("g", "gyro_bias"), ("a", "accel_bias")):
        q, T = axes_of(sensors[state]), _tau(params, state)
        fields |= {f"{name}b_psd": q, f"{name}b_corr": T}
        fields[f"{name}b_dyn"] = np.where(np.isfinite(T), q * np.sqrt(np.where(np.isfinite(T), T, 0.0) / 2), q)
    text = lambda v: ", ".join("Inf" if np.isinf(x) else f"{x:.8g}" for x in v)
    lines = [f"imu.{name} = [{text(value)}];" for name, value in fields.items()]
    scales = {name: params.measurements[name].scale for name in ("position", "velocity")}
    for name, scale in zip(("stdm", "stdv"), scales.values(), strict=True):
        lines.append(f"gnss.{name} = gnss.{name} .* [{text(axes_of(scale)[[1, 0, 2]])}];")
    return "\n".join([*_remark(sensors | {f"{name}_scale": a for name, a in scales.items()}, "%"), *lines, ""])


# ---------------------------------------------------------------------------- autopilots and ROS

EKF2_STEP, EKF3_STEP = 0.010, 0.012
"""s, prediction steps of PX4 and ArduPilot: a noise s adds (s dt)^2 at each, which is q^2 dt for a density."""


class StatedSd(NamedTuple):
    """Standard deviation that a receiver states of its fixes, before their scale."""

    position: float = 1.0  # m, horizontal
    velocity: float = 0.3  # m/s


def stated_sd(sd: Mapping[str, np.ndarray]) -> StatedSd:
    """Return the median horizontal sd of the fixes of a receiver.

    Args:
        sd: (N, 3) in ENU by stream, m of "position" and m/s of "velocity"; other streams do not count.
    """
    rows = {name: np.asarray(a) for name, a in sd.items() if name in StatedSd._fields and len(a)}
    return StatedSd(**{name: float(np.median(a[:, :2].max(1))) for name, a in rows.items()})


def sd_by_stream(fix: Fix, measurements: Sequence[Measurement]) -> dict[str, np.ndarray]:
    """Return the sd (N, size) of the valid fixes of a filter, by measurement.

    Args:
        fix: (..., m) of all epochs.
        measurements: rows of the filter, in its order.
    """
    sd, valid = (np.asarray(a).reshape(-1, np.shape(a)[-1]) for a in (fix.sd, fix.valid))
    ends = np.cumsum([m.size for m in measurements])
    return {m.name: sd[valid[:, end - m.size], end - m.size : end] for m, end in zip(measurements, ends, strict=True)}


def _per_step(q: Any, step: float) -> float:
    """Return an autopilot's noise for a root PSD: one number for all axes, the largest."""
    return float(axes_of(q).max()) / np.sqrt(step)


def _delays(params: Params) -> tuple[float, float]:
    """How late position and velocity are against the IMU, s."""
    offset = float(params.mounting.time_offset)
    late = [float(params.measurements[name].latency) + offset for name in ("position", "velocity")]
    return late[0], late[1]


def px4_params(params: Params, stated: StatedSd = StatedSd()) -> str:
    """Return PX4's EKF2 as lines of ``param set``: noise per step, lower limits of the receiver's sd, delay, antenna.

    EKF2 adds (EKF2_GYR_NOISE dt)^2 to the variance of an angle at every prediction of 10 ms (PX4-Autopilot,
    EKF/covariance.cpp), so that a root PSD q becomes q / sqrt(dt); so do accelerometers and biases' driving noise.

    Args:
        params: tuned parameters.
        stated: sd that the receiver states, for the lower limits.
    """
    sensors, arm = _sensors(params), axes_of(params.mounting.lever_arm)
    scale = {name: float(axes_of(params.measurements[name].scale).max()) for name in ("position", "velocity")}
    late = _delays(params)
    rows = [
        ("EKF2_GYR_NOISE", _per_step(sensors["gyro"], EKF2_STEP), "rad/s, of a step of 10 ms"),
        ("EKF2_ACC_NOISE", _per_step(sensors["accel"], EKF2_STEP), "m/s^2, of a step of 10 ms"),
        ("EKF2_GYR_B_NOISE", _per_step(sensors["gyro_bias"], EKF2_STEP), "rad/s^2, drives the gyros' biases"),
        ("EKF2_ACC_B_NOISE", _per_step(sensors["accel_bias"], EKF2_STEP), "m/s^3, drives the accelerometers' biases"),
        ("EKF2_GPS_P_NOISE", stated.position * scale["position"], "m, lower limit of the receiver's sd"),
        ("EKF2_GPS_V_NOISE", stated.velocity * scale["velocity"], "m/s, lower limit of the receiver's sd"),
        ("EKF2_GPS_DELAY", 1e3 * max(float(np.mean(late)), 0.0), "ms, one for position and velocity"),
        *((f"EKF2_GPS_POS_{axis}", a, "m, antenna, body") for axis, a in zip("XYZ", arm, strict=True)),
    ]
    return _lines(rows, "param set {key} {value:.6g}", "#", params)


def ardupilot_parm(params: Params, stated: StatedSd = StatedSd()) -> str:
    """Return ArduPilot's EKF3 as a ``.parm`` file; noise per step of 12 ms (AP_NavEKF3, EKF_TARGET_DT).

    Args:
        params: tuned parameters.
        stated: sd that the receiver states, for the lower limits.
    """
    sensors, arm = _sensors(params), axes_of(params.mounting.lever_arm)
    p, v = (axes_of(params.measurements[name].scale) for name in ("position", "velocity"))
    rows = [
        ("EK3_GYRO_P_NSE", _per_step(sensors["gyro"], EKF3_STEP), "rad/s, of a step of 12 ms"),
        ("EK3_ACC_P_NSE", _per_step(sensors["accel"], EKF3_STEP), "m/s^2, of a step of 12 ms"),
        ("EK3_GBIAS_P_NSE", _per_step(sensors["gyro_bias"], EKF3_STEP), "rad/s^2, drives the gyros' biases"),
        ("EK3_ABIAS_P_NSE", _per_step(sensors["accel_bias"], EKF3_STEP), "m/s^3, drives the accelerometers' biases"),
        ("EK3_POSNE_M_NSE", stated.position * float(p[:2].max()), "m, lower limit of the receiver's sd"),
        ("EK3_VELNE_M_NSE", stated.velocity * float(v[:2].max()), "m/s, lower limit of the receiver's sd"),
        ("EK3_VELD_M_NSE", stated.velocity * float(v[2]), "m/s, lower limit of the receiver's sd"),
        ("GPS_DELAY_MS", round(1e3 * max(float(np.mean(_delays(params))), 0.0)), "ms; GPS1_DELAY_MS from 4.6 on"),
        *((f"GPS_POS1_{axis}", a, "m, antenna; GPS1_POS_ from 4.6 on") for axis, a in zip("XYZ", arm, strict=True)),
    ]
    return _lines(rows, "{key},{value:.6g}", "#", params)


def robot_localization_yaml(params: Params, imu_rate_hz: float = 100.0) -> str:
    """Return parameters for robot_localization: covariances of its messages, for it has no IMU model.

    Its EKF takes rates and accelerations as measurements of a model of constant acceleration, so that a root PSD q is
    the variance q^2 rate of each sample, to be written into ``sensor_msgs/Imu``; biases and delays have no counterpart.

    Args:
        params: tuned parameters.
        imu_rate_hz: Hz, rate of the IMU's messages.
    """
    square = lambda q: ", ".join(f"{v:.6g}" for v in axes_of(q) ** 2 * imu_rate_hz)
    scale = lambda name: ", ".join(f"{v:.6g}" for v in axes_of(params.measurements[name].scale) ** 2)
    return "\n".join(
        [
            f"# of sensor_msgs/Imu at {imu_rate_hz:g} Hz, body FRD; diagonals of the covariances of each message",
            f"angular_velocity_covariance_diagonal: [{square(params.noise.gyro)}]  # (rad/s)^2, a value per sample",
            f"linear_acceleration_covariance_diagonal: [{square(params.noise.accel)}]  # (m/s^2)^2, a value per sample",
            "# factors on the covariances that the receiver states, east, north, up",
            f"position_covariance_factor: [{scale('position')}]",
            f"velocity_covariance_factor: [{scale('velocity')}]",
            "# no counterpart: drift of the biases, delays, clock drift, lever arm (a static transform)",
            "",
        ]
    )


def _lines(rows: list[tuple[str, float, str]], form: str, mark: str, params: Params) -> str:
    """Return settings with a remark on each, and the values without counterpart."""
    late = _delays(params)
    out = _remark(_sensors(params), mark)
    out += [f"{form.format(key=key, value=value)}  {mark} {text}" for key, value, text in rows]
    lost = []
    if abs(late[0] - late[1]) > 1e-3:
        lost.append(f"velocity is {late[1] - late[0]:+.3f} s later than position")
    if min(late) < 0:
        lost.append(f"fixes that are {-min(late):.3f} s early")
    if abs(float(params.mounting.clock_drift)) > 0.5 * units.PPM:
        lost.append(f"a clock drift of {float(params.mounting.clock_drift) / units.PPM:.0f} ppm")
    return "\n".join(
        [*out, f"{mark} no counterpart: {', '.join(lost)}" if lost else f"{mark} everything has a counterpart", ""]
    )


# ---------------------------------------------------------------------------- read back

WHITE = ("noise.gyro", "noise.accel")
DRIVEN = (*WHITE, "states.gyro_bias.driving_noise", "states.accel_bias.driving_noise")


NUMBER = re.compile(r"[-+]?(?:inf|(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?![\w.])", re.IGNORECASE)
SETTING = re.compile(
    r"\s*(?:param set\s+|\d+\s+\d+\s+)?([A-Za-z][\w.]*)[\s:=,]+(.*)"
)  # MAVLink's tables begin with two ids


def numbers(text: str) -> dict[str, np.ndarray]:
    """Return the numbers (k,) of the lines of a text by name.

    Args:
        text: lines such as ``a: [1, 2]``, ``a = [1, 2];``, ``a,1``, ``a 1``, ``param set a 1``, or tables of ground
            stations, ``1 1 a 1 9``, whose last column is a type; comments behind # or %.
    """
    lines = [SETTING.match(re.split("[#%]", line)[0]) for line in text.splitlines()]
    found = {line[1]: NUMBER.findall(line[2].rpartition("[")[2]) for line in lines if line}
    return {name: np.array(values, float) for name, values in found.items() if values}


def read_kfgins(text: str) -> dict[str, np.ndarray]:
    """Return leaves by name, in SI, of an ``imunoise``, see `kfgins_yaml`.

    Args:
        text: of the file; one that lacks a number raises KeyError.
    """
    n = numbers(text)
    time = n["corrtime"] * units.HOUR
    per = (units.DEG_PER_SQRT_HOUR, units.MPS_PER_SQRT_HOUR, units.DEG_PER_HOUR, units.MGAL)
    white, drive = np.ones(2), np.sqrt(2 / np.repeat(time, 2))
    keys = ("arw", "vrw", "gbstd", "abstd")
    found = {leaf: n[key] * unit * k for leaf, key, unit, k in zip(DRIVEN, keys, per, (*white, *drive), strict=True)}
    return found | {f"states.{name}.tau": time[0] for name in ("gyro_bias", "accel_bias")}


def read_navego(text: str) -> dict[str, np.ndarray]:
    """Return the same of `navego_fields`.

    Args:
        text: see `read_kfgins`.
    """
    n = numbers(text)
    found = {leaf: n[f"imu.{key}"] for leaf, key in zip(DRIVEN, ("arw", "vrw", "gb_psd", "ab_psd"), strict=True)}
    return found | {"states.gyro_bias.tau": n["imu.gb_corr"], "states.accel_bias.tau": n["imu.ab_corr"]}


def read_autopilot(keys: Sequence[str], step: float, text: str) -> dict[str, np.ndarray]:
    """Return the same of `px4_params` or `ardupilot_parm`.

    Args:
        keys: of the noise of `DRIVEN`.
        step: s, of its predictions.
        text: see `read_kfgins`.
    """
    n = numbers(text)
    found = {leaf: n[key][0] * np.sqrt(step) for leaf, key in zip(DRIVEN, keys, strict=True)}
    return found | {f"states.{name}.tau": np.array(np.inf) for name in ("gyro_bias", "accel_bias")}


def read_robot_localization(text: str, imu_rate_hz: float = 100.0) -> dict[str, np.ndarray]:
    """Return the same of `robot_localization_yaml`.

    Args:
        text: see `read_kfgins`.
        imu_rate_hz: Hz, rate of the IMU's messages.
    """
    n = numbers(text)
    keys = ("angular_velocity_covariance_diagonal", "linear_acceleration_covariance_diagonal")
    return {leaf: np.sqrt(n[key] / imu_rate_hz) for leaf, key in zip(WHITE, keys, strict=True)}
