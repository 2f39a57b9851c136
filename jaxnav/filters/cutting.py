"""The IMU's samples of each epoch: host numpy, a block of epochs at a time."""

import numpy as np

from jaxnav.maths.units import TICK
from jaxnav.types import ImuLog

BLOCK = 4096  # epochs that `cut_imu` cuts at a time


def cut_imu(imu: ImuLog, start: float, cuts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split the stream at every cut and pad: dt (E, k), gyro (E, k, 3), accel (E, k, 3).

    `BLOCK` epochs at a time: of a long recording the result alone takes memory.
    """
    begin = np.concatenate([[start], cuts[:-1]])
    inside = np.searchsorted(imu.t, cuts - TICK) - np.searchsorted(imu.t, begin + TICK, side="right")
    E, k = cuts.size, 1 + max(int(inside.max()), 0)
    result = np.zeros((E, k)), np.zeros((E, k, 3)), np.zeros((E, k, 3))
    for i in range(0, E, BLOCK):
        rows = slice(i, i + BLOCK)
        last = cuts[rows][-1]
        # the samples of the block, and one on either side
        first = max(int(np.searchsorted(imu.t, begin[i] - TICK)) - 1, 0)
        near = slice(first, int(np.searchsorted(imu.t, last + TICK)) + 1)
        part = _cut_block(ImuLog(*(a[near] for a in imu)), begin[i], cuts[rows], k)
        for into, values in zip(result, part, strict=True):
            into[rows] = values
    return result


def _cut_block(imu: ImuLog, start: float, cuts: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `cut_imu` of some epochs, padded to k samples."""
    edges = np.union1d(imu.t, np.concatenate([[start], cuts]))
    edges = edges[(edges >= start - TICK) & (edges <= cuts[-1] + TICK)]
    keep = np.diff(edges, append=np.inf) > TICK  # of two edges that are one time, the later stays
    edges = edges[keep]
    ends, dt = edges[1:], np.diff(edges)
    mid = ends - dt / 2
    source = np.clip(np.searchsorted(imu.t, mid), 0, imu.t.size - 1)
    hole = mid < (imu.t - imu.dt)[source] - TICK  # before the sample's interval: a gap in the stream
    before = np.where(hole, np.maximum(source - 1, 0), source)
    counts = np.bincount(np.searchsorted(cuts, ends - 2 * TICK), minlength=cuts.size)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    index = first[:, None] + np.arange(k)
    real = np.arange(k) < counts[:, None]
    index = np.where(real, index, (first + np.maximum(counts - 1, 0))[:, None])  # padding repeats the last sample
    later, earlier = source[index], before[index]
    mean = lambda a: 0.5 * (a[later] + a[earlier]) if hole.any() else a[later]
    return np.where(real, dt[index], 0.0), mean(imu.gyro), mean(imu.accel)
