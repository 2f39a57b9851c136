"""Times of the streams: against the IMU's, against one another, and each against its usual interval."""

import numpy as np

from jaxnav.findings import finding
from jaxnav.types import Finding, Recording, Severity

PAIR = ("position", "velocity")  # of one solution, so of one time
MAX_JITTER = 0.02  # of an interval: how closely a stream keeps its rhythm, and
MIN_JUMP = 0.1  # of an interval, deviation that is a finding
MIN_OFFSET = 0.05  # of an interval between two streams of one receiver
MIN_COVERAGE = 0.75  # of the time of position, below which the other stream ends, or begins, too soon


def ends(rec: Recording) -> list[Finding]:
    """Find a stream of position or velocity that covers much less time than the other."""
    if not all(name in rec.aiding and rec.aiding[name].t.size for name in PAIR):
        return []
    spans = {name: rec.aiding[name].t[[0, -1]] for name in PAIR}
    short, long = sorted(PAIR, key=lambda name: float(np.ptp(spans[name])))
    late, early = (spans[short] - spans[long]) * [1, -1]
    if np.ptp(spans[short]) >= MIN_COVERAGE * np.ptp(spans[long]):
        return []
    least = 0.1 * np.ptp(spans[long])
    parts = [
        f"begins {late:.1f} s after" if late > least else "",
        f"ends {early:.1f} s before" if early > least else "",
    ]
    return [finding("stream.short", short, parts=" and ".join(filter(None, parts)), other=long)]


def rhythm(rec: Recording) -> list[Finding]:
    """Find a stream at even intervals that leaves its rhythm once or twice, by less than an interval."""
    found = []
    for name, (usual, t) in _even(rec).items():
        off = _fraction(np.diff(t) / usual)
        odd = np.flatnonzero(np.abs(off) > MIN_JUMP)
        if 0 < odd.size <= 3:
            k = odd[np.abs(off[odd]).argmax()]
            side, more = "late" if off[k] > 0 else "early", f", and {odd.size - 1} more" if odd.size > 1 else ""
            size = abs(off[k]) * usual
            found.append(finding("time.jump", name, usual=usual, at=t[k + 1], size=size, side=side, more=more))
    return found


def stream_offset(rec: Recording) -> list[Finding]:
    """Find a constant offset between position and velocity at the same even intervals."""
    even = _even(rec)
    if len(even) < 2:
        return []
    (usual, t), (other, tv) = (even[name] for name in PAIR)
    after = t - tv[np.searchsorted(0.5 * (tv[1:] + tv[:-1]), t)]  # the nearest
    near = after[np.abs(after) < 0.6 * usual]
    if abs(usual / other - 1) > 1e-3 or near.size < 10:
        return []
    middle = float(np.median(near))
    if abs(middle) < MIN_OFFSET * usual or np.mean(np.abs(near - middle) < MAX_JITTER * usual) < 0.5:
        return []
    return [finding("time.stream_offset", value=middle, size=abs(middle), side="after" if middle > 0 else "before")]


def _even(rec: Recording) -> dict[str, tuple[float, np.ndarray]]:
    """Interval and times of position and velocity, where they keep a rhythm."""
    found = {}
    for name in PAIR:
        s = rec.aiding.get(name)
        if s is not None and s.t.size >= 20:
            usual = float(np.median(np.diff(s.t)))
            if np.mean(np.abs(_fraction(np.diff(s.t) / usual)) < MAX_JITTER) >= 0.9:
                found[name] = (usual, s.t)
    return found


def _fraction(intervals: np.ndarray) -> np.ndarray:
    """Return the distance from whole intervals."""
    return intervals - np.round(intervals)


def overlap(rec: Recording) -> list[Finding]:
    """Return how much of each stream is within the IMU's time."""
    first, last = rec.imu.t[0], rec.imu.t[-1]
    found = []
    for name, s in rec.aiding.items():
        share = float(np.mean((s.t >= first) & (s.t <= last)))
        covered = float((min(last, s.t[-1]) - max(first, s.t[0])) / max(last - first, 1e-9))
        if share < 0.9 or covered < 0.5:
            severity = None if share < 0.9 else Severity.INFO
            found.append(finding("time.overlap", name, 100 * share, covered=100 * max(covered, 0), severity=severity))
    return found
