"""Use of every sample of a recording in a run, and consistency of the innovations."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxnav.analysis import evaluate, metrics
from jaxnav.checkup.inertial import noise_floor
from jaxnav.filters.epochs import Packed
from jaxnav.filters.scores import mean_nis
from jaxnav.findings import finding
from jaxnav.gnss import ranges
from jaxnav.io.missing import UNMEASURED_SD
from jaxnav.maths import units
from jaxnav.maths.units import TICK
from jaxnav.measurements import Measurement, layout
from jaxnav.measurements.measurement import references
from jaxnav.measurements.satellites import SATELLITE
from jaxnav.types import Finding, ImuLog, Info, Json, Params, Recording

BOUND_PROBABILITY = 0.9999  # probability of the bounds, of each channel
MIN_NIS, MIN_CORRELATION = 1.25, 0.3  # NIS of all channels and correlation of neighbours below these make no finding
MAX_NOISE_RATIO = 5.0  # times the assumed noise; above it is a finding
AXIS_NOISE_RATIO = 3.0  # times the noise of the other axes, from which on an axis is named
MAX_UNUSED_SHARE = 0.02  # share of a stream that is left out without a word


class Use(NamedTuple):
    """Samples of one stream: how many there are, and where they went."""

    read: int
    before: int  # the start
    outside: int  # the IMU's time, or the stop
    hidden: int  # by an outage that was asked for
    refused: int  # by the filter's rule
    used: int


def usage(
    rec: Recording, packed: Packed, info: Info, measurements: tuple[Measurement, ...], hidden: np.ndarray
) -> dict[str, Use]:
    """Return the use by stream; ``hidden`` (E,) bool: epochs with hidden fixes. An unmeasured stream has 0 used.

    Fixes that ranges of satellites stand for are left out (`jaxnav.measurements.measurement.references`).
    """
    slices, found, compared = layout(measurements), {}, references(measurements)
    for name, s in rec.aiding.items():
        if name in compared:
            continue
        if name not in slices:
            found[name] = Use(s.t.size, 0, 0, 0, 0, 0)
            continue
        before = int((s.t <= packed.start + TICK).sum())
        outside = int((s.t > packed.t[-1] + TICK).sum())
        place = slice(slices[name].start, slices[name].stop)
        there = np.asarray(packed.epochs.fix.valid)[:, place].any(1)
        receiver = next(m.receiver for m in measurements if m.name == name)
        lost = there & hidden if receiver else np.zeros_like(there)
        used = np.asarray(info.used)[:, place].any(1) & there & ~lost
        refused = int((there & ~lost & ~used).sum())
        found[name] = Use(s.t.size, before, outside, int(lost.sum()), refused, int(used.sum()))
    return found


def usage_findings(found: dict[str, Use]) -> list[Finding]:
    """Return a finding for every stream with unused samples that a user would miss."""
    out = []
    for name, u in found.items():
        parts = [
            (u.before, "before the start"),
            (u.outside, "after the IMU's last sample, or the stop"),
            (u.refused, "refused by the filter's rule"),
            (u.hidden, "hidden as asked for"),
        ]
        why = ", ".join(f"{n} {where}" for n, where in parts if n > MAX_UNUSED_SHARE * u.read)
        if why:
            code = "stream.unused" if u.used + u.refused + u.hidden > 0 else "stream.refused"
            out.append(finding(code, name, float(u.used), used=u.used, read=u.read, why=why))
    return out


MIN_REJECTED, MIN_REJECTED_SHARE = 10, 0.1  # pseudoranges of a satellite, and share of them, that a finding names


def satellite_findings(packed: Packed, info: Info, measurements: tuple[Measurement, ...]) -> list[Finding]:
    """Return a finding for every satellite of which the gate rejected more than a few pseudoranges."""
    place = layout(measurements).get("pseudorange")
    if place is None:
        return []
    number = np.asarray(packed.epochs.fix.auxiliary["pseudorange"])[..., SATELLITE.index("satellite")]
    valid, used, nu = (np.asarray(a)[:, place] for a in (info.valid, info.used, info.nu))
    out = []
    for each in np.unique(number[valid]):
        seen = valid & (number == each)
        refused = seen & ~used
        count, read = int(refused.sum()), int(seen.sum())
        if count < max(MIN_REJECTED, MIN_REJECTED_SHARE * read):
            continue
        t = packed.t[refused.any(1)]
        size = float(np.median(np.abs(nu[refused])))
        out.append(
            finding(
                "satellite.rejected", ranges.name(int(each)), size, rejected=count, read=read, first=t[0], last=t[-1]
            )
        )
    return out


class ChannelNis(NamedTuple):
    """Normalised innovations squared of a channel: 1 if the filter expects them as they are."""

    value: float
    low: float  # bounds of a consistent filter, with as many independent samples as the correlation leaves
    high: float
    samples: int
    correlation: float  # of neighbouring innovations


def nis_by_channel(info: Info, measurements: tuple[Measurement, ...]) -> dict[str, ChannelNis]:
    """Return the normalised innovations squared by channel of a report, where ten or more measured something."""
    order, names, _ = evaluate.channel_names(measurements)
    z = metrics.normalized_innovations(info)[:, order]
    spread = np.sqrt(np.diagonal(np.asarray(info.S), axis1=-2, axis2=-1))[:, order]
    z = np.where(spread < 0.1 * UNMEASURED_SD, z, np.nan)  # a receiver without a vertical velocity, say
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
        low, high = metrics.chi2_bounds(independent, 1, BOUND_PROBABILITY)
        found[name] = ChannelNis(value, float(low / independent), float(high / independent), n, r)
    return found


def _worst(channels: dict[str, ChannelNis], size: Callable[[ChannelNis], float]) -> Json:
    """Return subject and numbers of the three worst of some channels."""
    names = sorted(channels, key=lambda name: -abs(size(channels[name])))
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return {"subject": ", ".join(names[:3]) + more, "names": names[:3]}


def channel_findings(channels: dict[str, ChannelNis]) -> list[Finding]:
    """Return which channels' innovations are larger, or smaller, than their predicted variance."""
    high = {name: e for name, e in channels.items() if e.value > max(e.high, 1.3)}
    low = {name: e for name, e in channels.items() if e.value < min(e.low, 0.7)}
    out = []
    for code, which in (("nis.high", high), ("nis.low", low)):
        if which:
            worst = _worst(which, lambda e: float(np.log(e.value)))
            names = worst.pop("names")
            vector = ", ".join(f"{which[name].value:.3g}" for name in names)
            first = which[names[0]]
            limit = first.high if code == "nis.high" else first.low
            out.append(finding(code, value=first.value, limit=limit, vector=vector, **worst))
    return out


def consistency_findings(info: Info, channels: dict[str, ChannelNis]) -> list[Finding]:
    """Return every inconsistency of the innovations with a consistent filter.

    Channel by channel by their size; where each passes alone, all of them together; and as neighbours, for the
    innovations of a consistent filter are white.
    """
    out = channel_findings(channels)
    together = nis_overall(info)
    if not out and together is not None and together.value > max(together.high, MIN_NIS):
        out.append(finding("nis.overall", value=together.value, limit=together.high))
    alike = {name: e for name, e in channels.items() if e.correlation > max(MIN_CORRELATION, 4 / np.sqrt(e.samples))}
    if alike:
        worst = _worst(alike, lambda e: e.correlation)
        names = worst.pop("names")
        vector = ", ".join(f"{alike[name].correlation:.2f}" for name in names)
        out.append(finding("innovations.correlated", value=alike[names[0]].correlation, vector=vector, **worst))
    return out


def noise_findings(imu: ImuLog, params: Params) -> list[Finding]:
    """Return the sensors, or an axis, with noise in the quietest seconds far above the assumed."""
    floor = noise_floor(imu)
    if floor is None:
        return []
    out = []
    for name, axes, nominal, unit, unit_text in (
        ("gyro", floor[0], params.noise.gyro, units.DEG_PER_SQRT_HOUR, "deg/sqrt(h)"),
        ("accelerometer", floor[1], params.noise.accel, units.UG, "ug/sqrt(Hz)"),
    ):
        size = np.atleast_1d(np.asarray(nominal))
        known = float(np.sqrt(np.mean((np.linalg.norm(size, axis=1) if size.ndim == 2 else size) ** 2)))
        found, worst = float(np.median(axes)), int(axes.argmax())
        others = float(np.max(np.delete(axes, worst)))
        if found > MAX_NOISE_RATIO * known > 0:
            value, limit = found / unit, known / unit
            out.append(finding("imu.noise_high", name, value, limit, unit_text=unit_text, ratio=found / known))
        elif axes[worst] > MAX_NOISE_RATIO * known > 0 and axes[worst] > AXIS_NOISE_RATIO * others:
            value, ratio = float(axes[worst]) / unit, float(axes[worst]) / known
            subject = f"{name} {'xyz'[worst]}"
            out.append(finding("imu.noise_axis", subject, value, others / unit, unit_text=unit_text, ratio=ratio))
    return out


def nis_overall(info: Info) -> ChannelNis | None:
    """Return NIS per degree of freedom over epochs with all channels used; None for fewer than ten."""
    valid = np.asarray(info.valid)
    complete = valid.any(1) & (np.asarray(info.used) == valid).all(1)
    dof = int(valid[complete].sum())
    if complete.sum() < 10:
        return None
    low, high = metrics.chi2_bounds(dof, 1, BOUND_PROBABILITY)
    return ChannelNis(mean_nis(info, complete), float(low / dof), float(high / dof), dof, 0.0)


def as_json(uses: dict[str, Use], channels: dict[str, ChannelNis]) -> Json:
    """Both as plain values."""
    return {
        "streams": {name: u._asdict() for name, u in uses.items()},
        "nis_by_channel": {name: e._asdict() for name, e in channels.items()},
    }
