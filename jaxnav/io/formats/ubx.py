"""u-blox UBX, by `pyubx2`: fixes for an IMU's file, and corrected ranges where it has raw measurements.

Fixes are those of NAV-PVT or NAV-PVAT, or of NAV-POSLLH and NAV-VELNED of older receivers; ranges RXM-RAWX with
RXM-SFRBX ephemerides; the IMU is that of ESF-RAW or ESF-MEAS. Where UBX has no fixes, NMEA is read.
"""

import datetime
import os
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.findings import finding
from jaxnav.gnss.corrections import Masks, Observations, aiding_of, solved, with_rates
from jaxnav.gnss.messages import Messages
from jaxnav.gnss.orbits import stacked
from jaxnav.gnss.ranges import FREQUENCY, LIGHT, number
from jaxnav.io.checks import ned_to_enu
from jaxnav.io.files import read_bytes
from jaxnav.io.formats import nmea
from jaxnav.io.formats.esf import MEAS, RAW, Sensors
from jaxnav.io.parts import Parts, Stream, TimeScale, scaled, unread
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK, leap_seconds
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Json, Note

SYNC = b"\xb5\x62"
FIXED = (3, 4)  # fixType: in three dimensions, alone or with dead reckoning
PVT = b"\x01\x07"  # class and number of NAV-PVT
FIXES = ("NAV-PVT", "NAV-PVAT")
BARE = 8  # bytes of a message without contents, which asks for one
CLASSES = b"\x01\x02"  # NAV and RXM: other messages are commands, settings and states of the receiver
SYSTEM = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J"}  # gnssId
FIRST_SIGNAL = {"G": (0,), "S": (0,), "E": (0, 1), "C": (0, 1), "J": (0,)}  # sigId of the first frequency
READ = {*FIXES, "NAV-RELPOSNED", "RXM-RAWX", "RXM-SFRBX", "ESF-RAW", "ESF-MEAS"}
SENSORS = b"\x01\x02\x10\x28"  # NAV, RXM, ESF and HNR: classes of messages that are measured
OLDER = ("NAV-POSLLH", "NAV-VELNED", "NAV-SOL", "NAV-STATUS", "NAV-TIMEGPS")


def recognises(path: Path, head: bytes) -> bool:
    """Return whether there is a UBX message with a right checksum near the start: text or RTCM may be in between."""
    return bool(frames(head)[0])


def frames(data: bytes) -> tuple[list[bytes], int]:
    """Return the messages with a right checksum, and the number of NAV-PVT that are damaged.

    After a message with a damaged length the search continues behind its sync bytes.
    """
    found, lost, at = [], 0, -1
    while (at := data.find(SYNC, at + 1)) >= 0:
        end = at + 6 + int.from_bytes(data[at + 4 : at + 6], "little")
        if end + 2 <= len(data):
            sums = np.cumsum(np.frombuffer(data[at + 2 : end], np.uint8), dtype=np.int64)
            if data[end : end + 2] == bytes([int(sums[-1]) & 255, int(sums.sum()) & 255]):
                found.append(data[at : end + 2])
                at = end + 1
                continue
        lost += data[at + 2 : at + 4] == PVT
    return found, lost


def read(
    path: Path,
    spp: bool = False,
    elevation_mask_deg: float = 10.0,
    cn0_mask_dbhz: float = 25.0,
    rates: str = "doppler",
) -> Parts:
    """Position and velocity of NAV-PVT, else of NAV-POSLLH and NAV-VELNED with the status of NAV-SOL or NAV-STATUS.

    Heading is that of NAV-RELPOSNED where the base moves along. hAcc, vAcc and sAcc are the sd of each axis. Times are
    s since 1970 in GPS time. Where there are RXM-RAWX and RXM-SFRBX, pseudoranges and range rates as well.

    Args:
        path: the file.
        spp: position and velocity by single points of the ranges instead of the receiver's.
        elevation_mask_deg: deg; lower satellites are left out of the ranges.
        cn0_mask_dbhz: dB-Hz; weaker ones likewise.
        rates: range rates by "doppler" or by differences of carrier "phase".

    Raises:
        DataError: no fix in three dimensions, or with ``spp`` no epoch with a solution.
    """
    import pyubx2

    raw, sensors = Raw(), (Sensors(RAW), Sensors(MEAS))  # both are of the same sensors
    older: dict[str, dict[int, Any]] = {name: {} for name in OLDER}
    rows: dict[int, list[float]] = {}
    pointed, without = [], 0
    others: Counter[str] = Counter()
    data = read_bytes(path)
    intact, damaged = frames(data)
    for frame in intact:
        name = pyubx2.UBX_MSGIDS.get(frame[2:4], f"0x{frame[2]:02x} 0x{frame[3]:02x}")
        others[name] += frame[2] in SENSORS and len(frame) > BARE and name not in {*READ, *OLDER}
        for each in sensors:
            each.take(frame)
        if frame[2] not in CLASSES or len(frame) <= BARE:
            continue
        try:
            message = pyubx2.UBXReader.parse(frame)
        except (pyubx2.UBXParseError, pyubx2.UBXMessageError, pyubx2.UBXTypeError):  # of a kind that it does not know
            continue
        if message.identity == "NAV-RELPOSNED" and getattr(message, "relPosHeadingValid", 0):
            if message.isMoving and message.relPosValid:
                pointed.append([message.iTOW, message.relPosHeading * DEG, message.accHeading * DEG])
        raw.take(message)
        if message.identity in older:
            older[message.identity][message.iTOW] = message
        if message.identity in (*FIXES, "NAV-POSLLH"):
            for each in sensors:
                each.fix(message.iTOW / 1e3)
        if message.identity not in FIXES:
            continue
        ok = getattr(message, "gnssFixOk", 0) or getattr(message, "gnssFixOK", 0)  # of NAV-PVT, of NAV-PVAT
        if message.fixType not in FIXED or not ok or not message.validDate:
            without += 1
            continue
        rows[message.iTOW] = _row(message)
    if not rows and not without:
        rows, without = _older_rows(older)
    if not rows and nmea.recognises(path, data):
        return nmea.read(path)
    ranges, about = raw.streams(path, Masks(elevation_mask_deg, cn0_mask_dbhz), spp, rates)
    if ranges and (spp or not rows):
        streams = {name: Stream(*samples) for name, samples in ranges.items()}
        return scaled(Parts(os.fspath(path), aiding=streams, notes=about), TimeScale.GPS)
    if not rows:
        raise DataError(
            f"{path}: has no NAV-PVT or NAV-POSLLH with a fix in three dimensions: {without} without one, {damaged} "
            f"damaged, {others.total()} of other types ({', '.join(sorted(+others)) or 'none'})"
        )
    notes: tuple[Note, ...] = about + unread(+others)
    if damaged:
        notes = (finding("file.damaged", count=damaged, words="NAV-PVT"), *notes)
    if without:
        notes = (finding("fixes.none", "position", count=without, words="messages"), *notes)
    t, lla, acc, vel, s_acc = np.split(np.array(list(rows.values())), [1, 4, 6, 9], axis=1)
    position = Stream(t[:, 0], lla, acc[:, [0, 0, 1]])
    moved = np.isfinite(vel[:, 0])
    velocity = Stream(t[moved, 0], ned_to_enu(vel[moved]), np.repeat(s_acc[moved], 3, axis=1))
    aiding = {"position": position, "velocity": velocity}
    if pointed:
        milliseconds, angle, sd = np.array(pointed).T
        tow = milliseconds / 1e3 + GPS_EPOCH
        week = np.round((np.median(t) - tow) / WEEK)  # a recording is shorter than half a week
        aiding["heading"] = Stream(tow + week * WEEK, angle[:, None], sd[:, None])
    aiding |= {name: Stream(*ranges[name]) for name in ("pseudorange", "range_rate") if name in ranges}
    seen = next((each for each in sensors if each.samples), sensors[0])
    imu, of_imu = seen.imu(float(np.median(t[:, 0] - np.array(list(rows)) / 1e3)))
    return scaled(Parts(os.fspath(path), imu, aiding, notes=notes + of_imu), TimeScale.GPS)


class Raw:
    """Raw measurements and navigation messages of a file."""

    def __init__(self) -> None:
        self.messages = Messages()
        self.rows: list[tuple[float, ...]] = []
        self.t = np.nan
        self.lock: dict[int, float] = {}  # ms of lock of a satellite's carrier at its last row

    def take(self, message: Any) -> None:
        """Take a message, of any kind."""
        if message.identity == "RXM-SFRBX" and message.gnssId in SYSTEM and np.isfinite(self.t):
            words = [getattr(message, f"dwrd_{i + 1:02d}") for i in range(message.numWords)]
            self.messages.take(f"{SYSTEM[message.gnssId]}{message.svId:02d}", words, self.t)
        if message.identity != "RXM-RAWX" or not message.numMeas:
            return
        self.t = GPS_EPOCH + message.week * WEEK + message.rcvTow
        for i in range(1, message.numMeas + 1):
            get = lambda key, i=i: getattr(message, f"{key}_{i:02d}")
            system = SYSTEM.get(get("gnssId"), "")
            if not system or get("sigId") not in FIRST_SIGNAL[system] or not get("prValid"):
                continue
            try:
                satellite = number(f"{system}{get('svId') - (120 if system == 'S' else 0)}")
            except DataError:
                continue
            wavelength, lock = LIGHT / FREQUENCY[system], float(get("locktime"))
            phase = get("cpMes") * wavelength if get("cpValid") else np.nan
            slipped, self.lock[satellite] = lock < self.lock.get(satellite, 0.0) or lock == 0.0, lock
            row = self.t, satellite, get("prMes"), -get("doMes") * wavelength, float(get("cno")), phase, slipped
            self.rows.append(row)

    def streams(self, path: Path, masks: Masks, needed: bool, rates: str) -> tuple[Json, tuple[Note, ...]]:
        """Return the streams of the ranges and notes; nothing where there are none.

        Raises:
            DataError: they are ``needed``, and no epoch has a solution; ``rates`` of which there are none.
        """
        eph = stacked(list(self.messages.found.values()))
        if not self.rows and not needed:
            return {}, ()
        rows = np.array(self.rows, float).reshape(-1, 7)
        try:
            seen, about = with_rates(Observations.of(rows), rates)
        except DataError as error:
            raise DataError(f"{path}: {error}") from error
        try:
            if not self.rows or not eph.satellite.size:
                raise DataError(f"{len(self.rows)} raw measurements, {eph.satellite.size} ephemerides")
            aiding, notes = aiding_of(*solved(seen, eph, self.messages.ionosphere, masks))
            more = () if self.messages.ionosphere is not None else (finding("ranges.ionosphere", path.name),)
            return aiding, (*about, *notes, *more)
        except DataError as error:
            if needed:
                raise DataError(f"{path}: {error}") from error
            return {}, (f"Its raw measurements are not used: {error}.",)


def _older_rows(older: dict[str, dict[int, Any]]) -> tuple[dict[int, list[float]], int]:
    """Return rows by ms of week as in `_row` of receivers without NAV-PVT; number without a fix in 3D."""
    weeks = [m.week for m in older["NAV-SOL"].values() if m.wknSet]
    weeks += [m.week for m in older["NAV-TIMEGPS"].values() if m.weekValid]
    base = GPS_EPOCH + int(np.median(weeks)) * WEEK if weeks else 0.0  # else seconds of the week
    fixed = {tow: m.gpsFix in FIXED and bool(m.gpsfixOK) for tow, m in older["NAV-SOL"].items()}
    fixed |= {tow: m.gpsFix in FIXED and bool(m.gpsFixOk) for tow, m in older["NAV-STATUS"].items()}
    rows, without = dict[int, list[float]](), 0
    for tow, p in older["NAV-POSLLH"].items():
        if not fixed.get(tow, not fixed):
            without += 1
            continue
        v = older["NAV-VELNED"].get(tow)
        motion = [np.nan] * 4 if v is None else [v.velN / 100, v.velE / 100, v.velD / 100, v.sAcc / 100]  # cm/s
        row = [base + tow / 1e3, p.lat * DEG, p.lon * DEG, p.height / 1e3, p.hAcc / 1e3, p.vAcc / 1e3, *motion]
        rows[tow] = row
    return rows, without


def _row(m: Any) -> list[float]:
    """T s, lat, lon rad, height above the ellipsoid m, hAcc, vAcc m, velN, velE, velD, sAcc m/s."""
    second = m.second if m.identity == "NAV-PVT" else m.sec
    moment = datetime.datetime(m.year, m.month, m.day, m.hour, m.min, min(second, 59), tzinfo=datetime.UTC)
    tow = m.iTOW / 1e3
    utc = moment.timestamp()
    week = round((utc + leap_seconds(utc) - GPS_EPOCH - tow) / WEEK)
    values = [m.height, m.hAcc, m.vAcc, m.velN, m.velE, m.velD, m.sAcc]
    return [GPS_EPOCH + week * WEEK + tow, m.lat * DEG, m.lon * DEG, *(v / 1e3 for v in values)]
