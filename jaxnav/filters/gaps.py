"""Gaps in an IMU's stream: samples that fill them, and the error of this fill.

Each half of a gap is filled with the mean of the half second next to it; beyond one second from both sides, with the
mean of the whole log. The log itself shows the error of such a fill: it is tried in places without a gap.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from jaxnav.types import ImuLog

MIN_GAP_S = 0.2  # s: a shorter hole is bridged by the mean of its two sides, and nothing more is made of it
SIDE_S = 0.5  # s, next to a hole; its mean fills the hole
SIDE_REACH_S = 1.0  # s, as far as a side's mean reaches
MAX_TRIALS = 200  # places where a fill is tried
MAX_HIDDEN_TURN = np.pi / np.sqrt(3.0)  # rad that a hole may hide: the sd of an unknown heading
BOUND_PROBABILITY = 0.9  # probability that the hidden variance is not above the stated one


class Holes(NamedTuple):
    """G holes longer than `MIN_GAP_S`."""

    begin: np.ndarray  # (G,) s
    end: np.ndarray  # (G,) s
    noise: np.ndarray  # (G, 2) root PSD that the fill adds: gyro rad/s/sqrt(Hz), accelerometer m/s^2/sqrt(Hz)


def holes(imu: ImuLog) -> Holes:
    """Return the long holes of a log, and the error that a fill may have in each."""
    begin, end = imu.t[:-1], imu.t[1:] - imu.dt[1:]
    where = np.flatnonzero(end - begin > MIN_GAP_S)
    begin, end = begin[where], end[where]
    if not where.size:
        return Holes(begin, end, np.zeros((0, 2)))
    log = _Log(imu)
    length, which = np.unique(np.round(end - begin, 2), return_inverse=True)
    return Holes(begin, end, np.array([_noise(log, imu, each, begin, end) for each in length])[which])


def fill(imu: ImuLog) -> tuple[ImuLog, Holes]:
    """Return the log with samples in its long holes, and the holes."""
    found = holes(imu)
    if not found.begin.size:
        return imu, found
    log = _Log(imu)
    t, dt, gyro, accel = [imu.t], [imu.dt], [imu.gyro], [imu.accel]
    for a, b in zip(found.begin, found.end, strict=True):
        edges, means = _pieces(log, np.array([a]), np.array([b]))
        t.append(edges[0, 1:])
        dt.append(np.diff(edges[0]))
        gyro.append(means[0, :, :3])
        accel.append(means[0, :, 3:])
    order = np.argsort(np.concatenate(t), kind="stable")
    filled = ImuLog(*(np.concatenate(parts)[order] for parts in (t, dt, gyro, accel)))
    return filled, found


class _Log:
    """Running integrals of the six readings, to take means between any two times by; holes count for nothing."""

    def __init__(self, imu: ImuLog):
        values = np.hstack([imu.gyro, imu.accel])
        self.t = np.column_stack([imu.t - imu.dt, imu.t]).ravel()
        steps = values * imu.dt[:, None]
        self.sum = np.repeat(np.cumsum(steps, 0), 2, 0)
        self.sum[0::2] -= steps
        self.time = np.repeat(np.cumsum(imu.dt), 2)
        self.time[0::2] -= imu.dt
        self.mean_of_all = values.mean(0)

    def between(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the integral (K, 6) and length (K,) of the covered part from a to b."""
        at = lambda t: np.column_stack([np.interp(t, self.t, c) for c in (*self.sum.T, self.time)])
        d = at(b) - at(a)
        return d[:, :6], d[:, 6]

    def mean(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Mean (K, 6) from a to b; of the whole log where nothing is covered."""
        total, time = self.between(a, b)
        some = time[:, None] > 1e-9
        return np.where(some, total / np.where(some, time[:, None], 1.0), self.mean_of_all)


def _pieces(log: _Log, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (K, p + 1) of the pieces that fill holes of one length from a to b (K,), and their values (K, p, 6)."""
    reach = min(SIDE_REACH_S, 0.5 * float(b[0] - a[0]))
    left, right = log.mean(a - SIDE_S, a), log.mean(b, b + SIDE_S)
    if b[0] - a[0] <= 2 * SIDE_REACH_S:
        return np.column_stack([a, a + reach, b]), np.stack([left, right], 1)
    middle = np.broadcast_to(log.mean_of_all, left.shape)
    return np.column_stack([a, a + reach, b - reach, b]), np.stack([left, middle, right], 1)


def _noise(log: _Log, imu: ImuLog, length: float, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the root PSD (2,) of the error of a fill of ``length`` s, by fills of that length elsewhere in the log."""
    first, last = float(imu.t[0] - imu.dt[0]) + SIDE_S, float(imu.t[-1]) - SIDE_S
    tried = min(length, max(0.25 * (last - first), 1e-3))
    a = np.linspace(first, last - tried, MAX_TRIALS)
    b = a + tried
    clear = ~((a[:, None] - SIDE_S < end) & (b[:, None] + SIDE_S > begin)).any(1)
    a, b = a[clear], b[clear]
    if a.size:
        edges, values = _pieces(log, a, b)
        missed = log.between(a, b)[0] - (np.diff(edges)[:, :, None] * values).sum(1)
        windows = max(1.0, float(imu.dt.sum()) / tried)  # that do not overlap: few say little about a long hole
        off = np.sqrt((missed**2).mean(0) * windows / chdtri(windows, BOUND_PROBABILITY)) * (length / tried)
    else:
        off = np.hstack([imu.gyro, imu.accel]).std(0) * length
    turn, push = float(off[:3].max()), float(off[3:].max())  # a vehicle turns about one axis, and this is its heading
    return np.array([min(turn, MAX_HIDDEN_TURN), push]) / np.sqrt(length)
