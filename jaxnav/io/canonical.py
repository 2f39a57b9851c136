"""The project's formats: a folder of CSV files, or one ``.npz``; see ``docs/formats.md``.

Columns are found by name, the unit is in the name, and a column may come in any of the units listed here. Both forms
round trip to the last bit: that is why the writer gives angles in radians.
"""

import difflib
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxnav.findings import finding
from jaxnav.gnss.ranges import ranges_of, streams
from jaxnav.io.checks import MAX_LEVER_ARM, check_recording, check_samples, increments_to_means, steps
from jaxnav.io.files import FilePath, Source, Table, atomic_write, format_csv, read_bytes, read_csv
from jaxnav.io.formats import raw_table
from jaxnav.io.formats.npz import read_npz, write_npz
from jaxnav.io.sheet import open_sheet
from jaxnav.maths.units import DEG, G0
from jaxnav.measurements import MEASUREMENTS, with_data
from jaxnav.measurements.columns import Names
from jaxnav.types import DataError, ImuLog, Json, Note, Recording, Samples, Track

AXES = ("x", "y", "z")
SATELLITES, RANGES = "satellites.csv", ("pseudorange", "range_rate")
GYRO: tuple[Names, ...] = tuple(((f"gyro_{a}_radps", 1.0), (f"gyro_{a}_degps", DEG)) for a in AXES)
DTHETA: tuple[Names, ...] = tuple(((f"dtheta_{a}_rad", 1.0), (f"dtheta_{a}_deg", DEG)) for a in AXES)
ACCEL: tuple[Names, ...] = tuple(((f"accel_{a}_mps2", 1.0), (f"accel_{a}_g", G0)) for a in AXES)
DV: tuple[Names, ...] = tuple(((f"dv_{a}_mps", 1.0),) for a in AXES)
LLA, VELOCITY = (tuple(c.names for c in MEASUREMENTS[name].columns) for name in ("position", "velocity"))
RPH: tuple[Names, ...] = tuple(((f"{a}_rad", 1.0), (f"{a}_deg", DEG)) for a in ("roll", "pitch", "heading"))
CORR: tuple[Names, ...] = tuple(((name, 1.0),) for name in ("corr_en", "corr_nu", "corr_ue"))


_OPTIONAL_NAN = frozenset(name for column in RPH for name, _ in column)


def read_recording(path: FilePath) -> Recording:
    """Read a folder of CSV files (``imu.csv`` at least) or one ``.npz``; DataError names file, line, and field."""
    path = Path(path)
    if not path.is_dir():
        rec = read_npz(path)
        return check_recording(rec, dict.fromkeys(("imu", "truth", "lever_arm", *rec.aiding), Source(str(path))))
    return read_folder(path)


def read_folder(path: FilePath, notes: list[Note] | None = None) -> Recording:
    """Read a folder of CSV files; with a list of ``notes`` a cut last line is left out and, like unread files, noted.

    Raises:
        DataError: as `read_recording`.
    """
    path = Path(path)
    known = [*(f"{name}.csv" for name in (*with_data(), "truth")), SATELLITES]
    files = {Path(name).stem: path / name for name in known if (path / name).exists()}
    files |= {file.stem.removeprefix("aiding_"): file for file in sorted(path.glob("aiding_*.csv"))}
    others = sorted({file.name for file in path.glob("*.csv")} - {file.name for file in files.values()} - {"imu.csv"})
    if "position" not in files and others:
        raise DataError(
            f"{path}: no position.csv, and {', '.join(others)} is not read: expected imu.csv, {', '.join(known)} or "
            "aiding_NAME.csv; other names and columns: a column map (docs/formats.md)"
        )
    if notes is not None:
        notes += [
            finding("file.other", name, words=_meant(name, [file for file in known if Path(file).stem not in files]))
            for name in others
        ]
    truth, satellites = files.pop("truth", None), files.pop(Path(SATELLITES).stem, None)
    about = _read_about(path / "recording.json")
    name = about["name"] or path.name
    rec = read_files(path / "imu.csv", files, truth, about["lever_arm_frd_m"], name, about["notes"], notes)
    if satellites is None:
        return rec
    ranges = streams(raw_table.project_rows(open_sheet(satellites)))
    for key, samples in ranges.items():
        check_samples(key, samples, Source(str(satellites)))
    return rec._replace(aiding=rec.aiding | ranges)


def _meant(name: str, absent: list[str]) -> str:
    """``; did you mean velocity.csv?``: by the letters it opens with, or by likeness."""
    stem = Path(name).stem.lower()
    like = [file for file in absent if file.startswith(stem[:3])] or difflib.get_close_matches(name, absent, n=1)
    return f"; did you mean {like[0]}?" if like else "."


def read_files(
    imu: FilePath,
    aiding: dict[str, Path],
    truth: FilePath | None = None,
    lever_arm: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    name: str = "recording",
    notes: str = "",
    said: list[Note] | None = None,
) -> Recording:
    """Read CSV files at explicit paths; ``aiding`` by measurement name, ``lever_arm`` (3,) m FRD.

    With a list ``said`` a cut last line is left out of a file and said there; else it is a DataError.
    """
    log, source = read_imu(imu, said)
    sources, streams = {"imu": source}, {}
    for key, file in aiding.items():
        streams[key], sources[key] = _read_stream(file, key, said)
    track = None
    if truth is not None:
        track, sources["truth"] = read_truth(truth, said)
    arm = np.asarray(lever_arm, dtype=np.float64)
    return check_recording(Recording(name, log, streams, track, arm, notes), sources)


def read_imu(path: FilePath, notes: list[Note] | None = None) -> tuple[ImuLog, Source]:
    """``imu.csv``: rates or increments by the names of the columns; without ``dt_s`` a step is the time between."""
    table = read_csv(path, notes=notes)
    (t,) = _columns(table, ((("t_s", 1.0),),)).T
    dt = steps(t, table.source) if "dt_s" not in table.names else _columns(table, ((("dt_s", 1.0),),))[:, 0]
    means = []
    for rates, increments in ((GYRO, DTHETA), (ACCEL, DV)):
        if any(name in table.names for column in increments for name, _ in column):
            if dt.min() <= 0.0:
                i = int(np.argmin(dt))
                line = table.source.lines[i] if table.source.lines is not None else i
                raise DataError(f"{table.source.file}: line {line}: column dt_s: expected dt > 0 s, got {dt[i]}")
            values = _columns(table, increments)
            means.append(values / dt[:, None] if "dt_s" in table.names else increments_to_means(values, dt))
        else:
            means.append(_columns(table, rates))
    return ImuLog(t, dt, means[0], means[1]), table.source


def read_truth(path: FilePath, notes: list[Note] | None = None) -> tuple[Track, Source]:
    """``truth.csv``; the three angles may be left out, or be nan where they are not known."""
    table = read_csv(path, _OPTIONAL_NAN, notes)
    t = _columns(table, ((("t_s", 1.0),),))[:, 0]
    rph = _columns(table, RPH) if _has_any(table, RPH) else np.full((len(t), 3), np.nan)
    return Track(t, _columns(table, LLA), _columns(table, VELOCITY), rph), table.source


def write_recording(path: FilePath, rec: Recording) -> None:
    """Write one ``.npz`` if the path ends so, else a new folder of CSV files; whole or not at all."""
    path = Path(path)
    check_recording(rec)
    if path.suffix == ".npz":
        return write_npz(path, rec)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise DataError(f"{path}: exists and is no empty folder; old and new streams would mix")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir(parents=True)
        for file, text in _files(rec):
            atomic_write(temporary / file, text)
        os.replace(temporary, path)
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return None


def _files(rec: Recording) -> Iterator[tuple[str, str]]:
    imu, track = rec.imu, rec.truth
    names = ["t_s", "dt_s", *_names(GYRO), *_names(ACCEL)]
    yield "imu.csv", format_csv(names, np.column_stack([imu.t, imu.dt, imu.gyro, imu.accel]))
    if ranges := {key: rec.aiding[key] for key in RANGES if key in rec.aiding}:
        yield SATELLITES, raw_table.table(ranges_of(ranges))
    for key, samples in rec.aiding.items():
        if key in RANGES:
            continue
        if not re.fullmatch(r"\w+", key):
            raise DataError(f"aiding stream {key!r}: expected a name of letters, digits and _")
        columns = [name for part in _stream_columns(key, samples.value.shape[1]) for name in _names(part)]
        file = f"{key}.csv" if key in with_data() else f"aiding_{key}.csv"
        corr = samples.corr[:, : len(columns) - 2 * samples.value.shape[1]]
        yield file, format_csv(["t_s", *columns], np.column_stack([samples.t, samples.value, samples.sd, corr]))
    if track is not None:
        names = ["t_s", *_names(LLA), *_names(VELOCITY), *_names(RPH)]
        yield "truth.csv", format_csv(names, np.column_stack([track.t, track.lla, track.vel, track.rph]))
    about = {"name": rec.name, "lever_arm_frd_m": np.asarray(rec.lever_arm).tolist(), "notes": rec.notes}
    yield "recording.json", json.dumps(about, indent=1) + "\n"


def _read_stream(path: FilePath, key: str, notes: list[Note] | None = None) -> tuple[Samples, Source]:
    table = read_csv(path, notes=notes)
    width = sum(name.startswith("value_") for name in table.names)
    value, sd, corr = _numbered(width) if width else _stream_columns(key, 0)
    if not value:
        raise DataError(f"{table.source.file}: expected columns value_0, sd_0, ..., got {', '.join(table.names)}")
    values = _columns(table, value)
    zeros = np.zeros_like(values)
    correlations = _columns(table, corr) if _has_any(table, corr) else zeros
    t = _columns(table, ((("t_s", 1.0),),))[:, 0]
    samples = Samples(t, values, _columns(table, sd), correlations)
    known = {name for column in (*value, *sd, *corr) for name, _ in column}
    wrong = [name for name in table.names if name.startswith(("sd_", "corr_")) and name not in known]
    if wrong:
        raise DataError(f"{table.source.file}: no column {wrong[0]} is known: expected {', '.join(sorted(known))}")
    return samples, table.source


def _stream_columns(key: str, width: int) -> tuple[tuple[Names, ...], tuple[Names, ...], tuple[Names, ...]]:
    """Columns of value, sd and correlation."""
    if key not in (streams := with_data()):
        return _numbered(width)
    row = streams[key]
    return tuple(c.names for c in row.columns), tuple(c.sd_names for c in row.columns), CORR if row.correlated else ()


def _numbered(width: int) -> tuple[tuple[Names, ...], tuple[Names, ...], tuple[Names, ...]]:
    value, sd, corr = (tuple(((f"{part}_{i}", 1.0),) for i in range(width)) for part in ("value", "sd", "corr"))
    return value, sd, corr


def _columns(table: Table, wanted: tuple[Names, ...]) -> np.ndarray:
    """(N, len(wanted)) in SI; DataError for a column that is there in no unit, or in two."""
    out = []
    for column in wanted:
        found = [(table.names.index(name), factor) for name, factor in column if name in table.names]
        if len(found) != 1:
            names = " or ".join(name for name, _ in column)
            raise DataError(f"{table.source.file}: expected one column {names}, got {', '.join(table.names)}")
        out.append(table.values[:, found[0][0]] * found[0][1])
    return np.stack(out, axis=1)


def _has_any(table: Table, columns: tuple[Names, ...]) -> bool:
    return any(name in table.names for column in columns for name, _ in column)


def _names(columns: tuple[Names, ...]) -> list[str]:
    return [column[0][0] for column in columns]


def _read_about(path: Path) -> Json:
    """Name, lever arm and notes; the file may be absent."""
    about = {"name": "", "lever_arm_frd_m": [0.0, 0.0, 0.0], "notes": ""}
    if not path.exists():
        return about
    data = read_bytes(path)
    try:
        read = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {error}") from error
    if not isinstance(read, dict) or not set(read) <= set(about):
        raise DataError(f"{path}: expected an object with the keys {', '.join(about)}")
    about |= read
    arm = about["lever_arm_frd_m"]
    if not (isinstance(arm, list) and len(arm) == 3 and all(type(x) in (int, float) for x in arm)):
        raise DataError(f"{path}: lever_arm_frd_m: expected three numbers, got {arm!r}")
    if not all(abs(x) <= MAX_LEVER_ARM for x in arm):  # nan too
        raise DataError(f"{path}: lever_arm_frd_m: expected at most {MAX_LEVER_ARM:g} m, got {arm}")
    if not all(isinstance(about[key], str) for key in ("name", "notes")):
        raise DataError(f"{path}: name and notes: expected text")
    return about
