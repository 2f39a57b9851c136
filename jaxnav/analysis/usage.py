"""What became of every sample of a recording in a run, and whether the innovations are what the filter expects."""

from typing import Any, NamedTuple

import numpy as np

from jaxnav.analysis import metrics
from jaxnav.data.epochs import TICK, Packed
from jaxnav.measurements import Measurement, layout
from jaxnav.types import Info, Recording

SURE = 0.9999  # probability of the bounds, of each channel
MUCH = 0.02  # share of a stream that is left out without a word


class Use(NamedTuple):
    """Of one stream, how many samples there are, and where they went."""

    read: int
    before: int  # the start
    outside: int  # the IMU's time, or the stop
    hidden: int  # by an outage that was asked for
    refused: int  # by the filter's rule
    used: int


def usage(
    rec: Recording, packed: Packed, info: Info, measurements: tuple[Measurement, ...], hidden: np.ndarray
) -> dict[str, Use]:
    """By stream; ``hidden`` (E,) bool: the epochs whose fixes are hidden. What no measurement takes is used 0 times."""
    slices, found = layout(measurements), {}
    for name, s in rec.aiding.items():
        if name not in slices:
            found[name] = Use(s.t.size, 0, 0, 0, 0, 0)
            continue
        before = int((s.t <= packed.start + TICK).sum())
        outside = int((s.t > packed.t[-1] + TICK).sum())
        own = slice(slices[name].start, slices[name].stop)
        there = np.asarray(packed.epochs.fix.valid)[:, own].any(1)
        receiver = next(m.receiver for m in measurements if m.name == name)
        lost = there & hidden if receiver else np.zeros_like(there)
        used = np.asarray(info.used)[:, own].any(1) & there & ~lost
        refused = int((there & ~lost & ~used).sum())
        found[name] = Use(s.t.size, before, outside, int(lost.sum()), refused, int(used.sum()))
    return found


def usage_in_words(found: dict[str, Use]) -> list[str]:
    """A sentence for every stream of which a user would miss samples."""
    lines = []
    for name, u in found.items():
        parts = [
            (u.before, "before the start"), (u.outside, "after the IMU's last sample, or the stop"),
            (u.refused, "refused by the filter's rule"), (u.hidden, "hidden as asked for"),
        ]  # fmt: skip
        gone = [f"{n} {why}" for n, why in parts if n > MUCH * u.read]
        if gone and u.used + u.refused + u.hidden > 0:
            lines.append(f"{name}: {u.used} of {u.read} samples used; {', '.join(gone)}")
        elif gone:
            lines.append(f"{name}: none of {u.read} samples used: {', '.join(gone)}")
    return lines


class Expected(NamedTuple):
    """Normalised innovations squared of a channel: 1 if the filter expects them as they are."""

    value: float
    low: float  # bounds of a consistent filter, with as many independent samples as the correlation leaves
    high: float
    samples: int
    correlation: float  # of neighbouring innovations


def expected(info: Info, names: list[str], order: list[int]) -> dict[str, Expected]:
    """By channel, ``names`` of the channels in ``order``."""
    z = metrics.normalized_innovations(info)[:, order]
    found = {}
    for name, column in zip(names, z.T, strict=True):
        there = np.isfinite(column)
        n = int(there.sum())
        if n < 10:
            continue
        x = column[there]
        value = float(np.mean(x**2))
        r = float(np.clip(np.mean(x[1:] * x[:-1]) / max(value, 1e-300), 0.0, 0.99))
        independent = max(2.0, n * (1 - r) / (1 + r))
        low, high = metrics.chi2_bounds(independent, 1, SURE)
        found[name] = Expected(value, float(low / independent), float(high / independent), n, r)
    return found


def expected_in_words(found: dict[str, Expected]) -> list[str]:
    """Which channels are not as expected, and what that usually means; empty where all are."""
    large = {name: e for name, e in found.items() if e.value > max(e.high, 1.3)}
    small = {name: e for name, e in found.items() if e.value < min(e.low, 0.7)}
    lines = []
    for which, said, means in (
        (large, "larger", "noise, delay, lever arm, axes or the start are other than the filter is told"),
        (small, "smaller", "the stated sd of the fixes, or the IMU's noise, are too large"),
    ):
        if which:
            worst = sorted(which, key=lambda name: -abs(np.log(which[name].value)))
            each = ", ".join(
                f"{name} {which[name].value:.3g} (1; up to {which[name].high:.2f} would pass)"
                if said == "larger"
                else f"{name} {which[name].value:.2g} (from {which[name].low:.2f} on)"
                for name in worst[:3]
            )
            more = f" and {len(worst) - 3} more" if len(worst) > 3 else ""
            lines.append(
                f"innovations squared are {said} than the filter expects in {each}{more}: {means}; "
                "see jaxnav check, jaxnav tune"
            )
    return lines


def as_json(uses: dict[str, Use], channels: dict[str, Expected]) -> dict[str, Any]:
    """Both as plain values."""
    return {
        "streams": {name: u._asdict() for name, u in uses.items()},
        "nis_by_channel": {name: e._asdict() for name, e in channels.items()},
    }
