"""RINEX 3 observations and navigation messages, and 2 of GPS: fixes and corrected ranges for an IMU's file."""

import datetime
import os
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.gnss.corrections import Ionosphere, Masks, Observations, aiding_of, solved, with_rates
from jaxnav.gnss.orbits import Ephemeris, stacked
from jaxnav.gnss.ranges import FREQUENCY, LIGHT, number
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import Parts, Stream, TimeScale, scaled
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.types import DataError, Note

FIRST_BAND = {"G": "1", "J": "1", "S": "1", "E": "1", "C": "2", "I": "5"}
CODES = "CPWXBIQSL"  # tracking codes, the best first
KEPLER, KEPLER_LINES = "GJEC", 8  # constellations whose messages are elements of an orbit, and lines of those
OTHER_LINES = {"R": 4, "S": 4, "I": 8}
BEIDOU_BEHIND = 14.0  # s, BeiDou time less GPS time


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the first line is that of a RINEX observation file."""
    first = head.split(b"\n", 1)[0]
    return b"RINEX VERSION / TYPE" in first and first[20:21] == b"O"


def read(
    path: Path,
    nav: str | None = None,
    elevation_mask_deg: float = 10.0,
    cn0_mask_dbhz: float = 25.0,
    rates: str = "doppler",
) -> Parts:
    """Position and velocity by single points, and corrected ranges, of an observation file.

    Args:
        path: the observations.
        nav: navigation messages of the same hours; None is a file of the same name with another ending, or the only
            one in the folder.
        elevation_mask_deg: deg; lower satellites are left out.
        cn0_mask_dbhz: dB-Hz; weaker ones are left out.
        rates: range rates by "doppler" or by differences of carrier "phase".

    Raises:
        DataError: no navigation messages, or no epoch with a solution.
    """
    messages = Path(nav) if nav is not None else _messages_of(path)
    eph, ionosphere = read_navigation(messages)
    seen, notes = read_observations(path)
    try:
        seen, about = with_rates(seen, rates)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
    try:
        ranges, found = solved(seen, eph, ionosphere, Masks(elevation_mask_deg, cn0_mask_dbhz))
    except DataError as error:
        raise DataError(f"{path}: {error} ({len(set(eph.satellite))} satellites in {messages})") from error
    aiding, more = aiding_of(ranges, found)
    missing = () if ionosphere is not None else (finding("ranges.ionosphere", messages.name),)
    streams = {name: Stream(*samples) for name, samples in aiding.items()}
    return scaled(Parts(os.fspath(path), aiding=streams, notes=(*notes, *about, *more, *missing)), TimeScale.GPS)


def _messages_of(path: Path) -> Path:
    files = [f for f in sorted(path.parent.iterdir()) if f != path and f.is_file() and _is_navigation(f)]
    same = [f for f in files if f.stem == path.stem] or (files if len(files) == 1 else [])
    if not same:
        said = f"of {', '.join(f.name for f in files)}" if files else "its folder has none"
        raise DataError(f"{path}: needs navigation messages, {said}: give nav")
    return same[0]


def _is_navigation(path: Path) -> bool:
    with open(path, "rb") as file:
        first = file.readline(100)
    return b"RINEX VERSION / TYPE" in first and first[20:21] in (b"N", b"J", b"E", b"C")


def _lines(path: Path) -> tuple[list[str], list[str], float]:
    """Return header, body and version."""
    lines = read_bytes(os.fspath(path)).decode("ascii", "replace").splitlines()
    end = next((i for i, line in enumerate(lines) if "END OF HEADER" in line), None)
    if end is None:
        raise DataError(f"{path}: has no line END OF HEADER: cut, or no RINEX file")
    try:
        return lines[:end], lines[end + 1 :], float(lines[0][:9])
    except ValueError as error:
        raise DataError(f"{path}: line 1: expected the version of RINEX, got {lines[0][:9]!r}") from error


def _number(text: str) -> float:
    """Return a number with an exponent of Fortran; nan for a blank."""
    text = text.strip().replace("D", "E").replace("d", "e")
    return float(text) if text else np.nan


def _gps(year: int, month: int, day: int, hour: int, minute: int, second: float) -> float:
    """Return s GPS since 1970 of a date in GPS time."""
    year += (1900 if year >= 80 else 2000) if year < 100 else 0
    whole = datetime.datetime(year, month, day, hour, minute, tzinfo=datetime.UTC)
    return whole.timestamp() + second


# ---------------------------------------------------------------------------- observations


def read_observations(path: Path) -> tuple[Observations, tuple[Note, ...]]:
    """Return code, Doppler, carrier phase and C/N0 of the first frequency of RINEX 3, and notes.

    Raises:
        DataError: RINEX 2, another time scale than that of GPS, or no observation.
    """
    head, body, version = _lines(path)
    if version < 3:
        raise DataError(f"{path}: RINEX {version:g} observations, expected 3: convert them, for instance by gfzrnx")
    types = _types(head)
    scale = next((line[48:51].strip() for line in head if "TIME OF FIRST OBS" in line), "GPS")
    if scale not in ("GPS", "GAL", "QZS", ""):
        raise DataError(f"{path}: times in {scale}, expected GPS")
    places = {system: _places(system, names) for system, names in types.items() if system in FIRST_BAND}
    rows: list[tuple[float, ...]] = []
    t, without, damaged = np.nan, 0, 0
    for line in body:
        if line.startswith(">"):
            try:
                date, flag = line[1:29].split(), int(line[29:32])
                t = _gps(*map(int, date[:5]), float(date[5])) if flag in (0, 1) else np.nan  # type: ignore[call-arg]
            except (ValueError, IndexError):
                t, damaged = np.nan, damaged + 1
            continue
        system = line[:1]
        if np.isnan(t) or system not in places:
            continue
        try:
            cells = ["" if i is None else line[3 + 16 * i : 19 + 16 * i] for i in places[system]]
            value = [_number(cell[:14]) for cell in cells]
            slipped = cells[-1][14:15] not in ("", " ", "0")  # the flag of lock, of the phase
            satellite = number(line[:3])
        except (ValueError, DataError):
            damaged += 1
            continue
        code, doppler, cn0, cycles = value
        if not np.isfinite(code) or code <= 0:
            without += 1
            continue
        rate = -doppler * LIGHT / FREQUENCY[system] if doppler else np.nan
        phase = cycles * LIGHT / FREQUENCY[system] if cycles else np.nan
        rows.append((t, satellite, code, rate, cn0 if np.isfinite(cn0) else 40.0, phase, slipped))
    if not rows:
        raise DataError(f"{path}: has no pseudorange of the first frequency of {', '.join(FIRST_BAND)}")
    left = [finding("file.left_out", "range", count=without, words="rows without a pseudorange")] if without else []
    left += [finding("file.damaged", count=damaged, words="lines")] if damaged else []
    return Observations.of(np.array(rows)), tuple(left)


def _types(head: list[str]) -> dict[str, list[str]]:
    """By constellation the observations of a row, in order."""
    types: dict[str, list[str]] = {}
    system = ""
    for line in head:
        if line[60:].strip() == "SYS / # / OBS TYPES":
            system = line[0].strip() or system
            types.setdefault(system, []).extend(line[7:58].split())
    return types


def _places(system: str, names: list[str]) -> tuple[int | None, ...]:
    """Return the columns of code, Doppler, C/N0 and phase of the first frequency, by the best tracking code."""
    band = FIRST_BAND[system]
    best = next((code for code in CODES if f"C{band}{code}" in names), "")
    return tuple(names.index(f"{kind}{band}{best}") if f"{kind}{band}{best}" in names else None for kind in "CDSL")


# ---------------------------------------------------------------------------- navigation messages


def read_navigation(path: Path) -> tuple[Ephemeris, Ionosphere | None]:
    """Return the ephemerides (K,) and the coefficients of the ionosphere, if there are any.

    Raises:
        DataError: no ephemeris of GPS, QZSS, Galileo or BeiDou.
    """
    head, body, version = _lines(path)
    rows, i = [], 0
    while i < len(body):
        line = body[i]
        system = line[:1] if version >= 3 else "G"
        if system and system in KEPLER and not line.startswith("   "):
            try:
                rows.append(_ephemeris(system, body[i : i + KEPLER_LINES], version))
            except (ValueError, IndexError, DataError):
                pass  # a cut or damaged message: the next one of the satellite is as good
            i += KEPLER_LINES
        else:
            i += OTHER_LINES.get(system, 1)
    if not rows:
        raise DataError(f"{path}: has no ephemeris of {', '.join(KEPLER)}")
    return stacked(rows), _ionosphere(head)


def _ionosphere(head: list[str]) -> Ionosphere | None:
    found: dict[str, list[float]] = {}
    for line in head:
        label = line[60:].strip()
        key = line[:4].strip() if label == "IONOSPHERIC CORR" else {"ION ALPHA": "GPSA", "ION BETA": "GPSB"}.get(label)
        if key in ("GPSA", "GPSB"):
            start = 5 if label == "IONOSPHERIC CORR" else 2
            found[key] = [_number(line[start + 12 * k : start + 12 * (k + 1)]) for k in range(4)]
    if set(found) != {"GPSA", "GPSB"} or not np.isfinite(list(found.values())).all():
        return None
    return Ionosphere(np.array(found["GPSA"]), np.array(found["GPSB"]))


def _ephemeris(system: str, lines: list[str], version: float) -> Ephemeris:
    """Ephemeris of one message (RINEX 3.05, tables A6, A8, A12, A14)."""
    start = 4 if version >= 3 else 3
    first = lines[0]
    if version >= 3:
        satellite, date = number(first[:3]), first[4:23].split()
        clock = [_number(first[23 + 19 * k : 42 + 19 * k]) for k in range(3)]
    else:
        satellite, date = number(f"G{first[:2]}"), first[3:22].split()
        clock = [_number(first[22 + 19 * k : 41 + 19 * k]) for k in range(3)]
    orbit = [[_number(line[start + 19 * k : start + 19 * (k + 1)]) for k in range(4)] for line in lines[1:]]
    (_, crs, dn, m0), (cuc, e, cus, sqrt_a), (toe, cic, omega0, cis) = orbit[:3]
    (i0, crc, omega, omega_dot), (idot, source, week, _), (_, health, delay, second) = orbit[3:6]
    toc = _gps(*map(int, date[:5]), float(date[5]))  # type: ignore[call-arg]
    behind = 0.0
    if system == "C":
        behind, week = BEIDOU_BEHIND, week + 1356
        toc += behind
    if system == "E" and int(source) & 1:
        delay = second  # I/NAV: E5b and E1
    begin = GPS_EPOCH + week * WEEK + toe + behind
    begin += round((toc - begin) / WEEK) * WEEK  # a week that counts from a roll-over
    if system == "E":
        health = float(int(health) & 0b111 and 1)  # of E1
    return made(satellite, begin, toc, sqrt_a, e, i0, idot, omega0, omega_dot, omega, m0, dn, cuc, cus, crc, crs, cic,
                cis, *clock, delay, toe, health)  # fmt: skip


def made(*values: float) -> Ephemeris:
    """Return an ephemeris of finite numbers.

    Raises:
        ValueError: a number is missing.
    """
    if not np.isfinite(values).all():
        raise ValueError("a number is missing")
    return Ephemeris(*(np.asarray(v) for v in values))
