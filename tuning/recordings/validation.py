"""Before and after on data that tuning never saw, with intervals."""

from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

FAILED_M = 1e6  # m: error of a failed run


class PairedGain(NamedTuple):
    """How much smaller an error became; every figure follows from the paired errors alone."""

    gain: float  # before_rms / after_rms: 1.10 is 10 % better, below 1 is worse
    low: float  # 95 % interval of the gain, percentiles of the bootstrap
    high: float
    before_rms: float
    after_rms: float


def paired_gain(
    before: np.ndarray, after: np.ndarray, blocks: np.ndarray | None = None, seed: int = 0, draws: int = 10_000
) -> PairedGain:
    """Ratio of RMS errors of the same windows or runs (W,) before and after, with a block-bootstrap interval.

    ``blocks`` (W,) names the windows that are drawn together: windows that overlap in time are not independent, so
    resampling them one by one would make the interval too narrow. None draws each alone.

    Raises:
        ValueError: shapes differ, fewer than two blocks, or an error that is not finite.
    """
    before, after = np.asarray(before, float), np.asarray(after, float)
    if before.shape != after.shape or before.ndim != 1:
        raise ValueError(f"before and after must be two vectors of one length, got {before.shape} and {after.shape}")
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        raise ValueError("before and after must be finite: leave out, and report, the runs that failed")
    labels = np.arange(before.size) if blocks is None else np.asarray(blocks)
    names = np.unique(labels)
    if names.size < 2:
        raise ValueError(f"an interval needs two blocks or more, got {names.size}")
    member = labels[None] == names[:, None]
    sums = np.stack([member @ before**2, member @ after**2, member.sum(1)])  # the RMS of a draw follows from these
    pick = np.random.default_rng(seed).integers(names.size, size=(draws, names.size))
    b, a, n = sums[:, pick].sum(-1)
    low, high = np.percentile(np.sqrt(b / a), [2.5, 97.5])
    rms = lambda e: float(np.sqrt(np.mean(e**2)))
    return PairedGain(rms(before) / rms(after), float(low), float(high), rms(before), rms(after))


class PairedRatio(NamedTuple):
    """How many times larger one error is than another of the same runs."""

    ratio: float
    low: float  # 95 % interval
    high: float


def block_ratio(before: np.ndarray, after: np.ndarray, blocks: np.ndarray, level: float = 0.95) -> PairedRatio:
    """Return the ratio of RMS errors, after to before, and its interval by Student's t over blocks' log ratios.

    Of few blocks a bootstrap's interval is too narrow.

    Args:
        before: (W,) errors; inf where a run failed.
        after: (W,) of the same windows.
        blocks: (W,) which windows are one.
        level: of the interval; of one block it is (0, inf).
    """
    labels, member = np.unique(blocks, return_inverse=True)
    mean = [np.bincount(member, np.minimum(e, FAILED_M) ** 2) / np.bincount(member) + 1e-6 for e in (before, after)]
    change, ratio = 0.5 * np.log(mean[1] / mean[0]), np.sqrt(np.mean(after**2) / np.mean(before**2))
    if labels.size < 2:
        return PairedRatio(float(ratio), 0.0, float("inf"))
    half = stdtrit(labels.size - 1, 0.5 + 0.5 * level) * change.std(ddof=1) / np.sqrt(labels.size)
    return PairedRatio(float(ratio), *(float(np.exp(change.mean() + sign * half)) for sign in (-1, 1)))


MIN_BLOCKS, CLEAR_RATIO = 4, 0.8  # of windows, from which on a ratio has an interval; a ratio that needs none


def drifts_less(before: np.ndarray, after: np.ndarray, blocks: np.ndarray) -> bool:
    """Return whether errors are smaller by more than chance.

    Args:
        before: (W,) errors.
        after: (W,) of the same windows.
        blocks: (W,) which windows are one; of fewer than `MIN_BLOCKS` a ratio below `CLEAR_RATIO` is enough.
    """
    found = block_ratio(before, after, blocks)
    sure = found.high < 1.0 if np.unique(blocks).size >= MIN_BLOCKS else found.ratio < CLEAR_RATIO
    return bool(sure and np.isfinite(after).all())


def paired_ratio(a: np.ndarray, b: np.ndarray, seed: int = 0, draws: int = 10_000) -> PairedRatio:
    """Geometric mean of a / b over errors (K, S) of K kinds of S runs each, every kind counted alike.

    Runs of one number share their random numbers over the kinds, so the bootstrap draws the S numbers.

    Raises:
        ValueError: shapes differ, fewer than two runs, or an error that is not positive and finite.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] < 2:
        raise ValueError(f"errors must be two tables (kinds, 2 runs or more) of one shape, got {a.shape} and {b.shape}")
    if not all((np.isfinite(e) & (e > 0)).all() for e in (a, b)):
        raise ValueError("errors must be positive and finite: leave out, and report, the runs that failed")
    each = np.log(a / b).mean(0)  # of each number
    pick = np.random.default_rng(seed).integers(each.size, size=(draws, each.size))
    low, high = np.percentile(each[pick].mean(1), [2.5, 97.5])
    return PairedRatio(*(float(np.exp(v)) for v in (each.mean(), low, high)))
