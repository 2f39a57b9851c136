"""Ways in which the rows of a stream's file are wrong: a new one is a function and a line in `DAMAGES`."""

from collections.abc import Callable

import numpy as np

Table = list[list[str]]  # a file's rows, the header first
Rng = np.random.Generator


def _some(rows: Table, rng: Rng) -> slice:
    """Some rows in a row, of up to half of them."""
    n = len(rows) - 1
    length = int(rng.integers(1, max(2, n // 2)))
    begin = 1 + int(rng.integers(0, n - length + 1))
    return slice(begin, begin + length)


def _column(rows: Table, rng: Rng) -> int:
    return int(rng.integers(1, len(rows[0])))


def _each(rows: Table, which: slice, column: int, change: Callable[[float], float]) -> None:
    for row in rows[which]:
        row[column] = repr(change(float(row[column])))


def lost(rows: Table, rng: Rng) -> None:
    """Rows are missing."""
    del rows[_some(rows, rng)]


def twice(rows: Table, rng: Rng) -> None:
    """Rows are there twice."""
    part = _some(rows, rng)
    rows[part.stop : part.stop] = [list(row) for row in rows[part]]


def backwards(rows: Table, rng: Rng) -> None:
    """Rows in another order."""
    part = _some(rows, rng)
    rows[part] = rows[part][::-1]


def cell(rows: Table, rng: Rng) -> None:
    """One value is another."""
    values = ["nan", "inf", "-inf", "0", "1e9", "-1e9", "", "x", "1e-300", "-0.1", "None", "1,5", "12:30:00"]
    rows[1 + int(rng.integers(len(rows) - 1))][_column(rows, rng)] = str(rng.choice(values))


def exchanged(rows: Table, rng: Rng) -> None:
    """Two columns are one another."""
    a, b = rng.choice(np.arange(1, len(rows[0])), 2, replace=False)
    for row in rows[1:]:
        row[a], row[b] = row[b], row[a]


def scaled(rows: Table, rng: Rng) -> None:
    """A column in another unit, or with another sign."""
    factor = float(rng.choice([-1.0, 180 / np.pi, np.pi / 180, 9.80665, 1 / 9.80665, 3.6, 0.3048, 1000.0, 0.5, 2.0]))
    _each(rows, slice(1, None), _column(rows, rng), lambda x: factor * x)


def stuck(rows: Table, rng: Rng) -> None:
    """A column repeats its value for a while."""
    part, column = _some(rows, rng), _column(rows, rng)
    value = rows[part][0][column]
    for row in rows[part]:
        row[column] = value


def biased(rows: Table, rng: Rng) -> None:
    """A column is off by its spread, and some times that."""
    column = _column(rows, rng)
    spread = float(np.std([float(row[column]) for row in rows[1:]])) or 1.0
    off = spread * float(rng.choice([-3.0, 0.3, 3.0, 30.0]))
    for_good = rng.random() < 0.5 and rows[0][1] != "lat_rad"  # a map that is off by an offset shows in nothing
    _each(rows, slice(1, None) if for_good else _some(rows, rng), column, lambda x: x + off)


def noisy(rows: Table, rng: Rng) -> None:
    """A column with the noise of its spread."""
    column = _column(rows, rng)
    spread = float(np.std([float(row[column]) for row in rows[1:]])) or 1.0
    _each(rows, slice(1, None), column, lambda x: x + float(rng.choice([0.1, 1.0])) * spread * rng.normal())


def shifted(rows: Table, rng: Rng) -> None:
    """Another time from some row on, or from the first."""
    off = float(rng.choice([-30.0, -1.0, -0.2, 0.2, 1.0, 30.0, 3600.0, 315964800.0]))
    part = slice(1, None) if rng.random() < 0.5 else slice(_some(rows, rng).start, None)
    _each(rows, part, 0, lambda t: t + off)


def drifting(rows: Table, rng: Rng) -> None:
    """A clock of another rate."""
    rate = float(rng.choice([1e-4, 1e-3, 1e-2, -1e-2, 1.0, 999.0]))
    _each(rows, slice(1, None), 0, lambda t: t * (1 + rate))


def rounded(rows: Table, rng: Rng) -> None:
    """A column, times too, with few digits."""
    digits = int(rng.integers(0, 5))
    _each(rows, slice(1, None), int(rng.integers(len(rows[0]))), lambda x: round(x, digits))


def renamed(rows: Table, rng: Rng) -> None:
    """A column has another name, or none."""
    rows[0][int(rng.integers(len(rows[0])))] = str(rng.choice(["", "x", "time", rows[0][-1], "gyro_x_degps"]))


def cut(rows: Table, rng: Rng) -> None:
    """The first rows, or the last, and nothing else."""
    keep = int(rng.integers(1, len(rows)))
    rows[1:] = rows[1 : 1 + keep] if rng.random() < 0.5 else rows[-keep:]


DAMAGES: dict[str, Callable[[Table, Rng], None]] = {
    each.__name__: each
    for each in (
        lost, twice, backwards, cell, exchanged, scaled, stuck, biased, noisy, shifted, drifting, rounded, renamed, cut
    )
}  # fmt: skip
