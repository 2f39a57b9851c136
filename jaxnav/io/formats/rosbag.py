"""ROS 1 bags, ROS 2 bags and MCAP files, by `rosbags`: standard messages, in ROS' axes and units (REP 103, 145).

And those of receivers' drivers that hold a fix: NavPVT of u-blox, GPSFix of gpsd.
"""

import os
import re
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.column_map import interpolated
from jaxnav.io.files import MAX_VALUE
from jaxnav.io.parts import ImuRows, Parts, Stream, TimeScale, scaled, unread
from jaxnav.io.units import pressure_height
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Note

SENSOR = re.compile(r"gps|gnss|navpvt|ublox|novatel|septentrio|rtk|imu|nmea|odom|wheel")  # in topics of sensors
ACCEL = "accelerometer"  # an IMU's topic that has nothing else
HALF = 50  # messages of an IMU's topic that show whether it has gyro and accelerometer
MAX_ACROSS = 0.3  # of the speed to the left over that forward, of wheels
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
    notes: list[Note] = []
    with AnyReader([path.parent if single else path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        chosen = _choose(path, bag.connections, topics or {}, notes)
        if not chosen:
            types = ", ".join(sorted({c.msgtype for c in bag.connections}))
            raise DataError(f"{path}: has no messages that are known, only {types or 'none'}")
        if "imu" in chosen and "imu" not in (topics or {}):
            chosen |= _whole_imu(bag, chosen["imu"], notes)
        rows: dict[str, list[list[float]]] = {stream: [] for stream in chosen}
        stamps: dict[str, list[int]] = {stream: [] for stream in chosen}
        heard: dict[str, list[int]] = {stream: [] for stream in chosen}
        wanted = set(chosen.values())
        for c, received, raw in bag.messages([c for c in bag.connections if c.topic in wanted and c.msgtype in KINDS]):
            message: Any = bag.deserialize(raw, c.msgtype)
            header = getattr(message, "header", None)  # NavPVT has none
            stamp = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
            for kind in KINDS[c.msgtype]:
                for stream in (kind.stream, *([ACCEL] if kind.stream == "imu" else [])):
                    if chosen.get(stream) == c.topic:
                        stamps[stream].append(stamp or received)
                        heard[stream].append(received)
                        rows[stream].append(kind.row(message))
    return _parts(os.fspath(path), rows, _one_clock(stamps, heard, notes), notes)


def _whole_imu(bag: Any, usual: str, notes: list[Note]) -> dict[str, str]:
    """Return the topics of the IMU, and of its accelerometer where gyro and accelerometer are two topics."""
    halves: dict[str, tuple[bool, bool]] = {}
    for c in bag.connections:
        if c.msgtype == IMU and c.topic not in halves:
            few = islice(bag.messages([c]), HALF)
            read_ = np.nan_to_num(np.array([_imu(bag.deserialize(raw, IMU)) for _, _, raw in few]).reshape(-1, 6))
            halves[c.topic] = bool(read_[:, :3].any()), bool(read_[:, 3:].any())
    if all(halves[usual]):
        return {"imu": usual}
    whole = [topic for topic, has in halves.items() if all(has)]
    if whole:
        none = "accelerometer" if halves[usual][0] else "gyro"
        notes.append(finding("stream.chosen", "imu", words=f"{whole[0]}: {usual} has no {none}, it reads 0"))
        return {"imu": whole[0]}
    gyros = [topic for topic, has in halves.items() if has[0]]
    accels = [topic for topic, has in halves.items() if has[1]]
    if not gyros or not accels:
        return {"imu": usual}
    words = f"the gyro of {gyros[0]}, the accelerometer of {accels[0]}: the other half of each reads 0"
    notes.append(finding("stream.chosen", "imu", words=words))
    return {"imu": gyros[0], ACCEL: accels[0]}


def _one_clock(stamps: dict[str, list[int]], heard: dict[str, list[int]], notes: list[Note]) -> dict[str, list[int]]:
    """Return stamps (ns) of one clock: those since start-up are moved by the times of reception where others are dates.

    Args:
        stamps: of the headers, by stream.
        heard: when each message was recorded.
        notes: gets a finding for each stream that is moved.
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
        notes.append(finding("clock.bridged", name, spread))
    return out


def from_receiver(topic: str) -> int:
    """Return how much a topic's name is that of a receiver's fixes, and not of a filter's estimate; 0 for neither."""
    words = set(re.split(r"[^a-z]+", topic.lower()))
    return len(words & RECEIVER) - len(words & ESTIMATE)


def of_a_filter(topic: str) -> bool:
    """Return whether the name of an odometry is that of a filter's estimate, and no wheel's."""
    return bool(set(re.split(r"[^a-z]+", topic.lower())) & (ESTIMATE - {"odom", "odometry", "local"}))


def _choose(path: Path, connections: Any, topics: dict[str, str], notes: list[Note]) -> dict[str, str]:
    """Return a topic by stream: the one that the user names, else the one with most messages."""
    counts: dict[str, dict[str, int]] = {}
    for c, kind in [(each, kind) for each in connections for kind in KINDS.get(each.msgtype, ())]:
        if kind.asked and kind.stream not in topics:  # it may as well be a command, or in the robot's axes
            words = f": if it is {kind.asked}, say topics={{'{kind.stream}': '{c.topic}'}}"
            notes.append(finding("file.other", c.topic, words=words))
            continue
        of = counts.setdefault(kind.stream, {})
        of[c.topic] = of.get(c.topic, 0) + c.msgcount
    chosen = {}
    for stream, topic in topics.items():
        if topic not in counts.get(stream, {}):
            known = ", ".join(counts.get(stream, {})) or "none of a type that is known"
            raise DataError(f"{path}: topics: {stream}: no {topic}, it has {known}")
    for topic in [topic for topic in counts.get("speed", {}) if "speed" not in topics and of_a_filter(topic)]:
        words = f": its name says a filter's: if wheels, say topics={{'speed': '{topic}'}}"
        notes.append(finding("file.other", topic, words=words))
        del counts["speed"][topic]
    for stream, of in counts.items():
        if not of:
            continue
        raw = from_receiver if stream in ("position", "velocity") else lambda topic: 0
        best = topics.get(stream) or max(of, key=lambda topic: (raw(topic), of[topic]))
        if len(of) > 1 and stream not in topics:
            notes.append(finding("stream.chosen", stream, words=f"{best}, of {', '.join(sorted(of))}"))
        chosen[stream] = best
    others = {c.topic: (f"{c.topic} of {c.msgtype}", c.msgcount) for c in connections if c.msgtype not in KINDS}
    if "position" not in chosen:
        words = "no topic has a type that is read: record sensor_msgs/NavSatFix"
        notes.append(finding("position.none", "position", words=words))
    else:
        others = {topic: row for topic, row in others.items() if SENSOR.search(topic.lower())}
    notes += unread(dict(others.values()))
    return chosen


def _parts(file: str, rows: dict[str, list[Any]], stamps: dict[str, list[int]], notes: list[Note]) -> Parts:
    first = min((s[0] for s in stamps.values() if s), default=0)
    zero = first // 10**9 * 10**9  # whole seconds: a float would round the nanoseconds of 1970
    notes.append(finding("time.zero", words=f"{zero // 10**9} s since 1970 by the headers' stamps"))
    imu, aiding = None, {}
    for stream, values in rows.items():
        if not values:
            continue
        t, table = (np.array(stamps[stream]) - zero) / 1e9, np.array(values, float)
        if stream == ACCEL:
            continue
        if stream == "imu":
            gyro, accel = table[:, :3], table[:, 3:]
            if ACCEL in rows:
                of = (np.array(stamps[ACCEL]) - zero) / 1e9
                accel, covered = interpolated(t, of, np.array(rows[ACCEL], float)[:, 3:])
                t, gyro, accel = t[covered], gyro[covered], accel[covered]
            imu = ImuRows(t, gyro, accel)
            continue
        if stream == "speed":
            forward, left = np.linalg.norm(np.nan_to_num(table[:, :3:2]), axis=0)
            across = left > MAX_ACROSS * forward
            if not table[:, :3:2].any() or across:
                why = "move sideways: in the world's axes" if across else "are all 0: it has a pose alone"
                notes.append(finding("file.other", stream, words=f": the twists of the odometry {why}"))
                continue
            table = table[:, :2]
        half = table.shape[1] // 2
        value, sd = table[:, :half], np.where(table[:, half:] > 0.0, table[:, half:], np.nan)
        if stream in ("position", "velocity"):
            keep = table[:, 0] < MAX_VALUE  # STATUS_NO_FIX
            if not keep.all():
                count = int(np.count_nonzero(~keep))
                notes.append(finding("fixes.none", stream, count=count, words=f"messages of the {stream}"))
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
    """Return the speed forward and its sd, and the speed to the left, which a wheel has not."""
    return [m.twist.twist.linear.x, _roots(m.twist.covariance, 6)[0], m.twist.twist.linear.y]


def _magnetic(m: Any) -> list[float]:
    sd = _roots(m.magnetic_field_covariance, 3)
    return [x * TESLA for x in (*_xyz(m.magnetic_field), *sd)]


def _pressure(m: Any) -> list[float]:
    return [float(pressure_height(np.array(m.fluid_pressure))), np.nan]


def _range(m: Any) -> list[float]:
    return [m.range if m.min_range < m.range < m.max_range else np.nan, np.nan]


def _pvt(m: Any) -> list[float]:
    """Return position and velocity of NavPVT, names as in ROS 1 or ROS 2: 1e-7 deg, mm, mm/s."""
    get = lambda *names, usual=np.nan: next((float(getattr(m, name)) for name in names if hasattr(m, name)), usual)
    if not int(get("flags", usual=1)) & 1 or get("fix_type", "fixType", usual=3) not in (3, 4):
        return [np.inf] * 12
    place = [get("lat") * 1e-7 * DEG, get("lon") * 1e-7 * DEG, get("height") / 1e3]
    wide, high = get("h_acc", "hAcc") / 1e3, get("v_acc", "vAcc") / 1e3
    velocity = [get("vel_e", "velE") / 1e3, get("vel_n", "velN") / 1e3, -get("vel_d", "velD") / 1e3]
    return [*place, wide, wide, high, *velocity, *[get("s_acc", "sAcc") / 1e3] * 3]


def _gps_fix(m: Any) -> list[float]:
    """Return position and velocity of GPSFix: deg, m, m/s; accuracies are at 95 %."""
    if m.status.status < 0:
        return [np.inf] * 12
    stated = _roots(m.position_covariance, 3) if m.position_covariance_type else [np.nan] * 3
    half = lambda error: error / 2 if error > 0 else np.nan
    spread = [half(m.err_horz), half(m.err_horz), half(m.err_vert)] if np.isnan(stated).all() else stated
    course, speed = m.track * DEG, m.speed
    velocity = [speed * np.sin(course), speed * np.cos(course), m.climb]
    return [m.latitude * DEG, m.longitude * DEG, m.altitude, *spread, *velocity, *[half(m.err_speed)] * 3]


IMU = "sensor_msgs/msg/Imu"
ONE: dict[str, Kind] = {
    IMU: Kind("imu", _imu),
    "sensor_msgs/msg/NavSatFix": Kind("position", _fix),
    "geometry_msgs/msg/TwistStamped": Kind("velocity", _velocity, "a receiver's, ENU"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": Kind("velocity", _velocity_with_sd, "a receiver's, ENU"),
    "nav_msgs/msg/Odometry": Kind("speed", _odometry),
    "sensor_msgs/msg/MagneticField": Kind("magnetometer", _magnetic),
    "sensor_msgs/msg/FluidPressure": Kind("barometer", _pressure),
    "sensor_msgs/msg/Range": Kind("rangefinder", _range, "a sensor that looks down"),
}
"""Types of one stream."""
BOTH = {"ublox_msgs/msg/NavPVT": _pvt, "gps_common/msg/GPSFix": _gps_fix, "gps_msgs/msg/GPSFix": _gps_fix}
"""Types of a position and a velocity, their value and sd each."""


def _flu(row: Callable[[Any], list[float]]) -> Callable[[Any], list[float]]:
    """Return value and sd of a vector (3,) from forward, left, up to forward, right, down."""
    return lambda m: (np.array(row(m)) * [1, -1, -1, 1, 1, 1]).tolist()


def _halves(row: Callable[[Any], list[float]]) -> tuple[Kind, ...]:
    return Kind("position", lambda m: row(m)[:6]), Kind("velocity", lambda m: row(m)[6:])


KINDS: dict[str, tuple[Kind, ...]] = {name: (kind,) for name, kind in ONE.items()}
for _name, _twist in (("TwistStamped", _velocity), ("TwistWithCovarianceStamped", _velocity_with_sd)):
    KINDS[f"geometry_msgs/msg/{_name}"] += (Kind("body_velocity", _flu(_twist), "a Doppler log's, forward, left, up"),)
KINDS |= {name: _halves(row) for name, row in BOTH.items()}
