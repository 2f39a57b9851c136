"""``read(path)``: any recording of a format that `READERS` knows, recognised by its content."""

import os
import re
import tomllib
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from jaxnav.io import canonical, draft, mend, units
from jaxnav.io.checks import MAX_RATE
from jaxnav.io.column_map import TOP, column_names, read_map
from jaxnav.io.containers import unpacked
from jaxnav.io.files import FilePath
from jaxnav.io.formats import (
    dataflash,
    ekf2_replay,
    euroc,
    flysight,
    gnss_logger,
    gpx,
    kfgins,
    kitti,
    navego,
    nmea,
    novatel,
    raw_table,
    rinex,
    rosbag,
    rtklib,
    sbf,
    sensor_logger,
    ubx,
    ulog,
    vbo,
    vectornav,
)
from jaxnav.io.mend import Changes
from jaxnav.io.options import OPTIONS, require
from jaxnav.io.parts import ImuRows, Parts, Stream, TimeScale, counted_from, parts_of, scaled
from jaxnav.io.rollover import unrolled
from jaxnav.types import DataError

HEAD = 4096  # bytes of a file that a reader sees to recognise it


class ReadFile(Protocol):
    """Reader of the files of a format; its options are keyword arguments that the row names."""

    def __call__(self, path: Path, /) -> Parts:
        """Return the contents of the file or folder.

        Raises:
            DataError: it cannot be used; names the file and the line or field.
        """


class Reader(NamedTuple):
    """A format. Adding one is a file and a row in `READERS`."""

    name: str  # for people
    recognises: Callable[[Path, bytes], bool]  # (path, its first HEAD bytes, b"" of a folder): is it mine? Never raises
    read: ReadFile
    options: tuple[str, ...] = ()  # keyword arguments of ``read``


def read_parts(path: FilePath, gnss: FilePath | None = None, **options: Any) -> Parts:
    """Return the contents of a file, before mending; options as for `jaxnav.read`."""
    options = {key: value for key, value in options.items() if value is not None}  # as if it were not there
    for key, value in (options | ({"gnss": gnss} if gnss is not None else {})).items():
        if key in OPTIONS:
            require(os.fspath(path), key, value, OPTIONS[key])
    with unpacked(path) as inside, nullcontext() if gnss is None else unpacked(gnss) as fixes:
        parts = _read_parts(inside, fixes, **options)
    return parts if inside == Path(path) else parts._replace(file=os.fspath(path))


def _read_parts(path: Path, gnss: Path | None, **options: Any) -> Parts:
    if (recipe := options.pop("map", None)) is not None:
        row, gnss = _mapped(recipe, path, gnss), None
    else:
        row = recognise(path)
    others = () if gnss is None else recognise(gnss).options
    reader = {key: value for key, value in options.items() if key in row.options}
    fixes = {key: value for key, value in options.items() if key in others and key not in reader}
    changes = {key: value for key, value in options.items() if key in Changes._fields and key not in reader}
    for key in options.keys() - reader.keys() - fixes.keys() - changes.keys():
        hint = units.nearest(key, (*row.options, *others, *Changes._fields, "gnss", "map"))
        raise DataError(f"{path}: {row.name}: no option {key}: {hint}")
    parts = _read(row, path, reader)
    if gnss is not None:
        other = counted_from(read_parts(gnss, **fixes), parts.zero)
        parts = parts._replace(aiding=parts.aiding | other.aiding, notes=parts.notes + other.notes)
    changed = Changes(**changes)
    return mend.applied(unrolled(parts._replace(name=parts.name or path.stem), changed.part), changed)


def _mapped(recipe: FilePath, path: Path, gnss: FilePath | None) -> Reader:
    """Return the reader of a folder, a file, or a file and that of its fixes, in place of those of a column map."""
    row = recognise(recipe)
    if row.recognises is not _map:
        raise DataError(f"{recipe}: {row.name}, expected a column map: jaxnav map drafts one")
    files = [path] if gnss is None else [path, gnss]
    where = {"folder": path} if path.is_dir() and gnss is None else {"files": files}
    return row._replace(read=lambda path: read_map(recipe, read_parts, **where)._replace(name=path.stem), options=())


def _read(row: Reader, path: Path, options: dict[str, Any]) -> Parts:
    try:
        return partial(row.read, **options)(path)
    except DataError:
        raise
    except ImportError as error:
        raise DataError(f"{path}: a {row.name} file needs the package {error.name}: pip install -e . again") from error
    except Exception as error:  # damage that no check foresaw, in here or in an optional package
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise DataError(f"{path}: cannot be read as {row.name}: {reason}") from error


def recognise(path: FilePath) -> Reader:
    """Return the row of `READERS` for a file or folder.

    Raises:
        DataError: it does not exist, or no format fits.
    """
    path = Path(path)
    head = b""
    if not path.is_dir():
        try:
            with open(path, "rb") as file:
                head = file.read(HEAD)
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
        if not head:
            raise DataError(f"{path}: is empty")
    for row in READERS:
        if row.recognises(path, head):
            return row
    raise DataError(_unknown(path))


def _unknown(path: Path) -> str:
    if path.is_dir():
        files = ", ".join(sorted(file.name for file in path.iterdir())[:20]) or "nothing"
        return f"{path}: a folder of no known format, with {files}: jaxnav map drafts a column map (docs/formats.md)"
    try:
        names = ", ".join(column_names(path)[:30])
    except DataError:
        names = ""
    if not names:
        return f"{path}: of no known format: {', '.join(row.name for row in READERS)}"
    return f"{path}: a table that no reader knows; jaxnav map drafts a column map of it (docs/formats.md): {names}"


# ---------------------------------------------------------------------------- the project's formats


def _folder(path: Path, head: bytes) -> bool:
    return (path / "imu.csv").is_file()


def _read_folder(path: Path) -> Parts:
    notes: list[str] = []
    rec = canonical.read_folder(path, notes)
    parts = parts_of(rec, os.fspath(path))
    return parts._replace(notes=parts.notes + tuple(notes))


def _npz(path: Path, head: bytes) -> bool:
    return head.startswith(b"PK\x03\x04") and b"aiding/" in head + _tail(path) and b"imu/" in head + _tail(path)


def _tail(path: Path) -> bytes:
    """Return the end of a zip archive, which lists its members."""
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - HEAD))
        return file.read()


def _imu_csv(path: Path, head: bytes) -> bool:
    names = re.split(rb"[,\r\n]", head.split(b"\n")[0])
    return b"t_s" in names and any(name.startswith((b"gyro_x_", b"dtheta_x_")) for name in names)


def _read_imu_csv(path: Path) -> Parts:
    notes: list[str] = []
    imu, source = canonical.read_imu(path, notes)
    return Parts(
        os.fspath(path), ImuRows(imu.t, imu.gyro, imu.accel, dt=imu.dt), notes=tuple(notes), lines=source.lines
    )


def _map(path: Path, head: bytes) -> bool:
    if path.is_dir() or not re.search(rb"^\s*(\[(imu|read)\]|(imu|read)\s*=\s*\{)", head, re.MULTILINE):
        return False
    try:
        return bool(set(tomllib.loads(path.read_text(encoding="utf-8-sig"))) & set(TOP))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return path.suffix == ".toml"  # a damaged map: its reader says where


def _read_map(path: Path, folder: FilePath | None = None) -> Parts:
    return read_map(path, read_parts, folder)


# ---------------------------------------------------------------------------- adapters of the older readers


def _read_pos(path: Path) -> Parts:
    notes: list[str] = []
    aiding = {name: Stream(*samples) for name, samples in rtklib.read_pos(path, notes).aiding.items()}
    return scaled(Parts(os.fspath(path), aiding=aiding, notes=tuple(notes)), TimeScale.GPS)


def _pos(path: Path, head: bytes) -> bool:
    return bool(re.search(rb"^%\s+(GPST|UTC|JST)\s.*\bQ\b", head, re.MULTILINE))


def _seven(head: bytes) -> np.ndarray | None:
    """Return the complete rows of a text of seven numbers a line; None of any other."""
    rows = [line.split() for line in head.split(b"\n")[:-1]][:20]
    try:
        return np.array(rows, float) if len(rows) > 1 and all(len(row) == 7 for row in rows) else None
    except ValueError:
        return None


def _kfgins_imu(path: Path, head: bytes) -> bool:
    rows = _seven(head)
    if rows is None:
        return False
    dt = np.median(np.diff(rows[:, 0]))
    if np.abs(rows[:, 1:4]).max() > MAX_RATE * dt:
        return False  # latitude and longitude
    return 0.0 < dt < 0.5 and 5.0 < np.median(np.linalg.norm(rows[:, 4:], axis=1)) / dt < 20.0  # gravity


def _read_kfgins_imu(path: Path) -> Parts:
    notes: list[str] = []
    imu = kfgins.read_kfgins_imu(path, notes)
    return Parts(os.fspath(path), ImuRows(imu.t, imu.gyro, imu.accel, dt=imu.dt), notes=tuple(notes))


def _kfgins_gnss(path: Path, head: bytes) -> bool:
    rows = _seven(head)
    return rows is not None and bool((np.abs(rows[:, 1]) <= 90).all() and (rows[:, 4:] >= 0).all())


def _read_kfgins_gnss(path: Path) -> Parts:
    notes: list[str] = []
    position = Stream(*kfgins.gnss_rows(path, notes)[0])
    return Parts(os.fspath(path), aiding={"position": position}, notes=tuple(notes))


MASKS = ("elevation_mask_deg", "cn0_mask_dbhz")  # of raw GNSS
READERS: tuple[Reader, ...] = (
    Reader("our folder of CSV", _folder, _read_folder),
    Reader("our .npz", _npz, lambda path: parts_of(canonical.read_recording(path), os.fspath(path))),
    Reader("column map", _map, _read_map, ("folder",)),
    Reader("ROS bag", rosbag.recognises, rosbag.read, ("topics",)),
    Reader("PX4 ULog", ulog.recognises, ulog.read, ("wheel_radius_m", "receiver")),
    Reader("ArduPilot DataFlash", dataflash.recognises, dataflash.read, ("instance", "receiver")),
    Reader("UBX", ubx.recognises, ubx.read, ("spp", "rates", *MASKS)),
    Reader("SBF", sbf.recognises, sbf.read),
    Reader("VectorNav binary", vectornav.recognises, vectornav.read),
    Reader("RINEX observations", rinex.recognises, rinex.read, ("nav", "rates", *MASKS)),
    Reader("GnssLogger", gnss_logger.recognises, gnss_logger.read),
    Reader("raw GNSS table", raw_table.recognises, raw_table.read, MASKS),
    Reader("RTKLIB .pos", _pos, _read_pos),
    Reader("NovAtel ASCII", novatel.recognises, novatel.read, ("imu",)),
    Reader("NMEA", nmea.recognises, nmea.read, ("leap_seconds", "metres_per_hdop")),
    Reader("FlySight 2", flysight.recognises, flysight.read),
    Reader("VBO", vbo.recognises, vbo.read),
    Reader("GPX", gpx.recognises, gpx.read),
    Reader("EKF2 replay", ekf2_replay.recognises, ekf2_replay.read),
    Reader("Sensor Logger", sensor_logger.recognises, sensor_logger.read),
    Reader("KITTI oxts", kitti.recognises, kitti.read),
    Reader("EuRoC", euroc.recognises, euroc.read),
    Reader("NaveGo .mat", navego.recognises, navego.read, ("imu", "fixes")),
    Reader("our imu.csv", _imu_csv, _read_imu_csv),
    Reader("KF-GINS IMU", _kfgins_imu, _read_kfgins_imu),
    Reader("KF-GINS GNSS", _kfgins_gnss, _read_kfgins_gnss),
    Reader("tables with names", draft.recognises, draft.read_tables),  # the last: it looks at all numbers
)
