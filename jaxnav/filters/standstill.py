"""A vehicle at rest, and constraints of wheels and wings: pseudo-measurements at the ends of epochs. Host numpy."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from jaxnav.maths.units import TICK
from jaxnav.measurements.measurement import Measurement
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


def constraint_samples(
    imu: ImuLog,
    cuts: np.ndarray,
    measurements: Iterable[Measurement],
    standing: np.ndarray | None = None,
    window: float = 1.0,
) -> dict[str, Samples]:
    """Return pseudo-measurements at the ends of epochs, for `pack` with ``cuts``.

    Args:
        imu: the IMU's samples.
        cuts: (E,) s, ends of epochs.
        measurements: rows, of which those without data are constraints.
        standing: (E,) bool (`stationary`), for those that hold at rest; None leaves them out.
        window: s, over which the values of a standstill are taken.

    Returns:
        Streams by measurement name.
    """
    made = {}
    for row in measurements:
        if row.has_data or (row.at_rest and standing is None):
            continue
        t = cuts[standing] if row.at_rest and standing is not None else cuts
        value = np.zeros((t.size, row.size)) if row.pseudo is None else row.pseudo(imu, t, window)
        made[row.name] = Samples(t, value, np.ones_like(value), np.zeros_like(value))
    return made
