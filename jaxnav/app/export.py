"""Noise parameters in the words of other software: the noise block of a KF-GINS configuration, and NaveGo's fields."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxnav.maths import units
from jaxnav.types import Params, StateParams

ONE_CORRELATION_TIME = 4 * units.HOUR  # s, what stands for a random walk where only a Gauss-Markov process can be told


def _axes(value) -> np.ndarray:
    """One number an axis; of a root, which is correlated noise, the norms of its rows."""
    value = np.asarray(value, float)
    return np.linalg.norm(value, axis=1) if value.ndim == 2 else np.broadcast_to(value, (3,))


def _remark(leaves: Mapping[str, Any], mark: str) -> list[str]:
    """A comment line, where some of the leaves are correlated between the axes."""
    correlated = [name for name, value in leaves.items() if np.any(np.tril(np.atleast_2d(value), -1))]
    return [f"{mark} correlations between the axes are left out of {', '.join(correlated)}"] if correlated else []


def _sensors(params: Params) -> dict[str, Any]:
    """White noise and what drives the biases, by name; zero where the filter has no biases."""
    still = StateParams(0.0, 0.0, np.inf)
    drives = {name: params.states.get(name, still).drive for name in ("gyro_bias", "accel_bias")}
    return {"gyro": params.noise.gyro, "accel": params.noise.accel, **drives}


def _tau(params: Params, name: str) -> np.ndarray:
    return _axes(params.states[name].tau if name in params.states else np.inf)


def kfgins_yaml(params: Params, scale_ppm: tuple[float, float] = (0.0, 0.0)) -> str:
    """The ``imunoise`` of a KF-GINS yaml: deg/sqrt(h), m/s/sqrt(h), deg/h, mGal, ppm, h; body FRD as here.

    A Gauss-Markov bias of root PSD q and time T has the sd q sqrt(T / 2). KF-GINS has one T for all: the gyro's, and
    the sd of the accelerometers keep their q with it. A random walk is told as a process of 4 h, which within less
    than that drives alike. ``scale_ppm``: sd of gyro and accelerometer scale errors, as given: no filter here has them.
    KF-GINS knows no correlation between axes; where there is some, the axes' own sd are told, and a comment says so.
    """
    tau, sensors = _tau(params, "gyro_bias"), _sensors(params)
    time = float(tau[0]) if np.isfinite(tau).all() and np.ptp(tau) == 0 else ONE_CORRELATION_TIME
    sd = lambda drive: _axes(drive) * np.sqrt(time / 2)  # noqa: E731
    rows = {
        "arw": (_axes(sensors["gyro"]) / units.DEG_PER_SQRT_HOUR, "deg/sqrt(h)"),
        "vrw": (_axes(sensors["accel"]) / units.MPS_PER_SQRT_HOUR, "m/s/sqrt(h)"),
        "gbstd": (sd(sensors["gyro_bias"]) / units.DEG_PER_HOUR, "deg/h"),
        "abstd": (sd(sensors["accel_bias"]) / units.MGAL, "mGal"),
        "gsstd": (_axes(scale_ppm[0]), "ppm"),
        "asstd": (_axes(scale_ppm[1]), "ppm"),
    }
    lines = [f"  {name}: [{', '.join(f'{v:.6g}' for v in value)}]  # {unit}" for name, (value, unit) in rows.items()]
    head = [*_remark(sensors, "#"), "imunoise:"]
    return "\n".join([*head, *lines, f"  corrtime: {time / units.HOUR:.6g}  # h", ""])


def navego_fields(params: Params) -> str:
    """NaveGo's fields of an ``imu`` struct in SI as assignments, and factors on the receiver's ``stdm`` and ``stdv``.

    ``gb_psd`` and ``ab_psd`` are the root PSD that drives the biases, which is what its filter takes; ``gb_dyn`` is
    the sd of a Gauss-Markov bias. Receiver axes are north, east, down. Correlations between axes as in `kfgins_yaml`.
    """
    sensors = _sensors(params)
    fields = {"arw": _axes(sensors["gyro"]), "vrw": _axes(sensors["accel"])}
    for name, state in (("g", "gyro_bias"), ("a", "accel_bias")):
        q, T = _axes(sensors[state]), _tau(params, state)
        fields |= {f"{name}b_psd": q, f"{name}b_corr": T}
        fields[f"{name}b_dyn"] = np.where(np.isfinite(T), q * np.sqrt(np.where(np.isfinite(T), T, 0.0) / 2), q)
    text = lambda v: ", ".join("Inf" if np.isinf(x) else f"{x:.8g}" for x in v)  # noqa: E731
    lines = [f"imu.{name} = [{text(value)}];" for name, value in fields.items()]
    scales = {name: params.measurements[name].scale for name in ("position", "velocity")}
    for name, scale in zip(("stdm", "stdv"), scales.values(), strict=True):
        lines.append(f"gnss.{name} = gnss.{name} .* [{text(_axes(scale)[[1, 0, 2]])}];")
    return "\n".join([*_remark(sensors | {f"{name}_scale": a for name, a in scales.items()}, "%"), *lines, ""])
