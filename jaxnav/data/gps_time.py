"""GPS time: its epoch, its weeks, and the leap seconds of UTC by date."""

import datetime

import numpy as np

GPS_EPOCH, WEEK = 315964800.0, 604800.0  # s: 1980-01-06 counted from 1970; a week
ROLL_OVER = 1024 * WEEK  # s, after which old receivers count weeks from 0
LEAPS = (  # year, month from whose first day on UTC is a second later still (IERS Bulletin C)
    (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7),
    (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
)  # fmt: skip
_STEPS = np.array([datetime.datetime(*month, 1, tzinfo=datetime.UTC).timestamp() for month in LEAPS])


def leap_seconds(utc: float) -> float:
    """Return how far GPS time is ahead of UTC, s, at a time in s since 1970."""
    return float(np.searchsorted(_STEPS, utc, side="right"))


def unrolled(t: np.ndarray) -> tuple[np.ndarray, int]:
    """Return seconds of the week (N,) that go on where they fall by a week, and how often they do."""
    falls = np.r_[False, np.diff(t) < -0.5 * WEEK]
    return t + WEEK * np.cumsum(falls), int(falls.sum())


def nearest_week(t: np.ndarray, other: np.ndarray) -> float:
    """Return the whole weeks (s) after which times (K,) meet others (N,), 0 where they meet as they are.

    Old receivers are off by 1,024 weeks, seconds of the week by one where a log goes over midnight on Saturday.
    """
    if not t.size or not other.size or (t[0] <= other[-1] and t[-1] >= other[0]):
        return 0.0
    apart = float(np.median(other) - np.median(t))
    for period in (WEEK, ROLL_OVER):
        shift = round(apart / period) * period
        near = abs(shift) <= WEEK if period == WEEK else shift != 0
        if shift and near and t[0] + shift <= other[-1] and t[-1] + shift >= other[0]:
            return shift
    return 0.0
