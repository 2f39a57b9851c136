"""What became of every sample of a recording in a run, and whether the innovations are what the filter expects."""

from typing import Any, NamedTuple

import numpy as np

from jaxnav.analysis import evaluate, metrics
from jaxnav.data.checkup.inertial import noise_floor
from jaxnav.data.epochs import TICK, Packed
from jaxnav.maths import units
from jaxnav.measurements import Measurement, layout
from jaxnav.types import ImuLog, Info, Params, Recording

SURE = 0.9999  # probability of the bounds, of each channel
LOUD, ALIKE = 1.25, 0.3  # NIS of all channels, correlation of neighbours, from which on they are worth a sentence
LOUDER = 5.0  # times the noise that the filter is told, from which on it is worth a sentence
ALONE = 3.0  # times the noise of the other axes, from which on an axis is named
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


def channels_of(info: Info, measurements: tuple[Measurement, ...]) -> dict[str, Expected]:
    """Return the normalised innovations squared by channel of a report, where there are ten or more."""
    order, names, _ = evaluate.channels(measurements)
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


def consistency_in_words(info: Info, channels: dict[str, Expected]) -> list[str]:
    """Every way in which the innovations are not those of a filter that knows its errors; empty where they are.

    Channel by channel by their size; where each passes alone, all of them together; and as neighbours, for the
    innovations of a consistent filter are white.
    """
    lines = expected_in_words(channels)
    together = whole(info)
    if not lines and together is not None and together.value > max(together.high, LOUD):
        lines.append(
            f"innovations squared of all channels together are {together.value:.3g} times what the filter expects "
            f"({together.high:.2f} would pass), though each alone passes: noise, a sensor or a delay is somewhat other "
            "than it is told; see jaxnav check, jaxnav tune"
        )
    alike = {name: e for name, e in channels.items() if e.correlation > max(ALIKE, 4 / np.sqrt(e.samples))}
    if alike:
        worst = sorted(alike, key=lambda name: -alike[name].correlation)[:3]
        each = ", ".join(f"{name} {alike[name].correlation:.2f}" for name in worst)
        lines.append(
            f"innovations are correlated from one to the next in {each}{' and more' if len(alike) > 3 else ''}: an "
            "error lasts, as of a delay, a lever arm, a scale, or a receiver whose errors are slow (state "
            "gnss_position_error)"
        )
    return lines


def noise_in_words(imu: ImuLog, params: Params) -> list[str]:
    """A sentence where the sensors, or an axis, are louder than the filter is told, even where they are quietest."""
    floor = noise_floor(imu)
    if floor is None:
        return []
    lines = []
    for name, axes, nominal, unit, text in (
        ("gyro", floor[0], params.noise.gyro, units.DEG_PER_SQRT_HOUR, "deg/sqrt(h)"),
        ("accelerometer", floor[1], params.noise.accel, units.UG, "ug/sqrt(Hz)"),
    ):
        size = np.atleast_1d(np.asarray(nominal))
        known = float(np.sqrt(np.mean((np.linalg.norm(size, axis=1) if size.ndim == 2 else size) ** 2)))
        found, worst = float(np.median(axes)), int(axes.argmax())
        others = float(np.max(np.delete(axes, worst)))
        if found > LOUDER * known > 0:
            lines.append(
                f"{name} noise where it is quietest is {found / unit:.3g} {text}, {found / known:.0f} times what the "
                "filter is told: vibration, another grade, or a unit; see filter.grade, jaxnav check, jaxnav tune"
            )
        elif axes[worst] > LOUDER * known > 0 and axes[worst] > ALONE * others:
            lines.append(
                f"{name} {'xyz'[worst]} has a noise of {axes[worst] / unit:.3g} {text} where it is quietest, "
                f"{axes[worst] / known:.0f} times what the filter is told, the other axes at most {others / unit:.3g}: "
                "a sensor or wire that is failing, or values in coarse steps"
            )
    return lines


def whole(info: Info) -> Expected | None:
    """NIS per degree of freedom over all epochs whose channels were all used; None where there are fewer than ten."""
    valid = np.asarray(info.valid)
    own = valid.any(1) & (np.asarray(info.used) == valid).all(1)
    dof = int(valid[own].sum())
    if own.sum() < 10:
        return None
    low, high = metrics.chi2_bounds(dof, 1, SURE)
    return Expected(float(np.asarray(info.nis)[own].sum() / dof), float(low / dof), float(high / dof), dof, 0.0)


def as_json(uses: dict[str, Use], channels: dict[str, Expected]) -> dict[str, Any]:
    """Both as plain values."""
    return {
        "streams": {name: u._asdict() for name, u in uses.items()},
        "nis_by_channel": {name: e._asdict() for name, e in channels.items()},
    }
