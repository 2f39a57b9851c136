"""VectorNav's binary output: the IMU and the fixes of its receiver, as VectorNav's interface documents have them."""

import os
from binascii import crc_hqx
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.checks import ned_to_enu
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import INCREMENTS, RATES, USUAL_DELAY_S, ImuRows, Parts, Stream, TimeScale
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Note

SYNC = 0xFA
COMMON, TIME, IMU, GNSS, ATTITUDE, INS, GNSS_2 = range(7)  # groups of outputs
LENGTHS = {
    COMMON: (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    TIME: (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),
    IMU: (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),
    GNSS: (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
    ATTITUDE: (2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24, 12),
    INS: (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64),
    GNSS_2: (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28),
}
"""Bytes of the outputs of a group, in the order of their bits."""
SAMPLES = (
    (RATES, ((COMMON, 5, 0, "<f4"), (COMMON, 8, 0, "<f4"))),
    (RATES, ((IMU, 10, 0, "<f4"), (IMU, 9, 0, "<f4"))),
    (RATES, ((COMMON, 9, 12, "<f4"), (COMMON, 9, 0, "<f4"))),
    (RATES, ((IMU, 3, 0, "<f4"), (IMU, 2, 0, "<f4"))),
    (INCREMENTS, ((COMMON, 11, 4, "<f4"), (COMMON, 11, 16, "<f4"))),
    (INCREMENTS, ((IMU, 6, 4, "<f4"), (IMU, 7, 0, "<f4"))),
)
"""Gyro (rad/s, of increments deg) and accelerometer (m/s^2, m/s): (group, output, bytes to skip, type), best first."""
STARTUP, TIME_GPS = ((COMMON, 0), (TIME, 0)), ((COMMON, 1), (TIME, 1))  # ns
FIXED = (3, 4, 5, 6, 7, 8)  # in three dimensions; 3 alone, then with corrections
Layout = dict[tuple[int, int], int]  # where an output begins in a message


def layout_of(head: bytes) -> tuple[Layout, int] | None:
    """Return the layout of a message and its length by its first bytes; None where an output's length is not known."""
    at, fields = 2, []
    for group in range(8):
        if not head[1] >> group & 1:
            continue
        fields.append((group, int.from_bytes(head[at : at + 2], "little")))
        at += 2
    found: Layout = {}
    for group, bits in fields:
        for output in range(16):
            if not bits >> output & 1:
                continue
            if output >= len(LENGTHS.get(group, ())):
                return None
            found[group, output] = at
            at += LENGTHS[group][output]
    return (found, at + 2) if found else None


def messages(data: bytes) -> tuple[dict[bytes, list[bytes]], int]:
    """Return the messages with a right checksum by their first bytes, and how many of the same kinds are damaged."""
    found: dict[bytes, list[bytes]] = {}
    heads: list[bytes] = []
    at = -1
    while (at := data.find(SYNC, at + 1)) >= 0:
        groups = data[at + 1].bit_count() if at + 1 < len(data) else 0
        head = data[at : at + 2 + 2 * groups]
        known = layout_of(head) if groups and len(head) == 2 + 2 * groups else None
        if known is None:
            continue
        block = data[at : at + known[1]]
        if len(block) == known[1] and crc_hqx(block[1:], 0) == 0:
            found.setdefault(head, []).append(block)
            at += known[1] - 1
        else:
            heads.append(head)
    return found, sum(head in found for head in heads)


def recognises(path: Path, head: bytes) -> bool:
    """Return whether there are messages with a right checksum near the start: one may be chance in another binary."""
    return SYNC in head and sum(map(len, messages(head)[0].values())) > 1


def read(path: Path) -> Parts:
    """Gyro and accelerometer, the compensated ones first, and fixes of the receiver, with the sd that it states.

    Times are s since 1970 in GPS time where the IMU's messages have it, else since start-up: fixes have the time of the
    message that brought them then. The INS's own solution is not read.

    Raises:
        DataError: no message with a gyro and an accelerometer, and no fix in three dimensions.
    """
    found, lost = messages(read_bytes(path))
    kinds = {head: (layout_of(head), np.frombuffer(b"".join(rows), np.uint8)) for head, rows in found.items()}
    logs = [_Log(known[0], table.reshape(-1, known[1])) for known, table in kinds.values() if known is not None]
    notes: list[Note] = []
    streams: dict[str, Stream] = {}
    if lost:
        notes.append(finding("file.damaged", count=lost, words="messages"))
    imus = [(log, rows) for log in logs if (rows := log.imu()) is not None]
    fixes = [(log, group) for log in logs for group in (GNSS, GNSS_2) if log.has(group, 5)]
    source = max(fixes, key=lambda each: (each[1] == GNSS, each[0].count), default=None)
    dated = not imus or any(log.has_one(TIME_GPS) for log, _ in imus)
    dated = dated and (source is None or source[0].is_dated(source[1]))  # else both by the time since start-up
    imu = None
    if imus:
        log, (sampling, gyro, accel) = max(
            imus, key=lambda each: (each[0].has_one(TIME_GPS if dated else STARTUP), each[0].count)
        )
        scale = TimeScale.GPS if dated else TimeScale.UNKNOWN
        imu = ImuRows(log.time(dated), gyro, accel, sampling, scale=scale)
    if source is not None:
        streams, without = source[0].fixes(source[1], dated)
        if without:
            notes.append(finding("fixes.none", "position", count=without, words="outputs of the receiver"))
        if not dated and imu is not None:
            notes.append(finding("time.by_message", "position", USUAL_DELAY_S, words=""))
    if imu is None and not streams:
        raise DataError(
            f"{path}: has no gyro with an accelerometer, and no fix in three dimensions: log AngularRate, Accel, "
            f"TimeGps and the group GNSS; {lost} messages are damaged"
        )
    return Parts(os.fspath(path), imu, streams, notes=tuple(notes))


class _Log:
    """Messages of one layout."""

    def __init__(self, layout: Layout, table: np.ndarray) -> None:
        self.layout, self.table, self.count = layout, table, len(table)

    def has(self, *outputs: int) -> bool:
        return outputs in self.layout

    def has_one(self, several: tuple[tuple[int, int], ...]) -> bool:
        return any(each in self.layout for each in several)

    def is_dated(self, group: int) -> bool:
        """Return whether fixes of a group have GPS time."""
        return (self.has(group, 1) and self.has(group, 2)) or self.has_one(TIME_GPS)

    def get(self, group: int, output: int, kind: str, width: int = 1, skip: int = 0) -> np.ndarray:
        """Return an output (N, width), or (N,) of one number."""
        begin, size = self.layout[group, output] + skip, np.dtype(kind).itemsize * width
        values = np.ascontiguousarray(self.table[:, begin : begin + size]).view(kind)
        return values[:, 0] if width == 1 else values.astype(float)

    def imu(self) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Return sampling, gyro and accelerometer; None of a layout that lacks one of them or any time."""
        for sampling, each in SAMPLES:
            if all((group, output) in self.layout for group, output, *_ in each) and self.has_one(STARTUP + TIME_GPS):
                gyro, accel = (self.get(group, output, kind, 3, skip) for group, output, skip, kind in each)
                return sampling, gyro * (DEG if sampling == INCREMENTS else 1.0), accel
        return None

    def time(self, dated: bool) -> np.ndarray:
        """(N,) s since 1970 in GPS time, or since start-up; nan of a time that is none."""
        of = TIME_GPS if dated else STARTUP
        output = next((each for each in of if each in self.layout), None)
        if output is None:
            return np.full(self.count, np.nan)
        ns = self.get(*output, "<u8")
        return np.where(ns > 0, ns // 10**9 + (ns % 10**9) / 1e9, np.nan) + (GPS_EPOCH if dated else 0)

    def fixes(self, group: int, dated: bool) -> tuple[dict[str, Stream], int]:
        """Return position and velocity, a row for each fix, and how many outputs have none."""
        t = self.time(dated)
        if dated and self.has(group, 1) and self.has(group, 2):
            tow, week = self.get(group, 1, "<u8"), self.get(group, 2, "<u2")
            t = GPS_EPOCH + week * WEEK + tow / 1e9
        fixed = np.isin(self.get(group, 4, "u1"), FIXED) if self.has(group, 4) else np.full(self.count, True)
        value = self.get(group, 5, "<f8", 3) * [DEG, DEG, 1.0]
        new = np.r_[True, (np.diff(value, axis=0) != 0).any(1)]
        if self.has(group, 1):
            new |= np.r_[True, np.diff(self.get(group, 1, "<u8").astype(np.int64)) != 0]
        rows, scale = fixed & new, TimeScale.GPS if dated else TimeScale.UNKNOWN
        if not rows.any():
            return {}, int((~fixed).sum())
        sd = self.get(group, 9, "<f4", 3)[rows][:, [1, 0, 2]] if self.has(group, 9) else None
        out = {"position": Stream(t[rows], value[rows], sd, scale=scale)}
        if self.has(group, 7):
            sd = np.repeat(self.get(group, 10, "<f4")[rows, None].astype(float), 3, 1) if self.has(group, 10) else None
            out["velocity"] = Stream(t[rows], ned_to_enu(self.get(group, 7, "<f4", 3)[rows]), sd, scale=scale)
        return out, int((~fixed).sum())
