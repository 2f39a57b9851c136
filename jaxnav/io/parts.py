"""Output of a reader: the rows of a file in SI, as written, for `jaxnav.io.mend` to make usable."""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.types import DataError, Note, Recording, Track

RATES, INCREMENTS, INSTANTANEOUS = "rates", "increments", "instantaneous"
SAMPLINGS = (RATES, INCREMENTS, INSTANTANEOUS)
MOST_NAMED = 12  # types of messages that a finding names
USUAL_DELAY_S = 0.1  # s, of data that is dated by the message that brings it


class TimeScale(StrEnum):
    """Origin and rate of a stream's times."""

    GPS = "gps"  # s since 1970 without leap seconds
    UTC = "utc"  # s since 1970 as Unix time, behind GPS time by the leap seconds
    UNKNOWN = "unknown"


class ImuRows(NamedTuple):
    """Rows of an inertial sensor in file order, nan where a cell could not be read."""

    t: np.ndarray  # (N,) s
    gyro: np.ndarray  # (N, 3) rad/s, or rad where sampling is "increments"; sensor axes
    accel: np.ndarray  # (N, 3) m/s^2 of specific force, or m/s; sensor axes
    sampling: str = RATES  # means over the interval that ends at t, increments over it, or instantaneous values at t
    dt: np.ndarray | None = None  # (N,) s that each row stands for, where the file says so
    repair: bool = False  # repair effects of polling, see `jaxnav.io.polling`
    scale: TimeScale = TimeScale.UNKNOWN


class Stream(NamedTuple):
    """Rows of a measurement in file order, nan where a cell could not be read."""

    t: np.ndarray  # (K,) s
    value: np.ndarray  # (K, s) as in `jaxnav.types.Samples`: lat, lon rad, h m; ENU m/s; m/s; m; uT; rad
    sd: np.ndarray | None = None  # (K, s), position and velocity ENU; None where the file has none
    corr: np.ndarray | None = None  # (K, s); None where the axes are independent
    valid: np.ndarray | None = None  # (K, s) bool; None: all
    auxiliary: np.ndarray | None = None  # (K, s, a), as in `jaxnav.types.Samples`
    turns: bool = False  # a vector in the axes of the IMU, to be turned into the body's with it
    scale: TimeScale = TimeScale.UNKNOWN


class Parts(NamedTuple):
    """The halves of a recording in one file; a missing one is None or empty."""

    file: str  # for messages
    imu: ImuRows | None = None
    aiding: dict[str, Stream] = {}
    truth: Track | None = None
    lever_arm: np.ndarray = np.zeros(3)  # (3,) m, IMU -> antenna, body FRD
    notes: tuple[Note, ...] = ()  # for the user: assumptions, omissions, oddities
    axes: str = "frd"  # of the sensor, see `jaxnav.maths.axes.rotation`
    name: str = ""
    lines: np.ndarray | None = None  # (N,) line of each row of the imu, where the file has lines
    zero: int = 0  # s of the file's time, subtracted from all times


def with_fixes(file: str, receivers: dict[str, np.ndarray], chosen: str | None, notes: list[Note]) -> str:
    """Return the receiver to read: the one asked for, else the first that mostly has a fix, else that with most fixes.

    Args:
        file: for the message.
        receivers: which messages (N,) have a fix in three dimensions by name, the usual receiver first.
        chosen: name that the user gave.
        notes: gets a finding where there are several.

    Raises:
        DataError: a name that is not there.
    """
    names = ", ".join(receivers)
    if chosen is not None and chosen not in receivers:
        raise DataError(f"{file}: receiver: no {chosen}, it has {names or 'none'}")
    counts = {name: int(np.count_nonzero(fixed)) for name, fixed in receivers.items()}
    mostly = (name for name, fixed in receivers.items() if 2 * counts[name] > fixed.size)
    name = chosen or next(mostly, max(counts, key=lambda name: counts[name]))
    if len(receivers) > 1:
        notes.append(finding("receiver.chosen", name, count=counts[name], words=names))
    return name


def unread(counts: Mapping[str, int]) -> tuple[Note, ...]:
    """Return the finding that messages of these types are not read, those with most of them first; none of none."""
    if not counts:
        return ()
    named = sorted(counts, key=lambda name: -counts[name])
    more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    words = ", ".join(f"{name} ({counts[name]})" for name in named[:MOST_NAMED]) + more
    return (finding("file.unread", words=words),)


def counted_from(parts: Parts, zero: int) -> Parts:
    """Return parts with times that count from ``zero`` s of the file's time."""
    shift = parts.zero - zero
    imu = None if parts.imu is None else parts.imu._replace(t=parts.imu.t + shift)
    aiding = {name: stream._replace(t=stream.t + shift) for name, stream in parts.aiding.items()}
    truth = None if parts.truth is None else parts.truth._replace(t=parts.truth.t + shift)
    return parts._replace(imu=imu, aiding=aiding, truth=truth, zero=zero)


def scaled(parts: Parts, scale: TimeScale) -> Parts:
    """Return parts with all streams in one time scale."""
    aiding = {name: stream._replace(scale=scale) for name, stream in parts.aiding.items()}
    return parts._replace(imu=None if parts.imu is None else parts.imu._replace(scale=scale), aiding=aiding)


def parts_of(rec: Recording, file: str) -> Parts:
    """Return a finished recording as parts, for options and another file's fixes."""
    aiding = {name: Stream(*samples) for name, samples in rec.aiding.items()}
    imu = ImuRows(rec.imu.t, rec.imu.gyro, rec.imu.accel, dt=rec.imu.dt)
    notes = tuple(rec.remarks.split("\n")) if rec.remarks else ()
    return Parts(file, imu, aiding, rec.truth, rec.lever_arm, (*notes, *rec.findings), name=rec.name)
