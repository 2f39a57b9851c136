"""PX4 ULog, by `pyulog`: topics and fields by the names and units that they had over the years."""

import os
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.checks import ned_to_enu
from jaxnav.io.clock_rate import at_gps_rate
from jaxnav.io.parts import ImuRows, Parts, Stream, with_fixes
from jaxnav.io.units import UNITS
from jaxnav.maths.axes import attitude
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Json, Note, Track

MAGIC = b"ULog\x01\x12\x35"
NEVER = 2**31 - 1  # timestamp_relative of a sensor that has not measured
GAUSS = UNITS["field"]["gauss"]
FIX_3D = 3
GPS = ("vehicle_gps_position", "sensor_gps")  # the input of PX4's filter comes first
DOWNWARD = 25  # orientation of a rangefinder that looks down


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the first seven bytes are those of ULog."""
    return head.startswith(MAGIC)


def read(path: Path, wheel_radius_m: float = 0.0, receiver: str | None = None) -> Parts:
    """Read a log, see docs/formats.md, with truth where it is simulated; t in s of its clock.

    Body FRD, as in the log. Heights are above the ellipsoid where the log has such, else above sea level, which a note
    says. ``eph``, ``epv`` and ``s_variance_m_s`` are taken as sd of each axis, as in PX4's filter.

    Args:
        path: the log.
        wheel_radius_m: of the wheels, since encoders count angles; 0 leaves them out.
        receiver: topic and instance of the fixes, such as "sensor_gps 1"; default the first that mostly has a fix.

    Raises:
        DataError: no topic with inertial data, or no such receiver.
    """
    from pyulog import ULog

    log = ULog(os.fspath(path))
    topics: dict[str, dict[str, np.ndarray]] = {}
    for data in sorted(log.data_list, key=lambda d: d.multi_id):  # the first instance of each
        topics.setdefault(data.name, data.data)
    notes: list[Note] = []
    if log.file_corruption:
        notes.append(finding("file.partly", "the log", words=""))
    if log.dropouts:
        lost = sum(d.duration for d in log.dropouts) / 1e3
        notes.append(finding("log.dropouts", value=lost, count=len(log.dropouts)))
    imu = _imu(topics)
    if imu is None:
        raise DataError(f"{path}: has no sensor_combined, vehicle_imu or sensor_gyro and sensor_accel")
    builders = {
        "barometer": _barometer,
        "magnetometer": _magnetometer,
        "airspeed": _airspeed,
        "heading": _heading,
        "rangefinder": _rangefinder,
    }
    gps = {f"{d.name} {d.multi_id}": d.data for name in GPS for d in log.data_list if d.name == name}
    if gps or receiver:
        fixed = {name: data["fix_type"] >= FIX_3D for name, data in gps.items()}
        best = with_fixes(os.fspath(path), fixed, receiver, notes)
        topics = {k: v for k, v in topics.items() if k not in GPS} | {best.split()[0]: gps[best]}
    aiding = _gnss(topics, notes) | {name: build(topics) for name, build in builders.items()}
    aiding["wheels"] = _wheels(topics, wheel_radius_m, notes)
    present = {name: stream for name, stream in aiding.items() if stream is not None and len(stream.t)}
    truth = _truth(topics)
    if truth is not None and not truth.lla[:, 2].any():
        notes.append(finding("truth.no_height"))
    parts = Parts(os.fspath(path), imu, present, truth, notes=tuple(notes))
    fix = topics.get(_first(topics, *GPS) or "", {})
    if "time_utc_usec" not in fix:
        return parts
    known = (fix["time_utc_usec"] > 0) & (fix["fix_type"] >= FIX_3D)
    return at_gps_rate(parts, _seconds(fix["timestamp"])[known], _seconds(fix["time_utc_usec"])[known])


def _seconds(stamp: np.ndarray) -> np.ndarray:
    return stamp.astype(np.int64) / 1e6


def _table(data: dict[str, np.ndarray], *names: str) -> np.ndarray:
    return np.stack([data[name] for name in names], axis=1).astype(float)


def _vector(data: dict[str, np.ndarray], name: str) -> np.ndarray:
    return _table(data, *(f"{name}[{i}]" for i in range(3)))


def _first(data: Json, *names: str) -> str | None:
    """Return the first of the names that is there."""
    return next((name for name in names if name in data), None)


def _imu(topics: dict[str, dict[str, np.ndarray]]) -> ImuRows | None:
    if "sensor_combined" in topics:
        data = topics["sensor_combined"]
        gyro = "gyro_rad" if "gyro_rad[0]" in data else "gyro_rad_s"
        return ImuRows(_seconds(data["timestamp"]), _vector(data, gyro), _vector(data, "accelerometer_m_s2"))
    if "vehicle_imu" in topics:
        data = topics["vehicle_imu"]
        rates = _vector(data, "delta_angle") / _interval(data, "delta_angle_dt")
        force = _vector(data, "delta_velocity") / _interval(data, "delta_velocity_dt")
        return ImuRows(_seconds(data["timestamp"]), rates, force)
    if "sensor_gyro" in topics and "sensor_accel" in topics:
        turn, push = topics["sensor_gyro"], topics["sensor_accel"]
        t = _seconds(turn["timestamp"])
        return ImuRows(
            t, _table(turn, "x", "y", "z"), columns_at(t, _seconds(push["timestamp"]), _table(push, "x", "y", "z"))
        )
    return None


def _interval(data: dict[str, np.ndarray], name: str) -> np.ndarray:
    """(N, 1) s of an increment: once a float in s, today an integer in us; nan where it is none."""
    dt = data[name].astype(float) / (1.0 if data[name].dtype.kind == "f" else 1e6)
    return np.where(dt > 0.0, dt, np.nan)[:, None]


def _gnss(topics: dict[str, dict[str, np.ndarray]], notes: list[Note]) -> dict[str, Stream]:
    name = _first(topics, *GPS)
    if name is None:
        return {}
    data: dict[str, np.ndarray] = topics[name]
    fixed = data["fix_type"] >= FIX_3D
    if not fixed.all():
        count = int(np.count_nonzero(~fixed))
        notes.append(finding("fixes.none", "position", count=count, words=f"of {len(fixed)} rows of {name}"))
    modern = "latitude_deg" in data  # before 2023: integers of 1e-7 deg and mm
    lat, lon = ("latitude_deg", "longitude_deg") if modern else ("lat", "lon")
    height = _height(data)
    if height in ("altitude_msl_m", "alt"):
        notes.append(finding("heights.sea_level"))
    unit = [DEG, DEG, 1.0] if modern else [1e-7 * DEG, 1e-7 * DEG, 1e-3]
    t, value = _seconds(data["timestamp"]), _table(data, lat, lon, height) * np.array(unit)
    streams = {"position": Stream(t[fixed], value[fixed], _table(data, "eph", "eph", "epv")[fixed])}
    moving = fixed & (data["vel_ned_valid"] != 0)
    if moving.any():
        vel = ned_to_enu(_table(data, "vel_n_m_s", "vel_e_m_s", "vel_d_m_s"))
        sd = np.repeat(data["s_variance_m_s"].astype(float)[:, None], 3, axis=1)
        streams["velocity"] = Stream(t[moving], vel[moving], sd[moving])
    return streams


def _height(data: dict[str, np.ndarray]) -> str:
    """Return the field above the ellipsoid if it is filled in, else the one above sea level."""
    names = [name for name in ("altitude_ellipsoid_m", "alt_ellipsoid", "altitude_msl_m", "alt") if name in data]
    return next((name for name in names if np.any(data[name])), names[-1])


def _relative(data: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return times of a sensor inside the old sensor_combined, and which rows are new measurements."""
    offset = data[f"{name}_timestamp_relative"].astype(np.int64)
    t = (data["timestamp"].astype(np.int64) + offset) / 1e6
    return t, (offset != NEVER) & np.r_[True, np.diff(t) > 0.0]


def _barometer(topics: dict[str, dict[str, np.ndarray]]) -> Stream | None:
    old = topics.get("sensor_combined", {})
    if "vehicle_air_data" in topics:
        data = topics["vehicle_air_data"]
        return Stream(_seconds(data["timestamp"]), data["baro_alt_meter"].astype(float)[:, None])
    if "baro_alt_meter" in old:
        t, new = _relative(old, "baro")
        return Stream(t[new], old["baro_alt_meter"].astype(float)[new, None])
    return None


def _magnetometer(topics: dict[str, dict[str, np.ndarray]]) -> Stream | None:
    old = topics.get("sensor_combined", {})
    if "vehicle_magnetometer" in topics:
        data = topics["vehicle_magnetometer"]
        return Stream(_seconds(data["timestamp"]), _vector(data, "magnetometer_ga") * GAUSS)
    if "magnetometer_ga[0]" in old:
        t, new = _relative(old, "magnetometer")
        return Stream(t[new], _vector(old, "magnetometer_ga")[new] * GAUSS)
    return None


def _airspeed(topics: dict[str, dict[str, np.ndarray]]) -> Stream | None:
    if "airspeed" not in topics:
        return None
    data = topics["airspeed"]
    return Stream(_seconds(data["timestamp"]), data["true_airspeed_m_s"].astype(float)[:, None])


def _heading(topics: dict[str, dict[str, np.ndarray]]) -> Stream | None:
    """Of a receiver with two antennas, of the body."""
    data = topics.get("vehicle_gps_position", topics.get("sensor_gps", {}))
    if "heading" not in data or not np.isfinite(data["heading"]).any():
        return None
    there = np.isfinite(data["heading"])
    sd = data.get("heading_accuracy", np.full(there.size, np.nan)).astype(float)[there, None]
    stated = np.isfinite(sd) & (sd > 0)
    value = data["heading"].astype(float)[there, None]
    return Stream(_seconds(data["timestamp"])[there], value, np.where(stated, sd, np.nan) if stated.any() else None)


def _rangefinder(topics: dict[str, dict[str, np.ndarray]]) -> Stream | None:
    """One that looks down, within its reach."""
    data = topics.get("distance_sensor")
    if data is None:
        return None
    d = data["current_distance"].astype(float)
    good = (data["orientation"] == DOWNWARD) & (d > data["min_distance"]) & (d < data["max_distance"])
    if "signal_quality" in data:
        good &= data["signal_quality"] != 0
    sd = np.sqrt(data["variance"].astype(float))[good, None]
    return Stream(_seconds(data["timestamp"])[good], d[good, None], sd if (sd > 0).all() else None)


def _wheels(topics: dict[str, dict[str, np.ndarray]], radius: float, notes: list[Note]) -> Stream | None:
    """Of both sides, left first; PX4 counts from the right."""
    data = topics.get("wheel_encoders")
    if data is None:
        return None
    if not radius > 0:
        notes.append(finding("file.other", "wheel_encoders", words=": it counts angles, option wheel_radius_m"))
        return None
    return Stream(_seconds(data["timestamp"]), radius * _table(data, "wheel_speed[1]", "wheel_speed[0]"))


def _truth(topics: dict[str, dict[str, np.ndarray]]) -> Track | None:
    """Return the simulator's true state, at the times of its position."""
    names = [f"vehicle_{part}_groundtruth" for part in ("global_position", "local_position", "attitude")]
    if any(name not in topics for name in names):
        return None
    place, motion, turn = (topics[name] for name in names)
    t = _seconds(place["timestamp"])
    vel = ned_to_enu(_table(motion, "vx", "vy", "vz"))
    rph = np.unwrap(attitude(_table(turn, *(f"q[{i}]" for i in range(4)))), axis=0)
    lla = _table(place, "lat", "lon", _height(place))
    lla *= np.array([DEG, DEG, 1.0])
    return Track(
        t,
        lla,
        columns_at(t, _seconds(motion["timestamp"]), vel),
        np.angle(np.exp(1j * columns_at(t, _seconds(turn["timestamp"]), rph))),
    )
