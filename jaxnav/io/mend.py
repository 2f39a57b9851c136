"""From the rows of a file to a recording that passes every check; every change is a sentence in its notes.

Harmless omissions are made and counted; a loss that would make the rest a guess is one `DataError`.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.io import missing, polling
from jaxnav.io.checks import check_recording, uncertainty
from jaxnav.io.files import MAX_VALUE, Source
from jaxnav.io.parts import INCREMENTS, INSTANTANEOUS, ImuRows, Parts, Stream, TimeScale
from jaxnav.maths.axes import rotation
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK, week_shift
from jaxnav.measurements import AUXILIARY, with_data
from jaxnav.types import DataError, Finding, ImuLog, Note, Recording, Samples

MAX_BAD_SHARE = 0.05  # share of rows that may be left out; with more, the file is probably of another kind
GAP_STEPS = 2.5  # median steps: a longer one is a gap, without samples
MAX_GAP_S = 3600.0  # s; rows on the two sides of a longer gap are two recordings, or a clock that was set
MIN_SD, MAX_SD = 1e-9, 1e9  # of a stated sd; others say nothing
MAX_TIME_S = 1e7  # s; later times are counted from the first sample, since a float would round them to 1e-7 s
MIN_RATE_HZ = 20.0  # Hz; an IMU slower than this averages the motion away


class Changes(NamedTuple):
    """Settings of a user in place of a file's values; None is as in the file."""

    name: str | None = None
    axes: str | list[float] | None = None  # of the sensor, see `jaxnav.maths.axes.rotation`
    accel_sign: float = 1.0  # -1: the accelerometer reads gravity, +9.8 downwards at rest, not specific force
    lever_arm: tuple[float, float, float] | None = None  # m, IMU -> antenna, body FRD
    time_shift_s: float = 0.0  # s, added to the times of the IMU
    time_scale: str | None = None  # of the IMU: "gps" or "utc", see `jaxnav.reading.timescale`
    sd: dict[str, float | list[float]] = {}  # by stream, instead of the file's
    part: int | None = None  # of a log whose clock starts again, from 1; None: the longest
    repair: bool = False  # mend an IMU's log that was polled, see `jaxnav.io.polling`


def applied(parts: Parts, changes: Changes) -> Parts:
    """Return the parts with the user's settings in place of the file's values.

    Raises:
        DataError: an sd for a stream that is not there, or of another size, or another sign than 1 and -1.
    """
    unknown = set(changes.sd) - set(parts.aiding)
    if unknown:
        raise DataError(f"{parts.file}: sd: no stream {sorted(unknown)[0]}, it has {', '.join(parts.aiding) or 'none'}")
    aiding = dict(parts.aiding)
    for name, sd in changes.sd.items():
        value = np.asarray(aiding[name].value)
        try:
            aiding[name] = aiding[name]._replace(sd=np.broadcast_to(np.asarray(sd, float), value.shape))
        except ValueError:
            raise DataError(f"{parts.file}: sd: {name}: expected 1 or {value.shape[1]} numbers, got {sd!r}") from None
    imu = parts.imu
    if changes.accel_sign not in (1, -1):
        raise DataError(f"{parts.file}: accel_sign: expected 1 or -1, got {changes.accel_sign!r}")
    if imu is not None and changes.accel_sign < 0:
        imu = imu._replace(accel=-np.asarray(imu.accel, float))
    if imu is not None and changes.time_shift_s:
        imu = imu._replace(t=np.asarray(imu.t, float) + changes.time_shift_s)
    if changes.time_scale is not None and changes.time_scale not in tuple(TimeScale):
        raise DataError(f"{parts.file}: time_scale: expected {', '.join(TimeScale)}, got {changes.time_scale!r}")
    if imu is not None and changes.time_scale is not None:
        imu = imu._replace(scale=TimeScale(changes.time_scale))
    if imu is not None and changes.repair:
        imu = imu._replace(repair=True)
    said = {key: value for key, value in changes._asdict().items() if key in ("name", "axes") and value is not None}
    if changes.lever_arm is not None:
        said["lever_arm"] = np.asarray(changes.lever_arm, float)
    return parts._replace(imu=imu, aiding=aiding, **said)


def mended(parts: Parts) -> Recording:
    """Return the checked recording of the parts, in body FRD, with a sentence in ``notes`` for every change.

    Raises:
        DataError: no IMU, more than one row in twenty unusable, or anything that `check_recording` refuses.
    """
    if parts.imu is None:
        held = ", ".join(parts.aiding) or "nothing that is read"
        raise DataError(f"{parts.file}: holds {held} and no IMU: read the IMU's file with gnss={parts.file!r}")
    notes = list(parts.notes)
    turn = rotation(parts.axes)
    imu = _imu(parts.imu, turn, parts, notes)
    aiding = {}
    streams = without_fix(parts.aiding)
    for key, stream in streams.items():
        if stream.turns:
            stream = stream._replace(value=stream.value @ turn.T)
        samples = _samples(key, stream, imu, parts.file, notes)
        if samples is not None:
            aiding[key] = samples
    truth = parts.truth
    if imu.t[0] >= MAX_TIME_S:  # the IMU's zero is everybody's
        zero = float(imu.t[0] - imu.dt[0])
        notes.append(finding("time.zero", words=f"{zero:.6f} s in the file's time"))
        imu = imu._replace(t=imu.t - zero)
        aiding = {key: samples._replace(t=samples.t - zero) for key, samples in aiding.items()}
        truth = None if truth is None else truth._replace(t=truth.t - zero)
    if "velocity" not in aiding and "position" in aiding:
        notes.append(finding("velocity.none"))
    name, arm = parts.name or parts.file, np.asarray(parts.lever_arm, float)
    said = list(dict.fromkeys(notes))
    found = tuple(note for note in said if isinstance(note, Finding))
    words = "\n".join(note for note in said if isinstance(note, str))
    rec = Recording(name, imu, aiding, truth, arm, words, findings=found)
    return check_recording(rec, dict.fromkeys(("imu", "truth", "lever_arm", *aiding), Source(parts.file)))


def without_fix(aiding: dict[str, Stream]) -> dict[str, Stream]:
    """Return the streams with nan for velocities of exactly 0 at the time of a position that stands for none."""
    if not {"position", "velocity"} <= set(aiding):
        return aiding
    position, velocity = aiding["position"], aiding["velocity"]
    lost = np.asarray(position.t)[missing.no_position(np.asarray(position.value, float))]
    zero = np.isin(velocity.t, lost) & (np.asarray(velocity.value)[:, :2] == 0).all(axis=1)
    value = np.where(zero[:, None], np.nan, velocity.value)
    return aiding | {"velocity": velocity._replace(value=value)}


def _imu(rows: ImuRows, turn: np.ndarray, parts: Parts, notes: list[Note]) -> ImuLog:
    columns = (*rows.gyro.T, *rows.accel.T)
    keep = usable("imu", rows.t, columns, parts.file, notes, parts.lines)
    keep &= _one_piece(rows.t, keep, notes)
    if not keep.all():
        stated = None if rows.dt is None else rows.dt[keep]
        rows = rows._replace(t=rows.t[keep], gyro=rows.gyro[keep], accel=rows.accel[keep], dt=stated)
    t, gyro, accel, stated = rows.t, rows.gyro, rows.accel, rows.dt
    if len(t) < 3:
        raise DataError(f"{parts.file}: imu: expected three rows or more, got {len(t)}")
    if rows.repair:
        t, values = _mended(t, np.hstack([gyro, accel]), notes)
        gyro, accel, stated = values[:, :3], values[:, 3:], None
    dt = _intervals(t, stated, notes)
    repeated = int(np.logical_and.reduce([a[1:] == a[:-1] for a in (*gyro.T, *accel.T)]).sum())
    if repeated:
        notes.append(finding("rows.repeated", "imu", count=repeated, of=len(t)))
    if rows.sampling == INCREMENTS:
        gyro, accel = gyro / dt[:, None], accel / dt[:, None]
    elif rows.sampling == INSTANTANEOUS:
        whole = np.r_[False, t[1:] - dt[1:] - t[:-1] < 1e-9]  # behind a gap a value has no neighbour
        gyro, accel = (np.where(whole[:, None], 0.5 * (a + np.roll(a, 1, axis=0)), a) for a in (gyro, accel))
    imu = ImuLog(t, dt, gyro @ turn.T, accel @ turn.T)
    _gravity_axis(imu, notes)
    return imu


def _mended(t: np.ndarray, values: np.ndarray, notes: list[Note]) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values of a polled log on the sensor's even clock; unchanged with gaps or without losses."""
    step = np.diff(t)
    if (step > GAP_STEPS * np.median(step)).any():
        notes.append(finding("imu.unmended", "imu"))
        return t, values
    mended = polling.repair(values)
    if not mended.lost.any():
        return t, values
    index, seen = np.arange(mended.lost.size), ~mended.lost
    interval, first = np.polyfit(index[seen], t[mended.poll[seen]], 1)
    repeated = int(polling.repeats(values).sum())
    lost = int(mended.lost.sum())
    notes.append(finding("imu.mended", "imu", 1e3 * float(interval), count=repeated, lost=lost))
    return first + interval * index, mended.values


def usable(
    name: str,
    t: np.ndarray,
    columns: Iterable[np.ndarray],
    file: str,
    notes: list[Note],
    lines: np.ndarray | None = None,
) -> np.ndarray:
    """(N,) bool, rows that are finite and later than all before; DataError where more than a few are not."""
    if not len(t):
        raise DataError(f"{file}: {name}: has no rows")
    finite = np.isfinite(t)
    for column in columns:
        finite &= np.abs(column) < MAX_VALUE
    index = np.flatnonzero(finite)
    s = t[index]
    # one time that jumps ahead and back is wrong itself; not all that come after it
    spike = np.r_[False, (s[1:-1] > s[2:]) & (s[2:] > s[:-2]), False] if len(s) > 2 else np.zeros(len(s), bool)
    index, s = index[~spike], s[~spike]
    latest = np.r_[-np.inf, np.maximum.accumulate(s)[:-1]] if len(s) else s
    keep, same = np.zeros(len(t), bool), np.zeros(len(t), bool)
    keep[index[s > latest]] = True
    same[index[s == latest]] = True
    for bad, problem, share in (
        (~finite, "that cannot be read", MAX_BAD_SHARE),
        (same, "at the time of the row before", 1.0),
        (finite & ~keep & ~same, "with a time before the row before", MAX_BAD_SHARE),
    ):
        if not bad.any():
            continue
        first = int(np.argmax(bad))
        at = f"line {int(lines[first])}" if lines is not None else f"row {first}"
        count, of = int(bad.sum()), len(t)
        if count > max(2, share * of):
            raise DataError(f"{file}: {at}: {name}: {count} of {of} rows {problem}, this is the first")
        notes.append(finding("rows.bad", name, count=count, of=of, why=problem, at=at))
    if not keep.any():
        raise DataError(f"{file}: {name}: has no row that can be used")
    return keep


def _one_piece(t: np.ndarray, keep: np.ndarray, notes: list[Note]) -> np.ndarray:
    """(N,) bool, rows of the longest piece between gaps of more than an hour."""
    piece = np.zeros(len(t), int)
    index = np.flatnonzero(keep)
    piece[index] = np.r_[0, np.cumsum(np.diff(t[index]) > MAX_GAP_S)]
    longest = int(np.argmax(np.bincount(piece[index])))
    dropped = int(np.count_nonzero(piece[index] != longest))
    if dropped:
        notes.append(finding("rows.piece", "imu", count=dropped))
    return piece == longest


def _intervals(t: np.ndarray, stated: np.ndarray | None, notes: list[Note]) -> np.ndarray:
    """(N,) s that each row stands for: the time since the row before, and the usual step at the start and after gaps.

    Whether a gap can be navigated through is not for a reader to say: the interval shows that no sample covers it.
    """
    step = np.diff(t)
    usual = float(np.median(step))
    gap = step > GAP_STEPS * usual
    # rows closer than a microsecond cannot stand for the time between them
    dt = np.maximum(np.r_[usual, np.where(gap, usual, step)], 1e-6)
    if gap.any():
        i = int(np.argmax(step))
        many = f"{gap.sum()} gaps" if gap.sum() > 1 else "one gap"
        notes.append(finding("imu.holes", value=float(step[i]), words=many, at=float(t[i] - t[0])))
    if usual > 1.0 / MIN_RATE_HZ:
        notes.append(finding("imu.seldom", value=1.0 / usual))
    return dt if stated is None else stated


def _gravity_axis(imu: ImuLog, notes: list[Note]) -> None:
    """Note gravity on the wrong axis."""
    force = np.average(imu.accel, axis=0, weights=imu.dt)
    size = float(np.linalg.norm(force))
    if not 8.0 < size < 11.6 or force[2] < -0.5 * size:
        return
    looks = (
        "the axes look like 'flu' or 'rfu', or the accelerometer has the other sign (accel_sign = -1): "
        "jaxnav check says which"
        if force[2] > 0.7 * size
        else "the IMU is mounted on its side: give axes"
    )
    mean = ", ".join(f"{x:.1f}" for x in force)
    notes.append(finding("imu.upright", vector=mean, words=looks))


def _samples(name: str, stream: Stream, imu: ImuLog, file: str, notes: list[Note]) -> Samples | None:
    """Return the usable rows within the IMU's time, with an sd; None where none is left."""
    t, value = np.asarray(stream.t, float), np.asarray(stream.value, float)
    if not len(t):
        return None
    t = _same_epoch(name, t, imu, notes)
    corr = np.zeros_like(value) if stream.corr is None else np.asarray(stream.corr, float)
    given = np.full_like(value, np.nan) if stream.sd is None else np.array(stream.sd, float)
    if stream.sd is None and name not in with_data():
        raise DataError(f"{file}: {name}: states no sd: give one, sd={{{name!r}: ...}}")
    if name == "position":
        value, given = _with_heights(value, given, notes)
    elif name in (streams := with_data()) and value.shape[1] == streams[name].size:
        value = np.where(missing.no_value(value, streams[name].columns), np.nan, value)
    none = ~np.isfinite(value).all(axis=1)
    if none.any():
        notes.append(finding("rows.no_value", name, count=int(none.sum()), of=len(t)))
    t, value, given, corr = t[~none], value[~none], given[~none], corr[~none]
    rows = np.flatnonzero(~none)
    if not len(t):
        _nothing_left(name, f"of {len(none)}", notes)
        return None
    given = _with_sd(name, given, notes)
    keep = usable(name, t, value.T, file, notes)
    if name == "position":
        far = np.zeros(len(t), bool)
        far[keep] = missing.unreachable(t[keep], value[keep])
        if far.any():
            first, limit = float(t[np.argmax(far)]), missing.MAX_SPEED
            notes.append(finding("rows.far", name, limit=limit, count=int(far.sum()), of=len(t), at=first))
        keep &= ~far
    good = np.all((given > MIN_SD) & (given < MAX_SD), axis=1)  # nan too
    if np.any(keep & ~good):
        notes.append(finding("rows.no_sd", name, count=int(np.count_nonzero(keep & ~good)), of=len(t)))
    inside = (t > imu.t[0] - imu.dt[0]) & (t <= imu.t[-1])
    outside = int(np.count_nonzero(keep & good & ~inside))
    if outside:
        notes.append(finding("rows.outside", name, count=outside, of=len(t)))
    keep &= good & inside
    if not keep.any():
        theirs, hint = "no time", ""
        if np.isfinite(t).any():
            first, last = float(np.nanmin(t)), float(np.nanmax(t))
            theirs, longer = f"{first:.1f} to {last:.1f}", (last - first) / max(float(np.ptp(imu.t)), 1e-9)
            near = [unit for unit, k in (("milliseconds", 1e3), ("microseconds", 1e6)) if 0.5 < longer / k < 2.0]
            hint = f" ({longer:.3g} times as long: {near[0]}? set time_unit)" if near else ""
        span = f"the IMU's are at {imu.t[0]:.1f} to {imu.t[-1]:.1f} s{hint}"
        _nothing_left(name, f"of {len(t)}, at {theirs} s; {span}", notes)
        return None
    again = np.mean(np.all(value[keep][1:] == value[keep][:-1], axis=1)) if keep.sum() > 1 else 0.0
    if again > 0.2 and name in ("position", "velocity"):
        notes.append(finding("rows.alike", name, 100 * float(again)))
    valid, auxiliary = (None if a is None else a[rows[keep]] for a in (stream.valid, stream.auxiliary))
    return Samples(t[keep], value[keep], given[keep], corr[keep], valid, auxiliary)


def _nothing_left(name: str, words: str, notes: list[Note]) -> None:
    """Note a stream that ends without rows, and what was left out of it."""
    said = [note.message for note in notes if isinstance(note, Finding) and note.subject == name]
    cause = "; ".join(words.removeprefix(f"{name}: ") for words in said)
    cause = cause or "they are outside of the IMU's time, or hold no values"
    notes.append(finding("stream.empty", name, words=f"no row is left {words}", cause=cause))


def _with_heights(value: np.ndarray, sd: np.ndarray, notes: list[Note]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and sd (K, 3): nan where there is no fix, heights that are missing interpolated and unsure."""
    none = ~np.isfinite(value[:, :2]).all(axis=1) | missing.no_position(value)
    lost = missing.no_height(value[:, 2]) & ~none
    value = np.where(none[:, None], np.nan, value)
    if lost.any():
        known, k = ~lost & ~none, np.arange(len(lost))
        words, count = "interpolated" if known.any() else "0 m", int(lost.sum())
        notes.append(
            finding("rows.no_height", "position", limit=missing.UNMEASURED_SD, count=count, of=len(lost), words=words)
        )
        value[lost, 2] = np.interp(k[lost], k[known], value[known, 2]) if known.any() else 0.0
        sd[lost, 2] = missing.UNMEASURED_SD
    return value, sd


def _with_sd(name: str, sd: np.ndarray, notes: list[Note]) -> np.ndarray:
    """Return sd (K, s) with assumed values on axes without any; a single row without one stays as it is."""
    none = ~(sd > MIN_SD)
    whole = np.asarray(none.all(axis=1))
    lost = none & (~whole[:, None] | whole.all())
    if name not in (streams := with_data()) or not lost.any():
        return sd
    assumed = np.resize([column.sd for column in streams[name].columns], sd.shape[1])
    if whole.all() and name not in AUXILIARY:
        scan = "; the noise scan may take them for smaller or larger" if name == "position" else ""
        notes.append(finding("stream.assumed_sd", name, words=uncertainty(name, assumed), scan=scan))
    elif not whole.all():
        count = int(lost.any(axis=1).sum())
        notes.append(finding("rows.some_sd", name, count=count, of=len(sd), words=uncertainty(name, assumed)))
    return np.where(lost, assumed, sd)


def _same_epoch(name: str, t: np.ndarray, imu: ImuLog, notes: list[Note]) -> np.ndarray:
    """Return times in the IMU's week: of another week, or s since 1970 where the IMU counts s of the week."""
    first = float(np.nanmin(t)) if np.isfinite(t).any() else 0.0
    weeks = week_shift(t[np.isfinite(t)], imu.t)
    if weeks:
        notes.append(finding("time.week", name, -weeks / WEEK))
        return t + weeks
    if not (imu.t[-1] < 2 * WEEK and first >= GPS_EPOCH):
        return t
    week = np.round((np.nanmedian(t) - GPS_EPOCH - float(np.median(imu.t))) / WEEK)
    notes.append(finding("time.since_1970", name, float(week)))
    return t - GPS_EPOCH - week * WEEK
