"""RTKLIB solutions (``.pos``) and time tags."""

import datetime
import os
import re
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.checks import check_samples
from jaxnav.io.files import FilePath, Source, Table, atomic_write, parse_numbers, read_bytes, read_lines
from jaxnav.io.parts import Parts, Stream, TimeScale, scaled
from jaxnav.maths.axes import enu_to_ecef, geodetic, local_to_lla
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK, leap_seconds
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Note, Samples

_VELOCITY = ("vn", "ve", "vu", "sdvn", "sdve", "sdvu", "sdvne", "sdveu", "sdvun")
FORMS = {  # of the position: columns of value, of sd and of the roots of covariances
    "deg": ("latitude longitude height", "sdn sde sdu sdne sdeu sdun"),
    "dms": ("latitude longitude height", "sdn sde sdu sdne sdeu sdun"),
    "ecef": ("x-ecef y-ecef z-ecef", "sdx sdy sdz sdxy sdyz sdzx"),
    "baseline": ("e-baseline n-baseline u-baseline", "sdn sde sdu sden sdue sdnu"),
}
_VELOCITY_ECEF = tuple("vx vy vz sdvx sdvy sdvz sdvxy sdvyz sdvzx".split())
DMS = "d'\""  # unit of degrees, minutes and seconds, three cells


class PosFile(NamedTuple):
    """Contents of a ``.pos`` file."""

    aiding: dict[str, Samples]  # "position", and "velocity" where the file has one
    quality: np.ndarray  # (K,) Q: 1 fixed, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP
    satellites: np.ndarray  # (K,)
    source: Source


def read_pos(path: FilePath, notes: list[Note] | None = None) -> PosFile:
    """Return an RTKLIB solution in any of its forms; t in seconds since 1970-01-01 in GPS time, no leap seconds.

    Columns are found by the names in the header: degrees, degrees with minutes and seconds, ECEF, or a baseline from
    the header's reference position, between blanks, tabs or commas. RTKLIB stores a covariance c as sign(c) sqrt(|c|);
    here it becomes a correlation, shrunk where the file's rounding makes the matrix singular. With a list of ``notes``
    a cut last line is left out and said there, and rows that repeat a time or state no sd stay, for
    `jaxnav.io.mend`. DataError names file and line.
    """
    head, table, t = _read_table(path, notes)
    column = dict(zip(table.names, table.values.T))
    value_names, sd_names = (names.split() for names in FORMS[head.form])
    missing = [name for name in (*value_names, *sd_names, "Q", "ns") if name not in column]
    if missing:
        raise DataError(f"{table.source.file}: expected a column {missing[0]}, got {', '.join(table.names)}")
    value, roots = (np.stack([column[name] for name in names], axis=1) for names in (value_names, sd_names))
    if head.form == "ecef":
        lla = geodetic(value)
        position = _turned("position", t, lla, roots, lla, table.source)
        names = _VELOCITY_ECEF
    else:
        scale = np.array([DEG, DEG, 1.0])
        lla = local_to_lla(value, head.reference) if head.form == "baseline" else value * scale
        position = _samples("position", t, lla, list(roots.T), table.source)
        names = _VELOCITY
    aiding = {"position": position}
    if all(name in column for name in names) and any(column[name].any() for name in names[3:6]):
        v, roots = (np.stack([column[name] for name in some], axis=1) for some in (names[:3], names[3:]))
        if head.form == "ecef":
            v = np.einsum("kij,ki->kj", _axes(lla), v)
            aiding["velocity"] = _turned("velocity", t, v, roots, lla, table.source)
        else:
            aiding["velocity"] = _samples("velocity", t, v[:, [1, 0, 2]], list(roots.T), table.source)
    if head.geodetic and notes is not None:
        notes.append(finding("heights.sea_level"))
    for name, samples in aiding.items() if notes is None else ():
        check_samples(name, samples, table.source)
    return PosFile(aiding, column["Q"].astype(int), column["ns"].astype(int), table.source)


def write_pos(
    path: FilePath,
    position: Samples,
    velocity: Samples | None = None,
    quality: int = 5,
    satellites: int = 0,
    t0: float = 0.0,
) -> None:
    """Write a ``.pos`` file in GPST; ``t0`` s since 1970 is added to the times, which both streams must share."""
    if velocity is not None and not np.array_equal(position.t, velocity.t):
        raise DataError(f"{os.fspath(path)}: position and velocity must have the same times")
    ned = position.value[:, [0, 1]] / DEG
    blocks = [ned, position.value[:, 2:], np.full((len(ned), 2), [quality, satellites]), _signed_roots(position)]
    names = ["latitude(deg)", "longitude(deg)", "height(m)", "Q", "ns"]
    names += ["sdn(m)", "sde(m)", "sdu(m)", "sdne(m)", "sdeu(m)", "sdun(m)", "age(s)", "ratio"]
    formats = ["%.11f", "%.11f", "%.6f", "%d", "%d"] + ["%.7f"] * 6 + ["%.2f", "%.1f"]
    blocks.append(np.zeros((len(ned), 2)))
    if velocity is not None:
        names += ["vn(m/s)", "ve(m/s)", "vu(m/s)", "sdvn", "sdve", "sdvu", "sdvne", "sdveu", "sdvun"]
        formats += ["%.7f"] * 9
        blocks += [velocity.value[:, [1, 0, 2]], _signed_roots(velocity)]
    template = " ".join(formats)
    lines = ["%  GPST " + " ".join(names)]
    lines += [f"{_stamp(t + t0)} {template % tuple(row)}" for t, row in zip(position.t, np.hstack(blocks).tolist())]
    atomic_write(path, "\n".join(lines) + "\n")


class _Head(NamedTuple):
    """Header of a ``.pos`` file."""

    form: str  # a key of `FORMS`
    reference: np.ndarray  # (3,) lat, lon rad, h m, where a baseline begins
    geodetic: bool  # heights above sea level


def _read_table(path: FilePath, notes: list[Note] | None) -> tuple[_Head, Table, np.ndarray]:
    """Return form, numeric columns with names without units, and times in s since 1970 in GPS time."""
    file, header, rows, reference, level = os.fspath(path), "", [], "", False
    for i, line in read_lines(path, notes):
        cells = line.replace(",", " ").split()
        if line.startswith("%"):
            header = line if "Q" in cells else header
            reference = line.partition(":")[2] if "ref pos" in line else reference
            level = level or "/geodetic" in line
        else:
            rows.append((i, cells))
    words = header.lstrip("%").replace(",", " ").split()
    if not words:
        raise DataError(f"{file}: expected a header line with column names (GPST latitude(deg) ... Q ...)")
    if words[0] not in BEHIND_UTC:
        raise DataError(f"{file}: expected times in {', '.join(BEHIND_UTC)}, got {words[0]}")
    units = dict(word.rstrip(")").split("(", 1) for word in words[1:] if "(" in word)
    form = _form(units, file, " ".join(words))
    names = tuple(word.split("(")[0] for word in words[1:])
    if len(set(names)) != len(names):
        raise DataError(f"{file}: a column name stands twice in {' '.join(words)}")
    cells_of = names
    if form == "dms":
        parts = lambda name: (name, f"{name}'", f'{name}"') if name in ("latitude", "longitude") else (name,)
        cells_of = tuple(part for name in names for part in parts(name))
    table = parse_numbers([(i, cells[2:]) for i, cells in rows], len(cells_of), path, cells_of)
    if form == "dms":
        column = dict(zip(cells_of, table.values.T))
        for name in ("latitude", "longitude"):
            size = np.abs(column[name]) + column[f"{name}'"] / 60 + column[f'{name}"'] / 3600
            column[name] = np.copysign(size, column[name])
        table = table._replace(values=np.stack([column[name] for name in names], axis=1), names=names)
    t = np.array([_seconds(cells, f"{file}: line {i}") for i, cells in rows])
    if words[0] != "GPST":
        t = t - BEHIND_UTC[words[0]]
        t = t + np.array([leap_seconds(x) for x in t])
    return _Head(form, _reference(reference, file) if form == "baseline" else np.zeros(3), level), table, t


BEHIND_UTC = {"GPST": 0.0, "UTC": 0.0, "JST": 9 * 3600.0}  # s that a clock is ahead of UTC, but for leap seconds


def _form(units: dict[str, str], file: str, header: str) -> str:
    """Return the form with the columns of a header."""
    if "latitude" in units and units["latitude"] == units.get("longitude") and units.get("height") == "m":
        form = {"deg": "deg", DMS: "dms"}.get(units["latitude"])
        if form:
            return form
    for form in ("ecef", "baseline"):
        if all(units.get(name) == "m" for name in FORMS[form][0].split()):
            return form
    raise DataError(
        f"{file}: expected columns latitude(deg) longitude(deg) height(m), x-ecef(m) ... or e-baseline(m) ..., "
        f"got {header}"
    )


def _reference(words: str, file: str) -> np.ndarray:
    """Return where a baseline begins: latitude, longitude in degrees and height, or ECEF, as the header has it."""
    try:
        values = np.array([float(word) for word in words.replace(",", " ").split()])
        if values.size == 3:
            far = np.abs(values[0]) > 90.0
            return geodetic(values[None])[0] if far else values * [DEG, DEG, 1.0]
    except ValueError:
        pass
    raise DataError(f"{file}: baselines need a line '% ref pos : LATITUDE LONGITUDE HEIGHT', got {words.strip()!r}")


def _axes(lla: np.ndarray) -> np.ndarray:
    """Return matrices (K, 3, 3) from ENU to ECEF at positions (K, 3)."""
    return np.array([enu_to_ecef(place) for place in lla])


def _turned(name: str, t: np.ndarray, value: np.ndarray, roots: np.ndarray, lla: np.ndarray, source: Source) -> Samples:
    """Return samples whose covariance the file states in ECEF: sd x, y, z, then signed roots of xy, yz, zx (K, 6)."""
    cov = np.zeros((len(t), 3, 3))
    cov[:, range(3), range(3)] = roots[:, :3] ** 2
    for k, (i, j) in enumerate(((0, 1), (1, 2), (2, 0))):
        cov[:, i, j] = cov[:, j, i] = np.sign(roots[:, 3 + k]) * roots[:, 3 + k] ** 2
    turn = _axes(lla)
    cov = np.einsum("kia,kij,kjb->kab", turn, cov, turn)
    signed = lambda i, j: np.sign(cov[:, i, j]) * np.sqrt(np.abs(cov[:, i, j]))
    sd = np.sqrt(np.maximum(cov[:, range(3), range(3)], 0.0))  # the file rounds
    columns = [sd[:, 1], sd[:, 0], sd[:, 2], signed(0, 1), signed(0, 2), signed(1, 2)]
    return _samples(name, t, value, columns, source)


def _seconds(cells: list[str], where: str) -> float:
    """Date and time, or week and time of week, in GPST to s since 1970."""
    try:
        if "/" not in cells[0]:
            week, tow = int(cells[0]), float(cells[1])
            if not (0 <= week < 10000 and 0.0 <= tow < WEEK):
                raise ValueError
            return GPS_EPOCH + week * WEEK + tow
        clock, _, fraction = cells[1].partition(".")
        moment = datetime.datetime.strptime(f"{cells[0]} {clock}", "%Y/%m/%d %H:%M:%S").replace(tzinfo=datetime.UTC)
        return moment.timestamp() + float(f"0.{fraction or 0}")
    except (ValueError, IndexError):
        raise DataError(
            f"{where}: expected a time like 2025/07/08 19:34:18.499 or week and seconds, got {' '.join(cells[:2])!r}"
        ) from None


def _stamp(seconds: float) -> str:
    whole, micro = divmod(round(seconds * 1e6), 1_000_000)
    moment = datetime.datetime(1970, 1, 1) + datetime.timedelta(seconds=whole)
    return f"{moment:%Y/%m/%d %H:%M:%S}.{micro:06d}"


def _samples(name: str, t: np.ndarray, value: np.ndarray, columns: list[np.ndarray], source: Source) -> Samples:
    """Columns sdn, sde, sdu, sdne, sdeu, sdun to sd in ENU and correlations (EN, NU, UE)."""
    n, e, u, ne, eu, un = columns
    sd = np.stack([e, n, u], axis=1)
    roots = np.stack([ne, un, eu], axis=1)
    product = sd * np.roll(sd, -1, axis=1)
    corr = np.where(product > 0, np.sign(roots) * np.square(roots) / np.where(product > 0, product, 1.0), 0.0)
    if (np.abs(corr) > 1.5).any():
        line = int(np.nonzero(np.abs(corr) > 1.5)[0][0])
        at = source.lines[line] if source.lines is not None else line
        raise DataError(
            f"{source.file}: line {at}: {name}: expected a covariance below the variances, got {roots[line]}"
        )
    return Samples(t, value, sd, _shrink(corr))


def _shrink(corr: np.ndarray, floor: float = 1e-3) -> np.ndarray:
    """Correlations (K, 3) scaled down in the rows whose matrix has an eigenvalue below ``floor``."""
    matrix = np.zeros((len(corr), 3, 3))
    for k, (i, j) in enumerate(((0, 1), (1, 2), (2, 0))):
        matrix[:, i, j] = matrix[:, j, i] = corr[:, k]
    lowest = np.linalg.eigvalsh(matrix)[:, 0]  # of the off-diagonal part: the correlation matrix has one more
    return corr * np.where(lowest < floor - 1.0, (1.0 - floor) / np.maximum(-lowest, 1e-9), 1.0)[:, None]


def _signed_roots(samples: Samples) -> np.ndarray:
    """(K, 6) sdn, sde, sdu, sdne, sdeu, sdun of a stream in ENU."""
    cov = samples.corr * samples.sd * np.roll(samples.sd, -1, axis=1)
    roots = np.sign(cov) * np.sqrt(np.abs(cov))  # en, nu, ue
    return np.hstack([samples.sd[:, [1, 0, 2]], roots[:, [0, 2, 1]]])


def read_tag(path: FilePath) -> tuple[float, float]:
    """Start of the log (s since 1970, GPST) and the last tick (s since the start) of an RTKLIB time tag.

    DataError names file and byte.
    """
    data = read_bytes(path)
    file = os.fspath(path)
    if not data.startswith(b"TIMETAG RTKLIB"):
        raise DataError(f"{file}: byte 0: expected an RTKLIB time tag")
    if len(data) < 84 or (len(data) - 76) % 8:
        raise DataError(f"{file}: byte {len(data)}: expected whole pairs of tick and offset after byte 76; cut short?")
    whole, fraction = struct.unpack_from("<Id", data, 64)
    ticks = np.frombuffer(data, "<u4", offset=76)[::2]
    if not 0.0 <= fraction < 1.0 or (np.diff(ticks.astype(np.int64)) < 0).any() or not ticks[-1]:
        raise DataError(f"{file}: byte 64: expected a start time and ticks that increase")
    return whole + fraction, float(ticks[-1]) / 1000.0


def recognises(path: Path, head: bytes) -> bool:
    """Is there the head of a solution?"""
    return bool(re.search(rb"^%\s+(GPST|UTC|JST)\s.*\bQ\b", head, re.MULTILINE))


def read(path: Path) -> Parts:
    """Return the fixes of a solution, in GPS time."""
    notes: list[Note] = []
    aiding = {name: Stream(*samples) for name, samples in read_pos(path, notes).aiding.items()}
    return scaled(Parts(os.fspath(path), aiding=aiding, notes=tuple(notes)), TimeScale.GPS)
