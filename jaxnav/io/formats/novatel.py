"""NovAtel's ASCII logs (OEM6, OEM7, SPAN): RAWIMU with its short and extended forms, BESTPOS, BESTVEL and INSPVA.

Fields, units and IMU types: OEM7 Commands and Logs Reference Manual, the page of each log.
"""

import math
import os
import re
import zlib
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import INCREMENTS, ImuRows, Parts, Stream, TimeScale, scaled, unread
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.maths.units import DEG, MG
from jaxnav.types import DataError, Note, Track, nearest

FOOT = 0.3048  # m
HONEYWELL = (2.0**-33, 2.0**-27 * FOOT)
KVH = (0.1 / (3600 * 256), 0.05 * 2.0**-15)
LITEF = (1e-9, 2e-8)
STIM = (2.0**-21 * DEG, 2.0**-22)
HG4930 = (2.0**-33, 2.0**-29)
IMUS: dict[str, tuple[int, float, float]] = {
    "HG1700_AG11": (1, *HONEYWELL),
    "HG1700_AG17": (4, 2.0**-33, 2.0**-26 * FOOT),
    "HG1900_CA29": (5, *HONEYWELL),
    "LN200": (8, 2.0**-19, 2.0**-14),
    "HG1700_AG58": (11, *HONEYWELL),
    "HG1700_AG62": (12, 2.0**-33, 2.0**-26 * FOOT),
    "IMAR_FSAS": (13, 0.1 * 2.0**-8 * DEG / 3600, 0.05 * 2.0**-15),
    "KVH_COTS": (16, *KVH),
    "HG1930_AA99": (20, *HONEYWELL),
    "ISA100C": (26, *LITEF),
    "HG1900_CA50": (27, *HONEYWELL),
    "HG1930_CA50": (28, *HONEYWELL),
    "ADIS16488": (31, 720 * 2.0**-31 * DEG, 200 * 2.0**-31),
    "STIM300": (32, *STIM),
    "KVH_1750": (33, *KVH),
    "EPSON_G320": (41, 0.008 * 2.0**-16 * DEG / 125, 0.2 * 2.0**-16 * MG / 125),
    "LITEF_MICROIMU": (52, *LITEF),
    "STIM300D": (56, *STIM),
    "HG4930_AN01": (58, *HG4930),
    "EPSON_G370": (61, 0.0151515 * 2.0**-16 * DEG / 200, 0.4 * 2.0**-16 * MG / 200),
    "EPSON_G320_200HZ": (62, 0.008 * 2.0**-16 * DEG / 200, 0.2 * 2.0**-16 * MG / 200),
    "HG4930_AN04": (68, *HG4930),
    "HG4930_AN04_400HZ": (69, *HG4930),
}
"""Number of the type, rad and m/s of one count of RAWIMU, by name."""

START = re.compile(rb"[#%]([A-Z0-9]+)A,")
TAIL = re.compile(rb"[^\r\n]+\*[0-9a-fA-F]{8}(?=[\r\n])")
LINE = re.compile(rb"[#%]([A-Z0-9]+)A,([^;\r\n*]*);([^\r\n*]*)\*([0-9a-fA-F]{8})")
POSITIONS, VELOCITIES = ("BESTGNSSPOS", "BESTPOS"), ("BESTGNSSVEL", "BESTVEL")  # without the INS before with it
SOLUTIONS = {"INSPVA": 0, "INSPVAS": 0, "INSPVAX": 1}  # 1: another order of the fields
RAW = {"RAWIMUX": 2, "RAWIMUSX": 2, "RAWIMU": 0, "RAWIMUS": 0}  # fields before the week; those that state a type first
WANTED = {*POSITIONS, *VELOCITIES, *SOLUTIONS, *RAW}
Rows = list[tuple[list[bytes], list[bytes]]]  # fields of header and body of each line
GOOD = {b"INS_SOLUTION_GOOD", b"INS_ALIGNMENT_COMPLETE"}


def recognises(path: Path, head: bytes) -> bool:
    """Return whether it has a line of a known log, or of others and no sentence of NMEA."""
    names = {match.group(1).decode() for match in LINE.finditer(head)}
    return bool(names & WANTED) or (bool(names) and not re.search(rb"\$G[A-Z]{4},", head))


def crc32(data: bytes) -> int:
    """Return NovAtel's checksum: CRC-32 from 0 without the last inversion."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def read(path: Path, imu: str | None = None) -> Parts:
    """IMU in increments, position and velocity of the receiver, the receiver's INS as truth; t in GPS time since 1970.

    Args:
        path: the text; other logs and lines are skipped.
        imu: row of `IMUS`, where the log states no type (RAWIMU and RAWIMUS).

    Raises:
        DataError: no line that could be read, or an IMU of no known type.
    """
    logs: dict[str, Rows] = defaultdict(list)
    data, untimed, others = read_bytes(path), 0, Counter[str]()
    damaged = sum(match.group(1).decode() in WANTED for match in START.finditer(data))
    damaged += sum(START.search(line) is None for line in TAIL.findall(data))  # whose name is lost
    for match in LINE.finditer(data):
        name, head, body, check = match.groups()
        if crc32(match.group(0)[1:-9]) != int(check, 16):
            continue
        if name.decode() not in WANTED:
            others[name.decode()] += 1
            continue
        damaged -= 1
        fields = head.split(b",")
        if len(fields) > 3 and fields[3] == b"UNKNOWN":  # the receiver does not know the time yet
            untimed += 1
            continue
        logs[name.decode()].append((fields, body.split(b",")))
    notes: list[Note] = [finding("file.damaged", count=damaged, words="lines")] if damaged else []
    if untimed:
        words = "lines from before the receiver knew the time"
        notes.append(finding("file.left_out", path.name, count=untimed, words=words))
    raw = next((name for name in RAW if name in logs), None)
    head = next((rows[0][0] for rows in logs.values()), [b"0", b"0"])
    week, second = (math.floor(_number(cell)) for cell in _when(head))
    zero = int(GPS_EPOCH + week * WEEK + second)
    parts = Parts(os.fspath(path), axes="rfu", zero=zero)
    if raw is not None:
        parts = parts._replace(imu=_imu(path, logs[raw], RAW[raw], imu, zero, notes))
        notes.append(finding("axes.assumed", "the IMU", words='right, forward, up, as SPAN has it: axes = "rfu"'))
    found = {"position": _position(logs, zero, notes), "velocity": _velocity(logs, zero)}
    aiding = {name: stream for name, stream in found.items() if stream is not None}
    if parts.imu is None and not aiding:
        raise DataError(f"{path}: expected {', '.join((*RAW, *POSITIONS))}, got {', '.join(logs) or 'none'}")
    solution = next((name for name in SOLUTIONS if name in logs), None)
    truth = None if solution is None else _solution(logs[solution], SOLUTIONS[solution], zero)
    if truth is not None:
        words = f"{solution}, the receiver's INS/GNSS solution, which uses the same fixes"
        notes.append(finding("stream.chosen", "truth", words=words))
    notes.append(finding("time.zero", words=f"{zero} s since 1970 in GPS time"))
    parts = scaled(parts._replace(aiding=aiding), TimeScale.GPS)
    return parts._replace(truth=truth, notes=(*notes, *unread(others)))


def _imu(path: Path, rows: Rows, first: int, name: str | None, zero: int, notes: list[Note]) -> ImuRows:
    """Return increments by the scale of the IMU's type; fields: week, s, status, then z, -y, x of accel and gyro."""
    if name is not None and name not in IMUS:
        raise DataError(f"{path}: imu: {nearest(name, tuple(IMUS))}")
    if name is None:
        names = {number: key for key, (number, *_) in IMUS.items()}
        kinds = Counter(int(_number(body[1])) for _, body in rows) if first else Counter()
        kind = kinds.most_common(1)[0][0] if kinds else None
        if kind not in names:
            said = "states no type of IMU" if kind is None else f"has an IMU of type {kind}, with an unknown scale"
            raise DataError(f"{path}: the log {said}: option imu = one of {', '.join(IMUS)}")
        name = names[kind]
        notes.append(finding("stream.chosen", "imu", words=f"of type {name}, by the log"))
    _, rad, mps = IMUS[name]
    values = np.array(
        [[_number(cell) for cell in body[first : first + 9]] for _, body in rows if len(body) == first + 9]
    )
    order = [2, 1, 0]
    sign = np.array([1.0, -1.0, 1.0])
    return ImuRows(
        _time(values, zero), values[:, 6:9][:, order] * sign * rad, values[:, 3:6][:, order] * sign * mps, INCREMENTS
    )


def _position(logs: dict[str, Rows], zero: int, notes: list[Note]) -> Stream | None:
    """Return fixes above the ellipsoid; those that the receiver made with its INS are left out where others are."""
    name = next((name for name in POSITIONS if name in logs), None)
    if name is None:
        return None
    rows = [(head, body) for head, body in logs[name] if body[0] == b"SOL_COMPUTED" and len(body) > 9]
    fixes = [row for row in rows if not row[1][1].startswith(b"INS")]
    if len(fixes) < len(rows):
        said = "left out" if fixes else "taken, there are no others"
        notes.append(finding("fixes.with_ins", name, count=len(rows) - len(fixes), of=len(rows), words=said))
    rows = fixes or rows
    if not rows:
        return None
    v = np.array([[_number(cell) for cell in body[2:10]] for _, body in rows])  # lat lon h undulation datum sd...
    lla = np.column_stack([v[:, 0] * DEG, v[:, 1] * DEG, v[:, 2] + v[:, 3]])
    return Stream(_stamps(rows, zero), lla, v[:, [6, 5, 7]])


def _velocity(logs: dict[str, Rows], zero: int) -> Stream | None:
    """Return velocities, at their times: that of the log less the latency it states."""
    name = next((name for name in VELOCITIES if name in logs), None)
    rows = [(h, b) for h, b in logs.get(name or "", []) if b[0] == b"SOL_COMPUTED" and len(b) > 6]
    fixes = [row for row in rows if not row[1][1].startswith(b"INS")] or rows
    if not fixes:
        return None
    late, _, speed, course, up = np.array([[_number(cell) for cell in body[2:7]] for _, body in fixes]).T
    vel = np.column_stack([speed * np.sin(course * DEG), speed * np.cos(course * DEG), up])
    return Stream(_stamps(fixes, zero) - late, vel)


def _solution(rows: Rows, extended: int, zero: int) -> Track | None:
    """Return INSPVA as a track where its status is good; roll, pitch and azimuth are those of FRD against NED."""
    if extended:  # status type lat lon h undulation vn ve vu roll pitch azimuth ...
        good = [(h, b) for h, b in rows if b[0] in GOOD and len(b) > 11]
        t, v = _stamps(good, zero), np.array([[_number(cell) for cell in b[2:12]] for _, b in good]).reshape(-1, 10)
        v = np.column_stack([v[:, :2], v[:, 2] + v[:, 3], v[:, 4:]])
    else:  # week s lat lon h vn ve vu roll pitch azimuth status
        good = [(h, b) for h, b in rows if b[-1] in GOOD and len(b) == 12]
        v = np.array([[_number(cell) for cell in b[:11]] for _, b in good]).reshape(-1, 11)
        t, v = _time(v, zero), v[:, 2:]
    t, first = np.unique(t, return_index=True)
    v = v[first]
    if t.size < 2 or not np.isfinite(v).all():
        return None
    return Track(t, v[:, :3] * [DEG, DEG, 1.0], v[:, [4, 3, 5]], v[:, 6:9] * DEG)


def _stamps(rows: Rows, zero: int) -> np.ndarray:
    """Return the times of headers."""
    return _time(np.array([[_number(cell) for cell in _when(head)] for head, _ in rows]).reshape(-1, 2), zero)


def _when(head: list[bytes]) -> list[bytes]:
    """Return week and second of a header: port, sequence, idle, status, week, s; or week, s."""
    return head[4:6] if len(head) > 3 else head[:2]


def _time(weeks: np.ndarray, zero: int) -> np.ndarray:
    """Return s from ``zero`` (s since 1970): whole numbers first, which a float keeps."""
    return (GPS_EPOCH + weeks[:, 0] * WEEK - zero) + weeks[:, 1]


def _number(cell: bytes) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan
