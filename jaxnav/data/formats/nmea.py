"""NMEA 0183, by `pynmeagps`: GGA, RMC, GST, HDT and THS, the fixes beside an IMU's file."""

import datetime
import io
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.data.files import read_bytes
from jaxnav.data.parts import Parts, Stream
from jaxnav.data.units import UNITS
from jaxnav.maths.units import DEG
from jaxnav.types import DataError

UP_SD = 1e3  # m/s: RMC has no vertical velocity
SPEED_SD = 0.3  # m/s, assumed: NMEA states none
DAY = 86400.0  # s
HEADINGS = {"HDT": "headingT", "THS": "headt"}  # field of what two antennas say, deg
KNOTS = UNITS["speed"]["knots"]


def recognises(path: Path, head: bytes) -> bool:
    """A sentence with a checksum at the start of a line."""
    return bool(re.search(rb"^\$[A-Z]{2}(GGA|RMC|GST|GSA|GSV|VTG|GLL),[^\r\n]*\*[0-9A-Fa-f]{2}", head, re.MULTILINE))


def read(path: Path, leap_seconds: float = 18.0, metres_per_hdop: float = 2.5) -> Parts:
    """Position of GGA, horizontal velocity of RMC, heading of HDT or THS; t in s since 1970 in GPS time.

    Args:
        path: the text; other messages between the sentences are passed over.
        leap_seconds: of GPS time on UTC, which is what NMEA tells.
        metres_per_hdop: sd of east and north, where there is no GST, as a multiple of HDOP; up has twice that.

    Raises:
        DataError: no fix, or no sentence that tells the date.
    """
    import pynmeagps

    fixes, motion, pointed, spread, day = [], [], [], {}, None
    first_day, last = None, -1.0
    errors: list[Any] = []
    stream = io.BytesIO(read_bytes(path))
    reader = pynmeagps.NMEAReader(stream, quitonerror=pynmeagps.ERR_LOG, errorhandler=errors.append)
    for _, m in reader:
        kind = getattr(m, "msgID", "")
        angle = getattr(m, HEADINGS.get(kind, ""), None)
        if isinstance(angle, (int, float)) and day is not None and getattr(m, "mi", "A") != "V":
            pointed.append([day + last, angle * DEG])  # has no time of its own: that of the RMC before it
        if kind not in ("GGA", "RMC", "GST") or not isinstance(m.time, datetime.time):
            continue
        second = _second(m.time)
        if kind == "RMC" and isinstance(m.date, datetime.date):
            day, last = _day(m.date), second
            first_day = day if first_day is None else first_day
            if m.status == "A" and all(isinstance(x, (int, float)) for x in (m.spd, m.cog)):
                motion.append([day + second, m.spd * KNOTS, m.cog * DEG])
        elif kind == "GGA" and m.quality and isinstance(m.lat, float):
            fixes.append(
                (_stamp(day, second, last), second, [m.lat * DEG, m.lon * DEG, m.alt + (m.sep or 0.0)], m.HDOP)
            )
        elif kind == "GST":
            spread[second] = [m.stdLong, m.stdLat, m.stdAlt]
    if not fixes:
        raise DataError(f"{path}: has no GGA with a fix")
    if first_day is None:
        raise DataError(f"{path}: has no RMC, which would tell the date")
    parts = _parts(path, fixes, motion, spread, first_day, leap_seconds, metres_per_hdop)
    if pointed:
        t, angles = np.array(pointed).T
        t, rows = np.unique(t, return_index=True)
        heading = {"heading": Stream(t + leap_seconds, angles[rows, None])}
        parts = parts._replace(aiding={**parts.aiding, **heading})
    said = (f"{len(errors)} sentences are damaged and left out.",) if errors else ()
    return parts._replace(notes=parts.notes + said)


def _second(moment: datetime.time) -> float:
    return moment.hour * 3600.0 + moment.minute * 60.0 + moment.second + moment.microsecond / 1e6


def _day(date: datetime.date) -> float:
    return datetime.datetime(date.year, date.month, date.day, tzinfo=datetime.UTC).timestamp()


def _stamp(day: float | None, second: float, last: float) -> float | None:
    """S since 1970 with the date of the last RMC; None before the first. GGA may come first after midnight."""
    if day is None:
        return None
    return day + second + (DAY if second < last - DAY / 2 else 0.0)


def _parts(
    path: Path, fixes: list[Any], motion: list[Any], spread: dict, first_day: float, leap: float, scale: float
) -> Parts:
    notes = []
    t = np.array([second + first_day if stamp is None else stamp for stamp, second, _, _ in fixes]) + leap
    sd = np.array([_sd(spread.get(second), hdop, scale) for _, second, _, hdop in fixes])
    guessed = np.count_nonzero([second not in spread for _, second, _, _ in fixes])
    if guessed:
        notes.append(f"position: the sd of {guessed} fixes are taken as {scale:g} m times HDOP, twice that upwards.")
    streams = {"position": Stream(t, np.array([lla for _, _, lla, _ in fixes]), sd)}
    if motion:
        t, speed, course = np.array(motion).T
        value = np.stack([speed * np.sin(course), speed * np.cos(course), np.zeros_like(speed)], axis=1)
        streams["velocity"] = Stream(t + leap, value, np.tile([SPEED_SD, SPEED_SD, UP_SD], (len(t), 1)))
        notes.append(f"velocity: NMEA states no sd; assumed are {SPEED_SD} m/s, and nothing is known upwards.")
    notes.append(f"UTC is taken as GPS time less {leap:g} s.")
    return Parts(os.fspath(path), aiding=streams, notes=tuple(notes))


def _sd(gst: list | None, hdop: Any, scale: float) -> list[float]:
    if gst is not None and all(isinstance(x, (int, float)) and x > 0 for x in gst):
        return gst
    horizontal = scale * (hdop if isinstance(hdop, (int, float)) else np.nan)
    return [horizontal, horizontal, 2.0 * horizontal]
