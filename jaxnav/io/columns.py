"""The columns that a table of a column map names, as numbers: `jaxnav.io.column_map` makes streams of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.io.formats.rtklib import read_tag
from jaxnav.io.options import OF, require
from jaxnav.io.sheet import Sheet, column, numbers, open_sheet, times
from jaxnav.types import DataError, Json, nearest

VALUES = ("gyro", "lla", "enu", "ned", "neu", "ecef", "speed_course", "value")  # keys that list columns


class Files(NamedTuple):
    """Where a table of the map finds its columns."""

    map: str  # the file of the map, for messages
    folder: Path
    opened: dict[tuple[Any, ...], Sheet]  # so that a file is read once
    origin: np.ndarray | None  # (3,) lat, lon rad, h m of local metres
    zero: int  # s, subtracted from all times


def known(table: Json, keys: tuple[str, ...], where: str, kinds: Mapping[str, str] = OF) -> None:
    """DataError for the first key that is not one of ``keys``, with the nearest, or whose value is of another kind."""
    for key, value in table.items():
        if key not in keys:
            raise DataError(f"{where}: {key}: unknown key; {nearest(key, keys)}")
        require(where, key, value, kinds.get(key, "table"))  # streams are tables


def sheet_of(files: Files, table: Json, ref: Any, key: str) -> tuple[Sheet, str]:
    """Return the sheet and the column's name of ``COLUMN`` or, where ``file`` is a table, ``FILE:COLUMN``."""
    name, _, rest = str(ref).partition(":")
    file = table.get("file")
    of = ""
    if isinstance(file, dict):
        if name not in file:
            raise DataError(f"{files.map}: {key}: column {ref!r}: {nearest(name, tuple(file))} (FILE:COLUMN)")
        path, ref, of = file[name], rest, f"{name}:"
    elif isinstance(file, str):
        path = file
    else:
        raise DataError(f"{files.map}: {key}: expected a key file, text or a table of names")
    cache = (path, table.get("delimiter"), table.get("header"), _kind(table, of))
    if cache not in files.opened:
        files.opened[cache] = open_sheet(_found(files, path), *cache[1:])
    return files.opened[cache], str(ref)


def _kind(table: Json, of: str) -> tuple[tuple[int, str], ...]:
    """Return columns of the file ``of`` by number and the text that ``where`` asks of each: rows of one kind."""
    kinds = ((ref.removeprefix(of), value) for ref, value in table.get("where", {}).items() if _is_kind(ref, value))
    return tuple((int(ref), value) for ref, value in kinds if ref.isdigit())


def _is_kind(ref: str, value: Any) -> bool:
    """Return whether a condition is the text of a column by its number: other lines are of other kinds."""
    return _is_text(value) and ref.rpartition(":")[2].isdigit()


def _is_text(value: Any) -> bool:
    """Return whether a value of ``where`` is text to be met, not a number or a comparison."""
    try:
        float(str(value).lstrip("<>=!"))
    except ValueError:
        return not str(value).startswith(tuple("<>=!"))
    return False


def _found(files: Files, pattern: str) -> Path:
    """Return the one file of this name or pattern."""
    path = files.folder / pattern
    if "*" not in pattern:
        return path
    found = sorted(files.folder.glob(pattern))
    if len(found) != 1:
        raise DataError(f"{path}: expected one file, found {len(found)}")
    return found[0]


def column_of(files: Files, table: Json, ref: Any, key: str) -> np.ndarray:
    """(N,) numbers of ``COLUMN``, ``-COLUMN`` or ``{ column = COLUMN, times = 0.01 }``."""
    if isinstance(ref, Mapping):
        known(dict(ref), ("column", "times"), f"{files.map}: {key}: column")
        if "column" not in ref:
            raise DataError(f"{files.map}: {key}: expected {{ column = .., times = .. }}, got {dict(ref)}")
        return column_of(files, table, ref["column"], key) * float(ref.get("times", 1.0))
    sheet, name = sheet_of(files, table, ref, key)
    negative = name.startswith("-") and name not in sheet.columns and name[1:] in sheet.columns
    return -numbers(sheet, name[1:]) if negative else numbers(sheet, name)


def table_of(files: Files, table: Json, key: str, stream: str, size: int = 3) -> np.ndarray:
    """(N, size) of the columns that ``key`` of the table lists."""
    refs = table.get(key)
    if not isinstance(refs, list) or len(refs) != size:
        raise DataError(f"{files.map}: {stream}: {key}: expected a list of {size} columns, got {refs!r}")
    return side_by_side(files, [column_of(files, table, ref, stream) for ref in refs], stream)


def side_by_side(files: Files, columns: list[np.ndarray], stream: str) -> np.ndarray:
    """(N, k) of columns (N,); DataError where they differ in length."""
    sizes = [len(c) for c in columns]
    if len(set(sizes)) != 1:
        raise DataError(f"{files.map}: {stream}: columns have different lengths: {sizes}")
    return np.stack(columns, axis=1)


def time_columns(refs: Any) -> list[str]:
    """Return the columns of a key ``time``: one, or those of date and time of day."""
    return [str(ref) for ref in refs] if isinstance(refs, list) else [str(refs)]


def times_of(files: Files, table: Json, stream: str) -> np.ndarray:
    """(N,) s, by the column ``time`` or, at ``rate_hz``, by the number of the row.

    With ``time_tag``, an RTKLIB time tag, the column counts ticks, which are stretched to the tag's.
    """
    shift = table.get("time_shift_s", 0.0)
    if ("rate_hz" in table) == ("time" in table):
        raise DataError(f"{files.map}: {stream}: expected a key time, or rate_hz where there is no such column")
    if "rate_hz" in table:
        first = next((table[key] for key in VALUES if key in table), None)
        first = first[0] if isinstance(first, list) and first else first
        rows = len(column_of(files, table, first, stream))
        return np.arange(1, rows + 1) / float(table["rate_hz"]) + shift
    unit, refs = table.get("time_unit", "s"), time_columns(table["time"])
    sheet, name = sheet_of(files, table, refs[0], stream)
    if len(refs) > 1:  # date and time of day
        if unit != "iso" and "%" not in unit:
            raise DataError(
                f'{files.map}: {stream}: time of {len(refs)} columns needs time_unit = "iso" or a pattern of dates'
            )
        cells = [column(*sheet_of(files, table, ref, stream)).tolist() for ref in refs]
        name, joined = " ".join(refs), np.array([" ".join(map(str, row)) for row in zip(*cells)])
        sheet = sheet._replace(columns={name: joined})
    if "time_tag" not in table:
        return times(sheet, name, unit, files.zero) + shift
    start, last = read_tag(files.folder / table["time_tag"])
    tick = times(sheet, name, table.get("time_unit", "s"))
    inner = tick[_skipped(files, table, stream, len(tick))]
    return (start - files.zero) + (tick - inner[0]) * (last / (inner[-1] - inner[0])) + shift


def _skipped(files: Files, table: Json, stream: str, n: int) -> slice:
    """All rows but those that ``skip = [first, last]`` leaves out at the start and at the end."""
    skip = table.get("skip", [0, 0])
    if len(skip) != 2 or min(skip) < 0 or sum(skip) > n - 2:
        raise DataError(f"{files.map}: {stream}: skip: expected rows to leave out at start and end, got {skip}")
    return slice(skip[0], n - skip[1])


def kept_rows(files: Files, table: Json, stream: str, n: int) -> np.ndarray:
    """(N,) bool, rows not to ``skip`` that meet all of ``where`` and are new in one of the columns of ``new_where``."""
    keep = np.zeros(n, bool)
    keep[_skipped(files, table, stream, n)] = True
    compare = {">=": np.greater_equal, "<=": np.less_equal, "!=": np.not_equal, ">": np.greater, "<": np.less}
    for ref, wanted in table.get("where", {}).items():
        if _is_kind(ref, wanted):
            continue  # the sheet has no others
        if _is_text(wanted):
            same = column(*sheet_of(files, table, ref, stream)) == wanted
            if not np.any(same):
                raise DataError(f"{files.map}: {stream}: where: {ref}: no row has the text {wanted!r}")
            keep &= same
            continue
        sign = next((s for s in compare if str(wanted).startswith(s)), "")
        try:
            value = float(str(wanted).removeprefix(sign))
        except ValueError:
            raise DataError(f"{files.map}: {stream}: where: {ref}: expected 3, '>=3' or text, got {wanted!r}") from None
        keep &= compare.get(sign, np.equal)(column_of(files, table, ref, stream), value)
    if "new_where" in table:
        refs = [ref["column"] if isinstance(ref, Mapping) and "column" in ref else ref for ref in table["new_where"]]
        columns = [column(*sheet_of(files, table, ref, stream)) for ref in refs]
        keep &= np.any([np.r_[True, c[1:] != c[:-1]] for c in columns], axis=0)
    return keep


def sd_of(files: Files, table: Json, stream: str, size: int) -> np.ndarray | None:
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


def _sd(files: Files, table: Json, entry: Any, stream: str) -> Any:
    """Return a number, a column, or ``{column = "HDOP", times = 2.5}``; of variances with ``variance = true``."""
    if isinstance(entry, (int, float)):
        return float(entry)
    if not (isinstance(entry, Mapping) and "variance" in entry):
        return column_of(files, table, entry, stream)
    ref = dict(entry)
    known({"variance": (squares := ref.pop("variance"))}, ("variance",), f"{files.map}: {stream}: sd")
    values = column_of(files, table, ref, stream)
    return np.sqrt(np.where(values >= 0, values, np.nan)) if squares else values
