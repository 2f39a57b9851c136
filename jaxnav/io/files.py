"""Strict reading of text and atomic writing of files: the base of every format."""

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from jaxnav.findings import finding
from jaxnav.types import DataError, Note

FilePath = str | os.PathLike[str]

MAX_BYTES = 2 << 30  # larger inputs are refused before they are read
HEAD = 4096  # bytes of a file that a reader sees to recognise it
MAX_VALUE = 1e15  # larger numbers are no measurement of anything here, and squares of them may overflow


class Source(NamedTuple):
    """Where rows came from, for messages."""

    file: str
    lines: np.ndarray | None = None  # (N,) line of each row, counted from 1; None where the file has no lines


class Table(NamedTuple):
    """A table of numbers with the line of every row."""

    names: tuple[str, ...]  # of the columns; empty where the format has no header
    values: np.ndarray  # (N, c)
    source: Source


def place(source: Source, row: int, stream: str = "") -> str:
    """``file: line 7`` where lines are known, else ``file: imu row 6`` (rows counted from 0)."""
    if source.lines is not None:
        return f"{source.file}: line {int(source.lines[row])}"
    return f"{source.file}: {stream} row {row}" if stream else f"{source.file}: row {row}"


@contextmanager
def open_bytes(path: FilePath) -> Iterator[IO[bytes]]:
    """Open a file; DataError where it is absent, unreadable, a folder or too large."""
    try:
        size = os.stat(path).st_size
        if size > MAX_BYTES:
            raise DataError(f"{os.fspath(path)}: {size} bytes, expected at most {MAX_BYTES}")
        with open(path, "rb") as stream:
            yield stream
    except OSError as error:
        raise DataError(f"{os.fspath(path)}: cannot be read: {error.strerror or error}") from error


def read_bytes(path: FilePath) -> bytes:
    """Read a file; DataError as `open_bytes`."""
    with open_bytes(path) as stream:
        return stream.read()


def read_lines(path: FilePath, notes: list[Note] | None = None) -> list[tuple[int, str]]:
    """Read the lines of a UTF-8 text that are not blank, each with its number from 1.

    A last line without a line end may have been cut: a DataError, or where there is a list of ``notes`` it is left out
    and said there.
    """
    data = read_bytes(path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise DataError(f"{os.fspath(path)}: line {line}: expected UTF-8 text, got binary data") from error
    # str.splitlines would also split at form feeds and the like, and the line numbers would be no editor's
    lines = [(i, line.rstrip("\r")) for i, line in enumerate(text.split("\n"), start=1)]
    if lines[-1][1].strip() and notes is not None:
        notes.append(finding("file.cut", Path(path).name))
        lines.pop()
    elif lines[-1][1].strip():
        raise DataError(f"{os.fspath(path)}: line {lines[-1][0]}: has no line end; the file looks cut short")
    return [(i, line) for i, line in lines if line.strip()]


def parse_numbers(
    rows: list[tuple[int, list[str]]],
    width: int,
    path: FilePath,
    names: tuple[str, ...] = (),
    nan: frozenset[str] = frozenset(),
) -> Table:
    """Cells of text to a table of ``width`` columns; ``nan`` names the columns where nan is allowed."""
    file, values = os.fspath(path), []
    if not rows:
        raise DataError(f"{file}: has no rows")
    for line, cells in rows:
        if len(cells) != width:
            raise DataError(f"{file}: line {line}: expected {width} columns, got {len(cells)}")
        try:
            values.append([_number(cell) for cell in cells])
        except ValueError:
            bad = next(i for i, cell in enumerate(cells) if not _is_number(cell))
            raise DataError(
                f"{file}: line {line}: {_column(names, bad)}: expected a number, got {cells[bad]!r}"
            ) from None
    array = np.array(values)
    allowed = np.array([name in nan for name in names] if names else [False] * width)
    ok = (np.abs(array) < MAX_VALUE) | (np.isnan(array) & allowed)
    if not ok.all():
        i, j = (int(k[0]) for k in np.nonzero(~ok))
        raise DataError(f"{file}: line {rows[i][0]}: {_column(names, j)}: expected a finite number, got {array[i, j]}")
    return Table(names, array, Source(file, np.array([line for line, _ in rows])))


def clean_table(
    path: FilePath, names: tuple[str, ...] | int, delimiter: str | None, nan: frozenset[str] = frozenset()
) -> Table | None:
    """Return the table of a file without a fault, None of any other: `parse_numbers` then says where the fault is.

    By numpy's parser: a fifth of the time, and no memory but the table's. ``names`` of the columns in the first line,
    or how many there are in a file without them.
    """
    head, width = (1, len(names)) if isinstance(names, tuple) else (0, names)
    try:
        if os.stat(path).st_size > MAX_BYTES:
            return None
        with open(path, "rb") as file:
            count, end = 0, b""
            for block in iter(partial(file.read, 1 << 20), b""):
                count, end = count + block.count(b"\n"), block[-1:]
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of a file without numbers
            values = np.loadtxt(path, np.float64, None, delimiter, skiprows=head, ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError, UserWarning):
        return None
    if end != b"\n" or values.shape != (count - head, width) or not values.size:
        return None  # a cut or blank line, or another number of columns
    allowed = np.array([name in nan for name in names]) if isinstance(names, tuple) else False
    if not ((np.abs(values) < MAX_VALUE) | (np.isnan(values) & allowed)).all():
        return None
    lines = np.arange(head + 1, count + 1)
    return Table(names if isinstance(names, tuple) else (), values, Source(os.fspath(path), lines))


def clean_csv(path: FilePath, nan: frozenset[str]) -> Table | None:
    """Return `clean_table` of a comma-separated file with a header of more than one name."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            names = tuple(name.strip() for name in file.readline(1 << 16).split(","))
    except (OSError, ValueError):
        return None
    if not 1 < len(names) == len(set(names)) or all(map(_is_number, names)):
        return None
    return clean_table(path, names, ",", nan)


def read_columns(path: FilePath, width: int, delimiter: str | None = None, notes: list[Note] | None = None) -> Table:
    """Read a table without a header: ``width`` numbers a line; delimiter None: white space; ``notes``: `read_lines`."""
    if (clean := clean_table(path, width, delimiter)) is not None:
        return clean
    return parse_numbers([(i, line.split(delimiter)) for i, line in read_lines(path, notes)], width, path)


def read_csv(path: FilePath, nan: frozenset[str] = frozenset(), notes: list[Note] | None = None) -> Table:
    """Read a comma-separated table with the names of its columns in the first line; ``notes`` as in `read_lines`."""
    if (clean := clean_csv(path, nan)) is not None:
        return clean
    lines = read_lines(path, notes)
    if not lines:
        raise DataError(f"{os.fspath(path)}: is empty, expected a header line")
    names = tuple(name.strip() for name in lines[0][1].split(","))
    if len(names) == 1 and (other := next((c for c in ";\t" if c in lines[0][1]), "")):
        name = {";": "semicolons", "\t": "tabs"}[other]
        raise DataError(
            f"{os.fspath(path)}: columns are separated by {name}, expected commas; a column map reads it as it is: "
            "docs/formats.md"
        )
    if len(set(names)) != len(names):
        raise DataError(f"{os.fspath(path)}: line {lines[0][0]}: a column name stands twice in {', '.join(names)}")
    if all(_is_number(name) for name in names):
        raise DataError(f"{os.fspath(path)}: line {lines[0][0]}: expected a header of column names, got numbers")
    return parse_numbers([(i, line.split(",")) for i, line in lines[1:]], len(names), path, names, nan)


def atomic_write(path: FilePath, data: str | bytes) -> None:
    """Write a whole file or nothing: a temporary file in the same folder takes the place of the old one at the end."""
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise DataError(f"{os.fspath(path)}: cannot be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def format_csv(names: list[str], columns: np.ndarray) -> str:
    """Return a header and rows of the shortest text that reads back to the same float64."""
    rows = [",".join(names)] + [",".join(map(repr, row)) for row in np.asarray(columns, dtype=np.float64).tolist()]
    return "\n".join(rows) + "\n"


def _number(cell: str) -> float:
    if "_" in cell:  # digit grouping of Python, which no file format means
        raise ValueError(cell)
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def _column(names: tuple[str, ...], i: int) -> str:
    return f"column {names[i]}" if names else f"column {i + 1}"
