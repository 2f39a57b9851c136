"""MATLAB files (version 5) of numbers, read strictly."""

import io
import os
from typing import Any

import numpy as np

from jaxnav.io.files import MAX_VALUE, FilePath, Source, place, read_bytes
from jaxnav.types import DataError, Json


def read_struct(path: FilePath, name: str) -> Any:
    """Read the struct of this name; no MATLAB file of version 5, or no such struct, is a DataError."""
    found = read_structs(path, [name])
    if name not in found:
        raise DataError(f"{os.fspath(path)}: expected a struct {name}")
    return found[name]


def read_structs(path: FilePath, names: list[str] | None = None) -> Json:
    """Every struct by name, or those of ``names``; a file that is no MATLAB file of version 5 is a DataError."""
    data = io.BytesIO(read_bytes(path))
    try:
        from scipy.io import loadmat

        variables = loadmat(data, squeeze_me=True, struct_as_record=False, variable_names=names)
    except Exception as error:  # scipy raises a dozen kinds on a damaged file
        raise DataError(f"{os.fspath(path)}: cannot be read as a MATLAB file: {error}") from error
    return {name: value for name, value in variables.items() if hasattr(value, "_fieldnames")}


def field(struct: Any, name: str, path: FilePath, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return one field as float64 (small integers come as uint8, which overflows); None in shape is any length."""
    if not hasattr(struct, name):
        raise DataError(f"{os.fspath(path)}: expected a field {name}")
    value = getattr(struct, name)
    if not isinstance(value, (np.ndarray, int, float)) or np.asarray(value).dtype.kind not in "fiu":
        raise DataError(f"{os.fspath(path)}: field {name}: expected numbers")
    array = np.asarray(value, dtype=np.float64)
    if len(array.shape) != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape)):
        raise DataError(f"{os.fspath(path)}: field {name}: expected shape {shape}, got {array.shape}")
    bad = ~(np.abs(array) < MAX_VALUE)
    if bad.any():
        row = int(np.nonzero(bad)[0][0]) if array.ndim else 0
        raise DataError(f"{place(Source(os.fspath(path)), row, name)}: expected finite numbers")
    return array
