"""A column map: a few lines of TOML that give the meaning of a file's columns; see ``docs/formats.md``."""

import os
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.findings import finding
from jaxnav.gnss.corrections import Masks
from jaxnav.gnss.ranges import Ranges, number, selected
from jaxnav.io import missing, units
from jaxnav.io.checks import ned_to_enu
from jaxnav.io.columns import (
    Files,
    column_of,
    kept_rows,
    known,
    sd_of,
    sheet_of,
    side_by_side,
    table_of,
    time_columns,
    times_of,
)
from jaxnav.io.files import FilePath, read_bytes
from jaxnav.io.formats import raw_table
from jaxnav.io.mend import GAP_STEPS, MAX_TIME_S
from jaxnav.io.options import OF
from jaxnav.io.parts import INCREMENTS, RATES, SAMPLINGS, ImuRows, Parts, Stream, TimeScale, counted_from
from jaxnav.io.sheet import DAYS, column, open_sheet
from jaxnav.maths.axes import enu_to_ecef, geodetic, local_to_lla, rotation, utm_to_lla
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import DEG
from jaxnav.measurements import with_data
from jaxnav.measurements.columns import QUANTITIES
from jaxnav.types import DataError, Json, Note, Track, nearest

COMMON = tuple(
    "file delimiter header time time_unit time_scale time_tag time_shift_s rate_hz skip where new_where".split()
)
FILES = ("file", "gnss", "nav", "time_tag")  # keys whose values are names of files
TOP = ("name", "notes", "folder", "lever_arm_frd_m", "origin_deg", "read", "imu", "truth", "satellites", *COMMON)
KEYS: dict[str, tuple[str, ...]] = {
    "imu": (*COMMON, *"gyro gyro_unit accel accel_unit accel_time axes sampling repair".split()),
    "position": (*COMMON, *"lla enu ned ecef utm zone unit h_unit sd sd_enu sd_ned".split()),
    "velocity": (*COMMON, *"enu ned neu ecef speed_course up down unit course_unit north_deg sd sd_enu sd_ned".split()),
    "truth": (
        *COMMON,
        *"lla enu ned ecef utm zone unit h_unit velocity_enu velocity_ned velocity_ecef rph rph_unit".split(),
    ),
    "magnetometer": (*COMMON, "value", "unit", "axes", "sd"),
    "body_velocity": (*COMMON, "value", "unit", "axes", "sd"),
    "baseline": (*COMMON, *"enu ned unit sd sd_enu sd_ned".split()),
    "satellites": (
        *COMMON,
        *"satellite pseudorange range_rate position velocity emission clock clock_rate delays".split(),
        *"elevation cn0 elevation_mask_deg cn0_mask_dbhz".split(),
    ),
    "wheels": (*COMMON, "left", "right", "unit", "radius", "sd"),
}
MAX_LOCAL_M = 500e3  # m; farther from its origin a plane is no map
SCALAR = (*COMMON, "value", "unit", "sd")  # of every other stream
KEYS |= {name: (*SCALAR, "north_deg") for name in ("heading", "course")}


def read_map(
    path: FilePath, base: Callable[..., Parts], folder: FilePath | None = None, files: Sequence[FilePath] = ()
) -> Parts:
    """Read the parts that a column map describes.

    Args:
        path: the map.
        base: reads the file that the table [read] names, with its options.
        folder: of the data, instead of the map's ``folder``, which is relative to the map.
        files: in place of those that the map names: the IMU's, then others in the order of their first mention.

    Raises:
        DataError: a key, file, column or unit that is not known, or data that cannot be read.
    """
    file, table = os.fspath(path), _load(path)
    if files:
        return described(_with_files(table, file, files), file, Path(), base)
    said = os.path.expandvars(table.get("folder", "."))
    if "$" in said and folder is None:
        raise DataError(f"{file}: folder: {said} names an environment variable that is not set")
    where = Path(folder) if folder is not None else Path(path).parent / said
    return described(table, file, where, base)


def _with_files(table: Json, file: str, files: Sequence[FilePath]) -> Json:
    """Return a map that names other files."""
    imu_first = {key: table[key] for key in sorted(table, key=lambda key: key not in ("read", "imu"))}
    named = list(dict.fromkeys(_files(imu_first)))
    if len(named) != len(files):
        given = ", ".join(os.fspath(path) for path in files)
        raise DataError(f"{file}: the map names {len(named)} files ({', '.join(named)}), in their place come {given}")
    other = dict(zip(named, [os.fspath(path) for path in files], strict=True))

    def renamed(value: Any, key: str) -> Any:
        if isinstance(value, dict):
            return {k: renamed(v, "file" if key == "file" else k) for k, v in value.items()}
        return other[value] if key in FILES and isinstance(value, str) else value

    return {key: renamed(value, key) for key, value in table.items()}


def _files(value: Any, key: str = "") -> Iterator[str]:
    """Yield every file that a map or a part of it names."""
    if isinstance(value, dict):
        for k, v in value.items():
            yield from _files(v, "file" if key == "file" else k)
    elif key in FILES and isinstance(value, str):
        yield value


def described(table: Json, file: str, where: Path, base: Callable[..., Parts] | None = None) -> Parts:
    """Return the parts that the tables of a column map describe.

    Args:
        table: the map, as in ``docs/formats.md``.
        file: for messages.
        where: folder of the data, or a .zip archive.
        base: reads the file that the table [read] names, with its options.

    Raises:
        DataError: as `read_map`.
    """
    table = _shared(table, file)
    origin = np.array(table["origin_deg"], float) if "origin_deg" in table else None
    files = Files(file, where, {}, None if origin is None else origin * [DEG, DEG, 1.0], 0)
    parts = Parts(file)
    if "read" in table and base is not None:
        options = dict(table["read"])
        if "file" not in options:
            raise DataError(f"{file}: [read] needs a key file")
        options |= {key: where / options[key] for key in ("gnss",) if key in options}
        parts = base(where / options.pop("file"), **options)
        files = files._replace(zero=parts.zero)
    if "imu" in table:
        zero = times_of(files, table["imu"], "imu")
        first = float(zero[0]) if len(zero) and np.isfinite(zero[0]) else 0.0
        files = files._replace(zero=int(first) if first >= MAX_TIME_S else 0)
        parts = _with_imu(counted_from(parts, files.zero), files, table["imu"])
    aiding = parts.aiding | {key: _stream(files, table[key], key) for key in with_data() if key in table}
    if "satellites" in table:
        ranges, said_of = _satellites(files, table["satellites"])
        aiding, parts = ranges | aiding, parts._replace(notes=(*parts.notes, *said_of))
    truth = _truth(files, table["truth"]) if "truth" in table else parts.truth
    notes = [*parts.notes, *([table["notes"]] if "notes" in table else [])]
    notes += [note for sheet in files.opened.values() for note in sheet.notes]
    if files.zero:
        notes.append(finding("time.zero", words=f"{files.zero} s in the file's time"))
    arm = np.array(table.get("lever_arm_frd_m", parts.lever_arm), float)
    name = table.get("name", Path(file).stem)
    return parts._replace(file=file, aiding=aiding, truth=truth, notes=tuple(notes), lever_arm=arm, name=name)


def _load(path: FilePath) -> Json:
    try:
        return tomllib.loads(read_bytes(path).decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{os.fspath(path)}: cannot be read as TOML: {error}") from error


def _shared(table: Json, file: str) -> Json:
    """Return the map with its top-level keys in every table that does not set them."""
    known(table, (*TOP, *with_data()), file)
    shared = {key: table[key] for key in COMMON if key in table}
    out = {key: value for key, value in table.items() if key not in shared}
    for name in ("imu", "truth", "satellites", *with_data()):
        if isinstance(out.get(name), dict):
            other = {"rate_hz": "time", "time": "rate_hz"}  # a table has one of the two
            inherited = {k: v for k, v in shared.items() if other.get(k) not in out[name]}
            out[name] = inherited | out[name]
    return out


# ---------------------------------------------------------------------------- streams


def _with_imu(parts: Parts, files: Files, table: Json) -> Parts:
    known(table, KEYS["imu"], f"{files.map}: imu")
    sampling = table.get("sampling", RATES)
    if sampling not in SAMPLINGS:
        raise DataError(f"{files.map}: imu: sampling: {nearest(str(sampling), SAMPLINGS)}")
    kinds = ("angle", "speed") if sampling == INCREMENTS else ("rate", "acceleration")
    scales = [
        units.factor(table, f"{key}_unit", kind, f"{files.map}: imu") for key, kind in zip(("gyro", "accel"), kinds)
    ]
    gyro, accel = (table_of(files, table, key, "imu") * scale for key, scale in zip(("gyro", "accel"), scales))
    t = times_of(files, table, "imu")
    keep = kept_rows(files, table, "imu", len(t))
    column = _accel_time(files, table)
    if column is None:
        side_by_side(files, [t, gyro[:, 0], accel[:, 0]], "imu")
    else:
        accel, covered = interpolated(t, times_of(files, table | {"time": column}, "imu"), accel)
        keep &= covered
        if not keep.any():
            raise DataError(f"{files.map}: imu: no time of the gyro is within those of the accelerometer ({column})")
    refs = time_columns(table["time"])[0] if "time" in table else table["gyro"][0]
    lines = sheet_of(files, table, refs, "imu")[0].lines
    scale = _scale(table, f"{files.map}: imu")
    rows = ImuRows(t[keep], gyro[keep], accel[keep], sampling, repair=bool(table.get("repair", False)), scale=scale)
    if column is not None:
        times = " ".join(time_columns(column))
        said = finding("imu.two_clocks", "imu", words=times, count=int(keep.sum()), of=len(t))
        parts = parts._replace(notes=(*parts.notes, said))
    return parts._replace(imu=rows, axes=table.get("axes", "frd"), lines=None if lines is None else lines[keep])


def _scale(table: Json, where: str) -> TimeScale:
    """Return the time scale that a table states; dates are UTC, RTKLIB's tags GPS time."""
    unit = str(table.get("time_unit"))
    usual = TimeScale.UTC if unit in ("iso", *DAYS) or "%y" in unit.lower() else TimeScale.UNKNOWN
    said = table.get("time_scale", TimeScale.GPS if "time_tag" in table else usual)
    if said not in tuple(TimeScale):
        raise DataError(f"{where}: time_scale: {nearest(str(said), tuple(TimeScale))}")
    return TimeScale(said)


def _accel_time(files: Files, table: Json) -> Any:
    """Return the accelerometer's time column: ``accel_time``, or the gyro's name of it in the accelerometer's file."""
    if "accel_time" in table:
        return table["accel_time"]
    if not isinstance(table.get("file"), dict) or "time" not in table or "time_tag" in table:
        return None
    file_of = lambda ref: str(ref).partition(":")[0]
    refs = time_columns(table["time"])
    if file_of(refs[0]) != file_of(table["gyro"][0]):
        return None
    same = [f"{file_of(table['accel'][0])}:{ref.partition(':')[2]}" for ref in refs]
    there = all(name in sheet.columns for sheet, name in (sheet_of(files, table, ref, "imu") for ref in same))
    return same if same != refs and there else None


def interpolated(t: np.ndarray, times: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate accelerations to the times of the gyro.

    Args:
        t: (N,) s, of the gyro.
        times: (M,) s, of the accelerometer, in any order.
        accel: (M, 3) m/s^2.

    Returns:
        (N, 3) m/s^2, and (N,) bool: between two samples that are at most `GAP_STEPS` usual steps from each other.
    """
    times, first = np.unique(times, return_index=True)
    after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    before = after - 1
    step, usual = times[after] - times[before], np.median(np.diff(times))
    at_sample = np.minimum(np.abs(t - times[after]), np.abs(t - times[before])) < 0.01 * usual
    between = (t >= times[0]) & (t <= times[-1]) & (step <= GAP_STEPS * usual)
    return columns_at(t, times, accel[first]), at_sample | between


def _stream(files: Files, table: Json, name: str) -> Stream:
    known(table, KEYS.get(name, SCALAR), f"{files.map}: {name}")
    value = BUILD.get(name, _scalar)(files, table, name)
    t = times_of(files, table, name)
    side_by_side(files, [t, value[:, 0]], name)
    keep = kept_rows(files, table, name, len(t))
    sd = sd_of(files, table, name, value.shape[1])
    if name == "velocity" and "speed_course" in table and "up" not in table and "down" not in table:
        sd = np.full(value.shape, 0.3) if sd is None else np.broadcast_to(sd, value.shape).copy()
        sd[:, 2] = missing.UNMEASURED_SD
    sd = None if sd is None else np.broadcast_to(sd, value.shape)[keep]
    return Stream(t[keep], value[keep], sd, scale=_scale(table, f"{files.map}: {name}"))


def _satellites(files: Files, table: Json) -> tuple[dict[str, Stream], tuple[Note, ...]]:
    """Corrected ranges of a table with one row a satellite and epoch, with fixes by single points, and notes."""
    stream = "satellites"
    where = f"{files.map}: {stream}"
    known(table, KEYS[stream], where, OF | {"position": "columns", "velocity": "columns"})
    for key in ("satellite", "pseudorange"):
        if key not in table:
            raise DataError(f"{where}: expected a key {key}, a column")
    get = lambda key: column_of(files, table, table[key], stream)
    t = times_of(files, table, stream)
    maybe = lambda key, empty: get(key) if key in table else np.full(t.size, empty)
    names = column(*sheet_of(files, table, table["satellite"], stream))
    delays = table.get("delays", [])
    late = sum((column_of(files, table, ref, stream) for ref in delays), np.zeros(t.size))
    ranges = Ranges(
        t,
        np.array([number(str(cell).strip()) for cell in names]),
        get("pseudorange") + maybe("clock", 0.0) - late,
        maybe("range_rate", np.nan) + maybe("clock_rate", 0.0),
        table_of(files, table, "position", stream),
        table_of(files, table, "velocity", stream) if "velocity" in table else np.full((t.size, 3), np.nan),
        maybe("elevation", np.nan) * DEG,
        maybe("cn0", raw_table.USUAL_CN0),
    )
    side_by_side(files, [t, ranges.pseudorange, ranges.range_rate, ranges.position[:, 0]], stream)
    if table.get("emission", False):
        ranges = raw_table.to_reception(ranges)
    masks = {"elevation_deg": table.get("elevation_mask_deg", 10.0), "cn0_dbhz": table.get("cn0_mask_dbhz", 25.0)}
    found, notes = raw_table.solved(selected(ranges, kept_rows(files, table, stream, t.size)), where, Masks(**masks))
    scale = _scale(table, where)
    return {key: Stream(*samples)._replace(scale=scale) for key, samples in found.items()}, notes


def _one(files: Files, table: Json, keys: tuple[str, ...], stream: str) -> str:
    found = [key for key in keys if key in table]
    if len(found) != 1:
        raise DataError(f"{files.map}: {stream}: expected one of the keys {', '.join(keys)}, got {len(found)}")
    return found[0]


def _position(files: Files, table: Json, name: str) -> np.ndarray:
    key = _one(files, table, ("lla", "enu", "ned", "ecef", "utm"), name)
    level = key != "ecef" and name != "truth" and len(table[key]) == 2  # no height: `mend` gives it a large sd
    values = table_of(files, table, key, name, 2 if level else 3)
    lla = _lla(files, table, name, key, np.pad(values, ((0, 0), (0, 3 - values.shape[1]))))
    return np.where(level & (np.arange(3) == 2), np.nan, lla)


def _lla(files: Files, table: Json, name: str, key: str, values: np.ndarray) -> np.ndarray:
    if key == "lla":
        scale = units.factor(table, "unit", "angle", f"{files.map}: {name}", "deg")
        height = units.factor(table, "h_unit", "length", f"{files.map}: {name}", "m")
        return values * np.array([scale, scale, height])
    values = values * units.factor(table, "unit", "length", f"{files.map}: {name}", "m")
    if key == "ecef":
        return geodetic(values)
    if key == "utm":
        zone = re.fullmatch(r"([1-9]|[1-5]\d|60) ?([C-HJ-NP-X]|north|south)", table.get("zone", ""))
        if zone is None:
            raise DataError(
                f"{files.map}: {name}: zone: expected '32N' with the letter of the band, '32 north' or '32 south', "
                f"got {table.get('zone')!r}"
            )
        return utm_to_lla(values, int(zone[1]), zone[2] == "south" or zone[2] < "N")
    if files.origin is None:
        raise DataError(f"{files.map}: {name}: local metres need origin_deg = [lat, lon, height]")
    away = float(np.nanmedian(np.linalg.norm(values[:, :2], axis=1))) if np.isfinite(values[:, :2]).any() else 0.0
    if away > MAX_LOCAL_M:
        raise DataError(
            f"{files.map}: {name}: local metres are {away / 1e3:.0f} km from origin_deg, expected at most "
            f"{MAX_LOCAL_M / 1e3:.0f} km: eastings and northings of UTM? utm = [..] with zone = '32N'"
        )
    return local_to_lla(values if key == "enu" else ned_to_enu(values), files.origin)


def _velocity(files: Files, table: Json, name: str) -> np.ndarray:
    key = _one(files, table, ("enu", "ned", "neu", "speed_course"), name)
    scale = units.factor(table, "unit", "speed", f"{files.map}: {name}", "m/s")
    if key != "speed_course":
        order = {"enu": [0, 1, 2], "neu": [1, 0, 2], "ned": [1, 0, 2]}[key]
        sign = np.array([1.0, 1.0, -1.0 if key == "ned" else 1.0])
        enu = table_of(files, table, key, name)[:, order] * sign * scale
        (s, c), (east, north, up) = (f(_north(table)) for f in (np.sin, np.cos)), enu.T
        return np.stack([c * east + s * north, c * north - s * east, up], axis=1)
    speed, course = table_of(files, table, key, name, 2).T
    speed = np.where(missing.no_speed(speed), np.nan, speed)
    course = course * units.factor(table, "course_unit", "angle", f"{files.map}: {name}", "deg") + _north(table)
    key = "up" if "up" in table else "down"
    up = column_of(files, table, table[key], name) * scale if key in table else np.zeros_like(speed)
    up = -up if key == "down" else up
    return np.stack([speed * scale * np.sin(course), speed * scale * np.cos(course), up], axis=1)


def _north(table: Json) -> float:
    """Return the azimuth of the direction that angles of a table are counted from, rad."""
    return float(table.get("north_deg", 0.0)) * DEG


def _three(files: Files, table: Json, name: str) -> np.ndarray:
    """Return a vector in the axes of a sensor, FRD by ``axes``."""
    kind = with_data()[name].columns[0].quantity
    scale = units.factor(table, "unit", kind, f"{files.map}: {name}", QUANTITIES[kind][1])
    return table_of(files, table, "value", name) * scale @ rotation(table.get("axes", "frd")).T


def _baseline(files: Files, table: Json, name: str) -> np.ndarray:
    key = _one(files, table, ("enu", "ned"), name)
    value = table_of(files, table, key, name) * units.factor(table, "unit", "length", f"{files.map}: {name}", "m")
    return ned_to_enu(value) if key == "ned" else value


def _wheels(files: Files, table: Json, name: str) -> np.ndarray:
    where = f"{files.map}: {name}"
    if "left" not in table or "right" not in table:
        raise DataError(f"{where}: expected the keys left and right")
    value = np.column_stack([_mean(files, table, table[side], name) for side in ("left", "right")])
    if "radius" not in table:
        return value * units.factor(table, "unit", "speed", where, "m/s")
    radius = table["radius"]
    if not isinstance(radius, (int, float)) or isinstance(radius, bool) or not radius > 0:
        raise DataError(f"{where}: radius: expected metres, got {radius!r}")
    return value * radius * units.factor(table, "unit", "rate", where, "rad/s")


def _mean(files: Files, table: Json, refs: Any, name: str) -> np.ndarray:
    """Return a column, or the mean of several, as of the wheels of an axle."""
    columns = [column_of(files, table, ref, name) for ref in (refs if isinstance(refs, list) else [refs])]
    return side_by_side(files, columns, name).mean(axis=1)


def _scalar(files: Files, table: Json, name: str) -> np.ndarray:
    if "value" not in table:
        raise DataError(f"{files.map}: {name}: expected a key value")
    value = _mean(files, table, table["value"], name)
    if name == "barometer" and table.get("unit") in units.PRESSURE:
        return units.pressure_height(value * units.PRESSURE[table["unit"]])[:, None]
    kind = with_data()[name].columns[0].quantity
    default = QUANTITIES[kind][1]
    return value[:, None] * units.factor(table, "unit", kind, f"{files.map}: {name}", default) + _north(table)


BUILD = {
    "position": _position,
    "velocity": _velocity,
    "magnetometer": _three,
    "body_velocity": _three,
    "baseline": _baseline,
    "wheels": _wheels,
}
"""Makers of a stream's values; `_scalar` for every other one."""


def _truth(files: Files, table: Json) -> Track:
    known(table, KEYS["truth"], f"{files.map}: truth")
    where = f"{files.map}: truth"
    lla = _position(files, table, "truth")
    key = _one(files, table, ("velocity_enu", "velocity_ned", "velocity_ecef"), "truth")
    vel = table_of(files, table, key, "truth")
    if key == "velocity_ned":
        vel = ned_to_enu(vel)
    if key == "velocity_ecef":
        vel = np.stack([v @ enu_to_ecef(place) for v, place in zip(vel, lla)])
    rph = np.full_like(lla, np.nan)
    if "rph" in table:
        rph = table_of(files, table, "rph", "truth") * units.factor(table, "rph_unit", "angle", where, "deg")
    t = times_of(files, table, "truth")
    keep = kept_rows(files, table, "truth", len(t)) & np.isfinite(np.column_stack([t, lla, vel])).all(axis=1)
    return Track(t[keep], lla[keep], vel[keep], rph[keep])


def column_names(path: FilePath) -> list[str]:
    """Return the names of the columns of any table, for a message."""
    sheet = open_sheet(path)
    named = [key for key in sheet.columns if not key.isdigit()]
    return named or [f"{key} ({column(sheet, key)[0]})" for key in sheet.columns]


def recognises(path: Path, head: bytes) -> bool:
    """Is it TOML with the tables of a map?"""
    if path.is_dir() or not re.search(rb"^\s*(\[(imu|read)\]|(imu|read)\s*=\s*\{)", head, re.MULTILINE):
        return False
    try:
        return bool(set(tomllib.loads(path.read_text(encoding="utf-8-sig"))) & set(TOP))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return path.suffix == ".toml"  # a damaged map: its reader says where
