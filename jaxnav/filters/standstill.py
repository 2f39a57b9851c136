"""A vehicle at rest, and constraints of wheels and wings: pseudo-measurements at the ends of epochs. Host numpy."""

import math
from typing import Any, NamedTuple

import numpy as np

from jaxnav.filters.gaps import TICK
from jaxnav.types import ImuLog, Samples


class Standing(NamedTuple):
    """When a vehicle stands: both sd over the window, each the root sum square of the axes, are below these."""

    window: float = 1.0  # s
    accel_sd: float = 0.2  # m/s^2
    gyro_sd: float = math.radians(1.0)  # rad/s


def stationary(imu: ImuLog, t: np.ndarray, window: float, accel_sd: float, gyro_sd: float) -> np.ndarray:
    """Detect standstills at ``t`` from the samples before (causal).

    True where the standard deviations of specific force and rate over the window, each the root sum of squares of the
    axes, are below the thresholds and data cover the whole window.

    Args:
        imu: the IMU's samples.
        t: (E,) s.
        window: s, length of the window before each time.
        accel_sd: m/s^2, threshold of specific force.
        gyro_sd: rad/s, threshold of the rate.

    Returns:
        (E,) bool.
    """
    covered, accel, gyro = spreads(imu, t, window)
    return covered & (accel < accel_sd) & (gyro < gyro_sd)


def spreads(imu: ImuLog, t: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for windows that end at ``t``: covered (E,), sd of specific force (E,) and of rate (E,)."""
    sums = lambda a: np.concatenate([np.zeros((1, 3)), np.cumsum(a, 0)])
    last = np.searchsorted(imu.t, t + TICK)
    first = np.searchsorted(imu.t, t - window + TICK)
    n = np.maximum(last - first, 1)[:, None]

    def spread(a: Any) -> Any:
        a = a - a.mean(0)
        mean = (sums(a)[last] - sums(a)[first]) / n
        var = (sums(a**2)[last] - sums(a**2)[first]) / n - mean**2
        return np.sqrt(np.maximum(var, 0).sum(1))

    time = np.concatenate([[0.0], np.cumsum(imu.dt)])
    # all but a sample's length at either end; a hole in the stream may hold anything
    covered = (time[last] - time[first] >= window - 2 * float(np.median(imu.dt))) & (last - first >= 2)
    return covered, spread(imu.accel), spread(imu.gyro)


def is_driving(velocity: Samples, t: np.ndarray) -> np.ndarray:
    """Return where the receiver's speed is above 0.5 m/s and 3 sd at the times ``t`` (E,), bool (E,).

    The velocity is the nearest in time, within a second.
    """
    after = np.clip(np.searchsorted(velocity.t, t), 1, max(velocity.t.size - 1, 1)) % velocity.t.size
    near = np.where(np.abs(velocity.t[after] - t) < np.abs(velocity.t[after - 1] - t), after, after - 1)
    speed = np.hypot(velocity.value[near, 0], velocity.value[near, 1])
    return (np.abs(velocity.t[near] - t) <= 1.0) & (speed > 0.5 + 3 * velocity.sd[near, :2].max(1))


def mean_rate(imu: ImuLog, t: np.ndarray, window: float) -> np.ndarray:
    """Mean raw gyro rate over the ``window`` s before each of ``t``, (E, 3) rad/s: the value of a zero-rate update."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyro, 0)])
    last, first = np.searchsorted(imu.t, t + TICK), np.searchsorted(imu.t, t - window + TICK)
    return (total[last] - total[first]) / np.maximum(last - first, 1)[:, None]


def constraint_samples(
    imu: ImuLog,
    cuts: np.ndarray,
    *,
    nonholonomic: bool = False,
    sideslip: bool = False,
    level: bool = False,
    standing: np.ndarray | None = None,
    window: float = 1.0,
) -> dict[str, Samples]:
    """Return pseudo-measurements at the ends of epochs, for `pack` with ``cuts``.

    Args:
        imu: the IMU's samples.
        cuts: (E,) s, ends of epochs.
        nonholonomic: wheels without slip, at every end.
        sideslip: an aircraft without sideslip, at every end.
        level: a constant height, at every end.
        standing: (E,) bool (`stationary`): zero velocity and zero rate there.
        window: s, over which the mean rate of a standstill is taken.

    Returns:
        Streams by measurement name.
    """

    def samples(t: np.ndarray, value: np.ndarray) -> Samples:
        return Samples(t, value, np.ones_like(value), np.zeros_like(value))

    held = (("nonholonomic", 2, nonholonomic), ("sideslip", 1, sideslip), ("level", 1, level))
    made = {name: samples(cuts, np.zeros((cuts.size, size))) for name, size, wanted in held if wanted}
    if standing is not None:
        t = cuts[standing]
        made["zero_velocity"] = samples(t, np.zeros((t.size, 3)))
        made["zero_rate"] = samples(t, mean_rate(imu, t, window))
    return made
