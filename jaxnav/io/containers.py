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
            if kind == GZ:
                inside.write_bytes(_gunzipped(path))
            else:
                inside = _unzip(path, inside)
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


def _gunzipped(path: Path) -> bytes:
    with gzip.open(path) as packed:
        data = packed.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise DataError(f"{path}: unpacks to more than {MAX_BYTES} bytes")
    return data


def _unzip(path: Path, inside: Path) -> Path:
    with zipfile.ZipFile(path) as archive:
        members = _members(archive)
        if sum(member.file_size for member in members) > MAX_BYTES:
            raise DataError(f"{path}: unpacks to more than {MAX_BYTES} bytes")
        archive.extractall(inside, members)
    while inside.is_dir() and len(held := list(inside.iterdir())) == 1:
        inside = held[0]
    return inside


def _members(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the files of an archive without those that a computer adds."""
    ours = lambda name: not any(part in NO_DATA for part in Path(name).parts)
    return [member for member in archive.infolist() if not member.is_dir() and ours(member.filename)]


def members(path: FilePath) -> list[Path]:
    """Return the files in a .zip, each as ``archive.zip/member`` (`contents`); any other path alone."""
    path = Path(path)
    if _kind(path) != ZIP:
        return [path]
    with zipfile.ZipFile(path) as archive:
        return [path / member.filename for member in _members(archive)]


def contents(path: FilePath) -> bytes:
    """Read a file, ``archive.zip/member``, or what is in a .gz."""
    path = Path(path)
    archive = next((parent for parent in path.parents if parent.suffix == ".zip" and parent.is_file()), None)
    try:
        if archive is None:
            return _gunzipped(path) if _kind(path) == GZ else read_bytes(path)
        with zipfile.ZipFile(io.BytesIO(read_bytes(archive))) as opened:
            member = path.relative_to(archive).as_posix()
            if opened.getinfo(member).file_size > MAX_BYTES:
                raise DataError(f"{path}: unpacks to more than {MAX_BYTES} bytes")
            return opened.read(member)
    except DataError:
        raise
    except Exception as error:  # zipfile and zlib raise a dozen kinds on a damaged archive
        raise DataError(f"{path}: cannot be read from the archive: {error}") from error
