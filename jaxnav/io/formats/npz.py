"""A recording in one ``.npz``: the arrays of the host types by name, no pickles, sizes checked before reading."""

import io
import math
import os
import re
import zipfile

import numpy as np

from jaxnav.io.files import MAX_BYTES, FilePath, atomic_write, open_bytes
from jaxnav.types import DataError, ImuLog, Json, Recording, Samples, Track


def read_npz(path: FilePath) -> Recording:
    """Read a file of `write_npz`, without checks of its values; DataError names file and array."""
    file = os.fspath(path)
    arrays = _arrays(file)
    streams = sorted({key.split("/")[1] for key in arrays if key.startswith("aiding/") and key.count("/") == 2})
    aiding = {name: _samples(arrays, f"aiding/{name}", file) for name in streams}
    imu = ImuLog(*_group(arrays, "imu", ImuLog._fields, file))
    has_truth = any(key.startswith("truth/") for key in arrays)
    truth = Track(*_group(arrays, "truth", Track._fields, file)) if has_truth else None
    name, notes = (str(arrays.get(key, "")) for key in ("name", "notes"))
    (lever_arm,) = _group(arrays, "", ("lever_arm",), file)
    return Recording(name or file, imu, aiding, truth, lever_arm, notes)


def _samples(arrays: dict[str, np.ndarray], group: str, file: str) -> Samples:
    """Return a stream, of which ``valid`` and ``auxiliary`` may be left out."""
    valid = arrays.get(f"{group}/valid")
    t, value, sd, corr = _group(arrays, group, Samples._fields[:4], file)
    return Samples(t, value, sd, corr, None if valid is None else valid > 0, arrays.get(f"{group}/auxiliary"))


def write_npz(path: FilePath, rec: Recording) -> None:
    """Write a recording to one file with the arrays ``imu/t``, ``aiding/position/value``, ``truth/lla`` and so on."""
    groups: Json = {"imu": rec.imu} | {f"aiding/{name}": samples for name, samples in rec.aiding.items()}
    if any(not re.fullmatch(r"\w+", name) for name in rec.aiding):
        raise DataError(f"{os.fspath(path)}: expected stream names of letters, digits and _")
    if rec.truth is not None:
        groups["truth"] = rec.truth
    arrays = {
        f"{group}/{field}": array
        for group, data in groups.items()
        for field, array in data._asdict().items()
        if array is not None
    }
    arrays |= {"lever_arm": rec.lever_arm, "name": np.array(rec.name), "notes": np.array(rec.notes)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    atomic_write(path, buffer.getvalue())


def _arrays(file: str) -> dict[str, np.ndarray]:
    try:
        with open_bytes(file) as stream, zipfile.ZipFile(stream) as archive:
            total = sum(member.file_size for member in archive.infolist())
            if total > MAX_BYTES:
                raise DataError(f"{file}: unpacks to {total} bytes, expected at most {MAX_BYTES}")
            return {
                member.filename.removesuffix(".npy"): _array(archive, member, file) for member in archive.infolist()
            }
    except DataError:
        raise
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds on a damaged file
        raise DataError(f"{file}: cannot be read as .npz: {type(error).__name__}: {error}") from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, file: str) -> np.ndarray:
    """One array, after its header was held against the bytes that are there."""
    with archive.open(member) as stream:
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        version = np.lib.format.read_magic(stream)
        if version not in read:
            raise DataError(f"{file}: {member.filename}: expected .npy version 1 or 2, got {version}")
        shape, _, dtype = read[version](stream)
        if dtype.kind not in "fUb" or math.prod(shape) * dtype.itemsize > member.file_size:
            raise DataError(f"{file}: {member.filename}: expected floats or text, got {dtype} of shape {shape}")
        if dtype.kind == "f" and dtype.itemsize < 8:  # 0.4 m of latitude, and of time 0.06 s after a week
            raise DataError(f"{file}: {member.filename}: expected float64, got {dtype}: the digits are already lost")
    with archive.open(member) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
    # one byte order and one precision from here on
    return array.astype(np.float64, copy=False) if dtype.kind == "f" else array


def _group(arrays: dict[str, np.ndarray], group: str, fields: tuple[str, ...], file: str) -> list[np.ndarray]:
    keys = [f"{group}/{field}" if group else field for field in fields]
    missing = [key for key in keys if key not in arrays]
    if missing:
        raise DataError(f"{file}: expected an array {missing[0]}, got {', '.join(sorted(arrays))}")
    return [arrays[key] for key in keys]
