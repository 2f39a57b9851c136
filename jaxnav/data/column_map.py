"""A column map: a few lines of TOML that say what the columns of somebody's files are; see ``docs/formats.md``."""

import os
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.data import units
from jaxnav.data.axes import enu_to_ecef, geodetic, local_to_lla, rotation
from jaxnav.data.checks import STREAM_SIZES, ned_to_enu
from jaxnav.data.files import FilePath, read_bytes
from jaxnav.data.mend import LATE
from jaxnav.data.parts import INCREMENTS, RATES, SAMPLINGS, ImuRows, Parts, Stream
from jaxnav.data.sheet import Sheet, column, numbers, open_sheet, times
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Track

UNKNOWN_SD = 1e3  # m/s, of a component that nothing measured

TOP = ("name", "notes", "folder", "lever_arm_frd_m", "origin_deg", "read", "imu", "truth", *STREAM_SIZES)
COMMON = tuple("file delimiter header time time_unit time_shift_s rate_hz where new_where".split())
KEYS: dict[str, tuple[str, ...]] = {
    "imu": (*COMMON, *"gyro gyro_unit accel accel_unit axes sampling".split()),
    "position": (*COMMON, *"lla enu ned ecef unit h_unit sd sd_enu sd_ned".split()),
    "velocity": (*COMMON, *"enu ned neu ecef speed_course up down unit course_unit sd sd_enu sd_ned".split()),
    "truth": (*COMMON, *"lla enu ned ecef unit h_unit velocity_enu velocity_ned velocity_ecef rph rph_unit".split()),
    "magnetometer": (*COMMON, "value", "unit", "axes", "sd"),
}
SCALAR = (*COMMON, "value", "unit", "sd")  # of every other stream


class Files(NamedTuple):
    """Where a table of the map finds its columns."""

    map: str  # the file of the map, for messages
    folder: Path
    opened: dict[tuple, Sheet]  # so that a file is read once
    origin: np.ndarray | None  # (3,) lat, lon rad, h m of local metres
    zero: int  # s, subtracted from all times


def read_map(path: FilePath, base: Callable[..., Parts], folder: FilePath | None = None) -> Parts:
    """The parts that a column map describes.

    Args:
        path: the map.
        base: reads the file that the table [read] names, with its options.
        folder: of the data, instead of the map's ``folder``, which counts from the map's own.

    Raises:
        DataError: a key, file, column or unit that is not known, or data that cannot be read.
    """
    table, file = _load(path), os.fspath(path)
    known(table, TOP, file)
    said = os.path.expandvars(table.get("folder", "."))
    if "$" in said:
        raise DataError(f"{file}: folder: {said} names an environment variable that is not set")
    where = Path(folder) if folder is not None else Path(path).parent / said
    origin = np.array(_numbers(table["origin_deg"], 3, f"{file}: origin_deg")) if "origin_deg" in table else None
    files = Files(file, where, {}, None if origin is None else origin * [DEG, DEG, 1.0], 0)
    parts = Parts(file)
    if "read" in table:
        options = dict(table["read"])
        if "file" not in options:
            raise DataError(f"{file}: [read] needs a key file")
        options |= {key: where / options[key] for key in ("gnss",) if key in options}
        parts = base(where / options.pop("file"), **options)
    if "imu" in table:
        zero = _times(files, table["imu"], "imu")
        first = float(zero[0]) if len(zero) and np.isfinite(zero[0]) else 0.0
        files = files._replace(zero=int(first) if first >= LATE else 0)
        parts = _with_imu(parts, files, table["imu"])
    aiding = parts.aiding | {key: _stream(files, table[key], key) for key in STREAM_SIZES if key in table}
    truth = _truth(files, table["truth"]) if "truth" in table else parts.truth
    notes = [*parts.notes, *([table["notes"]] if "notes" in table else [])]
    notes += [note for sheet in files.opened.values() for note in sheet.notes]
    if files.zero:
        notes.append(f"t = 0 is {files.zero} s in the file's time.")
    arm = np.array(_numbers(table.get("lever_arm_frd_m", parts.lever_arm.tolist()), 3, f"{file}: lever_arm_frd_m"))
    name = table.get("name", parts.name or Path(path).stem)
    return parts._replace(file=file, aiding=aiding, truth=truth, notes=tuple(notes), lever_arm=arm, name=name)


def known(table: dict, keys: tuple[str, ...], where: str) -> None:
    """DataError for the first key that is not one of ``keys``, with the nearest."""
    for key in table:
        if key not in keys:
            raise DataError(f"{where}: {key}: unknown key; {units.nearest(key, keys)}")


def _load(path: FilePath) -> dict[str, Any]:
    try:
        return tomllib.loads(read_bytes(path).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{os.fspath(path)}: cannot be read as TOML: {error}") from error


def _numbers(value: Any, size: int, where: str) -> list[float]:
    good = isinstance(value, list) and len(value) == size
    if not good or not all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in value):
        raise DataError(f"{where}: expected {size} numbers, got {value!r}")
    return value


# ---------------------------------------------------------------------------- columns


def _sheet(files: Files, table: dict, ref: Any, key: str) -> tuple[Sheet, str]:
    """The sheet and the column's name in it, of ``COLUMN`` or, where ``file`` is a table, ``FILE:COLUMN``."""
    name, _, rest = str(ref).partition(":")
    file = table.get("file")
    if isinstance(file, dict):
        if name not in file:
            raise DataError(f"{files.map}: {key}: column {ref!r}: {units.nearest(name, tuple(file))} (FILE:COLUMN)")
        path, ref = file[name], rest
    elif isinstance(file, str):
        path = file
    else:
        raise DataError(f"{files.map}: {key}: expected a key file, text or a table of names")
    cache = (path, table.get("delimiter"), table.get("header"))
    if cache not in files.opened:
        files.opened[cache] = open_sheet(_found(files, path), *cache[1:])
    return files.opened[cache], str(ref)


def _found(files: Files, pattern: str) -> Path:
    """The one file of this name or pattern."""
    path = files.folder / pattern
    if "*" not in pattern:
        return path
    found = sorted(files.folder.glob(pattern))
    if len(found) != 1:
        raise DataError(f"{path}: expected one file, found {len(found)}")
    return found[0]


def _column(files: Files, table: dict, ref: Any, key: str) -> np.ndarray:
    sheet, name = _sheet(files, table, ref, key)
    return numbers(sheet, name)


def _columns(files: Files, table: dict, key: str, stream: str, size: int = 3) -> np.ndarray:
    """(N, size) of the columns that ``key`` of the table lists."""
    refs = table.get(key)
    if not isinstance(refs, list) or len(refs) != size:
        raise DataError(f"{files.map}: {stream}: {key}: expected a list of {size} columns, got {refs!r}")
    return _stack(files, [_column(files, table, ref, stream) for ref in refs], stream)


def _stack(files: Files, columns: list[np.ndarray], stream: str) -> np.ndarray:
    sizes = [len(c) for c in columns]
    if len(set(sizes)) != 1:
        raise DataError(f"{files.map}: {stream}: columns have different lengths: {sizes}")
    return np.stack(columns, axis=1)


def _times(files: Files, table: dict, stream: str) -> np.ndarray:
    """(N,) s, by the column ``time`` or, at ``rate_hz``, by the number of the row."""
    shift = table.get("time_shift_s", 0.0)
    if ("rate_hz" in table) == ("time" in table):
        raise DataError(f"{files.map}: {stream}: expected a key time, or rate_hz where there is no such column")
    if "rate_hz" in table:
        first = next(value[0] for value in table.values() if isinstance(value, list))
        rows = len(_column(files, table, first, stream))
        return np.arange(1, rows + 1) / float(table["rate_hz"]) + shift
    sheet, name = _sheet(files, table, table["time"], stream)
    return times(sheet, name, table.get("time_unit", "s"), files.zero) + shift


def _rows(files: Files, table: dict, stream: str, n: int) -> np.ndarray:
    """(N,) bool, rows that meet every condition of ``where`` and are new in one of the columns of ``new_where``."""
    keep = np.ones(n, bool)
    compare = {">=": np.greater_equal, "<=": np.less_equal, "!=": np.not_equal, ">": np.greater, "<": np.less}
    for ref, wanted in table.get("where", {}).items():
        sign = next((s for s in compare if str(wanted).startswith(s)), "")
        try:
            value = float(str(wanted).removeprefix(sign))
        except ValueError:
            raise DataError(f"{files.map}: {stream}: where: {ref}: expected 3 or '>=3', got {wanted!r}") from None
        keep &= compare.get(sign, np.equal)(_column(files, table, ref, stream), value)
    if "new_where" in table:
        watched = [_column(files, table, ref, stream) for ref in table["new_where"]]
        keep &= np.any([np.r_[True, c[1:] != c[:-1]] for c in watched], axis=0)
    return keep


def _uncertainty(files: Files, table: dict, stream: str, size: int) -> np.ndarray | None:
    """(N or 1, size) sd, ENU; None where the table says none."""
    given = [key for key in ("sd", "sd_enu", "sd_ned") if key in table]
    if not given:
        return None
    value = table[given[0]]
    entries = value if isinstance(value, list) else [value] * size
    if len(given) > 1 or len(entries) != size:
        raise DataError(f"{files.map}: {stream}: expected one of sd, sd_enu, sd_ned with {size} entries")
    columns = np.broadcast_arrays(*(np.atleast_1d(_sd(files, table, entry, stream)) for entry in entries))
    return np.stack(columns, axis=1)[:, [1, 0, 2] if given[0] == "sd_ned" else slice(None)]


def _sd(files: Files, table: dict, entry: Any, stream: str) -> Any:
    """A number, a column, or ``{column = "HDOP", times = 2.5}``."""
    if isinstance(entry, (int, float)):
        return float(entry)
    if isinstance(entry, dict):
        known(entry, ("column", "times"), f"{files.map}: {stream}: sd")
        return _column(files, table, entry.get("column"), stream) * float(entry.get("times", 1.0))
    return _column(files, table, entry, stream)


# ---------------------------------------------------------------------------- streams


def _with_imu(parts: Parts, files: Files, table: dict) -> Parts:
    known(table, KEYS["imu"], f"{files.map}: imu")
    sampling = table.get("sampling", RATES)
    if sampling not in SAMPLINGS:
        raise DataError(f"{files.map}: imu: sampling: {units.nearest(str(sampling), SAMPLINGS)}")
    kinds = ("angle", "speed") if sampling == INCREMENTS else ("rate", "acceleration")
    scales = [
        units.factor(table, f"{key}_unit", kind, f"{files.map}: imu") for key, kind in zip(("gyro", "accel"), kinds)
    ]
    gyro, accel = (_columns(files, table, key, "imu") * scale for key, scale in zip(("gyro", "accel"), scales))
    t = _times(files, table, "imu")
    _stack(files, [t, gyro[:, 0], accel[:, 0]], "imu")
    keep = _rows(files, table, "imu", len(t))
    refs = table["time"] if "time" in table else table["gyro"][0]
    lines = _sheet(files, table, refs, "imu")[0].lines
    rows = ImuRows(t[keep], gyro[keep], accel[keep], sampling)
    return parts._replace(imu=rows, axes=table.get("axes", "frd"), lines=None if lines is None else lines[keep])


def _stream(files: Files, table: dict, name: str) -> Stream:
    known(table, KEYS.get(name, SCALAR), f"{files.map}: {name}")
    build = {"position": _position, "velocity": _velocity, "magnetometer": _field}.get(name, _scalar)
    value = build(files, table, name)
    t = _times(files, table, name)
    _stack(files, [t, value[:, 0]], name)
    keep = _rows(files, table, name, len(t))
    sd = _uncertainty(files, table, name, value.shape[1])
    if name == "velocity" and "speed_course" in table and "up" not in table and "down" not in table:
        sd = np.full(value.shape, 0.3) if sd is None else np.broadcast_to(sd, value.shape).copy()
        sd[:, 2] = UNKNOWN_SD
    return Stream(t[keep], value[keep], None if sd is None else np.broadcast_to(sd, value.shape)[keep])


def _one(files: Files, table: dict, keys: tuple[str, ...], stream: str) -> str:
    found = [key for key in keys if key in table]
    if len(found) != 1:
        raise DataError(f"{files.map}: {stream}: expected one of the keys {', '.join(keys)}, got {len(found)}")
    return found[0]


def _position(files: Files, table: dict, name: str) -> np.ndarray:
    key = _one(files, table, ("lla", "enu", "ned", "ecef"), name)
    values = _columns(files, table, key, name)
    if key == "lla":
        scale = units.factor(table, "unit", "angle", f"{files.map}: {name}", "deg")
        height = units.factor(table, "h_unit", "length", f"{files.map}: {name}", "m")
        return values * np.array([scale, scale, height])
    values = values * units.factor(table, "unit", "length", f"{files.map}: {name}", "m")
    if key == "ecef":
        return geodetic(values)
    if files.origin is None:
        raise DataError(f"{files.map}: {name}: local metres need origin_deg = [lat, lon, height]")
    return local_to_lla(values if key == "enu" else ned_to_enu(values), files.origin)


def _velocity(files: Files, table: dict, name: str) -> np.ndarray:
    key = _one(files, table, ("enu", "ned", "neu", "speed_course"), name)
    scale = units.factor(table, "unit", "speed", f"{files.map}: {name}", "m/s")
    if key != "speed_course":
        order = {"enu": [0, 1, 2], "neu": [1, 0, 2], "ned": [1, 0, 2]}[key]
        sign = np.array([1.0, 1.0, -1.0 if key == "ned" else 1.0])
        return _columns(files, table, key, name)[:, order] * sign * scale
    speed, course = _columns(files, table, key, name, 2).T
    course = course * units.factor(table, "course_unit", "angle", f"{files.map}: {name}", "deg")
    up = np.zeros_like(speed)
    for vertical, sign in (("up", scale), ("down", -scale)):
        up = _column(files, table, table[vertical], name) * sign if vertical in table else up
    return np.stack([speed * scale * np.sin(course), speed * scale * np.cos(course), up], axis=1)


def _field(files: Files, table: dict, name: str) -> np.ndarray:
    scale = units.factor(table, "unit", "field", f"{files.map}: {name}", "uT")
    return _columns(files, table, "value", name) * scale @ rotation(table.get("axes", "frd")).T


def _scalar(files: Files, table: dict, name: str) -> np.ndarray:
    if "value" not in table:
        raise DataError(f"{files.map}: {name}: expected a key value")
    refs = table["value"] if isinstance(table["value"], list) else [table["value"]]
    value = _stack(files, [_column(files, table, ref, name) for ref in refs], name).mean(axis=1)  # wheels of an axle
    if name == "barometer" and table.get("unit") in units.PRESSURE:
        return units.pressure_height(value * units.PRESSURE[table["unit"]])[:, None]
    kind, default = {"barometer": ("length", "m"), "heading": ("angle", "deg")}.get(name, ("speed", "m/s"))
    return value[:, None] * units.factor(table, "unit", kind, f"{files.map}: {name}", default)


def _truth(files: Files, table: dict) -> Track:
    known(table, KEYS["truth"], f"{files.map}: truth")
    where = f"{files.map}: truth"
    lla = _position(files, table, "truth")
    key = _one(files, table, ("velocity_enu", "velocity_ned", "velocity_ecef"), "truth")
    vel = _columns(files, table, key, "truth")
    if key == "velocity_ned":
        vel = ned_to_enu(vel)
    if key == "velocity_ecef":
        vel = np.stack([v @ enu_to_ecef(place) for v, place in zip(vel, lla)])
    rph = np.full_like(lla, np.nan)
    if "rph" in table:
        rph = _columns(files, table, "rph", "truth") * units.factor(table, "rph_unit", "angle", where, "deg")
    t = _times(files, table, "truth")
    keep = _rows(files, table, "truth", len(t)) & np.isfinite(np.column_stack([t, lla, vel])).all(axis=1)
    return Track(t[keep], lla[keep], vel[keep], rph[keep])


def column_names(path: FilePath) -> list[str]:
    """The names of the columns of any table, for a message."""
    sheet = open_sheet(path)
    named = [key for key in sheet.columns if not key.isdigit()]
    return named or [f"{key} ({column(sheet, key)[0]})" for key in sheet.columns]
