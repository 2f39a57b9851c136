"""What a key of a column map and an option of a reader take: values of another kind are refused in one place."""

import math
import os
from collections.abc import Callable, Mapping
from typing import Any

from jaxnav.types import DataError


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _column(value: Any) -> bool:
    return isinstance(value, (str, Mapping)) or (isinstance(value, int) and not isinstance(value, bool))


def _listed(one: Callable[[Any], bool], size: int = 0) -> Callable[[Any], bool]:
    """Return whether a value is a list of such values, of ``size`` or of any but none."""
    fits = lambda value: isinstance(value, (list, tuple)) and all(map(one, value))
    return lambda value: fits(value) and (len(value) == size if size else len(value) > 0)


def _sd(value: Any) -> bool:
    return _number(value) or _column(value)


KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "text": ("text", lambda value: isinstance(value, str)),
    "number": ("a number", _number),
    "flag": ("true or false", lambda value: isinstance(value, bool)),
    "path": ("a path", lambda value: isinstance(value, (str, os.PathLike))),
    "column": ("a column, by name or number, or { column, times }", _column),
    "columns": ("a list of columns", _listed(_column)),
    "some": ("a column or a list of columns", lambda value: _column(value) or _listed(_column)(value)),
    "three": ("3 numbers", lambda value: getattr(value, "shape", None) == (3,) or _listed(_number, 3)(value)),
    "axes": ("text or 3 angles", lambda value: isinstance(value, str) or _listed(_number, 3)(value)),
    "file": ("a file, or a table of files", lambda value: isinstance(value, (str, Mapping))),
    "table": ("a table", lambda value: isinstance(value, Mapping)),
    "rows": ("two numbers of rows", _listed(lambda value: isinstance(value, int) and value >= 0, 2)),
    "sd": ("a number, a column, { column, times }, or a list of these", lambda v: _sd(v) or _listed(_sd)(v)),
}
"""Kinds of values: in words, and the test."""
OF: dict[str, str] = {
    **dict.fromkeys(("gyro", "accel", "lla", "enu", "ned", "neu", "ecef", "utm", "speed_course", "new_where", "rph",
                     "velocity_enu", "velocity_ned", "velocity_ecef", "delays"), "columns"),
    **dict.fromkeys(("time", "accel_time", "value", "left", "right"), "some"),
    **dict.fromkeys(("up", "down", "satellite", "pseudorange", "range_rate", "clock", "clock_rate", "elevation", "cn0"),
                    "column"),
    **dict.fromkeys(("time_shift_s", "rate_hz", "radius", "north_deg", "elevation_mask_deg",
                     "cn0_mask_dbhz"), "number"),
    **dict.fromkeys(("unit", "h_unit", "gyro_unit", "accel_unit", "course_unit", "rph_unit", "time_unit", "time_scale",
                     "time_tag", "zone", "delimiter", "sampling", "name", "notes", "folder"), "text"),
    **dict.fromkeys(("header", "repair", "emission", "variance"), "flag"),
    **dict.fromkeys(("sd", "sd_enu", "sd_ned"), "sd"),
    **dict.fromkeys(("where", "read", "imu", "truth", "satellites"), "table"),
    "column": "column", "times": "number",
    "file": "file", "axes": "axes", "skip": "rows", "lever_arm_frd_m": "three", "origin_deg": "three",
}  # fmt: skip
"""Kind of each key of a column map."""


OPTIONS: dict[str, str] = {
    **dict.fromkeys(("name", "time_scale", "rates", "receiver", "imu", "fixes"), "text"),
    **dict.fromkeys(("accel_sign", "time_shift_s", "elevation_mask_deg", "cn0_mask_dbhz", "wheel_radius_m", "instance",
                     "leap_seconds", "metres_per_hdop", "part"), "number"),
    **dict.fromkeys(("gnss", "nav", "folder", "map"), "path"), **dict.fromkeys(("sd", "topics"), "table"),
    **dict.fromkeys(("repair", "spp"), "flag"), "axes": "axes", "lever_arm": "three",
}  # fmt: skip
"""Kind of each option of `jaxnav.read`."""


FORMS: dict[str, str] = {
    "where": "{ status = '>=3' }",
    "sd": "{ position = 2.0 }",
    "topics": "{ imu = '/imu/data' }",
    "read": "{ file = 'log.bag' }",
}
"""What a table looks like."""


def require(where: str, key: str, value: Any, kind: str) -> None:
    """Raise DataError for a value of another kind, a key of `KINDS`."""
    words, fits = KINDS[kind]
    if not fits(value):
        form = f" such as {FORMS[key]}" if key in FORMS else ""
        raise DataError(f"{where}: {key}: expected {words}{form}, got {value!r}")
