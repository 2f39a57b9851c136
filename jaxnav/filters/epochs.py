"""From recorded streams to epochs: host numpy, once per recording.

The IMU stream is cut at the time of every fix. A sample that a fix falls into is split there; epochs are padded to
equal length with samples of dt = 0; an outage is cut into epochs of the nominal interval without a valid channel.
Regular, irregular, late and missing fixes then have one shape, and hiding a fix is an edit of a mask.
"""

from collections.abc import Collection, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters import gaps
from jaxnav.filters.cutting import cut_imu
from jaxnav.filters.programs import stored
from jaxnav.filters.standstill import Standing, constraint_samples, is_driving, stationary
from jaxnav.maths.units import TICK
from jaxnav.measurements import AUXILIARY, GNSS, Measurement, layout
from jaxnav.measurements.satellites import SATELLITE
from jaxnav.types import ConfigError, DataError, Epoch, Fix, Imu, ImuLog, Recording, Samples, nearest, require_double

MAX_EPOCHS = 10_000_000  # of a recording: ten minutes in steps of a microsecond, or a year at 0.3 Hz


class Packed(NamedTuple):
    """Epochs for a filter, and their times and counts for the host."""

    epochs: Epoch  # fields (E, k, ...) and (E, m), jax
    t: np.ndarray  # (E,) s, end of each epoch
    start: float  # s, where navigation starts


def cut_times(
    imu: ImuLog, aiding: dict[str, Samples], interval: float, start: float | None = None, stop: float | None = None
) -> np.ndarray:
    """Return the ends of epochs, (E,) s: every fix in the span, and every ``interval`` where there is none.

    Args:
        imu: the IMU's samples.
        aiding: streams of measurements by name.
        interval: s, length of epochs without a fix.
        start: s, begin of the span; None is that of the IMU.
        stop: s, its end; None is that of the IMU.

    Raises:
        DataError: the IMU does not cover the span, or no time is left.
    """
    first, last = imu.t[0] - imu.dt[0], imu.t[-1]
    start = first if start is None else start
    stop = last if stop is None else min(stop, last)
    if start < first - TICK or start >= stop:
        raise DataError(f"the IMU covers {first:.3f} to {last:.3f} s, which does not hold {start:.3f} to {stop:.3f} s")
    times = np.concatenate([s.t for s in aiding.values()]) if aiding else np.empty(0)
    times = np.unique(times[(times > start + TICK) & (times <= stop + TICK)])
    times = times[np.diff(times, prepend=-np.inf) > 2 * TICK]  # a fix belongs to a cut within that
    edges = np.concatenate([[start], times, [stop] if times.size == 0 or stop - times[-1] > 2 * TICK else []])
    if (stop - start) / interval > MAX_EPOCHS:
        raise DataError(f"interval = {interval:g} s cuts {stop - start:g} s into more than {MAX_EPOCHS:,} epochs")
    cuts = []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        n = max(1, int(np.ceil((b - a) / interval - 1e-3)))  # a fix 0.1 % late starts no extra epoch
        cuts.append(np.concatenate([a + interval * np.arange(1, n), [b]]))
    return np.concatenate(cuts)


def pack(
    imu: ImuLog,
    aiding: dict[str, Samples],
    interval: float,
    measurements: tuple[Measurement, ...] = GNSS,
    start: float | None = None,
    stop: float | None = None,
    cuts: np.ndarray | None = None,
) -> Packed:
    """Cut a recording into epochs for a filter.

    A hole in the IMU's stream is filled (`jaxnav.filters.gaps`), with the noise that such a fill has elsewhere in the
    log. Of auxiliary streams (`jaxnav.measurements.auxiliary.AUXILIARY`) an epoch has the last value before its end.

    Args:
        imu: the IMU's samples.
        aiding: streams of measurements by name.
        interval: s, nominal fix interval, the length of epochs without a fix.
        measurements: rows of the filter, in its order.
        start: s, begin of the span; None is that of the IMU.
        stop: s, its end; None is that of the IMU.
        cuts: (E,) s, known ends of epochs (`cut_times`).

    Returns:
        Epochs (E, k, ...) with their times and counts.

    Raises:
        DataError: a stream that no measurement uses, of another shape, unsorted, not finite, with an sd <= 0 or in
            degrees; a fix between the given ``cuts``; or too many epochs.
    """
    slices, by_name = layout(measurements), {m.name: m for m in measurements}
    auxiliary = {name: s for name, s in aiding.items() if name in AUXILIARY}
    aiding = {name: s for name, s in aiding.items() if name not in auxiliary}
    for name in aiding:
        if name not in slices:
            raise DataError(f"no measurement of the filter takes {name!r}: {nearest(name, slices)}")
    _check_imu(imu)
    for name, stream in aiding.items():
        _check_samples(name, stream, slices[name].stop - slices[name].start, by_name[name].auxiliary)
    for name, stream in auxiliary.items():
        _check_samples(name, stream, 1)
    if not (np.isfinite(interval) and interval > 0):
        raise DataError(f"interval must be positive, got {interval} s")
    imu, holes = gaps.fill(imu)
    cuts = cut_times(imu, aiding, interval, start, stop) if cuts is None else cuts
    begin = float(imu.t[0] - imu.dt[0] if start is None else start)
    samples = cut_imu(imu, begin, cuts)
    fix = _align_fixes(aiding, measurements, begin, cuts)
    gap = gap_noise(holes, begin, cuts) if holes.begin.size else None
    epochs = Epoch(Imu(*(jnp.asarray(a, float) for a in samples)), fix, gap, _held(auxiliary, cuts))
    return Packed(epochs, cuts, begin)


def _check_imu(imu: ImuLog) -> None:
    """Raise DataError for a log that is not sorted, finite and of one length."""
    n = np.shape(imu.t)[0] if np.ndim(imu.t) == 1 else 0
    if not n:
        raise DataError(f"imu: t must be (N,) with N > 0, got {np.shape(imu.t)}")
    for name, shape in (("dt", (n,)), ("gyro", (n, 3)), ("accel", (n, 3))):
        if np.shape(getattr(imu, name)) != shape:
            raise DataError(f"imu: {name} must be {shape}, as t says, got {np.shape(getattr(imu, name))}")
    _check_rows("imu", imu.t, *imu[1:])
    if not np.all(imu.dt > 0):
        raise DataError(f"imu: dt must be > 0, is {imu.dt.min():g} at t = {imu.t[int(imu.dt.argmin())]:.3f} s")


def _check_samples(name: str, s: Samples, size: int, auxiliary: tuple[str, ...] = ()) -> None:
    """Raise DataError for a stream that a filter cannot use."""
    K = np.shape(s.t)[0] if np.ndim(s.t) == 1 else -1
    for field in ("value", "sd", "corr"):
        if np.shape(getattr(s, field)) != (K, size):
            raise DataError(f"{name}: {field} must be {(K, size)}, got {np.shape(getattr(s, field))}")
    if s.valid is not None and np.shape(s.valid) != (K, size):
        raise DataError(f"{name}: valid must be {(K, size)}, got {np.shape(s.valid)}")
    more = np.zeros((K, size, 0)) if s.auxiliary is None else s.auxiliary
    if np.shape(more) != (K, size, len(auxiliary)):
        raise DataError(f"{name}: auxiliary must be {(K, size, len(auxiliary))}, got {np.shape(more)}")
    require_double(name, s.value)
    _check_rows(name, s.t, s.value, s.sd, s.corr, more)
    if not np.all(s.sd > 0):
        raise DataError(f"{name}: sd must be > 0, is {s.sd.min():g} at t = {s.t[int(s.sd.min(1).argmin())]:.3f} s")
    if name == "position" and K and np.abs(s.value[:, :2]).max() > 2 * np.pi:
        raise DataError("position: latitude and longitude are in radians, these look like degrees")


def _check_rows(name: str, t: np.ndarray, *columns: np.ndarray) -> None:
    """Raise DataError where times do not increase or a number is not finite."""
    for a in (t, *columns):
        bad = ~np.isfinite(a).reshape(len(t), -1).all(1) if len(t) else np.zeros(0, bool)
        if bad.any():
            raise DataError(f"{name}: row {int(bad.argmax())} has a value that is not finite")
    if np.any(np.diff(t) <= 0):
        i = int(np.argmax(np.diff(t) <= 0))
        raise DataError(f"{name}: times must increase, row {i + 1} is {t[i + 1]:.6f} s after {t[i]:.6f} s")


def _held(auxiliary: dict[str, Samples], cuts: np.ndarray) -> dict[str, jax.Array]:
    """Return the last value (E,) of each auxiliary stream before the ends of epochs; the first one before that."""
    last = lambda s: np.maximum(np.searchsorted(s.t, cuts + TICK) - 1, 0)
    return {name: jnp.asarray(s.value[last(s), 0], float) for name, s in auxiliary.items()}


def gap_noise(holes: gaps.Holes, start: float, cuts: np.ndarray) -> jnp.ndarray:
    """Root PSD (E, 2) that holes add to the noise of epochs: that of the hole, for the share of it in the epoch."""
    begin = np.concatenate([[start], cuts[:-1]])
    shared = np.minimum(cuts[:, None], holes.end) - np.maximum(begin[:, None], holes.begin)
    density = np.maximum(shared, 0.0) @ holes.noise**2 / (cuts - begin)[:, None]
    return jnp.asarray(np.sqrt(density))


def _align_fixes(
    aiding: dict[str, Samples], measurements: tuple[Measurement, ...], start: float, cuts: np.ndarray
) -> Fix:
    E, m, slices = cuts.size, sum(each.size for each in measurements), layout(measurements)
    auxiliary = {each.name: np.zeros((E, each.size, len(each.auxiliary))) for each in measurements if each.auxiliary}
    value, sd = np.zeros((E, m)), np.ones((E, m))
    corr, valid = np.zeros((E, m)), np.zeros((E, m), bool)
    for name, s in aiding.items():
        where = np.searchsorted(cuts, s.t - 2 * TICK)
        hit = (where < E) & (np.abs(cuts[np.minimum(where, E - 1)] - s.t) <= 2 * TICK)
        lost = (s.t > start + TICK) & (s.t < cuts[-1]) & ~hit
        if lost.any():
            raise DataError(f"{name}: the fix at t = {s.t[lost][0]:.6f} s is not at the end of an epoch: cut there")
        rows = where[hit]
        for field, data in ((value, s.value), (sd, s.sd), (corr, s.corr)):
            field[rows, slices[name]] = data[hit]
        valid[rows, slices[name]] = True if s.valid is None else s.valid[hit]
        if name in auxiliary and s.auxiliary is not None:
            auxiliary[name][rows] = s.auxiliary[hit]
    fix = Fix(jnp.asarray(value, float), jnp.asarray(sd, float), jnp.asarray(corr, float), jnp.asarray(valid))
    return fix._replace(auxiliary={name: jnp.asarray(a, float) for name, a in auxiliary.items()})


@stored
def _shown(valid: jax.Array, hidden: jax.Array, receiver: jax.Array) -> jax.Array:
    return valid & ~(hidden[..., None] & receiver)


@partial(stored, static_argnums=(2,))
def _highest(valid: jax.Array, elevation: jax.Array, count: int) -> jax.Array:
    """Return the valid channels (E, s) of the highest satellites of each epoch."""
    order = jnp.argsort(jnp.argsort(jnp.where(valid, -elevation, jnp.inf), axis=-1), axis=-1)
    return valid & (order < count)


def hide(epochs: Epoch, hidden: np.ndarray, measurements: tuple[Measurement, ...] = GNSS, satellites: int = 0) -> Epoch:
    """Return epochs without the receiver's channels where ``hidden``; constraints stay.

    Args:
        epochs: (E, ...) of one run.
        hidden: (E,) bool.
        measurements: rows of the filter, in its order.
        satellites: how many of the highest of an epoch stay.
    """
    receiver = np.concatenate([np.full(m.size, m.receiver) for m in measurements])
    valid = _shown(epochs.fix.valid, jnp.asarray(hidden), receiver)
    for name, place in layout(measurements).items() if satellites else ():
        if name in epochs.fix.auxiliary:
            there = epochs.fix.valid[..., place]
            elevation = epochs.fix.auxiliary[name][..., SATELLITE.index("elevation_rad")]
            kept = jnp.where(jnp.asarray(hidden)[..., None], _highest(there, elevation, satellites), there)
            valid = valid.at[..., place].set(kept)
    return epochs._replace(fix=epochs.fix._replace(valid=valid))


def bucket_size(n: int) -> int:
    """Return the least size not below n of those that arrays are padded to: 4, 5, 6 or 7 times a power of two."""
    step = 2 ** max(0, n.bit_length() - 3)
    return -(-n // step) * step


def pad_to_bucket(epochs: Epoch) -> Epoch:
    """Pad epochs (E, K) of one run to sizes that recordings share: a program compiled for one of them serves others.

    See `pad_epochs`.
    """
    return pad_epochs(epochs, *map(bucket_size, epochs.imu.dt.shape))


def pad_epochs(epochs: Epoch, size: int, samples: int) -> Epoch:
    """Epochs (E, K) of one run as (size, samples), neither of them less than it was.

    Padding lasts no time and has no fix, so that it changes nothing; it comes last, in an epoch and in the run.
    """
    more, longer = size - epochs.imu.dt.shape[0], samples - epochs.imu.dt.shape[1]
    epochs = jax.device_get(epochs)  # on the host, where no program is compiled for it
    rows = lambda a: np.concatenate([a, np.repeat(a[-1:], more, 0)])
    wide = lambda a: rows(np.concatenate([a, np.repeat(a[:, -1:], longer, 1)], 1))
    nothing = lambda a, *n: np.pad(a, [(0, k) for k in n] + [(0, 0)] * (a.ndim - len(n)))
    imu = jax.tree.map(wide, epochs.imu)._replace(dt=nothing(epochs.imu.dt, more, longer))
    fix = jax.tree.map(rows, epochs.fix)._replace(
        valid=nothing(epochs.fix.valid, more), auxiliary={k: nothing(a, more) for k, a in epochs.fix.auxiliary.items()}
    )
    gap = None if epochs.gap is None else nothing(epochs.gap, more)
    return Epoch(imu, fix, gap, {name: rows(a) for name, a in epochs.auxiliary.items()})


def stack_epochs(runs: Sequence[Epoch]) -> Epoch:
    """Stack epochs of recordings of different lengths into one batch (B, E, K, ...), for `jax.vmap` over `run`.

    Shorter ones are padded as in `pad_epochs`; a run's recorded epochs come first.

    Args:
        runs: epochs (E, K, ...) of each recording.

    Raises:
        ValueError: nothing to stack, or runs of different measurements.
    """
    channels = {epochs.fix.value.shape[-1] for epochs in runs}
    if len(channels) != 1:
        raise ValueError(f"stack_epochs takes runs of the same measurements, got {sorted(channels)} channels")
    size, samples = (max(epochs.imu.dt.shape[axis] for epochs in runs) for axis in (0, 1))
    if any(epochs.gap is not None for epochs in runs):
        none = lambda epochs: np.zeros((epochs.imu.dt.shape[0], 2))
        runs = [epochs if epochs.gap is not None else epochs._replace(gap=none(epochs)) for epochs in runs]
    common = set.intersection(*(set(epochs.auxiliary) for epochs in runs))
    runs = [epochs._replace(auxiliary={name: epochs.auxiliary[name] for name in sorted(common)}) for epochs in runs]
    return jax.tree.map(lambda *a: np.stack(a), *(pad_epochs(epochs, size, samples) for epochs in runs))


def outage_windows(t: np.ndarray, starts: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the epochs in windows start < t <= start + length, and each window's last epoch.

    >>> hidden, last = outage_windows(np.arange(10.0), np.array([2.0, 6.0]), 2.0)
    >>> np.flatnonzero(hidden), last
    (array([3, 4, 7, 8]), array([4, 8]))

    Args:
        t: (E,) s, ends of epochs.
        starts: (W,) s.
        length: s, of every window.

    Returns:
        Hidden epochs (E,) bool, and the last epoch of each window (W,) int.

    Raises:
        DataError: a window in which no epoch ends.
    """
    inside = np.array([within(t, [(start, start + length)]) for start in starts], bool).reshape(len(starts), t.size)
    if not inside.any(1).all():
        raise DataError(f"no epoch in the outage that starts at {starts[~inside.any(1)][0]:.3f} s")
    return np.any(inside, axis=0), t.size - 1 - inside[:, ::-1].argmax(1)


# ---------------------------------------------------------------------------- a whole recording


MAX_FALSE_STANDSTILLS = 0.1  # of the epochs at rest by the detector, at most, that are in motion by the receiver


def pack_recording(
    rec: Recording,
    measurements: tuple[Measurement, ...],
    start: float,
    interval: float = 0.0,
    stop: float | None = None,
    standing: Standing = Standing(),
    sees: Collection[str] | None = None,
) -> Packed:
    """Epochs of a recording from ``start`` s on, with the constraints that are among the filter's ``measurements``.

    ``interval``: s, of epochs without a fix; 0 is the median of the position's. ``sees``: names of those measurements
    that are taken, by default all; the channels of others stay, without a fix.

    Raises:
        DataError: a measurement without a stream in the recording, or as in `pack`.
        ConfigError: a detector of standstills that takes a drive for one.
    """
    seen = tuple(m for m in measurements if sees is None or m.name in sees)
    carried = {m.name for m in seen if m.has_data}
    for name in sorted(carried - set(rec.aiding) - {"velocity"}):
        raise DataError(f"{rec.name}: has no stream {name}, which the filter takes")
    aiding = {name: s for name, s in rec.aiding.items() if name in carried or name in AUXILIARY}
    interval = interval or float(np.median(np.diff(rec.aiding["position"].t)))
    measured = {name: s for name, s in aiding.items() if name in carried}
    cuts = cut_times(rec.imu, measured, interval, start, stop)
    still = None
    if any(m.at_rest for m in seen):
        still = stationary(rec.imu, cuts, *standing)
        _check_standing(rec, cuts[still])
    aiding |= constraint_samples(rec.imu, cuts, seen, still, standing.window)
    return pack(rec.imu, aiding, interval, measurements, start, stop, cuts)


def _check_standing(rec: Recording, t: np.ndarray) -> None:
    """Raise ConfigError where the detector takes a smooth drive for a standstill.

    One in `MAX_FALSE_STANDSTILLS` is let pass: which epochs these are must not be known where fixes are hidden.
    """
    if "velocity" not in rec.aiding or not t.size:
        return
    moving = is_driving(rec.aiding["velocity"], t)
    if moving.mean() > MAX_FALSE_STANDSTILLS:
        raise ConfigError(
            f"filter.standing_accel_sd_mps2, standing_gyro_sd_deg_per_s: {moving.sum()} of {t.size} epochs that these "
            f"take for rest have a velocity of over 0.5 m/s, the first at {t[moving][0]:.3f} s: lower them"
        )


def in_windows(t: np.ndarray, windows: Sequence[Sequence[float]]) -> np.ndarray:
    """Epochs, ending at t (E,) s, in any of the windows start < t <= end, bool (E,); windows before all are allowed.

    Raises:
        ConfigError: a window that is not (start, end), or a later one in which no epoch ends.
    """
    for window in windows:
        if len(window) != 2 or not window[1] > window[0]:
            raise ConfigError(f"filter.outages: expected [start, end] with start < end, got {list(window)}")
        if window[1] > t[0] and not within(t, [window]).any():
            raise ConfigError(f"filter.outages: {list(window)} holds no epoch, they end from {t[0]:g} to {t[-1]:g} s")
    return within(t, windows)


def within(t: np.ndarray, windows: Sequence[Sequence[float]]) -> np.ndarray:
    """Which of the times t (E,) s are in any of the windows start < t <= end, bool (E,)."""
    return np.any([(t > a + TICK) & (t <= b + TICK) for a, b in windows] or [np.zeros(t.size, bool)], axis=0)
