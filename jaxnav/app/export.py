"""Noise parameters in the words of other software: the noise block of a KF-GINS configuration, and NaveGo's fields."""

import numpy as np

from jaxnav.maths import units
from jaxnav.types import Noise

ONE_CORRELATION_TIME = 4 * units.HOUR  # s, what stands for a random walk where only a Gauss-Markov process can be told


def _axes(value) -> np.ndarray:
    """One number an axis; of a root, which is correlated noise, the norms of its rows."""
    value = np.asarray(value, float)
    return np.linalg.norm(value, axis=1) if value.ndim == 2 else np.broadcast_to(value, (3,))


def _remark(noise: Noise, names: tuple[str, ...], mark: str) -> list[str]:
    """A comment line, where some of the leaves are correlated between the axes."""
    correlated = [name for name in names if np.any(np.tril(np.atleast_2d(getattr(noise, name)), -1))]
    return [f"{mark} correlations between the axes are left out of {', '.join(correlated)}"] if correlated else []


SENSORS, SCALES = ("gyro", "accel", "gyro_bias", "accel_bias"), ("position_scale", "velocity_scale")


def kfgins_yaml(noise: Noise, scale_ppm: tuple[float, float] = (0.0, 0.0)) -> str:
    """The ``imunoise`` of a KF-GINS yaml: deg/sqrt(h), m/s/sqrt(h), deg/h, mGal, ppm, h; body FRD as here.

    A Gauss-Markov bias of root PSD q and time T has the sd q sqrt(T / 2). KF-GINS has one T for all: the gyro's, and
    the sd of the accelerometers keep their q with it. A random walk is told as a process of 4 h, which within less
    than that drives alike. ``scale_ppm``: sd of gyro and accelerometer scale errors, as given: no filter here has them.
    KF-GINS knows no correlation between axes; where there is some, the axes' own sd are told, and a comment says so.
    """
    tau = _axes(noise.gyro_tau)
    time = float(tau[0]) if np.isfinite(tau).all() and np.ptp(tau) == 0 else ONE_CORRELATION_TIME
    sd = lambda drive: _axes(drive) * np.sqrt(time / 2)  # noqa: E731
    rows = {
        "arw": (_axes(noise.gyro) / units.DEG_PER_SQRT_HOUR, "deg/sqrt(h)"),
        "vrw": (_axes(noise.accel) / units.MPS_PER_SQRT_HOUR, "m/s/sqrt(h)"),
        "gbstd": (sd(noise.gyro_bias) / units.DEG_PER_HOUR, "deg/h"),
        "abstd": (sd(noise.accel_bias) / units.MGAL, "mGal"),
        "gsstd": (_axes(scale_ppm[0]), "ppm"),
        "asstd": (_axes(scale_ppm[1]), "ppm"),
    }
    lines = [f"  {name}: [{', '.join(f'{v:.6g}' for v in value)}]  # {unit}" for name, (value, unit) in rows.items()]
    head = [*_remark(noise, SENSORS, "#"), "imunoise:"]
    return "\n".join([*head, *lines, f"  corrtime: {time / units.HOUR:.6g}  # h", ""])


def navego_fields(noise: Noise) -> str:
    """NaveGo's fields of an ``imu`` struct in SI as assignments, and factors on the receiver's ``stdm`` and ``stdv``.

    ``gb_psd`` and ``ab_psd`` are the root PSD that drives the biases, which is what its filter takes; ``gb_dyn`` is
    the sd of a Gauss-Markov bias. Receiver axes are north, east, down. Correlations between axes as in `kfgins_yaml`.
    """
    fields = {"arw": _axes(noise.gyro), "vrw": _axes(noise.accel)}
    for name, drive, tau in (("g", noise.gyro_bias, noise.gyro_tau), ("a", noise.accel_bias, noise.accel_tau)):
        q, T = _axes(drive), _axes(tau)
        fields |= {f"{name}b_psd": q, f"{name}b_corr": T}
        fields[f"{name}b_dyn"] = np.where(np.isfinite(T), q * np.sqrt(np.where(np.isfinite(T), T, 0.0) / 2), q)
    text = lambda v: ", ".join("Inf" if np.isinf(x) else f"{x:.8g}" for x in v)  # noqa: E731
    lines = [f"imu.{name} = [{text(value)}];" for name, value in fields.items()]
    for name, scale in (("stdm", noise.position_scale), ("stdv", noise.velocity_scale)):
        lines.append(f"gnss.{name} = gnss.{name} .* [{text(_axes(scale)[[1, 0, 2]])}];")
    return "\n".join([*_remark(noise, SENSORS + SCALES, "%"), *lines, ""])
