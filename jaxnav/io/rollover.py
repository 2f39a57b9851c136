"""Clocks that start again: a counter's wrap, the end of a day or a week, and a logger that was switched on again."""

from typing import Any

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.mend import MAX_BAD_SHARE
from jaxnav.io.parts import Parts
from jaxnav.maths.gps_time import WEEK
from jaxnav.types import DataError, Json

PERIODS: dict[str, float] = {
    "2^32 ns": 2**32 / 1e9, "2^32 us": 2**32 / 1e6, "2^32 ms": 2**32 / 1e3, "2^16 ms": 2**16 / 1e3,
    "10^6 us": 1.0, "a minute": 60.0, "an hour": 3600.0, "a day": 86400.0, "a week": WEEK,
}  # fmt: skip
"""What a clock counts before it begins again, s."""
STEPS, SHARE = 20, 0.02  # of a wrap: median steps, or share of the period, by which it may miss the next time
BEFORE, AFTER = 3, 2  # rows that are compared, before and after a fall


def falls(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (F,) at which times (N,) fall and stay below what they were, and by how much, (F,) s."""
    rows = np.flatnonzero(np.isfinite(t))
    t = t[rows]
    down = np.flatnonzero(np.diff(t) < 0) + 1
    # a single time that jumps ahead and back, or a few rows out of order, are no fall
    at = np.array([k for k in down if t[k : k + AFTER].max() < np.median(t[max(k - BEFORE, 0) : k])], int)
    return rows[at], t[at - 1] - t[at]


def wrapped(t: np.ndarray) -> str | None:
    """Return the period of `PERIODS` by which times (N,) fall each time that they do; None of another clock."""
    _, by = falls(t)
    if not by.size:
        return None
    step = np.diff(t[np.isfinite(t)])
    usual = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    for name, period in PERIODS.items():
        after = period - by
        if (
            np.nanmax(t) - np.nanmin(t) <= period
            and (after >= 0).all()
            and (after <= min(STEPS * usual, SHARE * period + usual)).all()
        ):
            return name
    return None


def going_on(t: np.ndarray, period: float) -> np.ndarray:
    """Return times (N,) that go on where they fall by a period."""
    again = np.zeros(len(t))
    again[falls(t)[0]] = period
    return np.asarray(t + np.cumsum(again))


def unrolled(parts: Parts, part: int | None = None) -> Parts:
    """Return parts whose times go on where a clock starts again, with a note.

    A clock that starts again at another time is a logger's that was switched on again: one part is a recording.

    Args:
        parts: of a file.
        part: of several, from 1; the longest one where it is None.

    Raises:
        DataError: there is no such part.
    """
    streams = {} if parts.imu is None else {"imu": np.asarray(parts.imu.t, float)}
    streams |= {name: np.asarray(stream.t, float) for name, stream in parts.aiding.items()}
    if parts.truth is not None:
        streams["truth"] = np.asarray(parts.truth.t, float)
    names = {name: wrapped(t) for name, t in streams.items()}
    found = [name for name in names.values() if name]
    if found:
        period, notes = PERIODS[found[0]], list(parts.notes)
        fall = ", ".join(name for name, of in names.items() if of == found[0])
        notes.append(finding("clock.wraps", fall, period, words=found[0]))
        streams = {name: going_on(t, period) if names[name] == found[0] else t for name, t in streams.items()}
        first = next(iter(streams.values()))
        streams = {name: t + _into(t, first, period) for name, t in streams.items()}
        parts = _timed(parts, streams)._replace(notes=tuple(notes))
    return _one_part(parts, streams, part)


def _into(t: np.ndarray, other: np.ndarray, period: float) -> float:
    """Return the periods, s, by which times (K,) overlap others (N,) the most; 0 where several do."""
    known, others = t[np.isfinite(t)], other[np.isfinite(other)]
    if not known.size or not others.size:
        return 0.0
    shared = lambda shift: min(known.max() + shift, others.max()) - max(known.min() + shift, others.min())
    return max((0.0, period, -period), key=shared)


def _timed(parts: Parts, streams: dict[str, np.ndarray]) -> Parts:
    imu = None if parts.imu is None else parts.imu._replace(t=streams["imu"])
    aiding = {name: stream._replace(t=streams[name]) for name, stream in parts.aiding.items()}
    truth = None if parts.truth is None else parts.truth._replace(t=streams["truth"])
    return parts._replace(imu=imu, aiding=aiding, truth=truth)


def _one_part(parts: Parts, streams: dict[str, np.ndarray], part: int | None) -> Parts:
    """Return one part of a recording whose clock starts again."""
    t = streams.get("imu")
    at = np.array([], int) if t is None else falls(t)[0]
    lost = 0.0 if t is None or not at.size else float((t < np.fmax.accumulate(t)).mean())
    if t is None or lost <= MAX_BAD_SHARE:
        if part not in (None, 1):
            raise DataError(f"{parts.file}: part: the IMU's clock does not start again, there is no part {part}")
        return parts
    ends = np.r_[0, at, len(t)]
    lengths = [float(np.nanmax(t[a:b]) - np.nanmin(t[a:b])) for a, b in zip(ends, ends[1:])]
    chosen = int(np.argmax(lengths)) if part is None else part - 1
    if not 0 <= chosen < len(lengths):
        raise DataError(f"{parts.file}: part: expected 1 to {len(lengths)}, got {part}")
    each = ", ".join(f"{length:.1f} s" for length in lengths)
    note = finding("clock.restarts", "imu", count=at.size, words=each, part=chosen + 1)
    assert parts.imu is not None
    imu = _cut(parts.imu, ends[chosen], ends[chosen + 1])
    lines = None if parts.lines is None else parts.lines[ends[chosen] : ends[chosen + 1]]
    others: Json = {**parts.aiding, **({} if parts.truth is None else {"truth": parts.truth})}
    for name, rows in others.items():
        own = np.r_[0, falls(streams[name])[0], len(streams[name])]
        if len(own) == len(ends):
            others[name] = _cut(rows, own[chosen], own[chosen + 1])
    truth = others.pop("truth", None)
    return parts._replace(imu=imu, aiding=others, truth=truth, lines=lines, notes=(*parts.notes, note))


def _cut(rows: Any, a: int, b: int) -> Any:
    """Return rows a to b of all columns."""
    n = len(rows.t)
    return rows._make(x[a:b] if isinstance(x, np.ndarray) and x.ndim and len(x) == n else x for x in rows)
