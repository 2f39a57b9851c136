"""Any table as columns by name: text, JSON, .npy, .npz, .mat, .xlsx, alone or inside a zip archive; leniently.

A cell without a number is nan, a line of another width is left out: `jaxnav.io.mend` decides about them.
"""

import csv
import datetime
import difflib
import io
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.containers import ZIP, contents
from jaxnav.io.files import FilePath
from jaxnav.io.units import MULTIPLE, number_of
from jaxnav.types import DataError, Finding, Json

DAYS = {"excel": 25569.0, "matlab": 719529.0}  # days on which 1970 began, of units that count days
FORMS = ("iso", "%H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%I:%M:%S.%f %p", "%m/%d/%Y %I:%M:%S.%f %p")
"""Dates and times of the day, none of which passes for another."""
LONG_FRACTION = re.compile(r"(\.\d{6})\d+")  # of a second: `datetime` has six digits
DATE = re.compile(r"\s*(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})[T\s]+(\d{1,2}):(\d{1,2}):(\d{1,2}(?:\.\d*)?)\s*Z?\s*")
TICKS = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}  # units of time, how many a second
WHOLE, LED = re.compile(r"[+-]?\d+"), re.compile(r"0\d+(\.\d*)?")
QUOTED = re.compile(r'"[^"]*"')
NO_NAME = ("", "nan", "n/a", "na", "null", "none", "-")  # cells in place of a number, which make no header
MIN_QUICK, HEAD, TAIL = 2000, 200, 50  # lines of a file that is read quickly; first and last ones that are looked at
MAX_BAD = 0.05  # share of lines of another width that may be left out


class Sheet(NamedTuple):
    """Columns of equal or different length, as text where the file is text."""

    file: str
    columns: dict[str, np.ndarray]  # by name; text columns also by number from 1
    lines: np.ndarray | None  # of the rows, where the file has lines
    notes: tuple[Finding, ...] = ()
    twice: tuple[str, ...] = ()  # names that stand above several columns
    units: Mapping[str, str] = {}  # of a line below the header, by name


def open_sheet(
    path: FilePath, delimiter: str | None = None, header: bool | None = None, only: tuple[tuple[int, str], ...] = ()
) -> Sheet:
    """Open the columns of a file.

    Args:
        path: the file, or ``archive.zip/member``.
        delimiter: between cells; detected where it is None, as the header is.
        header: whether the first line has the names.
        only: lines of a text whose cells of these numbers, from 1, are these texts.

    Raises:
        DataError: not there, or no table.
    """
    data, file = contents(path), str(path)
    if data.startswith(b"\x93NUMPY"):
        return Sheet(file, _flat({"": _npy(io.BytesIO(data), file)}), None)
    if data.startswith(ZIP) and file.endswith(".xlsx"):
        data = _xlsx(data, file)
    if data.startswith(ZIP):
        return Sheet(file, _npz(data, file), None)
    if data.startswith(b"MATLAB"):
        return Sheet(file, _flat(_mat(data, file)), None)
    if data[:64].lstrip()[:1] in (b"{", b"[") and (objects := _json(data, file)) is not None:
        return objects
    quick = None if only else _numbers_only(data, file, delimiter, header)
    return _text(data, file, delimiter, header, only) if quick is None else quick


def column(sheet: Sheet, name: str | int) -> np.ndarray:
    """Return the column of this name, or of this number from 1, as it stands; DataError names the nearest."""
    if name in sheet.twice:
        raise DataError(f"{sheet.file}: the name {name} stands above several columns: say their numbers, from 1")
    if str(name) not in sheet.columns:
        near = difflib.get_close_matches(str(name), sheet.columns, n=1)
        known = [key for key in sheet.columns if not key.isdigit()] or list(sheet.columns)
        hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(known[:40])}"
        raise DataError(f"{sheet.file}: no column {name}: {hint}")
    return sheet.columns[str(name)]


def numbers(sheet: Sheet, name: str | int) -> np.ndarray:
    """(N,) float64, nan where a cell is no number."""
    cells = column(sheet, name)
    if cells.dtype.kind != "U":
        return cells.astype(np.float64)
    try:
        return cells.astype(np.float64)
    except ValueError:
        return np.array([_number(cell) for cell in cells.tolist()])


def times(sheet: Sheet, name: str | int, unit: str, zero: int = 0) -> np.ndarray:
    """(N,) s since ``zero`` (s): ``unit`` is one of TICKS, or "iso" for dates, which are counted from 1970 in UTC.

    "excel" and "matlab" are days, as those count them; text with % is a pattern of dates, "%m/%d/%Y %H:%M:%S.%f".

    Whole numbers are subtracted as such: a float would round nanoseconds since 1970 to 256 of them.
    """
    cells = column(sheet, name)
    if unit == "iso" or "%" in unit:
        dates = np.array([dated(cell, unit) for cell in cells.tolist()])
        if np.isnan(dates).all():
            raise DataError(
                f"{sheet.file}: {name}: time_unit: expected dates as {unit} has them, got {cells[0]!s:.40}: a pattern "
                "such as '%d.%m.%Y %H:%M:%S.%f' says their order"
            )
        return dates - zero
    if unit in DAYS:
        return (numbers(sheet, name) - DAYS[unit]) * 86400.0 - zero
    times_, name_of = MULTIPLE.fullmatch(unit).groups()  # type: ignore[union-attr]  # it fits any text
    if times_ and name_of in TICKS and (length := number_of(times_)) > 0:
        return numbers(sheet, name) * (length / TICKS[name_of]) - zero
    if unit not in TICKS:
        raise DataError(
            f"{sheet.file}: time_unit: expected one of {', '.join((*TICKS, *DAYS))}, iso, a multiple such as "
            f"'1/25600 s', a pattern of dates such as '%d.%m.%Y %H:%M:%S.%f', got {unit!r}"
        )
    ticks = TICKS[unit]
    if cells.dtype.kind == "U":
        try:
            cells = cells.astype(np.int64)
        except (ValueError, OverflowError):  # not whole numbers
            pass
    if cells.dtype.kind in "iu":
        return (cells.astype(np.int64) - zero * ticks) / ticks
    return numbers(sheet, name) / ticks - zero


def _number(cell: str) -> float:
    try:
        return float("nan") if "_" in cell else float(cell)
    except ValueError:
        return float("nan")


def date(cell: Any) -> float:
    """Return s since 1970 of a date as ISO 8601 or RTKLIB (2025/7/8 19:34:18.5) writes it; nan of anything else.

    Where it has no zone it is UTC.
    """
    try:
        moment = datetime.datetime.fromisoformat(str(cell))
    except ValueError:
        parts = DATE.fullmatch(str(cell))
        try:
            year, month, day, hour, minute, seconds = parts.groups() if parts else ("0",) * 6
            moment = datetime.datetime(int(year), int(month), int(day), int(hour), int(minute), tzinfo=datetime.UTC)
            return moment.timestamp() + float(seconds)
        except ValueError:
            return float("nan")
    return (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)).timestamp()


def form_of(cells: Iterable[str]) -> str:
    """Return the one of `FORMS` in which texts are dates or times of the day; empty of others."""
    cells = list(cells)
    return next((form for form in FORMS if cells and np.isfinite([dated(cell, form) for cell in cells]).all()), "")


def dated(cell: Any, pattern: str) -> float:
    """Return s since 1970 of a date by a pattern of `datetime.strptime`, in UTC where it has no zone; nan of others.

    "iso" is that of `date`. Of a pattern without a year they are of the day, counted from midnight. Fractions of a
    second may be missing.
    """
    if pattern == "iso":
        return date(cell)
    if pattern == "%H:%M:%S.%f" and np.isfinite(quick := date(f"1970-01-01T{cell}")):
        return quick  # in a fifth of the time of `strptime`
    text = LONG_FRACTION.sub(r"\1", str(cell))
    for form in (pattern, pattern.replace(".%f", "")):
        try:
            moment = datetime.datetime.strptime(text, form)
        except ValueError:
            continue
        moment = moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)
        midnight = datetime.datetime(1900, 1, 1, tzinfo=datetime.UTC)  # of a pattern without a date
        return moment.timestamp() - (midnight.timestamp() if moment.year == midnight.year else 0.0)
    return float("nan")


def _numbers_only(data: bytes, file: str, delimiter: str | None, header: bool | None) -> Sheet | None:
    """Return the columns of a long file of nothing but numbers below its header, None of any other.

    Its first and last lines are read as those of any file; the rest by numpy's parser, in a fifth of the time and a
    sixth of the memory. Columns of whole numbers are int64, the others float64.
    """
    count = data.count(b"\n")
    if count < MIN_QUICK or not data.endswith(b"\n"):
        return None
    sample = _ends(data)
    try:
        seen = _text(sample, file, delimiter, header)
    except DataError:
        return None
    width = sum(key.isdigit() for key in seen.columns)
    first, names = (0 if seen.lines is None else int(seen.lines[0])), list(seen.columns)[width:]
    if seen.lines is None or seen.twice or len(seen.lines) != HEAD + TAIL - first + 1 or len(names) not in (0, width):
        return None  # blank lines, comments among the rows, lines of another width, or a number for a name
    if any(LED.fullmatch(cell) for k in range(width) for cell in seen.columns[str(k + 1)].tolist()):
        return None  # a time of day: a number would lose its zeros
    whole = [all(WHOLE.fullmatch(cell) for cell in seen.columns[str(k + 1)].tolist()) for k in range(width)]
    kinds = np.dtype([(str(k + 1), np.int64 if w else np.float64) for k, w in enumerate(whole)])
    mark = _delimiter(sample.decode("utf-8", errors="replace").split("\n")[-51:-1]) if delimiter is None else delimiter
    between = None if mark == "space" else mark
    try:
        table = np.loadtxt(io.BytesIO(data), kinds, None, between, skiprows=first - 1, ndmin=1, encoding="utf-8")
    except ValueError:
        return None
    if table.size != count - first + 1:
        return None
    columns = {str(k + 1): np.ascontiguousarray(table[str(k + 1)]) for k in range(width)}
    columns |= {name: columns[str(k + 1)] for k, name in enumerate(names)}
    return Sheet(file, columns, np.arange(first, count + 1), seen.notes, units=seen.units)


def _ends(data: bytes) -> bytes:
    """Return the first `HEAD` and the last `TAIL` lines of a text."""
    end, begin = -1, len(data) - 1
    for _ in range(HEAD):
        end = data.index(b"\n", end + 1)
    for _ in range(TAIL):
        begin = data.rindex(b"\n", 0, begin)
    return data[: end + 1] + data[begin + 1 :]


def _text(
    data: bytes, file: str, delimiter: str | None, header: bool | None, only: tuple[tuple[int, str], ...] = ()
) -> Sheet:
    text = data.decode("utf-8-sig", errors="replace")
    if "\0" in text[:4096]:
        raise DataError(f"{file}: expected text, got binary data that no reader knows")
    lines = [(i, line.strip("\r")) for i, line in enumerate(text.split("\n"), start=1)]
    notes = []
    if lines[-1][1].strip() and len(lines) > 2:
        notes.append(finding("file.cut", Path(file).name))
        lines.pop()
    lines = [(i, line) for i, line in lines if line.strip()]
    comments = [line.lstrip("#% ") for _, line in lines[:100] if line.lstrip()[:1] in ("#", "%")]
    lines = [(i, line) for i, line in lines if line.lstrip()[:1] not in ("#", "%")]
    if not lines:
        raise DataError(f"{file}: has no rows")
    if re.fullmatch(r"sep=.", lines[0][1].strip(), re.IGNORECASE):  # Excel's
        delimiter = lines.pop(0)[1].strip()[-1] if delimiter is None else delimiter
    delimiter = _delimiter([line for _, line in lines[-50:]]) if delimiter is None else delimiter
    rows = [(i, _cells(line, delimiter)) for i, line in lines]
    if only:
        first, kind = only[0]
        comments = [line for line in comments if _cells(line, delimiter)[first - 1 : first] == [kind]]
        of_kind = lambda cells: all(cells[at - 1 : at] == [text] for at, text in only)
        every, rows = rows, [(i, cells) for i, cells in rows if of_kind(cells)]
        if not rows:
            texts = " and ".join(f"{text!r} in column {at}" for at, text in only)
            raise DataError(f"{file}: has no line with {texts}")
    width = Counter(len(cells) for _, cells in rows).most_common(1)[0][0]
    if only and (odd := _of_no_kind(every, only[0][0], width)):
        notes.append(finding("file.lines", Path(file).name, count=len(odd), why="of no kind", at=odd[0]))
    if delimiter != "," and _decimal_commas(rows):
        rows = [(i, [cell.replace(",", ".") for cell in cells]) for i, cells in rows]
        notes.append(finding("file.commas", Path(file).name))
    names: list[str] = _cells(comments[-1], delimiter) if comments else []
    below: list[str] = []
    before = next((k for k, (_, cells) in enumerate(rows) if len(cells) == width), 0)
    text_only = lambda cells: not any(np.isfinite(_number(cell)) for cell in cells)
    if header or (header is None and not only and _is_header([cells for _, cells in rows[before : before + 2]])):
        names = rows[before][1]
        if before:
            notes.append(finding("file.header", Path(file).name, count=before))
        rows = rows[before + 1 :]
        if rows and len(rows[0][1]) == width and len(rows) > 1 and header is None and text_only(rows[0][1]):
            notes.append(finding("file.units", Path(file).name))
            below = rows.pop(0)[1]
    whole = [row for row in rows if len(row[1]) == width]
    if len(rows) - len(whole) > max(2, MAX_BAD * len(rows)) or not whole:
        bad = next((i for i, cells in rows if len(cells) != width), 1)
        raise DataError(f"{file}: line {bad}: expected {width} columns like most lines")
    if len(whole) < len(rows):
        bad = next(i for i, cells in rows if len(cells) != width)
        count = len(rows) - len(whole)
        notes.append(finding("file.lines", Path(file).name, count=count, why="of another width", at=bad))
    cells = np.array([cells for _, cells in whole])
    columns = {str(k + 1): cells[:, k] for k in range(width)}
    if len(names) == width:
        columns |= {name: cells[:, k] for k, name in enumerate(names)}
    twice = tuple(name for name, count in Counter(names).items() if count > 1)
    return Sheet(file, columns, np.array([i for i, _ in whole]), tuple(notes), twice, dict(zip(names, below)))


def _of_no_kind(rows: list[tuple[int, list[str]]], at: int, width: int) -> list[int]:
    """Return the lines that are as wide as those of a kind, and whose cell of the kind no other line has."""
    kinds = Counter(tuple(cells[at - 1 : at]) for _, cells in rows)
    return [i for i, cells in rows if len(cells) == width and kinds[tuple(cells[at - 1 : at])] == 1]


def _is_header(rows: list[list[str]]) -> bool:
    """Return whether the first of two rows has names: no number, or few and text above numbers."""
    is_number = lambda cell: bool(np.isfinite(_number(cell)))
    numeric = [is_number(cell) for cell in rows[0]]
    if not any(numeric) or len(rows) < 2:
        return not any(numeric)
    above = [not a and is_number(b) and cell.lower() not in NO_NAME for a, cell, b in zip(numeric, *rows)]
    return 2 * sum(numeric) < len(numeric) and any(above)


def _delimiter(lines: list[str]) -> str:
    """Return the mark between cells: semicolons or tabs where all lines have as many, else commas, else space."""
    lines = [QUOTED.sub("", line) for line in lines]
    for mark in (";", "\t"):
        counts = {line.count(mark) for line in lines}
        if len(counts) == 1 and counts != {0}:
            return mark
    total = {mark: sum(line.count(mark) for line in lines) for mark in (",", ";", "\t")}
    best = max(total, key=lambda mark: total[mark])
    return best if total[best] else "space"


def _decimal_commas(rows: list[tuple[int, list[str]]]) -> bool:
    """Return whether the cells of the last lines have decimal commas and no decimal points."""
    cells = [cell for _, row in rows[-20:] for cell in row]
    return any(re.fullmatch(r"[+-]?\d+,\d+([eE][+-]?\d+)?", c) for c in cells) and not any("." in c for c in cells)


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line; a mark inside of quotes is none."""
    if delimiter == "space":
        cells = line.split()
    elif '"' in line and len(delimiter) == 1:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    else:
        cells = line.split(delimiter)
    return [cell.strip().strip('"') for cell in cells]


def _npy(stream: io.BytesIO, file: str) -> np.ndarray:
    try:
        return np.lib.format.read_array(stream, allow_pickle=False)
    except Exception as error:  # numpy raises a dozen kinds on a damaged file
        raise DataError(f"{file}: cannot be read as an array: {error}") from error


def _npz(data: bytes, file: str) -> dict[str, np.ndarray]:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return _flat({key: arrays[key] for key in arrays.files})
    except Exception as error:
        raise DataError(f"{file}: cannot be read as .npz: {error}") from error


def _json(data: bytes, file: str) -> Sheet | None:
    """Return an array of objects, or a line each, as columns; nested objects and arrays by dotted path.

    None of a text that only begins with a bracket.
    """
    notes: tuple[Finding, ...] = ()
    whole, lines = _loaded(data), None
    if whole is not None:
        rows = whole if isinstance(whole, list) else _rows(whole)
    else:
        text = data.decode("utf-8-sig", errors="replace").split("\n")
        read = [(i, _loaded(line)) for i, line in enumerate(text, start=1) if line.strip()]
        lost = [i for i, row in read if not isinstance(row, dict)]
        if read[0][0] in lost:
            return None
        if len(lost) > max(2, MAX_BAD * len(read)):
            raise DataError(f"{file}: line {lost[0]}: expected a JSON object like most lines")
        if lost:
            said = finding("file.lines", Path(file).name, count=len(lost), why="that are no JSON", at=lost[0])
            notes = (said,)
        kept = [(i, row) for i, row in read if isinstance(row, dict)]
        rows, lines = [row for _, row in kept], np.array([i for i, _ in kept])
    if not rows or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{file}: expected JSON objects, one a row")
    flat = [dict(_leaves(row)) for row in rows]
    names = dict.fromkeys(name for row in flat for name in row)
    columns = {name: np.array([row.get(name, "") for row in flat]) for name in names}
    return Sheet(file, columns, lines, notes)


def _rows(whole: Json) -> list[Any]:
    """Return the rows of a JSON object: of its list of objects or, by their paths, of several; else of its arrays."""
    lists = dict(_lists(whole))
    tables = {path: rows for path, rows in lists.items() if all(isinstance(row, dict) for row in rows)}
    if len(tables) == 1:
        return next(iter(tables.values()))
    if tables:
        return [{path: row} for path, rows in tables.items() for row in rows]
    groups: dict[int, list[str]] = {}  # arrays of one length are columns of one table
    for path, values in lists.items():
        groups.setdefault(len(values), []).append(path)
    return [{path: lists[path][k] for path in paths} for n, paths in groups.items() for k in range(n)] or [whole]


def _lists(value: Json, path: str = "") -> Iterator[tuple[str, list[Any]]]:
    """Yield the dotted path of each list that is not empty."""
    for key, inner in value.items():
        if isinstance(inner, dict):
            yield from _lists(inner, f"{path}{key}.")
        elif isinstance(inner, list) and inner:
            yield f"{path}{key}", inner


def _loaded(text: str | bytes) -> Any:
    """Return a JSON object or array; None of any other text."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, (dict, list)) else None


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted path and text of each number or text of a JSON value."""
    if isinstance(value, (dict, list)):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{path}.{key}" if path else str(key))
    elif value is not None:
        yield path, str(value)


def _xlsx(data: bytes, file: str) -> bytes:
    """Return the first sheet of a workbook as CSV."""
    from openpyxl import load_workbook

    try:
        rows = load_workbook(io.BytesIO(data), read_only=True, data_only=True).worksheets[0].iter_rows(values_only=True)
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(["" if cell is None else cell for cell in row] for row in rows)
    except Exception as error:  # openpyxl raises a dozen kinds on a damaged workbook
        raise DataError(f"{file}: cannot be read as a workbook: {error}") from error
    return text.getvalue().encode()


def _mat(data: bytes, file: str) -> Json:
    try:
        from scipy.io import loadmat

        found = loadmat(io.BytesIO(data), squeeze_me=True, struct_as_record=False)
    except Exception as error:  # scipy raises a dozen kinds on a damaged file
        raise DataError(f"{file}: cannot be read as a MATLAB file: {error}") from error
    return {key: value for key, value in found.items() if not key.startswith("__")}


def _flat(values: Json, prefix: str = "") -> dict[str, np.ndarray]:
    """Numbers of nested structs by dotted path; of a table each column as ``path[0]``, .. (or by number from 1)."""
    out: dict[str, np.ndarray] = {}
    for key, value in values.items():
        path = f"{prefix}{key}"
        if hasattr(value, "_fieldnames"):
            out |= _flat({name: getattr(value, name) for name in value._fieldnames}, f"{path}.")
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            continue
        if array.dtype.kind != "f" or array.itemsize < 8:
            array = array.astype(np.int64 if array.dtype.kind in "iub" else np.float64)
        if array.ndim == 1:
            out[path or "1"] = array
        elif array.ndim == 2:
            tall = array if array.shape[0] >= array.shape[1] else array.T
            out |= {f"{path}[{k}]" if path else str(k + 1): tall[:, k] for k in range(tall.shape[1])}
    return out
