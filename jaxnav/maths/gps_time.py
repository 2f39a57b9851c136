"""GPS time: its epoch, its weeks, and the leap seconds of UTC by date."""

import datetime

import numpy as np

GPS_EPOCH, WEEK = 315964800.0, 604800.0  # s: 1980-01-06 counted from 1970; a week
ROLL_OVER = 1024 * WEEK  # s, after which old receivers count weeks from 0
LEAPS = (  # year and month from the start of which UTC is a second later still (IERS Bulletin C)
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


def week_shift(t: np.ndarray, other: np.ndarray) -> float:
    """Return the whole weeks (s) to add to times (K,) so that they overlap others (N,); else 0.

    Old receivers are off by 1,024 weeks, seconds of the week by one where a log goes over midnight on Saturday.
    """
    if not t.size or not other.size:
        return 0.0
    rolled = round(float(np.median(other) - np.median(t)) / ROLL_OVER) * ROLL_OVER
    overlaps = lambda shift: t.min() + shift <= other.max() and t.max() + shift >= other.min()
    return next((shift for shift in (0.0, WEEK, -WEEK, rolled) if overlaps(shift)), 0.0)
