"""A draft of a column map: what the columns of tables hold, by their names, their units and their numbers."""

import os
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.column_map import described
from jaxnav.io.containers import members
from jaxnav.io.files import FilePath
from jaxnav.io.naming import MIN_ROWS, THREE, Column, named_column, named_columns, readings, unit_of, words_of
from jaxnav.io.parts import Parts
from jaxnav.io.sheet import TICKS, Sheet, dated, form_of, numbers, open_sheet, times
from jaxnav.io.toml import cell
from jaxnav.io.units import UNITS
from jaxnav.maths.earth import enu_path
from jaxnav.maths.units import G0
from jaxnav.types import DataError, Json

WITHOUT_GRAVITY = {"user", "linear", "free"}  # words of an acceleration that a logger has taken gravity out of
MAX_RADPS = 12.0  # of the rates of a vehicle
LONG_STEP_S = 5.0  # s between fixes, over which their distance is no way
MAX_OFF = 0.07  # of a unit by the way between positions: knots and mph differ by 14 %
TURN_S, MOVING_MPS, MIN_TURNS, MIN_ALIKE = 5.0, 1.5, 5, 0.8  # s and m/s of a course; courses and correlation at least
IMU_HZ, FIX_HZ = (4.0, 4000.0), (0.09, 60.0)
SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".log", ".mat", ".npz")
MAX_FILES = 20
PARTS_OF_TIME = {
    "%Y": ("year", "yyyy"), "%m": ("month",), "%d": ("day",),
    "%H": ("hour", "hours", "hh"), "%M": ("minute", "minutes", "min"), "%S.%f": ("second", "seconds", "sec"),
}  # fmt: skip
"""Columns that are a time together: pattern of each, and its names."""


class Draft(NamedTuple):
    """A column map in the making."""

    tables: dict[str, Json]  # of the map, by name
    remarks: list[tuple[str, str]]  # (table, how a value was found)
    unsure: list[str]  # what a person has to confirm

    def text(self) -> str:
        """Return the map as TOML, with the evidence as comments."""
        out = [
            "# Drafted from names and numbers of the columns: confirm what is marked by a question mark.",
            "lever_arm_frd_m = [0.0, 0.0, 0.0] # IMU -> antenna, forward, right, down: no log says it",
        ]
        out += [f"# ? {line}" for line in self.unsure]
        for table, keys in self.tables.items():
            out += ["", f"[{table}]", *(f"{key} = {cell(value)}" for key, value in keys.items())]
            out += [f"# {said}" for name, said in self.remarks if name == table]
        return "\n".join(out) + "\n"


def draft(paths: Sequence[FilePath], folder: Path | None = None) -> Draft:
    """Return a column map of tables: the IMU in one of them, and fixes in one or the other.

    Args:
        paths: files with names in a header; a folder stands for the tables in it.
        folder: that the map's files are relative to.

    Raises:
        DataError: no table, no IMU in them, or one that cannot be used; says which columns were seen.
    """
    files = [file for path in paths for file in _files(Path(path))]
    sheets = {}
    for file in files:
        name = os.path.relpath(file, folder) if folder is not None else os.fspath(file)
        try:
            sheets[name] = open_sheet(file)
        except DataError:
            if len(files) == 1:
                raise
    columns = [column for name, sheet in sheets.items() for column in named_columns(name, sheet)]
    found = Draft({}, [], [])
    gyro, accel = (_group(columns, kind, found) for kind in THREE)
    fixes = _fixes(columns, found)
    if not (gyro and accel) and not fixes:
        seen = ", ".join(key for sheet in sheets.values() for key in sheet.columns if not key.isdigit()) or "no names"
        raise DataError(
            f"{', '.join(map(str, paths))}: neither an IMU nor fixes among the columns: {seen[:400]}: "
            "describe them in a column map (docs/formats.md)"
        )
    if gyro and accel:
        _imu(found, sheets, gyro, accel)
    if fixes:
        _position(found, sheets, fixes)
        _velocity(found, sheets, fixes)
    else:
        found.remarks.append(("imu", "no latitude and longitude among the columns: name the fixes' file as well"))
    if "imu" in found.tables:
        _by_motion(found, sheets, gyro, accel, fixes)
    return found


def read_tables(path: Path) -> Parts:
    """Read tables whose columns say by themselves what they hold.

    Raises:
        DataError: a table that cannot be read.
    """
    folder = path if path.is_dir() else path.parent
    found = _drafted(path, _stamps(path))
    parts = described(found.tables, os.fspath(path), folder)
    return parts._replace(notes=(*parts.notes, finding("columns.taken", path.name)))


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the columns of a table or a folder say by themselves what they hold."""
    try:
        return not _drafted(path, _stamps(path)).unsure
    except (DataError, OSError):
        return False


@lru_cache(1)
def _drafted(path: Path, stamps: tuple[tuple[str, int, int], ...]) -> Draft:
    """Return the draft of a table or folder, once for the recogniser and the reader, of files as ``stamps`` say."""
    return draft([path], path if path.is_dir() else path.parent)


def _stamps(path: Path) -> tuple[tuple[str, int, int], ...]:
    return tuple((file.name, about.st_mtime_ns, about.st_size) for file in _files(path) for about in [file.stat()])


def _files(path: Path) -> list[Path]:
    inside = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else members(path)
    if inside == [path]:
        return inside
    found = sorted(file for file in inside if file.suffix.lower() in SUFFIXES)
    if len(found) > MAX_FILES:
        raise DataError(f"{path}: {len(found)} tables, more than {MAX_FILES}: name those of one recording")
    return found


def _group(columns: list[Column], kind: str, found: Draft) -> list[Column]:
    """Return the columns x, y, z of one sensor, the first that has all of them; none without gravity."""
    groups: dict[tuple[str, str], dict[str, Column]] = {}
    for column in columns:
        if column.quantity == kind:
            groups.setdefault((column.file, column.group), {}).setdefault(column.axis, column)
    whole = [[axes[a] for a in "xyz"] for axes in groups.values() if set(axes) == set("xyz")]
    usable = [g for g in whole if np.isfinite(np.stack([c.values for c in g])).all(0).mean() > 0.5]
    if kind == "accel":
        usable.sort(key=lambda g: bool(WITHOUT_GRAVITY & set(g[0].group.split())))
    if len(usable) > 1:
        names = "; ".join(f"{g[0].file}: {', '.join(c.name for c in g)}" for g in usable[1:3])
        said = f"{kind}: the first of several, others are {names}"
        if usable[1][0].file == usable[0][0].file:
            found.remarks.append(("imu", said))
        else:
            found.unsure.append(said)
    return usable[0] if usable else []


def _fixes(columns: list[Column], found: Draft) -> dict[str, Column]:
    """Return the columns of the receiver, by quantity: those of the first table with latitude and longitude."""
    having = {quantity: [c.file for c in columns if c.quantity == quantity] for quantity in ("lat", "lon")}
    files = list(dict.fromkeys(file for file in having["lat"] if file in having["lon"]))
    if len(files) > 1:
        found.unsure.append(
            f"position: of the first of several tables with positions, others are {', '.join(files[1:])}"
        )
    fixes: dict[str, Column] = {}
    for column in columns:
        if column.file in files[:1] and column.quantity not in (*THREE, "time", "date"):
            fixes.setdefault(column.quantity, column)
    return fixes


def _imu(found: Draft, sheets: dict[str, Sheet], gyro: list[Column], accel: list[Column]) -> None:
    norm = float(np.nanmedian(np.linalg.norm(np.stack([c.values for c in accel]), axis=0)))
    likely = {unit: norm * factor / G0 for unit, factor in UNITS["acceleration"].items()}
    unit = next((unit for unit, g in likely.items() if 0.85 < g < 1.15), "")
    if not unit:
        raise DataError(
            f"{accel[0].file}: columns {', '.join(c.name for c in accel)}: the median size is {norm:.3g}, at rest it "
            "is 9.8 m/s^2 or 1 g: gravity was taken out by the logger (log the total acceleration), or another unit"
        )
    if accel[0].unit and accel[0].unit != unit:
        found.unsure.append(f"accel: the header says {accel[0].unit}, the numbers {unit} ({norm:.3g} in the median)")
    rate, how = _rate_unit(gyro)
    table: Json = {}
    one = gyro[0].file == accel[0].file
    table["file"] = gyro[0].file if one else {"g": gyro[0].file, "a": accel[0].file}
    of_gyro, of_accel = ("", "") if one else ("g:", "a:")
    time = _time(found, "imu", gyro[0], sheets[gyro[0].file], IMU_HZ, of_gyro)
    table |= time | {"gyro": [of_gyro + c.name for c in gyro], "gyro_unit": rate or "rad/s"}
    table |= {"accel": [of_accel + c.name for c in accel], "accel_unit": unit}
    if not one and "time" in time:
        other = _time(found, "imu", accel[0], sheets[accel[0].file], IMU_HZ, of_accel)
        table |= {"accel_time": other["time"]} if "time" in other and other["time"][2:] != time["time"][2:] else {}
    mean = np.nanmean(np.stack([c.values for c in accel]), 1) * UNITS["acceleration"][unit]
    up = int(np.argmax(np.abs(mean)))
    said = f"accel: {norm:.4g} in the median, so {unit}; {'xyz'[up]} reads {mean[up]:+.1f} m/s^2 in the mean"
    if rate:
        found.remarks.append(("imu", f"gyro: {how}"))
    if up == 2 and mean[2] > 0:
        table["axes"] = "flu"
        said += ": z points up, and axes are taken for forward, left, up"
    elif up != 2:
        said += ": the IMU is mounted on its side; the alignment finds any mounting, axes states it"
    found.remarks.append(("imu", said))
    found.tables["imu"] = table


def _rate_unit(gyro: list[Column]) -> tuple[str, str]:
    """Return the unit of gyros and how it was found; "" where neither header nor size show it."""
    if gyro[0].unit:
        return gyro[0].unit, f"{gyro[0].unit} by the header"
    most = float(np.nanpercentile(np.abs(np.stack([c.values for c in gyro])), 99.9))
    return ("deg/s", f"deg/s, since rates reach {most:.3g}") if most > MAX_RADPS else ("", "")


def _by_motion(
    found: Draft, sheets: dict[str, Sheet], gyro: list[Column], accel: list[Column], fixes: dict[str, Column]
) -> None:
    """Hold times and rates of the IMU against those of the fixes: the unit of gyros is that of the course's turns."""
    imu, position = found.tables["imu"], found.tables.get("position", {})
    near, stated = "", _rate_unit(gyro)[0]
    if "time" in imu and "time" in position:
        t = _seconds(imu, sheets[gyro[0].file])
        up = np.array([np.nanmean(c.values) for c in accel])
        rate = up / np.linalg.norm(up) @ np.stack([c.values for c in gyro])
        good = np.isfinite(t + rate)
        _, *track = _track(position, sheets[fixes["lat"].file], fixes)
        if min(good.sum(), track[0].size) >= MIN_ROWS:
            t, first = t[good], float(track[0][0])
            if first > t.max() or track[0][-1] < t.min():
                found.unsure.append(f"times of IMU and fixes do not meet: {t[0]:.12g} and {first:.12g} s at first")
            else:
                near = _unit_by_turns(t, np.cumsum(rate[good] * np.diff(t, prepend=t[0])), *track)
    if not stated and near:
        imu["gyro_unit"] = near
        found.remarks.append(("imu", f"gyro: {near}, since its turns are then those of the course"))
    elif not stated:
        found.unsure.append("gyro_unit: the header states none, and no turns of the course show it")
    elif near not in ("", stated):
        found.unsure.append(f"gyro_unit: {stated} by the header or size, {near} by the turns of the course")


def _unit_by_turns(t: np.ndarray, turned: np.ndarray, at: np.ndarray, north: np.ndarray, east: np.ndarray) -> str:
    """Return the unit in which angles about the vertical are those of a course, "" where it does not show.

    Args:
        t: (N,) s, of the IMU.
        turned: (N,) angle about the vertical, up or down.
        at: (K,) s, of the fixes.
        north: (K,) m.
        east: (K,) m.
    """
    every = max(1, round(TURN_S / max(float(np.median(np.diff(at))), 1e-3)))
    at, north, east = at[::every], north[::every], east[::every]
    way = np.hypot(np.diff(east), np.diff(north))
    moving = way > MOVING_MPS * np.diff(at)
    course = np.arctan2(np.diff(east), np.diff(north))[moving]
    by_gyro = np.diff(np.interp(0.5 * (at[1:] + at[:-1])[moving], t, turned))
    change = (np.diff(course) + np.pi) % (2 * np.pi) - np.pi
    if change.size < MIN_TURNS or not min(np.ptp(change), np.ptp(by_gyro)) > 0:
        return ""
    far = way[moving] ** 2  # a course is the surer, the longer its way
    C = np.cov(change, by_gyro, aweights=far[1:] * far[:-1] / (far[1:] + far[:-1]))
    alike, ratio = abs(C[0, 1]) / np.sqrt(C[0, 0] * C[1, 1]), abs(C[0, 1]) / C[1, 1]
    return _nearest(float(ratio), "rate", np.log(2.0)) if alike > MIN_ALIKE else ""


def _nearest(ratio: float, kind: str, most: float) -> str:
    """Return the unit whose factor to SI is ``ratio``, within the logarithm ``most``; "" where there is none."""
    off = {unit: abs(np.log(max(ratio, 1e-12) / factor)) for unit, factor in UNITS[kind].items()}
    unit = min(off, key=lambda each: off[each])
    return unit if off[unit] < most else ""


def _track(
    table: Json, sheet: Sheet, fixes: dict[str, Column]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rows with a new position, their times (s), and metres north and east of the first one."""
    scale = UNITS["angle"][table.get("unit", "deg")]
    t, lat, lon = _seconds(table, sheet), scale * fixes["lat"].values, scale * fixes["lon"].values
    new = np.flatnonzero(np.isfinite(t + lat + lon) & (np.diff(lat, prepend=np.nan) != 0) & (lat != 0))
    lla = np.stack([lat, lon, 0 * lat], 1)[new]
    east, north, _ = enu_path(lla, lla[0] if new.size else np.zeros(3)).T
    return new, t[new], north, east


def _seconds(table: Json, sheet: Sheet) -> np.ndarray:
    """Return the times of a table, s."""
    refs = [table["time"]] if isinstance(table["time"], str) else table["time"]
    names = [ref if ref in sheet.columns else ref.partition(":")[2] for ref in refs]
    if len(names) > 1:
        rows = zip(*(sheet.columns[name].tolist() for name in names), strict=True)
        return np.array([dated(" ".join(map(str, cells)), table["time_unit"]) for cells in rows])
    return times(sheet, names[0], table.get("time_unit", "s"))


def _time(found: Draft, table: str, of: Column, sheet: Sheet, rates: tuple[float, float], prefix: str = "") -> Json:
    """Return the keys of the time of a table: a column as long as ``of``, and its unit."""
    file, size = of.file, of.values.size
    names = [n for n, cells in sheet.columns.items() if not n.isdigit() and n not in sheet.twice and len(cells) == size]
    names.sort(key=lambda name: not name.startswith(of.name.rpartition(".")[0]))  # of the same struct first
    each = [named_column(file, name, *reading) for name in names for reading in readings(name, file)]
    known = list({c.name: c for c in each if c is not None and c.quantity in ("time", "date")}.values())
    parts, form_of_parts = _parts_of_time(names)
    days = [c.name for c in known if c.quantity == "date"]
    here = np.isfinite(of.values)  # rows of other sensors have times as well
    some = np.flatnonzero(here)[:5]
    best: list[tuple[float, Json, str]] = []
    for name, stated in (
        (c.name, c.unit or unit_of(sheet.units.get(c.name, ""), "time"))
        for c in known
        if c.quantity == "time" and c.name not in parts
    ):
        cells = sheet.columns[name]
        if cells.dtype.kind == "U" and np.isnan(numbers(sheet, name)[some]).all():
            for refs in (*([day, name] for day in days), [name]):
                begin = [" ".join(each) for each in zip(*(sheet.columns[ref][some].tolist() for ref in refs))]
                if form := form_of(begin):
                    named = [f"{prefix}{ref}" for ref in refs]
                    best.append((0.0, {"time": named if refs[1:] else named[0], "time_unit": form}, "dates"))
                    break
            continue
        t = numbers(sheet, name)[here]
        t = t[np.isfinite(t)]
        steps = np.diff(t)
        if t.size < 3 or not (steps > 0).any() or (steps < 0).mean() > 0.02:
            continue
        step, first = float(np.median(steps[steps > 0])), abs(float(t[0]))
        epoch = next((u for u, ticks in TICKS.items() if 1e9 < first / ticks < 2.2e9), "")
        fits = [u for u, ticks in TICKS.items() if rates[0] <= ticks / step <= rates[1]]
        unit = stated or epoch or (fits[0] if fits else "")
        if not unit or (fits and unit not in fits):
            continue
        rate = TICKS[unit] / step
        how = "the header" if stated else "its size since 1970" if epoch else "the rate that follows"
        score = (unit not in fits) + 0.1 * (not stated) + 1e-3 * float((steps == 0).mean() > 0.2)
        keys = {"time": f"{prefix}{name}"} | ({"time_unit": unit} if unit != "s" else {})
        best.append((score, keys, f"{unit} by {how}: {rate:.3g} Hz"))
    if not best and parts:  # last: a receiver's whole seconds stand next to its time of week
        best.append((0.0, {"time": [f"{prefix}{ref}" for ref in parts], "time_unit": form_of_parts}, " ".join(parts)))
    if not best:
        found.unsure.append(f"{table}: no column of {file} is a time that grows: set time and time_unit, or rate_hz")
        return {}
    _, keys, said = min(best, key=lambda each: each[0])
    found.remarks.append((table, f"time: {said}"))
    return keys


def _parts_of_time(names: Sequence[str]) -> tuple[list[str], str]:
    """Return the columns of year to second, or of hour to second, and the pattern of their texts; none of neither."""
    of = {" ".join(words_of(name)[0]): name for name in reversed(names)}
    refs = {form: next((of[word] for word in said if word in of), "") for form, said in PARTS_OF_TIME.items()}
    if not all(list(refs.values())[3:]):
        return [], ""
    kept = {form: ref for form, ref in refs.items() if all(refs.values()) or form in list(PARTS_OF_TIME)[3:]}
    return list(kept.values()), " ".join(kept)


def _together(sheets: dict[str, Sheet], column: Column, other: str) -> bool:
    """Return whether rows of a column have a number in another of its table."""
    there, values = np.isfinite(column.values), numbers(sheets[column.file], other)
    return values.size == there.size and bool(np.isfinite(values[there]).any())


def _position(found: Draft, sheets: dict[str, Sheet], fixes: dict[str, Column]) -> None:
    lat, lon, height = fixes["lat"], fixes["lon"], fixes.get("height")
    table: Json = {"file": lat.file}
    remark = lambda words: found.remarks.append(("position", words))
    imu = found.tables.get("imu", {})
    if imu.get("file") == lat.file and _together(sheets, lat, imu["gyro"][0]):
        table |= {key: imu[key] for key in ("time", "time_unit") if key in imu}
    else:
        table |= _time(found, "position", lat, sheets[lat.file], FIX_HZ)
    if height is None:
        found.unsure.append("position: no column of the height: a filter takes positions in three dimensions")
        return
    if np.isfinite(lat.values + lon.values).sum() < MIN_ROWS:
        found.unsure.append("position: no rows with latitude and longitude")
        return
    table["lla"] = [lat.name, lon.name, height.name]
    size = float(np.nanmax(np.abs(np.concatenate([lat.values, lon.values]))))
    unit = "1e-7 deg" if size > 1e4 else lat.unit or ("deg" if size > np.pi else "rad")
    if unit == "rad" and not lat.unit:
        remark(f"unit: rad, since degrees below {size:.3g} would be off the coast of Africa")
    if unit != "deg":
        table["unit"] = unit
    if height.unit not in ("", "m"):
        table["h_unit"] = height.unit
    elif not height.unit and float(np.nanmedian(np.abs(height.values))) > 2e4:
        table["h_unit"] = "mm"
        remark("height: taken for millimetres, by its size")
    still = np.mean((np.diff(lat.values) == 0) & (np.diff(lon.values) == 0))
    if still > 0.5:
        table["new_where"] = [lat.name, lon.name]
        remark(f"{100 * still:.0f} % of the rows repeat the last position: new ones alone count")
    level, up, hdop = fixes.get("level sd"), fixes.get("height sd"), fixes.get("hdop")
    if level is not None:
        ref = lambda c, times=1.0: _scaled(c, times * UNITS["length"][c.unit or table.get("h_unit", "m")])
        table["sd_enu"] = [ref(level), ref(level), ref(level, 2.0) if up is None else ref(up)]
    elif hdop is not None:
        table["sd_enu"] = [{"column": hdop.name, "times": 2.5}] * 2 + [{"column": hdop.name, "times": 5.0}]
        remark("sd: 2.5 m times HDOP, assumed")
    found.tables["position"] = table


def _scaled(column: Column, times: float) -> Any:
    return column.name if times == 1.0 else {"column": column.name, "times": times}


def _velocity(found: Draft, sheets: dict[str, Sheet], fixes: dict[str, Column]) -> None:
    if "position" not in found.tables:
        return
    position = found.tables["position"]
    kept: tuple[str, ...] = ("file", "time", "time_unit", "new_where")
    table: Json = {key: position[key] for key in kept if key in position}
    vertical = fixes.get("down") or fixes.get("up")
    if {"north", "east"} <= fixes.keys() and vertical is not None:
        key, order = ("ned", ("north", "east")) if vertical.quantity == "down" else ("enu", ("east", "north"))
        used = [fixes[order[0]], fixes[order[1]], vertical]
        table[key] = [c.name for c in used]
    elif {"speed", "course"} <= fixes.keys():
        used = [fixes["speed"]]
        table["speed_course"] = [fixes["speed"].name, fixes["course"].name]
        course = fixes["course"]
        if course.unit == "rad" or (not course.unit and float(np.nanmax(np.abs(course.values))) < 6.4):
            table["course_unit"] = "rad"
        if vertical is not None and vertical.unit == fixes["speed"].unit:
            table[vertical.quantity] = vertical.name
    else:
        return
    unit = _speed_unit(found, sheets[used[0].file], fixes, used[:2])
    if unit != "m/s":
        table["unit"] = unit
    sd = fixes.get("speed sd")
    if sd is not None:
        table["sd"] = _scaled(sd, UNITS["speed"][sd.unit or unit])
    found.tables["velocity"] = table


def _speed_unit(found: Draft, sheet: Sheet, fixes: dict[str, Column], used: list[Column]) -> str:
    """Return the unit of speeds, by the header and by the way between the positions."""
    stated, near = used[0].unit, ""
    if "time" in found.tables["position"]:
        new, t, north, east = _track(found.tables["position"], sheet, fixes)
        way, step = np.hypot(np.diff(north), np.diff(east)), np.diff(t)
        speed = np.linalg.norm(np.stack([c.values for c in used]), axis=0)[new][1:]
        known = np.where(np.isfinite(speed), speed, 0.0)
        usual = float(np.percentile(known, 90)) if known.size else 0.0
        fast = (step > 0) & (step < LONG_STEP_S) & (known > max(0.5 * usual, 1e-3))  # the noise of slow ones adds up
        if fast.sum() > MIN_TURNS:
            near = _nearest(float(way[fast].sum() / (speed * step)[fast].sum()), "speed", MAX_OFF)
    if not stated and near:
        found.remarks.append(("velocity", f"unit: {near}, by the way between positions"))
    elif not stated:
        found.unsure.append("velocity: the unit of the speed is not stated, and positions do not show it")
    elif near not in ("", stated):
        found.unsure.append(f"velocity: {stated} by the header, {near} by the way between positions")
    return stated or near or "m/s"
