"""Corrected ranges to satellites, one row a satellite and epoch, and the streams of a recording made of them."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.measurements.satellites import CONSTELLATION, CONSTELLATIONS, SATELLITE
from jaxnav.states.receiver_clock import SLOTS
from jaxnav.types import DataError, Note, Samples

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

LIGHT = 299_792_458.0  # m/s
FREQUENCY = {"G": 1575.42e6, "J": 1575.42e6, "S": 1575.42e6, "E": 1575.42e6, "C": 1561.098e6, "I": 1176.45e6}
"""Hz, of the first frequency of each constellation."""
CLOCK_STEP = 1e-3 * LIGHT  # m; receivers set their clock by milliseconds
KNOT_S = 60.0  # s between knots of the clock's course that is taken out


class Ranges(NamedTuple):
    """Rows of satellites; see `jaxnav.measurements.satellites` for the corrections."""

    t: np.ndarray  # (N,) s of reception, equal for the rows of an epoch, not decreasing
    satellite: np.ndarray  # (N,) int, `number`
    pseudorange: np.ndarray  # (N,) m, nan where there is none
    range_rate: np.ndarray  # (N,) m/s, nan where there is none
    position: np.ndarray  # (N, 3) m, ECEF axes of the time of reception
    velocity: np.ndarray  # (N, 3) m/s, derivative of that
    elevation: np.ndarray  # (N,) rad
    cn0: np.ndarray  # (N,) dB-Hz


def number(name: str) -> int:
    """Return the number of a satellite by its name in RINEX.

    >>> number("G05"), number("E 1")
    (5, 301)

    Raises:
        DataError: no such constellation or number.
    """
    system, digits = name[:1].upper() or "?", name[1:].strip()
    if system not in CONSTELLATIONS or not digits.isdigit() or not 0 < int(digits) < CONSTELLATION:
        raise DataError(f"satellite {name!r}: expected one of {', '.join(CONSTELLATIONS)} and a number, such as G05")
    return CONSTELLATION * CONSTELLATIONS.index(system) + int(digits)


def name(satellite: int) -> str:
    """Return the name of a satellite in RINEX by its `number`."""
    system, prn = divmod(int(satellite), CONSTELLATION)
    return f"{CONSTELLATIONS[system]}{prn:02d}"


def frequency(satellites: np.ndarray) -> np.ndarray:
    """Return the first frequency (N,) Hz of satellites by their `number`."""
    each = np.array([FREQUENCY.get(system, FREQUENCY["G"]) for system in CONSTELLATIONS])
    return each[np.asarray(satellites) // CONSTELLATION]


def selected(ranges: Ranges, rows: np.ndarray) -> Ranges:
    """Return some rows, by a mask (N,) or indices."""
    return Ranges(*(a[rows] for a in ranges))


def epochs(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of epochs (E,) and the epoch of each row (N,)."""
    times, of = np.unique(t, return_inverse=True)
    return times, of


def slots(ranges: Ranges) -> np.ndarray:
    """Return the slot of each row, (N,), -1 for none: a satellite keeps its slot until another one needs it.

    A new satellite takes the slot that has been free for longest. Of more satellites than slots the highest are kept.
    """
    held = np.zeros(SLOTS, int)  # satellite of each slot
    last = np.full(SLOTS, -1)  # epoch of its last row
    found = np.full(ranges.t.size, -1)
    _, of = epochs(ranges.t)
    starts = np.append(np.searchsorted(of, np.arange(of[-1] + 1 if of.size else 0)), of.size)
    for e, (a, b) in enumerate(zip(starts[:-1], starts[1:], strict=True)):
        rows = np.arange(a, b)[np.argsort(-ranges.elevation[a:b], kind="stable")][:SLOTS]
        place = {int(s): i for i, s in enumerate(held) if s}
        for row in rows:
            if (i := place.get(int(ranges.satellite[row]))) is not None:
                found[row], last[i] = i, e
        for row in rows[found[rows] < 0]:
            i = int(np.argmin(last))
            held[i], last[i], found[row] = ranges.satellite[row], e, i
    return found


def streams(ranges: Ranges) -> dict[str, Samples]:
    """Return the streams ``pseudorange`` and ``range_rate`` of a recording, one channel a slot."""
    times, of = epochs(ranges.t)
    slot = slots(ranges)
    kept = slot >= 0
    row, column = of[kept], slot[kept]
    auxiliary = np.zeros((times.size, SLOTS, len(SATELLITE)))
    columns = np.column_stack(
        [ranges.satellite, ranges.position, ranges.velocity, ranges.elevation, ranges.cn0, np.zeros(ranges.t.size)]
    )
    auxiliary[row, column] = columns[kept]
    before = np.zeros(SLOTS)
    for e in range(times.size):
        here = auxiliary[e, :, 0]
        auxiliary[e, :, -1] = (here > 0) & (here != before)
        before = np.where(here > 0, here, before)
    found = {}
    for key, values in (("pseudorange", ranges.pseudorange), ("range_rate", ranges.range_rate)):
        value = np.full((times.size, SLOTS), np.nan)
        value[row, column] = values[kept]
        valid = np.isfinite(value)
        some = valid.any(1)
        if some.any():
            value = np.where(valid, value, 0.0)[some]
            found[key] = Samples(
                times[some], value, np.ones_like(value), np.zeros_like(value), valid[some], auxiliary[some]
            )
    return found


def ranges_of(aiding: dict[str, Samples]) -> Ranges:
    """Return the rows of the streams of a recording, the inverse of `streams`."""
    parts = [s for key in ("pseudorange", "range_rate") if (s := aiding.get(key)) is not None]
    times = np.unique(np.concatenate([s.t for s in parts])) if parts else np.zeros(0)
    table = np.zeros((times.size, SLOTS, len(SATELLITE)))
    values = {key: np.full((times.size, SLOTS), np.nan) for key in ("pseudorange", "range_rate")}
    for key in values:
        if (s := aiding.get(key)) is not None and s.valid is not None and s.auxiliary is not None:
            at = np.searchsorted(times, s.t)
            values[key][at] = np.where(s.valid, s.value, np.nan)
            table[at] = np.where(s.valid[..., None], s.auxiliary, table[at])
    e, i = np.nonzero(np.isfinite(values["pseudorange"]) | np.isfinite(values["range_rate"]))
    columns = table[e, i]
    return Ranges(times[e], columns[:, 0].astype(int), values["pseudorange"][e, i], values["range_rate"][e, i],
                  columns[:, 1:4], columns[:, 4:7], columns[:, 7], columns[:, 8])  # fmt: skip


def without_clock(ranges: Ranges, t: np.ndarray, bias: np.ndarray) -> tuple[Ranges, tuple[Note, ...]]:
    """Return ranges and rates without the course of the receiver's clock, and a note on it.

    All ranges of an epoch change by the same, which a filter's clock states would follow: a bias of kilometres or a
    step of a millisecond needs no prior of that size then.

    Args:
        ranges: the rows.
        t: (E,) s.
        bias: (E,) m, the clock's bias in a single-point solution; nan where there is none.
    """
    known = np.isfinite(bias)
    if known.sum() < 2:
        return ranges, ()
    t, bias = t[known], bias[known]
    drift = np.median(np.diff(bias) / np.diff(t))
    steps = np.round((np.diff(bias) - drift * np.diff(t)) / CLOCK_STEP) * CLOCK_STEP
    taken = np.append(0.0, np.cumsum(steps))
    at = np.searchsorted(t, ranges.t, side="right") - 1
    ranges = ranges._replace(pseudorange=ranges.pseudorange - taken[np.clip(at, 0, t.size - 1)])
    course = _smooth(t, bias - taken)
    ranges = ranges._replace(
        pseudorange=ranges.pseudorange - course(ranges.t), range_rate=ranges.range_rate - course(ranges.t, 1)
    )
    count = int(np.count_nonzero(steps))
    jumps = f" and {count} steps of milliseconds" if count else ""
    return ranges, (finding("range.clock", "pseudorange", bias[0], rate=drift, words=jumps),)


def _smooth(t: np.ndarray, y: np.ndarray) -> "BSpline":
    """Return a cubic spline through y (E,) at t (E,) with a knot every `KNOT_S`; outliers lose weight (Huber)."""
    from scipy.interpolate import make_lsq_spline

    every = max(5, round(KNOT_S / float(np.median(np.diff(t)))))  # epochs a knot, so that each piece has some
    inner, degree = t[every:-5:every], min(3, t.size - 1)
    knots = np.concatenate([np.full(degree + 1, t[0]), inner, np.full(degree + 1, t[-1])])
    weight = np.ones(t.size)
    for _ in range(5):
        found = make_lsq_spline(t, y, knots, degree, weight)
        off = np.abs(y - found(t))
        weight = 1 / np.maximum(off / max(2 * float(np.median(off)), 1e-3), 1.0)
    return found
