"""u-blox UBX, by `pyubx2`: NAV-PVT, the fixes beside an IMU's file."""

import datetime
import io
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.data.checks import ned_to_enu
from jaxnav.data.files import read_bytes
from jaxnav.data.mend import GPS_EPOCH, WEEK
from jaxnav.data.parts import Parts, Stream
from jaxnav.maths.units import DEG
from jaxnav.types import DataError

SYNC = b"\xb5\x62"
FIXED = (3, 4)  # fixType: in three dimensions, alone or with dead reckoning
LEAP = 18.0  # s, of GPS time on UTC: near enough to find the week


def recognises(path: Path, head: bytes) -> bool:
    """A message of UBX near the start whose checksum is right: text or RTCM may stand between."""
    at = -1
    while (at := head.find(SYNC, at + 1)) >= 0:
        end = at + 6 + int.from_bytes(head[at + 4 : at + 6], "little")
        if len(head) < end + 2:
            continue
        a = b = 0
        for byte in head[at + 2 : end]:
            a = (a + byte) & 255
            b = (b + a) & 255
        if head[end : end + 2] == bytes([a, b]):
            return True
    return False


def read(path: Path) -> Parts:
    """Position and velocity of NAV-PVT, heading of NAV-RELPOSNED where the base moves along; hAcc, vAcc, sAcc are sd.

    Times are s since 1970 in GPS time.

    Raises:
        DataError: no NAV-PVT.
    """
    import pyubx2

    rows, pointed, without = [], [], 0
    errors: list[Any] = []
    stream = io.BytesIO(read_bytes(path))
    reader = pyubx2.UBXReader(
        stream, protfilter=pyubx2.UBX_PROTOCOL, quitonerror=pyubx2.ERR_LOG, errorhandler=errors.append
    )
    for _, message in reader:
        if message is not None and message.identity == "NAV-RELPOSNED" and getattr(message, "relPosHeadingValid", 0):
            if message.isMoving and message.relPosValid:
                pointed.append([message.iTOW, message.relPosHeading * DEG, message.accHeading * DEG])
        if message is None or message.identity != "NAV-PVT":
            continue
        if message.fixType not in FIXED or not message.gnssFixOk or not message.validDate:
            without += 1
            continue
        rows.append(_row(message))
    if not rows:
        raise DataError(f"{path}: has no NAV-PVT with a fix in three dimensions ({without} without)")
    said = {"NAV-PVT have no fix in three dimensions.": without, "messages are damaged and left out.": len(errors)}
    notes = tuple(f"{count} {what}" for what, count in said.items() if count)
    t, lla, acc, vel, s_acc = np.split(np.array(rows), [1, 4, 6, 9], axis=1)
    position = Stream(t[:, 0], lla, acc[:, [0, 0, 1]])
    velocity = Stream(t[:, 0], ned_to_enu(vel), np.repeat(s_acc, 3, axis=1))
    aiding = {"position": position, "velocity": velocity}
    if pointed:
        milliseconds, angle, sd = np.array(pointed).T
        tow = milliseconds / 1e3 + GPS_EPOCH
        week = np.round((np.median(t) - tow) / WEEK)  # a recording is shorter than half a week
        aiding["heading"] = Stream(tow + week * WEEK, angle[:, None], sd[:, None])
    return Parts(os.fspath(path), aiding=aiding, notes=notes)


def _row(m: Any) -> list[float]:
    """T s, lat, lon rad, height above the ellipsoid m, hAcc, vAcc m, velN, velE, velD, sAcc m/s."""
    moment = datetime.datetime(m.year, m.month, m.day, m.hour, m.min, min(m.second, 59), tzinfo=datetime.UTC)
    tow = m.iTOW / 1e3
    week = round((moment.timestamp() + LEAP - GPS_EPOCH - tow) / WEEK)
    values = [m.height, m.hAcc, m.vAcc, m.velN, m.velE, m.velD, m.sAcc]
    return [GPS_EPOCH + week * WEEK + tow, m.lat * DEG, m.lon * DEG, *(v / 1e3 for v in values)]
