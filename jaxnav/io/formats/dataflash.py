"""ArduPilot DataFlash logs, binary (``.BIN``) and text (``.log``): the format describes itself in FMT messages."""

import os
import re
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.checks import ned_to_enu
from jaxnav.io.clock_rate import at_gps_rate
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import ImuRows, Parts, Stream, with_fixes
from jaxnav.io.units import UNITS
from jaxnav.maths.gps_time import WEEK
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Json, Note

SYNC, FMT, FMT_SIZE = b"\xa3\x95", 128, 89
MILLIGAUSS = UNITS["field"]["mgauss"]
FIX_3D = 3
WEEK_AND_TIME = (("GWk", "Week"), ("GMS", "TimeMS"))  # columns of GPS week and ms of it, today and in the past
DOWNWARD, SEES = 25, 4  # orientation and status of a rangefinder

# format character: code of `struct`, and the factor to the unit in the name of the column
CODES: dict[str, tuple[str, float]] = {
    "b": ("b", 1.0), "B": ("B", 1.0), "M": ("B", 1.0), "h": ("h", 1.0), "H": ("H", 1.0), "i": ("i", 1.0),
    "I": ("I", 1.0), "q": ("q", 1.0), "Q": ("Q", 1.0), "f": ("f", 1.0), "d": ("d", 1.0), "g": ("e", 1.0),
    "c": ("h", 0.01), "C": ("H", 0.01), "e": ("i", 0.01), "E": ("I", 0.01), "L": ("i", 1e-7),
    "n": ("4s", 0.0), "N": ("16s", 0.0), "Z": ("64s", 0.0), "a": ("64s", 0.0),
}  # fmt: skip


class Format(NamedTuple):
    """A kind of message: its name, columns and the structure of its body."""

    name: str
    columns: tuple[str, ...]
    codes: str
    body: struct.Struct


def recognises(path: Path, head: bytes) -> bool:
    """Return whether a log opens with the format of its formats, in bytes or as text."""
    return head.startswith(SYNC + bytes([FMT])) or bool(re.match(rb"FMT, *128, *89, *FMT,", head))


def read(path: Path, instance: int = 0, receiver: str | None = None) -> Parts:
    """IMU ``instance`` and the first of each other sensor of a log, see docs/formats.md; t in s of the board.

    ``receiver``: such as "GPS 1"; default the first that mostly has a fix.

    Body FRD, as in the log. Heights of fixes are above sea level; HAcc, VAcc and SAcc are the sd of each axis.

    Raises:
        DataError: no such IMU or receiver.
    """
    notes: list[Note] = []
    logged = read_messages(path, notes)
    imu = _instance(logged, "IMU", instance)
    if imu is None:
        kinds = ", ".join(sorted(logged)) or "no messages"
        raise DataError(f"{path}: has no IMU {instance}, only {kinds}")
    rows = ImuRows(_seconds(imu), _columns(imu, "GyrX", "GyrY", "GyrZ"), _columns(imu, "AccX", "AccY", "AccZ"))
    gps = {f"GPS {i}": data for i in range(4) for data in [_instance(logged, "GPS", i)] if data is not None}
    number = 0
    if gps or receiver:
        fixed = {name: data["Status"] >= FIX_3D for name, data in gps.items()}
        number = int(with_fixes(os.fspath(path), fixed, receiver, notes)[-1])
    aiding = _gps(logged, notes, number)
    baro, mag, wind = (_instance(logged, name, 0) for name in ("BARO", "MAG", "ARSP"))
    if baro is not None:
        aiding["barometer"] = Stream(_seconds(baro), _columns(baro, "Alt"))
    if mag is not None:
        aiding["magnetometer"] = Stream(_seconds(mag), _columns(mag, "MagX", "MagY", "MagZ") * MILLIGAUSS)
    if wind is not None:
        aiding["airspeed"] = Stream(_seconds(wind), _columns(wind, "Airspeed"))
    down = _rangefinder(_instance(logged, "RFND", 0))
    if down is not None:
        aiding["rangefinder"] = down
    parts = Parts(os.fspath(path), rows, aiding, notes=tuple(notes))
    return at_gps_rate(parts, *_clocks(gps[f"GPS {number}"])) if gps else parts


def _rangefinder(data: dict[str, np.ndarray] | None) -> Stream | None:
    """One that looks down, where it says that it sees something."""
    if data is None or "Dist" not in data:
        return None
    good = data["Dist"] > 0
    good &= data["Orient"] == DOWNWARD if "Orient" in data else True
    good &= data["Stat"] == SEES if "Stat" in data else True
    return Stream(_seconds(data)[good], data["Dist"][good, None]) if good.any() else None


def _damaged(count: int, words: str) -> list[Note]:
    """Return the finding on bytes or lines that are no message; none of none."""
    return [finding("file.damaged", count=count, words=words)] if count > 0 else []


def read_messages(path: Path, notes: list[Note] | None = None) -> dict[str, dict[str, np.ndarray]]:
    """Every kind of message: its numeric columns (N,) by name, in the unit that the format's character means.

    Bytes without a message are skipped; ``notes`` gets their number.
    """
    data = read_bytes(path)
    rows, formats, damaged = _binary(data) if data.startswith(SYNC) else _text(data)
    if notes is not None:
        notes += damaged
    out = {}
    for name, values in rows.items():
        kept = [(i, c) for i, c in enumerate(formats[name].columns) if CODES[formats[name].codes[i]][1]]
        out[name] = {c: np.array([row[i] for row in values], float) for i, c in kept}
    return out


def _format(kind: str, columns: str, name: str) -> Format | None:
    names = tuple(c for c in columns.split(",") if c)
    if len(names) != len(kind) or any(c not in CODES for c in kind):
        return None
    return Format(name, names, kind, struct.Struct("<" + "".join(CODES[c][0] for c in kind)))


def _binary(data: bytes) -> tuple[dict[str, list[Any]], dict[str, Format], list[Note]]:
    """Return rows by name, formats, and the skipped part: from a damaged message to the next sync bytes."""
    formats: dict[int, Format] = {}
    rows: dict[str, list[Any]] = {}
    sizes = {FMT: FMT_SIZE}
    at = used = 0
    while (at := data.find(SYNC, at)) >= 0 and at + 3 <= len(data):
        kind = data[at + 2]
        size = sizes.get(kind, 0)
        if not size or at + size > len(data):
            at += 2
            continue
        body = data[at + 3 : at + size]
        if kind == FMT:
            number, length, name, codes, columns = struct.unpack("<BB4s16s64s", body)
            words = [_word(x) for x in (codes, columns, name)]
            made = _format(*words)
            if made is not None and made.body.size + 3 == length:
                formats[number], sizes[number] = made, length
        elif kind in formats:
            form = formats[kind]
            values = form.body.unpack(body)
            rows.setdefault(form.name, []).append(
                [v * CODES[c][1] if CODES[c][1] else 0.0 for v, c in zip(values, form.codes)]
            )
        at += size
        used += size
    passed = len(data.rstrip(b"\0\xff")) - used  # erased memory may follow
    return rows, {form.name: form for form in formats.values()}, _damaged(passed, "bytes")


def _word(data: bytes) -> str:
    return data.split(b"\0")[0].decode("ascii", errors="replace")


def _text(data: bytes) -> tuple[dict[str, list[Any]], dict[str, Format], list[Note]]:
    formats: dict[str, Format] = {}
    rows: dict[str, list[Any]] = {}
    lines = data.decode(errors="replace").split("\n")
    passed = 1 if lines.pop().strip() else 0  # a last line without an end is cut
    for line in lines:
        cells = [cell.strip() for cell in line.split(",")]
        if cells[0] == "FMT" and len(cells) > 5:
            made = _format(cells[4], ",".join(cells[5:]), cells[3])
            if made is not None:
                formats[made.name] = made
        elif cells[0] in formats and len(cells) == len(formats[cells[0]].columns) + 1:
            try:
                codes = formats[cells[0]].codes
                rows.setdefault(cells[0], []).append(
                    [float(cell) if CODES[c][1] else 0.0 for cell, c in zip(cells[1:], codes)]
                )
            except ValueError:
                passed += 1
        else:
            passed += bool(line.strip())
    return rows, formats, _damaged(passed, "lines")


def _instance(logged: dict[str, Json], name: str, number: int) -> dict[str, np.ndarray] | None:
    """Messages of one sensor: by its column ``I`` or ``Instance``, by the name's last digit (IMU, IMU2) in the past."""
    data = logged.get(name)
    key = next((key for key in ("I", "Instance") if data is not None and key in data), None)
    if data is not None and key is not None:
        mine = data[key] == number
        return {key: values[mine] for key, values in data.items()} if mine.any() else None
    return logged.get(f"{name}{number + 1}") if number else data


def _seconds(data: dict[str, np.ndarray]) -> np.ndarray:
    """Return the board's time (N,) s; TimeMS of an old GPS message is GPS time of week, and T the board's."""
    if "TimeUS" in data:
        return data["TimeUS"] / 1e6
    return data["T" if "T" in data else "TimeMS"] / 1e3


def _clocks(gps: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the board's time and GPS time (K,) of the rows with a fix; nan where the log has none."""
    week, second = (next((gps[name] for name in names if name in gps), None) for names in WEEK_AND_TIME)
    fixed = gps["Status"] >= FIX_3D
    if week is None or second is None or second is gps.get("TimeMS") and "T" not in gps:
        return _seconds(gps)[fixed], np.full(np.count_nonzero(fixed), np.nan)
    return _seconds(gps)[fixed], (week * WEEK + second / 1e3)[fixed]


def _columns(data: dict[str, np.ndarray], *names: str) -> np.ndarray:
    missing = [name for name in names if name not in data]
    if missing:
        raise DataError(f"expected a column {missing[0]}, got {', '.join(data)}")
    return np.stack([data[name] for name in names], axis=1)


def _gps(logged: dict[str, Json], notes: list[Note], number: int) -> dict[str, Stream]:
    gps, accuracy = _instance(logged, "GPS", number), _instance(logged, "GPA", number)
    if gps is None:
        return {}
    fixed = gps["Status"] >= FIX_3D
    if not fixed.all():
        count = int(np.count_nonzero(~fixed))
        notes.append(finding("fixes.none", "position", count=count, words=f"of {len(fixed)} rows of GPS"))
    notes.append(finding("heights.sea_level"))
    t = _seconds(gps)
    lla = _columns(gps, "Lat", "Lng", "Alt") * np.array([DEG, DEG, 1.0])
    course = gps["GCrs"] * DEG
    vel = np.stack([gps["Spd"] * np.cos(course), gps["Spd"] * np.sin(course), gps["VZ"]], axis=1)
    sd: list[np.ndarray | None] = [None, None]
    if accuracy is not None:  # another message with the same time
        found = np.searchsorted(_seconds(accuracy), t, side="left").clip(max=len(accuracy["HAcc"]) - 1)
        same = np.abs(_seconds(accuracy)[found] - t) < 0.05
        table = np.where(same[:, None], _columns(accuracy, "HAcc", "VAcc", "SAcc")[found], np.nan)
        sd = [table[fixed][:, [0, 0, 1]], table[fixed][:, [2, 2, 2]]]
    streams = {
        "position": Stream(t[fixed], lla[fixed], sd[0]),
        "velocity": Stream(t[fixed], ned_to_enu(vel[fixed]), sd[1]),
    }
    pointed = fixed & (gps["Yaw"] != 0) if "Yaw" in gps else np.zeros_like(fixed)  # of two antennas; 0 is none
    if pointed.any():
        streams["heading"] = Stream(t[pointed], gps["Yaw"][pointed, None] * DEG)
    return streams
