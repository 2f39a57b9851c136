"""Files inside of others: .zip and .gz, opened before any reader looks."""

import gzip
import io
import os
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxnav.io.files import MAX_BYTES, FilePath, read_bytes
from jaxnav.types import DataError

ZIP, GZ = b"PK\x03\x04", b"\x1f\x8b"
OFFICE = "[Content_Types].xml"  # member of a spreadsheet, which is a table itself
NO_DATA = ("__MACOSX", ".DS_Store")  # what a computer adds to a folder


@contextmanager
def unpacked(path: FilePath) -> Iterator[Path]:
    """Yield the recording in a .zip or .gz, for as long as the context lasts; any other path as it is.

    A single file or folder of an archive is the recording, else all of it together. A refusal names the archive.

    Raises:
        DataError: a damaged archive, or one that unpacks to more than `MAX_BYTES`.
    """
    path = Path(path)
    kind = _kind(path)
    if kind is None:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="jaxnav_") as folder:
        inside = Path(folder, path.stem)
        try:
            inside = _gunzip(path, inside) if kind == GZ else _unzip(path, inside)
        except DataError:
            raise
        except Exception as error:  # zipfile, gzip and zlib raise a dozen kinds on a damaged archive
            raise DataError(f"{path}: cannot be unpacked: {error}") from error
        try:
            yield inside
        except DataError as error:
            raise DataError(str(error).replace(os.fspath(inside), os.fspath(path))) from error


def _kind(path: Path) -> bytes | None:
    """Return the first bytes of an archive of files, None of any other path."""
    try:
        with open(path, "rb") as file:
            head = file.read(4)
        if head == ZIP:
            with zipfile.ZipFile(path) as archive:
                names = archive.namelist()
            return None if OFFICE in names or any(name.endswith(".npy") for name in names) else ZIP
    except (OSError, zipfile.BadZipFile):  # a folder, not there, or cut: its reader says so
        return None
    return GZ if head.startswith(GZ) else None


def _gunzip(path: Path, inside: Path) -> Path:
    with gzip.open(path) as packed:
        data = packed.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise DataError(f"{path}: unpacks to more than {MAX_BYTES} bytes")
    inside.write_bytes(data)
    return inside


def _unzip(path: Path, inside: Path) -> Path:
    with zipfile.ZipFile(path) as archive:
        members = [m for m in archive.infolist() if not any(part in NO_DATA for part in Path(m.filename).parts)]
        if sum(member.file_size for member in members) > MAX_BYTES:
            raise DataError(f"{path}: unpacks to more than {MAX_BYTES} bytes")
        archive.extractall(inside, members)
    while inside.is_dir() and len(held := list(inside.iterdir())) == 1:
        inside = held[0]
    return inside


def contents(path: FilePath) -> bytes:
    """Read a file, or ``archive.zip/member``."""
    path = Path(path)
    archive = next((parent for parent in path.parents if parent.suffix == ".zip" and parent.is_file()), None)
    if archive is None:
        return read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(archive))) as opened:
            member = path.relative_to(archive).as_posix()
            if opened.getinfo(member).file_size > MAX_BYTES:
                raise DataError(f"{path}: unpacks to more than {MAX_BYTES} bytes")
            return opened.read(member)
    except DataError:
        raise
    except Exception as error:  # zipfile and zlib raise a dozen kinds on a damaged archive
        raise DataError(f"{path}: cannot be read from the archive: {error}") from error
