"""From observations and ephemerides to corrected ranges: satellite clock, flight, Earth rotation, atmosphere."""

import math
from typing import NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.gnss.atmosphere import klobuchar, saastamoinen
from jaxnav.gnss.orbits import HALF_STEP, Ephemeris, chosen, state, turned
from jaxnav.gnss.ranges import FREQUENCY, LIGHT, Ranges, epochs, frequency, selected, streams, without_clock
from jaxnav.gnss.single_point import SinglePoint, single_point
from jaxnav.maths.axes import enu_to_ecef, geodetic
from jaxnav.maths.earth import RATE
from jaxnav.maths.gps_time import GPS_EPOCH
from jaxnav.types import DataError, Note, Samples


class Observations(NamedTuple):
    """Rows of a receiver, one a satellite and epoch, first frequency."""

    t: np.ndarray  # (N,) s GPS since 1970, the receiver's stamp
    satellite: np.ndarray  # (N,) int, `jaxnav.gnss.ranges.number`
    pseudorange: np.ndarray  # (N,) m
    range_rate: np.ndarray  # (N,) m/s, -wavelength times Doppler; nan where there is none
    cn0: np.ndarray  # (N,) dB-Hz
    phase: np.ndarray  # (N,) m, wavelength times carrier phase; nan where there is none
    slipped: np.ndarray  # (N,) bool, lock was lost since the satellite's row before
    interval: np.ndarray  # (N,) s before ``t`` that the range rate is the mean over; 0: it is that at ``t``

    @classmethod
    def of(cls, table: np.ndarray) -> "Observations":
        """Return rows, range rates at their time.

        Args:
            table: (N, 7) the fields but the last, in their order.
        """
        t, satellite, code, rate, cn0, phase, slipped = table.T
        return cls(t, satellite.astype(int), code, rate, cn0, phase, slipped > 0, np.zeros(t.size))


class Ionosphere(NamedTuple):
    """Broadcast coefficients of `klobuchar`."""

    alpha: np.ndarray  # (4,)
    beta: np.ndarray  # (4,)


class Masks(NamedTuple):
    """Satellites that are left out."""

    elevation_deg: float = 10.0  # below it
    cn0_dbhz: float = 25.0  # below it


RATES = ("doppler", "phase")
"""Where range rates come from: the option ``rates`` of readers."""
MAX_GAP = 1.5  # epochs between two phases that are differenced


def with_rates(seen: Observations, rates: str) -> tuple[Observations, tuple[Note, ...]]:
    """Return the rows with range rates by Doppler, or by differences of carrier phase, and a note on those.

    A difference is the mean over its interval, and so as old as half of it. Doppler is not put in its place where lock
    was lost: its errors are ten times larger.

    Args:
        seen: rows in order of their epochs.
        rates: one of `RATES`.

    Raises:
        DataError: another ``rates``, or no phase that goes on for two epochs.
    """
    if rates not in RATES:
        raise DataError(f"rates must be one of {', '.join(RATES)}, got {rates!r}")
    if rates == "doppler":
        return seen, ()
    order = np.lexsort((seen.t, seen.satellite))
    t, phase, satellite = seen.t[order], seen.phase[order], seen.satellite[order]
    step = float(np.median(np.diff(np.unique(t)))) if t.size > 1 else 0.0
    interval, change = np.diff(t, prepend=t[:1]), np.diff(phase, prepend=phase[:1])
    goes_on = np.diff(satellite, prepend=-1) == 0
    good = goes_on & ~seen.slipped[order] & (interval > 0) & (interval < MAX_GAP * step) & np.isfinite(change)
    if not good.any():
        raise DataError("rates='phase': no satellite has a carrier phase in two epochs that follow each other")
    rate, over = np.full(t.size, np.nan), np.zeros(t.size)
    rate[order[good]], over[order[good]] = change[good] / interval[good], interval[good]
    note = finding("range_rate.phase", "range_rate", step / 2, over=step, lost=100 * (1 - good.mean()))
    return seen._replace(range_rate=rate, interval=over), (note,)


def sight(position: np.ndarray, receiver: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and elevation (N,) rad of satellites from receivers, both (N, 3) m, ECEF."""
    east, north, up = np.einsum("nj,nji->in", position - receiver, enu_to_ecef(geodetic(receiver)))
    return np.arctan2(east, north), np.arctan2(up, np.hypot(east, north))


def at_reception(
    eph: Ephemeris, t: np.ndarray, pseudorange: np.ndarray, receiver: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return satellites (N, 3) m in the axes of the time of reception, and their clock errors (N,) s.

    A signal left at ``t - pseudorange / c`` by the satellite's clock, whatever the receiver's clock is off. The Earth
    turns during distance / c; without a ``receiver`` (N, 3) m that is pseudorange / c, which its clock makes wrong.
    """
    emitted = t - pseudorange / LIGHT
    _, clock = state(eph, emitted)
    position, clock = state(eph, emitted - clock)
    flight = pseudorange if receiver is None else np.linalg.norm(position - receiver, axis=1)
    return turned(position, RATE * flight / LIGHT), clock


def corrected(
    seen: Observations, eph: Ephemeris, receiver: np.ndarray | None, ionosphere: Ionosphere | None = None
) -> Ranges:
    """Return corrected ranges of the observations that have a valid ephemeris.

    Args:
        seen: rows of the receiver.
        eph: columns (K,) of ephemerides.
        receiver: (N, 3) m, ECEF, approximate, of each row; None: not known, so that elevations are 90 deg and the
            atmosphere stays.
        ionosphere: coefficients; None leaves the ionosphere in.
    """
    match = chosen(eph, seen.satellite, seen.t)
    known = match >= 0
    seen = Observations(*(a[known] for a in seen))
    receiver = None if receiver is None else receiver[known]
    eph = Ephemeris(*(a[match[known]] for a in eph))
    rate = np.where(np.isfinite(seen.range_rate), seen.range_rate, 0.0)
    steps = [at_reception(eph, seen.t + h, seen.pseudorange + h * rate, receiver) for h in (0.0, -HALF_STEP, HALF_STEP)]
    (position, clock), (before, clock_before), (after, clock_after) = steps
    pseudorange = seen.pseudorange + LIGHT * clock
    range_rate = seen.range_rate + LIGHT * (clock_after - clock_before) / (2 * HALF_STEP)
    elevation = np.full(seen.t.size, math.pi / 2)
    if receiver is not None:
        azimuth, elevation = sight(position, receiver)
        lat, lon, h = geodetic(receiver).T
        pseudorange = pseudorange - saastamoinen(lat, h, elevation)
        if ionosphere is not None:
            tow = seen.t - GPS_EPOCH
            delay = klobuchar(*ionosphere, lat, lon, azimuth, elevation, tow)  # of L1
            pseudorange = pseudorange - delay * (FREQUENCY["G"] / frequency(seen.satellite)) ** 2
    velocity = (after - before) / (2 * HALF_STEP)
    if receiver is not None and seen.interval.any():
        past = at_reception(eph, seen.t - seen.interval, seen.pseudorange - seen.interval * rate, receiver)[0]
        range_rate = range_rate + at_the_end(position, velocity, past, receiver, seen.interval)
    return Ranges(seen.t, seen.satellite, pseudorange, range_rate, position, velocity, elevation, seen.cn0)


def at_the_end(
    position: np.ndarray, velocity: np.ndarray, past: np.ndarray, receiver: np.ndarray, interval: np.ndarray
) -> np.ndarray:
    """Return a satellite's range rate less its mean over the ``interval`` (N,) s before, m/s, from a fixed receiver.

    ``position``, ``past`` (N, 3) m at both ends of it and ``velocity`` (N, 3) m/s at the end, ECEF; 0 for no interval.
    """
    distance = np.linalg.norm(position - receiver, axis=1)
    rate = np.sum((position - receiver) * velocity, 1) / distance
    mean = (distance - np.linalg.norm(past - receiver, axis=1)) / np.where(interval > 0, interval, 1.0)
    return np.where(interval > 0, rate - mean, 0.0)


def solved(
    seen: Observations, eph: Ephemeris, ionosphere: Ionosphere | None = None, masks: Masks = Masks()
) -> tuple[Ranges, SinglePoint]:
    """Return corrected ranges above the masks, and the single-point solution by them.

    Args:
        seen: rows of the receiver, in any order.
        eph: columns (K,) of ephemerides.
        ionosphere: coefficients; None leaves the ionosphere in.
        masks: satellites that are left out.

    Raises:
        DataError: no epoch with a solution.
    """
    order = np.lexsort((seen.satellite, seen.t))
    seen = Observations(*(a[order] for a in seen))
    seen = Observations(*(a[np.isfinite(seen.pseudorange) & (seen.cn0 >= masks.cn0_dbhz)] for a in seen))
    found = single_point(corrected(seen, eph, None))
    if not found.t.size:
        raise DataError("no epoch has satellites enough with valid ephemerides for a single-point solution")
    for _ in range(2):
        ranges = corrected(seen, eph, found.position[_nearest(found.t, seen.t)], ionosphere)
        ranges = selected(ranges, ranges.elevation >= math.radians(masks.elevation_deg))
        found = single_point(ranges)
        if not found.t.size:
            raise DataError(f"no epoch has satellites enough above {masks.elevation_deg:g} deg for a solution")
    return ranges, found


def _nearest(times: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the index of the nearest of sorted ``times`` (E,) for each of t (N,)."""
    i = np.clip(np.searchsorted(times, t), 1, times.size - 1)
    return np.where(t - times[i - 1] <= times[i] - t, i - 1, i)


def aiding_of(ranges: Ranges, found: SinglePoint) -> tuple[dict[str, Samples], tuple[Note, ...]]:
    """Return the streams of a recording and notes: ranges and rates, and position and velocity by single points.

    Args:
        ranges: corrected rows, in order of their times.
        found: the single points of them.

    Returns:
        Streams by name, and notes. Times are those of reception, the receiver's stamps less its clock's error.
    """
    ranges, note = without_clock(ranges, found.t, found.clock)
    times, of = epochs(ranges.t)
    bias = np.interp(times, found.t, found.clock) / LIGHT
    ranges = ranges._replace(t=(times - bias)[of])
    position, velocity = found.samples()
    kept = {"position": position, "velocity": velocity} if velocity.t.size else {"position": position}
    per = np.bincount(of)
    about = finding("range.satellites", "satellites", np.median(per), low=per.min(), high=per.max(), count=times.size)
    return kept | streams(ranges), (about, *note)
