"""Every reader against every fault of a row: read with a note, or refused in a sentence; never silently wrong.

Faults of lines are written into texts; those of times and sd into what a reader returns, ahead of all that they share.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxnav.initialization.initialize import require_positions
from jaxnav.io import readers
from jaxnav.io.parts import Parts
from jaxnav.maths.gps_time import WEEK
from jaxnav.types import DataError, Recording

from .test_damage import FORMATS

BINARY = {
    "npz",
    "ros1",
    "ros2 sqlite",
    "ros2 mcap",
    "ulog",
    "dataflash",
    "ubx",
    "sbf",
    "vectornav",
    "navego",
    "column map",
}
TEXTS = [name for name in FORMATS if name not in BINARY]
TWO_FILES = {"pos", "nmea", "ubx", "kfgins gnss", "gpx"}  # an IMU and fixes


def streams_of(rec: Recording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times and values by stream."""
    imu = np.column_stack([rec.imu.gyro, rec.imu.accel])
    return {"imu": (rec.imu.t, imu)} | {name: (s.t, s.value) for name, s in rec.aiding.items()}


def changed(whole: Recording, rec: Recording) -> list[str]:
    """Streams that lack a row of the whole recording, or have another one."""
    out = []
    for name, (t, value) in streams_of(whole).items():
        found = streams_of(rec).get(name)
        if found is None or found[0].shape != t.shape or not np.allclose(found[0], t, atol=1e-6):
            out.append(name)
        elif not np.allclose(found[1], value, rtol=1e-9, atol=1e-12):
            out.append(name)
    return out


def judged(reader: Callable[[], Recording], whole: Recording, file: Path, fault: str) -> str:
    """Return "refused", "noted" or "same"; fail where a change is silent or a refusal names no file."""
    try:
        rec = reader()
    except DataError as error:
        text = str(error)
        assert "\n" not in text and (file.name in text or str(file.parents[-3]) in text), f"{fault}: {text}"
        return "refused"
    if not changed(whole, rec):
        return "same"
    assert rec.notes != whole.notes, f"{fault}: {changed(whole, rec)} differ without a word"
    return "noted"


# ---------------------------------------------------------------------------- lines of texts


def cell(lines: list[str], at: int, column: int, text: str) -> list[str]:
    """Replace a cell of a line."""
    mark = "," if "," in lines[at] else " "
    cells = lines[at].split(mark)
    cells[column % len(cells)] = text
    return [*lines[:at], mark.join(cells), *lines[at + 1 :]]


LINES: dict[str, Callable[[list[str], int, int], list[str]]] = {
    "twice": lambda lines, at, column: [*lines[: at + 1], *lines[at:]],
    "out of order": lambda lines, at, column: [*lines[: at - 1], lines[at], lines[at - 1], *lines[at + 1 :]],
    "empty cell": lambda lines, at, column: cell(lines, at, column, ""),
    "nan": lambda lines, at, column: cell(lines, at, column, "nan"),
    "text": lambda lines, at, column: cell(lines, at, column, "x"),
    "cut": lambda lines, at, column: [*lines[: at + 1], lines[at + 1][: 1 + column]],
}


@pytest.mark.parametrize("format", TEXTS)
def test_a_line_of_a_text(format, tmp_path):
    file, reader = FORMATS[format](tmp_path)
    whole, lines = reader(), file.read_text().split("\n")
    if not lines[-1]:
        lines.pop()
    found = {}
    at = max(len(lines) // 2, min(3, len(lines) - 2))
    for fault, damage in LINES.items():
        for column in range(8) if fault in ("empty cell", "nan", "text", "cut") else (0,):
            end = "" if fault == "cut" else "\n"
            file.write_text("\n".join(damage(lines, at, column)) + end)
            found[fault, column] = judged(reader, whole, file, f"{fault} {column}")
    assert set(found.values()) - {"same"}, found


# ---------------------------------------------------------------------------- what a reader returns


def rows_changed(parts: Parts, stream: str, change: Callable[[Any], Any]) -> Parts:
    """Return parts with another stream, of which every column has as many rows."""
    if stream == "imu":
        return parts._replace(imu=change(parts.imu), lines=None)
    return parts._replace(aiding=parts.aiding | {stream: change(parts.aiding[stream])})


def each_column(rows: Any, order: np.ndarray) -> Any:
    """Return rows in another order."""
    n = len(rows.t)
    pick = lambda x: x[order] if isinstance(x, np.ndarray) and x.ndim and len(x) == n else x
    return rows._make(map(pick, rows))


def with_value(rows: Any, at: int, value: float) -> Any:
    """Return rows with another number in the first measured column."""
    name = "gyro" if hasattr(rows, "gyro") else "value"
    column = np.array(getattr(rows, name), float)
    column[at, 0] = value
    return rows._replace(**{name: column})


def with_sd(rows: Any, value: float) -> Any:
    """Return rows one of which states another sd."""
    usual = np.full(np.shape(rows.value), 2.0) if rows.sd is None else np.array(rows.sd, float)
    usual[len(usual) // 2] = value
    return rows._replace(sd=usual)


def stepped(rows: Any, by: float) -> Any:
    """Return rows whose clock steps in the middle."""
    t = np.array(rows.t, float)
    t[len(t) // 2 :] += by
    return rows._replace(t=t)


def folded(rows: Any) -> Any:
    """Return rows whose seconds of the week end in the middle."""
    t = np.array(rows.t, float)
    return rows._replace(t=np.mod(t - t[len(t) // 2], WEEK))


middle = lambda rows: len(rows.t) // 2
twice = lambda rows: each_column(rows, np.insert(np.arange(len(rows.t)), middle(rows), middle(rows)))


def swapped(rows: Any) -> Any:
    """Return rows two of which are in the other order."""
    order, k = np.arange(len(rows.t)), middle(rows)
    order[[k - 1, k]] = order[[k, k - 1]]
    return each_column(rows, order)


ROWS: dict[str, Callable[[Any], Any]] = {
    "twice": twice, "out of order": swapped, "nan in a value": lambda rows: with_value(rows, middle(rows), np.nan),
    "too large": lambda rows: with_value(rows, middle(rows), 1e30), "clock step": lambda rows: stepped(rows, 7.0),
    "clock back": lambda rows: stepped(rows, -1.5 * float(np.median(np.diff(rows.t)))), "end of a week": folded,
    "sd 0": lambda rows: with_sd(rows, 0.0), "nan in a sd": lambda rows: with_sd(rows, np.nan),
}  # fmt: skip


@pytest.mark.full
@pytest.mark.parametrize("format", FORMATS)
def test_a_row_that_a_reader_returns(format, tmp_path, monkeypatch):
    file, reader = FORMATS[format](tmp_path)
    whole, original, done = reader(), readers._read, {}

    def damaging(stream: str, change: Callable[[Any], Any]) -> Callable[..., Parts]:
        def read(*args: Any) -> Parts:
            parts = original(*args)
            there = parts.imu is not None if stream == "imu" else stream in parts.aiding
            return rows_changed(parts, stream, change) if there else parts

        return read

    for stream in ("imu", "position"):
        if stream == "position" and (stream not in whole.aiding or whole.aiding[stream].t.size < 3):
            continue
        for fault, change in ROWS.items():
            of_sd = fault in ("sd 0", "nan in a sd")
            if (of_sd and stream == "imu") or (fault == "end of a week" and format in TWO_FILES):
                continue
            monkeypatch.setattr(readers, "_read", damaging(stream, change))
            done[stream, fault] = judged(reader, whole, file, f"{stream}: {fault}")
    assert len(done) >= 7, done


GONE: dict[str, Callable[[Any], Any]] = {
    "marks": lambda rows: rows._replace(value=np.zeros(np.shape(rows.value))),
    "nan": lambda rows: rows._replace(value=np.full(np.shape(rows.value), np.nan)),
    "other times": lambda rows: rows._replace(t=np.asarray(rows.t, float) + 5e4),
}


@pytest.mark.parametrize("format", FORMATS)
def test_a_recording_whose_positions_are_gone_says_what_dropped_them(format, tmp_path, monkeypatch):
    _, reader = FORMATS[format](tmp_path)
    if "position" not in reader().aiding:
        pytest.skip("has no positions")
    original = readers._read
    for gone, change in GONE.items():

        def read(*args: Any, change: Any = change) -> Parts:
            parts = original(*args)
            return rows_changed(parts, "position", change) if "position" in parts.aiding else parts

        monkeypatch.setattr(readers, "_read", read)
        with pytest.raises(DataError, match="has no positions to start from") as refusal:
            require_positions(reader())
        why = str(refusal.value).split("\n")[1:]
        assert any(line.startswith(("position", "fixes")) for line in why), f"{gone}: {refusal.value}"
