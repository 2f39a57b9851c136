"""ROS 1 bags, ROS 2 bags and MCAP files, by `rosbags`: standard messages, in ROS' axes and units (REP 103, 145)."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.io.files import MAX_VALUE
from jaxnav.io.parts import ImuRows, Parts, Stream, TimeScale, scaled
from jaxnav.io.units import pressure_height
from jaxnav.maths.units import DEG
from jaxnav.types import DataError

RECEIVER = {"raw", "fix", "gps", "gnss", "receiver"}  # words of a topic
ESTIMATE = {"filtered", "filter", "fused", "odometry", "odom", "global", "local", "ekf", "estimate", "estimated"}
TESLA = 1e6  # microtesla


A_DATE = 3e17  # ns since 1970, in 1979: stamps below count from start-up


class Kind(NamedTuple):
    """Stream of the messages of a type."""

    stream: str
    row: Callable[[Any], list[float]]  # value, then sd, of a message
    asked: str = ""  # the quantity it must hold: read only where ``topics`` names one, for the type does not say


def recognises(path: Path, head: bytes) -> bool:
    """Return whether it has the magic of one of the three containers, or the metadata of a ROS 2 bag."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and bool([*path.glob("*.db3*"), *path.glob("*.mcap*")])
    sqlite = head.startswith(b"SQLite format 3\0") and (path.parent / "metadata.yaml").is_file()
    return head.startswith((b"#ROSBAG V", b"\x89MCAP0\r\n")) or sqlite


def read(path: Path, topics: dict[str, str] | None = None) -> Parts:
    """IMU, fixes, velocity, wheel speed, magnetometer and pressure of a bag; t in s since 1970 by the header's stamp.

    Args:
        path: the bag.
        topics: topic of a stream ("imu", "position", ...), where there are several; default a receiver's by its name,
            else the one with most messages.

    Raises:
        DataError: no message that is known, or a topic that is not there.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    single = path.suffix == ".db3"
    notes: list[str] = []
    with AnyReader([path.parent if single else path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        chosen = _choose(path, bag.connections, topics or {}, notes)
        if not chosen:
            types = ", ".join(sorted({c.msgtype for c in bag.connections}))
            raise DataError(f"{path}: has no messages that are known, only {types or 'none'}")
        rows: dict[str, list[list[float]]] = {stream: [] for stream in chosen.values()}
        stamps: dict[str, list[int]] = {stream: [] for stream in chosen.values()}
        heard: dict[str, list[int]] = {stream: [] for stream in chosen.values()}
        for c, received, raw in bag.messages([c for c in bag.connections if c.topic in chosen and c.msgtype in KINDS]):
            message: Any = bag.deserialize(raw, c.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            stamps[chosen[c.topic]].append(stamp or received)
            heard[chosen[c.topic]].append(received)
            rows[chosen[c.topic]].append(KINDS[c.msgtype].row(message))
    return _parts(os.fspath(path), rows, _one_clock(stamps, heard, notes), notes)


def _one_clock(stamps: dict[str, list[int]], heard: dict[str, list[int]], notes: list[str]) -> dict[str, list[int]]:
    """Return stamps (ns) of one clock: those since start-up are moved by the times of reception where others are dates.

    Args:
        stamps: of the headers, by stream.
        heard: when each message was recorded.
        notes: gets a sentence for each stream that is moved.
    """
    date = {name: np.median(times) > A_DATE for name, times in stamps.items() if times}
    if all(date.values()) or not any(date.values()):
        return stamps
    out = dict(stamps)
    for name in (name for name, is_date in date.items() if not is_date):
        late = np.array(heard[name]) - np.array(stamps[name])
        offset = int(np.median(late))
        out[name] = [stamp + offset for stamp in stamps[name]]
        spread = float(np.ptp(np.quantile(late, [0.05, 0.95]))) / 1e9
        notes.append(
            f"{name}: its stamps count from start-up, others from 1970: the times of reception bridge the clocks "
            f"(within {spread:.3f} s)."
        )
    return out


def from_receiver(topic: str) -> int:
    """Return how much a topic's name is that of a receiver's fixes, and not of a filter's estimate; 0 for neither."""
    words = set(re.split(r"[^a-z]+", topic.lower()))
    return len(words & RECEIVER) - len(words & ESTIMATE)


def _choose(path: Path, connections: Any, topics: dict[str, str], notes: list[str]) -> dict[str, str]:
    """Streams by topic: the topic that the user names, else the one with most messages."""
    counts: dict[str, dict[str, int]] = {}
    for c in connections:
        if c.msgtype not in KINDS:
            continue
        kind = KINDS[c.msgtype]
        if kind.asked and kind.stream not in topics:  # it may as well be a command, or in the robot's axes
            notes.append(f"{c.topic} is not read: if it is {kind.asked}, say topics={{'{kind.stream}': '{c.topic}'}}.")
            continue
        of = counts.setdefault(kind.stream, {})
        of[c.topic] = of.get(c.topic, 0) + c.msgcount
    chosen = {}
    for stream, topic in topics.items():
        if topic not in counts.get(stream, {}):
            known = ", ".join(counts.get(stream, {})) or "none of a type that is known"
            raise DataError(f"{path}: topics: {stream}: no {topic}, it has {known}")
    for stream, of in counts.items():
        raw = from_receiver if stream in ("position", "velocity") else lambda topic: 0
        best = topics.get(stream) or max(of, key=lambda topic: (raw(topic), of[topic]))
        if len(of) > 1 and stream not in topics:
            notes.append(f"{stream} is {best}, of {', '.join(sorted(of))}.")
        chosen[best] = stream
    return chosen


def _parts(file: str, rows: dict[str, list[Any]], stamps: dict[str, list[int]], notes: list[str]) -> Parts:
    first = min((s[0] for s in stamps.values() if s), default=0)
    zero = first // 10**9 * 10**9  # whole seconds: a float would round the nanoseconds of 1970
    notes.append(f"t = 0 is {zero // 10**9} s since 1970 by the headers' stamps.")
    imu, aiding = None, {}
    for stream, values in rows.items():
        if not values:
            continue
        t, table = (np.array(stamps[stream]) - zero) / 1e9, np.array(values, float)
        if stream == "imu":
            imu = ImuRows(t, table[:, :3], table[:, 3:])
            continue
        half = table.shape[1] // 2
        value, sd = table[:, :half], np.where(table[:, half:] > 0.0, table[:, half:], np.nan)
        if stream == "position":
            keep = table[:, 0] < MAX_VALUE  # STATUS_NO_FIX
            notes += (
                [f"position: {np.count_nonzero(~keep)} messages say that there is no fix."] if not keep.all() else []
            )
            t, value, sd = t[keep], value[keep], sd[keep]
        # a magnetometer is taken to sit in the IMU's case
        aiding[stream] = Stream(t, value, None if np.isnan(sd).all() else sd, turns=stream == "magnetometer")
    parts = Parts(file, imu, aiding, notes=tuple(notes), axes="flu", zero=zero // 10**9)
    return scaled(parts, TimeScale.UTC)


def _xyz(v: Any) -> list[float]:
    return [v.x, v.y, v.z]


def _roots(covariance: Any, size: int) -> list[float]:
    """Sd of the first three of a covariance (size, size); nan where nothing is stated."""
    variance = np.asarray(covariance, float).reshape(size, size).diagonal()[:3]
    return np.sqrt(np.where(variance > 0.0, variance, np.nan)).tolist()


def _imu(m: Any) -> list[float]:
    return [*_xyz(m.angular_velocity), *_xyz(m.linear_acceleration)]


def _fix(m: Any) -> list[float]:
    if m.status.status < 0:
        return [np.inf] * 6
    sd = [np.nan] * 3 if m.position_covariance_type == 0 else _roots(m.position_covariance, 3)
    return [m.latitude * DEG, m.longitude * DEG, m.altitude, *sd]  # ENU, as in the message


def _velocity(m: Any) -> list[float]:
    return [*_xyz(m.twist.linear), *[np.nan] * 3]  # ENU, as GNSS drivers publish it


def _velocity_with_sd(m: Any) -> list[float]:
    return [*_xyz(m.twist.twist.linear), *_roots(m.twist.covariance, 6)]


def _odometry(m: Any) -> list[float]:
    return [m.twist.twist.linear.x, _roots(m.twist.covariance, 6)[0]]


def _magnetic(m: Any) -> list[float]:
    sd = _roots(m.magnetic_field_covariance, 3)
    return [x * TESLA for x in (*_xyz(m.magnetic_field), *sd)]


def _pressure(m: Any) -> list[float]:
    return [float(pressure_height(np.array(m.fluid_pressure))), np.nan]


def _range(m: Any) -> list[float]:
    return [m.range if m.min_range < m.range < m.max_range else np.nan, np.nan]


KINDS: dict[str, Kind] = {
    "sensor_msgs/msg/Imu": Kind("imu", _imu),
    "sensor_msgs/msg/NavSatFix": Kind("position", _fix),
    "geometry_msgs/msg/TwistStamped": Kind("velocity", _velocity, "a receiver's, ENU"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": Kind("velocity", _velocity_with_sd, "a receiver's, ENU"),
    "nav_msgs/msg/Odometry": Kind("speed", _odometry),
    "sensor_msgs/msg/MagneticField": Kind("magnetometer", _magnetic),
    "sensor_msgs/msg/FluidPressure": Kind("barometer", _pressure),
    "sensor_msgs/msg/Range": Kind("rangefinder", _range, "a sensor that looks down"),
}
