"""``read(path)``: any recording of a format that `READERS` knows, recognised by its content."""

import os
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from jaxnav.io import column_map, draft, mend
from jaxnav.io.column_map import column_names, read_map
from jaxnav.io.containers import unpacked
from jaxnav.io.files import HEAD, FilePath
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
    own,
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
from jaxnav.io.parts import Parts, counted_from
from jaxnav.io.rollover import unrolled
from jaxnav.types import DataError, Json, nearest


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
        hint = nearest(key, (*row.options, *others, *Changes._fields, "gnss", "map"))
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
    if row.recognises is not column_map.recognises:
        raise DataError(f"{recipe}: {row.name}, expected a column map: jaxnav map drafts one")
    files = [path] if gnss is None else [path, gnss]
    where = {"folder": path} if path.is_dir() and gnss is None else {"files": files}
    return row._replace(read=lambda path: read_map(recipe, read_parts, **where)._replace(name=path.stem), options=())


def _read(row: Reader, path: Path, options: Json) -> Parts:
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


def read_described(path: Path, folder: FilePath | None = None) -> Parts:
    """Return the files that a column map describes."""
    return read_map(path, read_parts, folder)


MASKS = ("elevation_mask_deg", "cn0_mask_dbhz")  # of raw GNSS
READERS: tuple[Reader, ...] = (
    Reader("our folder of CSV", own.is_folder, own.read_folder),
    Reader("our .npz", own.is_npz, own.read_npz),
    Reader("column map", column_map.recognises, read_described, ("folder",)),
    Reader("ROS bag", rosbag.recognises, rosbag.read, ("topics",)),
    Reader("PX4 ULog", ulog.recognises, ulog.read, ("wheel_radius_m", "receiver")),
    Reader("ArduPilot DataFlash", dataflash.recognises, dataflash.read, ("instance", "receiver")),
    Reader("UBX", ubx.recognises, ubx.read, ("spp", "rates", *MASKS)),
    Reader("SBF", sbf.recognises, sbf.read),
    Reader("VectorNav binary", vectornav.recognises, vectornav.read),
    Reader("RINEX observations", rinex.recognises, rinex.read, ("nav", "rates", *MASKS)),
    Reader("GnssLogger", gnss_logger.recognises, gnss_logger.read),
    Reader("raw GNSS table", raw_table.recognises, raw_table.read, MASKS),
    Reader("RTKLIB .pos", rtklib.recognises, rtklib.read),
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
    Reader("our imu.csv", own.is_imu_csv, own.read_imu_csv),
    Reader("KF-GINS IMU", kfgins.is_imu, kfgins.read_imu),
    Reader("KF-GINS GNSS", kfgins.is_gnss, kfgins.read_gnss),
    Reader("tables with names", draft.recognises, draft.read_tables),  # the last: it looks at all numbers
)
