"""NMEA 0183, by `pynmeagps`: fixes of GGA, GNS, RMC, GLL, VTG, ZDA, GST, HDT and THS for the file of an IMU."""

import datetime
import os
import re
from collections import Counter
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.files import read_bytes
from jaxnav.io.missing import UNMEASURED_SD
from jaxnav.io.parts import Parts, Stream, TimeScale, scaled, unread
from jaxnav.io.units import UNITS
from jaxnav.maths import gps_time
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Note

SPEED_SD = 0.3  # m/s, assumed: NMEA states none
DAY = 86400.0  # s
PLACES = ("GGA", "GNS", "RMC", "GLL")  # sentences with a position, the best first; two of them without a height
HEADINGS = {"HDT": "headingT", "THS": "headt"}  # field of a two-antenna heading, deg
READ = {*PLACES, *HEADINGS, "VTG", "GST", "ZDA"}
KNOTS = UNITS["speed"]["knots"]


def recognises(path: Path, head: bytes) -> bool:
    """Return whether it has a sentence, after any prefix of a logger."""
    return bool(re.search(rb"\$[A-Z]{2}(GGA|GNS|RMC|GST|GSA|GSV|VTG|GLL|ZDA),[^\r\n$]*,[^\r\n$]*[\r\n]", head))


def sentences(data: bytes) -> tuple[list[bytes], int]:
    """Return the sentences of a log, and how many lack a checksum: those are taken where all do."""
    found = re.findall(rb"\$[A-Z]{2}[A-Z0-9]{3},[\x20-\x23\x25-\x29\x2b-\x7e]*(?:\*[0-9A-Fa-f]{2}|(?=[\r\n]))", data)
    bare = [line for line in found if b"*" not in line]
    if bare and len(bare) == len(found):
        return [b"%s*%02X" % (line, reduce(xor, line[1:])) for line in bare], len(bare)
    return [line for line in found if b"*" in line], len(bare)


def read(path: Path, leap_seconds: float | None = None, metres_per_hdop: float = 2.5) -> Parts:
    """Position of GGA, else of GNS, RMC or GLL, horizontal velocity of RMC or VTG, heading of HDT or THS.

    Times are s since 1970 in GPS time.

    Args:
        path: the text; other lines are skipped.
        leap_seconds: of GPS time on UTC, the time scale of NMEA; None: those of the date.
        metres_per_hdop: sd of east and north, where there is no GST, as a multiple of HDOP; up has twice that.

    Raises:
        DataError: no fix, or no sentence with the date.
    """
    import pynmeagps

    places: dict[str, list[Any]] = {kind: [] for kind in PLACES}
    motion, pointed, spread, day = [], [], {}, None
    first_day, last, now, damaged, level = None, -1.0, None, 0, 0
    others: Counter[str] = Counter()
    lines, bare = sentences(read_bytes(path))
    for line in lines:
        try:
            m: Any = pynmeagps.NMEAReader.parse(line + b"\r\n", msgmode=pynmeagps.GET)
        except Exception:  # a wrong checksum, or fields of another kind
            damaged += 1
            continue
        kind = getattr(m, "msgID", "")
        others[kind] += kind not in READ
        angle: Any = getattr(m, HEADINGS.get(kind, ""), None)
        if _numeric(angle) and now is not None and getattr(m, "mi", "A") != "V":
            pointed.append([now, angle * DEG])  # without a time: that of the sentence before
        if kind == "VTG" and now is not None and _numeric(m.cogt, m.sogn):
            motion.append(["VTG", now, m.sogn * KNOTS, m.cogt * DEG])
        if kind not in (*PLACES, "GST", "ZDA") or not isinstance(m.time, datetime.time):
            continue
        second = _second(m.time)
        date = _date(m) if kind in ("RMC", "ZDA") else None
        if date is not None:
            day, last = _day(date), second
            first_day = day if first_day is None else first_day
        now = _stamp(day, second, last)
        if kind == "RMC" and date is not None and m.status == "A" and _numeric(m.spd, m.cog):
            motion.append(["RMC", _day(date) + second, m.spd * KNOTS, m.cog * DEG])
        if kind in PLACES and _is_fix(m) and _numeric(m.lat, m.lon):
            if kind == "GGA" and not _numeric(m.alt):
                level += 1
                continue
            alt: Any = getattr(m, "alt", None)
            sep: Any = getattr(m, "sep", None)
            height = alt + (sep if _numeric(sep) else 0.0) if _numeric(alt) else np.nan
            places[kind].append((now, second, [m.lat * DEG, m.lon * DEG, height], getattr(m, "HDOP", None)))
        elif kind == "GST":
            spread[second] = [m.stdLong, m.stdLat, m.stdAlt]
    most = max(map(len, places.values()))
    fixes = next(rows for rows in places.values() if 2 * len(rows) >= most)
    if not fixes:
        raise DataError(f"{path}: has no {', '.join(PLACES)} with a fix in three dimensions")
    if first_day is None:
        raise DataError(f"{path}: has no RMC or ZDA, the sentences with the date")
    kind = "RMC" if any(row[0] == "RMC" for row in motion) else "VTG"
    moved = [row[1:] for row in motion if row[0] == kind]
    leap = gps_time.leap_seconds(first_day) if leap_seconds is None else leap_seconds
    parts = _parts(path, fixes, moved, spread, first_day, leap, metres_per_hdop)
    if pointed:
        t, angles = np.array(pointed).T
        t, rows = np.unique(t, return_index=True)
        heading = {"heading": Stream(t + leap, angles[rows, None])}
        parts = parts._replace(aiding={**parts.aiding, **heading})
    done = "taken" if len(lines) == bare else "left out"
    left = (
        (damaged, finding("file.damaged", count=damaged, words="sentences")),
        (bare, finding("file.unchecked", count=bare, words="sentences", done=done)),
        (level, finding("file.left_out", "position", count=level, words="GGA without a height, in two dimensions,")),
    )
    return parts._replace(notes=(*parts.notes, *(said for count, said in left if count), *unread(+others)))


def _is_fix(m: Any) -> bool:
    """Return whether a sentence of `PLACES` says that it has a fix."""
    if m.msgID == "GGA":
        return bool(m.quality)
    if m.msgID == "GNS":
        return any(mode not in "N" for mode in str(m.posMode))
    return bool(m.status == "A")


def _numeric(*fields: Any) -> bool:
    return all(isinstance(field, (int, float)) for field in fields)


def _date(m: Any) -> datetime.date | None:
    """Return the date of an RMC or ZDA, None where it has none."""
    if m.msgID == "RMC":
        return m.date if isinstance(m.date, datetime.date) else None
    try:
        return datetime.date(int(m.year), int(m.month), int(m.day))
    except (TypeError, ValueError):
        return None


def _second(moment: datetime.time) -> float:
    return moment.hour * 3600.0 + moment.minute * 60.0 + moment.second + moment.microsecond / 1e6


def _day(date: datetime.date) -> float:
    return datetime.datetime(date.year, date.month, date.day, tzinfo=datetime.UTC).timestamp()


def _stamp(day: float | None, second: float, last: float) -> float | None:
    """S since 1970 with the last date; None before the first. GGA may come first after midnight."""
    if day is None:
        return None
    return day + second + (DAY if second < last - DAY / 2 else 0.0)


def _parts(
    path: Path,
    fixes: list[Any],
    motion: list[Any],
    spread: dict[float, list[Any]],
    first_day: float,
    leap: float,
    scale: float,
) -> Parts:
    notes: list[Note] = []
    t = np.array([second + first_day if stamp is None else stamp for stamp, second, _, _ in fixes]) + leap
    sd = np.array([_sd(spread.get(second), hdop, scale) for _, second, _, hdop in fixes])
    guessed = np.count_nonzero([second not in spread and _numeric(hdop) for _, second, _, hdop in fixes])
    if guessed:
        words = f"{scale:g} m times HDOP, twice that upwards"
        notes.append(finding("rows.some_sd", "position", count=guessed, of=len(fixes), words=words))
    streams = {"position": Stream(t, np.array([lla for _, _, lla, _ in fixes]), sd)}
    if motion:
        t, speed, course = np.array(motion).T
        value = np.stack([speed * np.sin(course), speed * np.cos(course), np.zeros_like(speed)], axis=1)
        streams["velocity"] = Stream(t + leap, value, np.tile([SPEED_SD, SPEED_SD, UNMEASURED_SD], (len(t), 1)))
        words = f"{SPEED_SD} m/s, and nothing is known upwards"
        notes.append(finding("stream.assumed_sd", "velocity", words=words, scan=""))
    notes.append(finding("time.utc", "fixes", leap, words=""))
    return scaled(Parts(os.fspath(path), aiding=streams, notes=tuple(notes)), TimeScale.GPS)


def _sd(gst: list[Any] | None, hdop: Any, scale: float) -> list[float]:
    if gst is not None and all(isinstance(x, (int, float)) and x > 0 for x in gst):
        return gst
    horizontal = scale * (hdop if isinstance(hdop, (int, float)) else np.nan)
    return [horizontal, horizontal, 2.0 * horizontal]
