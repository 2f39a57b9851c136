"""Tables of raw GNSS, one row a satellite and epoch: corrected ranges of the project, Google's smartphone logs.

Google's ``device_gnss.csv`` (Smartphone Decimeter Challenge) has satellites at emission, in the axes of that time.
"""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.findings import finding
from jaxnav.gnss.corrections import Masks, aiding_of, sight
from jaxnav.gnss.orbits import turned
from jaxnav.gnss.ranges import LIGHT, Ranges, name, number, selected
from jaxnav.gnss.single_point import single_point
from jaxnav.io.files import format_csv
from jaxnav.io.parts import Parts, Stream, TimeScale, scaled
from jaxnav.io.sheet import Sheet, column, numbers, open_sheet
from jaxnav.maths.earth import RATE
from jaxnav.maths.gps_time import GPS_EPOCH, leap_seconds
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Note, Samples

COLUMNS = ("t_s", "satellite", "pseudorange_m", "range_rate_mps", "x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps",
       "elevation_rad", "cn0_dbhz")  # fmt: skip
GOOGLE_SYSTEM = {1: "G", 2: "S", 3: "R", 4: "J", 5: "C", 6: "E", 7: "I"}  # ConstellationType of Android
GOOGLE_SIGNAL = r"(GPS_L1|QZS_L1|GAL_E1|BDS_B1|GLO_G1|SBS_L1).*"
USUAL_CN0 = 40.0  # dB-Hz, where a table has none


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the first line names the columns of one of the two tables."""
    if path.is_dir():
        return False
    names = set(re.split(rb"[,\r\n]", head.split(b"\n")[0]))
    return {b"satellite", b"pseudorange_m", b"x_m"} <= names or {b"Svid", b"RawPseudorangeMeters"} <= names


def read(path: Path, elevation_mask_deg: float = 10.0, cn0_mask_dbhz: float = 25.0) -> Parts:
    """Corrected ranges of a table, with position and velocity by single points.

    Args:
        path: the table.
        elevation_mask_deg: deg; lower satellites are left out.
        cn0_mask_dbhz: dB-Hz; weaker ones are left out.

    Raises:
        DataError: a column is missing, or no epoch has a solution.
    """
    sheet = open_sheet(path)
    ours = "pseudorange_m" in sheet.columns
    ranges, scale = (project_rows(sheet), TimeScale.UNKNOWN) if ours else (google_rows(sheet), TimeScale.GPS)
    streams, notes = solved(ranges, os.fspath(path), Masks(elevation_mask_deg, cn0_mask_dbhz))
    aiding = {key: Stream(*samples) for key, samples in streams.items()}
    return scaled(Parts(os.fspath(path), aiding=aiding, notes=(*sheet.notes, *notes)), scale)


def solved(ranges: Ranges, file: str, masks: Masks) -> tuple[dict[str, Samples], tuple[Note, ...]]:
    """Return streams and notes of rows in any order; elevations that are nan are found by a first solution.

    Raises:
        DataError: no epoch has a solution.
    """
    usable = np.isfinite(ranges.t) & np.isfinite(ranges.position).all(1) & (ranges.cn0 >= masks.cn0_dbhz)
    usable &= np.isfinite(ranges.pseudorange) | np.isfinite(ranges.range_rate)
    left = int(np.count_nonzero(~usable))
    ranges = selected(ranges, usable)
    ranges = selected(ranges, np.lexsort((ranges.satellite, ranges.t)))
    _, again = np.unique(np.stack([ranges.t, ranges.satellite]), axis=1, return_index=True)
    ranges = selected(ranges, np.sort(again))
    if not np.isfinite(ranges.velocity).all():
        ranges = ranges._replace(velocity=differentiated(ranges))
    low = np.isnan(ranges.elevation)
    if low.any():
        first = single_point(ranges._replace(elevation=np.full(low.shape, 0.5 * np.pi)))
        if first.t.size:
            at = np.clip(np.searchsorted(first.t, ranges.t), 0, first.t.size - 1)
            elevation = sight(ranges.position, first.position[at])[1]
            ranges = ranges._replace(elevation=np.where(low, elevation, ranges.elevation))
    ranges = selected(ranges, ranges.elevation >= masks.elevation_deg * DEG)
    found = single_point(ranges)
    if not found.t.size:
        raise DataError(f"{file}: no epoch has satellites enough for a single-point solution, of {ranges.t.size} rows")
    streams, notes = aiding_of(ranges, found)
    words = "rows that are weak or have no range or satellite"
    return streams, ((finding("file.left_out", "range", count=left, words=words),) if left else ()) + notes


def differentiated(ranges: Ranges) -> np.ndarray:
    """Return velocities (N, 3) of the satellites by differences of their positions."""
    velocity = np.zeros_like(ranges.position)
    for satellite in np.unique(ranges.satellite):
        rows = np.flatnonzero(ranges.satellite == satellite)
        if rows.size > 1:
            velocity[rows] = np.gradient(ranges.position[rows], ranges.t[rows], axis=0)
    return velocity


def project_rows(sheet: Sheet) -> Ranges:
    """Return the rows of the table of this project; columns of velocity, elevation and C/N0 may be left out."""
    t = numbers(sheet, "t_s")
    maybe = lambda key, empty: numbers(sheet, key) if key in sheet.columns else np.full(t.size, empty)
    satellite = np.array([number(str(cell).strip()) for cell in column(sheet, "satellite")])
    position, velocity = (np.stack([maybe(key, np.nan) for key in COLUMNS[i : i + 3]], 1) for i in (4, 7))
    elevation = maybe("elevation_deg", np.nan) * DEG if "elevation_deg" in sheet.columns else maybe(COLUMNS[10], np.nan)
    return Ranges(t, satellite, numbers(sheet, COLUMNS[2]), maybe(COLUMNS[3], np.nan), position, velocity, elevation,
                  maybe(COLUMNS[11], USUAL_CN0))  # fmt: skip


def google_rows(sheet: Sheet) -> Ranges:
    """Return the rows of a ``device_gnss.csv``: first frequency, corrected by its columns.

    pseudorange + satellite clock - inter-signal bias - ionosphere - troposphere, as its documentation has it.
    """
    get = lambda key: numbers(sheet, key)
    maybe = lambda key: np.nan_to_num(get(key)) if key in sheet.columns else 0.0
    if "ArrivalTimeNanosSinceGpsEpoch" in sheet.columns:
        t = get("ArrivalTimeNanosSinceGpsEpoch") / 1e9 + GPS_EPOCH
    else:
        t = get("utcTimeMillis") / 1e3
        t = t + leap_seconds(float(np.nanmedian(t)))
    kinds = get("ConstellationType").astype(int)
    satellite = np.array([_google(k, s) for k, s in zip(kinds, get("Svid").astype(int), strict=True)])
    first = np.ones(t.size, bool)
    if "SignalType" in sheet.columns:
        first = np.array([re.fullmatch(GOOGLE_SIGNAL, str(cell)) is not None for cell in column(sheet, "SignalType")])
    raw = get("RawPseudorangeMeters")
    pseudorange = raw + maybe("SvClockBiasMeters") - maybe("IsrbMeters")
    pseudorange = pseudorange - maybe("IonosphericDelayMeters") - maybe("TroposphericDelayMeters")
    rate = get("PseudorangeRateMetersPerSecond")
    position, velocity = (
        np.stack([get(f"Sv{kind}{axis}Ecef{unit}") for axis in "XYZ"], 1)
        for kind, unit in (("Position", "Meters"), ("Velocity", "MetersPerSecond"))
    )
    elevation = get("SvElevationDegrees") * DEG if "SvElevationDegrees" in sheet.columns else np.full(t.size, np.nan)
    rows = Ranges(t, satellite, pseudorange, rate + maybe("SvClockDriftMetersPerSecond"), position, velocity, elevation,
                  get("Cn0DbHz"))  # fmt: skip
    return selected(to_reception(rows), first & (satellite > 0))


def to_reception(ranges: Ranges) -> Ranges:
    """Return rows with satellites in the axes of reception, from those of emission.

    Velocities are derivatives by the time of reception: a second there is 1 - r / c seconds of emission where the range
    grows by r m/s, and the axes turn by a longer flight.
    """
    flight = np.nan_to_num(ranges.pseudorange) / LIGHT
    position, velocity = (turned(a, RATE * flight) for a in (ranges.position, ranges.velocity))
    growth = np.nan_to_num(ranges.range_rate)[:, None] / LIGHT
    across = np.stack([position[:, 1], -position[:, 0], np.zeros(flight.size)], 1)
    return ranges._replace(position=position, velocity=(1 - growth) * velocity + RATE * growth * across)


def _google(kind: int, svid: int) -> int:
    system = GOOGLE_SYSTEM.get(kind, "")
    prn = svid - 192 if system == "J" and svid > 192 else svid - 100 if system == "S" and svid > 100 else svid
    return number(f"{system}{prn}") if system and 0 < prn < 100 else 0


def table(ranges: Ranges) -> str:
    """Return the table of this project of ranges."""
    values: list[Any] = [ranges.t, ranges.pseudorange, ranges.range_rate, *ranges.position.T, *ranges.velocity.T,
                         ranges.elevation, ranges.cn0]  # fmt: skip
    text = format_csv([COLUMNS[0], *COLUMNS[2:]], np.column_stack(values)).splitlines()
    cells = ["satellite", *(name(s) for s in ranges.satellite)]
    rows = (f"{line.split(',', 1)[0]},{cell},{line.split(',', 1)[1]}" for line, cell in zip(text, cells, strict=True))
    return "\n".join(rows) + "\n"
