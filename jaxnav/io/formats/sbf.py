"""Septentrio SBF: fixes, heading of two antennas, and the IMU of ExtSensorMeas, as its reference guides have them."""

import os
from binascii import crc_hqx
from collections import Counter
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import ImuRows, Parts, Stream, TimeScale, scaled, unread
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Note

SYNC = b"$@"
PVT, POSITION_COV, VELOCITY_COV, EULER, SENSORS = 4007, 5906, 5908, 5938, 4050  # numbers of blocks
NONE = -2e10  # and 65535, 4294967295: values that are none
HEAD = [("sync", "S2"), ("crc", "<u2"), ("id", "<u2"), ("length", "<u2"), ("tow", "<u4"), ("week", "<u2")]
MODE = [("mode", "u1"), ("error", "u1")]
TYPES = {
    PVT: np.dtype([*HEAD, *MODE, ("lat", "<f8"), ("lon", "<f8"), ("height", "<f8"), ("undulation", "<f4"),
                   ("north", "<f4"), ("east", "<f4"), ("up", "<f4")]),
    POSITION_COV: np.dtype([*HEAD, *MODE, ("cov", "<f4", 3)]),  # of north, east, up
    VELOCITY_COV: np.dtype([*HEAD, *MODE, ("cov", "<f4", 3)]),
    EULER: np.dtype([*HEAD, ("satellites", "u1"), ("error", "u1"), ("mode", "<u2"), ("info", "<u2"),
                     ("heading", "<f4")]),
    SENSORS: np.dtype([*HEAD, ("count", "u1"), ("size", "u1")]),
}  # fmt: skip
"""Beginnings of the blocks that are read."""
SAMPLE = np.dtype([("source", "u1"), ("model", "u1"), ("type", "u1"), ("info", "u1"), ("xyz", "<f8", 3)])
ACCEL, GYRO = 0, 1  # types of samples: m/s^2, deg/s


def blocks(data: bytes) -> tuple[dict[int, list[bytes]], int, Counter[str]]:
    """Return the blocks of `TYPES` by number, how many of them have a wrong checksum or are cut, and other blocks."""
    others: Counter[str] = Counter()
    found: dict[int, list[bytes]] = {number: [] for number in TYPES}
    lost, at = 0, -1
    while (at := data.find(SYNC, at + 1)) >= 0:
        head = data[at : at + 8]
        if len(head) < 8:
            lost += 1
            break
        number, length = int.from_bytes(head[4:6], "little") & 0x1FFF, int.from_bytes(head[6:8], "little")
        if length % 4 or length < (TYPES[number].itemsize if number in TYPES else 8):
            continue
        block = data[at : at + length]
        if len(block) < length or crc_hqx(block[4:], 0) != int.from_bytes(head[2:4], "little"):
            lost += number in TYPES
            continue
        if number in TYPES:
            found[number].append(block)
        else:
            others[f"block {number}"] += 1
        at += length - 1
    return found, lost, others


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the first blocks are SBF: of any number, with a right checksum."""
    at = head.find(SYNC)
    for _ in range(20):
        if at < 0:
            return False
        length = int.from_bytes(head[at + 6 : at + 8], "little")
        block = head[at : at + length]
        if 8 < length == len(block) and crc_hqx(block[4:], 0) == int.from_bytes(head[at + 2 : at + 4], "little"):
            return True
        at = head.find(SYNC, at + 1)
    return False


def read(path: Path) -> Parts:
    """Position and velocity of PVTGeodetic, their sd of the covariances, heading of AttEuler, IMU of ExtSensorMeas.

    Times are s since 1970 in GPS time.

    Raises:
        DataError: no fix in three dimensions and no IMU.
    """
    found, lost, others = blocks(read_bytes(path))
    rows = {number: _rows(found[number], kind) for number, kind in TYPES.items()}
    pvt = rows[PVT]
    fixed = (pvt["mode"] & 15 > 0) & (pvt["mode"] & 128 == 0) & (pvt["error"] == 0) & (pvt["lat"] > NONE)
    aiding, pvt = {}, pvt[fixed]
    if pvt.size:
        t = _time(pvt)
        sd = {number: _sd(t, rows[number]) for number in (POSITION_COV, VELOCITY_COV)}
        aiding["position"] = Stream(t, np.stack([pvt["lat"], pvt["lon"], pvt["height"]], 1), sd[POSITION_COV])
        velocity = np.stack([pvt[name] for name in ("east", "north", "up")], 1).astype(float)
        aiding["velocity"] = Stream(t, np.where(velocity > NONE, velocity, np.nan), sd[VELOCITY_COV])
    euler = rows[EULER]
    euler = euler[(euler["mode"] > 0) & (euler["error"] == 0) & (euler["heading"] > NONE)]
    if euler.size:
        aiding["heading"] = Stream(_time(euler), euler["heading"].astype(float)[:, None] * DEG)
    imu = _imu(found[SENSORS])
    if not aiding and imu is None:
        raise DataError(
            f"{path}: has no PVTGeodetic with a fix in three dimensions and no ExtSensorMeas, {lost} damaged, "
            f"{others.total()} of other numbers"
        )
    notes: list[Note] = []
    if without := int((~fixed).sum()):
        notes.append(finding("fixes.none", "position", count=without, words="PVTGeodetic"))
    if lost:
        notes.append(finding("file.damaged", count=lost, words="blocks"))
    return scaled(Parts(os.fspath(path), imu, aiding, notes=(*notes, *unread(others))), TimeScale.GPS)


def _rows(found: list[bytes], kind: np.dtype) -> np.ndarray:
    return np.frombuffer(b"".join(block[: kind.itemsize] for block in found), kind)


def _time(rows: np.ndarray) -> np.ndarray:
    """(K,) s since 1970 in GPS time; nan of a time or week that is none."""
    known = (rows["tow"] < 2**32 - 1) & (rows["week"] < 2**16 - 1)
    return np.where(known, GPS_EPOCH + rows["week"] * WEEK + rows["tow"] / 1e3, np.nan)


def _sd(t: np.ndarray, rows: np.ndarray) -> np.ndarray | None:
    """(K, 3) sd, ENU, of the covariances at the same times; nan where there is none."""
    if not rows.size:
        return None
    stamps, first = np.unique(_time(rows), return_index=True)
    variance = rows["cov"][first].astype(float)[:, [1, 0, 2]]
    at = np.clip(np.searchsorted(stamps, t - 1e-4), 0, stamps.size - 1)
    same = np.abs(stamps[at] - t) < 1e-3
    return np.sqrt(np.where(same[:, None] & (variance[at] > 0), variance[at], np.nan))


def _imu(found: list[bytes]) -> ImuRows | None:
    """Return the samples of gyro and accelerometer at times that have both."""
    read_: dict[float, dict[int, np.ndarray]] = {}
    begin = TYPES[SENSORS].itemsize
    for block, head in zip(found, _rows(found, TYPES[SENSORS])):
        t = float(_time(head))
        for k in range(int(head["count"])):
            part = block[begin + k * int(head["size"]) :][: SAMPLE.itemsize]
            if len(part) == SAMPLE.itemsize:
                sample = np.frombuffer(part, SAMPLE)[0]
                read_.setdefault(t, {})[int(sample["type"])] = sample["xyz"]
    whole = {t: row for t, row in sorted(read_.items()) if {ACCEL, GYRO} <= set(row)}
    if not whole:
        return None
    values = {kind: np.array([row[kind] for row in whole.values()]) for kind in (ACCEL, GYRO)}
    values = {kind: np.where(value > NONE, value, np.nan) for kind, value in values.items()}
    return ImuRows(np.array(list(whole)), values[GYRO] * DEG, values[ACCEL], scale=TimeScale.GPS)
