"""Options of readers and keys of a column map with values of other kinds: one sentence, and no traceback."""

import contextlib

import numpy as np
import pytest

from jaxnav.io import mend
from jaxnav.io.column_map import KEYS, SCALAR, TOP
from jaxnav.io.mend import Changes
from jaxnav.io.options import KINDS, OF, OPTIONS
from jaxnav.io.readers import READERS, read_parts
from jaxnav.io.toml import cell
from jaxnav.types import DataError

VALUES = (2, 2.5, -1, "x", "", [], [1], ["a", "b", "c"], {"a": 1}, True)
TABLES = {
    "imu": {"file": "i.csv", "time": "t", "gyro": ["a", "b", "c"], "gyro_unit": "rad/s", "accel": ["d", "e", "f"],
            "accel_unit": "m/s^2"},
    "position": {"file": "g.csv", "time": "t", "lla": ["lat", "lon", "h"]},
    "velocity": {"file": "g.csv", "time": "t", "speed_course": ["s", "c"]},
}  # fmt: skip
OTHERS = {
    "magnetometer": {"value": ["s", "c", "h"]}, "barometer": {"value": "h"}, "wheels": {"left": "s", "right": "s"},
    "body_velocity": {"value": ["s", "c", "h"]},
    "baseline": {"enu": ["s", "c", "h"]}, "truth": {"lla": ["lat", "lon", "h"], "velocity_enu": ["s", "c", "h"]},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place, t = tmp_path_factory.mktemp("options"), 0.02 * np.arange(60)
    rows = "".join(f"{x:.2f},0.01,0.02,0.0{k % 7},0.1,0.2,-9.8{k % 3}\n" for k, x in enumerate(t))
    (place / "i.csv").write_text(f"t,a,b,c,d,e,f\n{rows}")
    rows = "".join(f"{x:.2f},{48 + 1e-6 * k:.8f},11,500,1.{k},4{k}\n" for k, x in enumerate(t[::10]))
    (place / "g.csv").write_text(f"t,lat,lon,h,s,c\n{rows}")
    return place


def opened(place, tables, /, **options):
    """Read a map; a DataError is an answer."""
    top = "".join(f"{key} = {cell(value)}\n" for key, value in tables.items())
    (place / "map.toml").write_text(top)
    with contextlib.suppress(DataError):
        mend.mended(read_parts(place / "map.toml", **options))


@pytest.mark.parametrize("key", TOP)
def test_keys_above_the_tables(folder, key):
    for value in VALUES:
        opened(folder, {**TABLES, key: value})


@pytest.mark.parametrize("name", [*TABLES, *OTHERS])
def test_keys_of_a_table(folder, name):
    table = TABLES.get(name) or {"file": "g.csv", "time": "t"} | OTHERS[name]
    for key in KEYS.get(name, SCALAR):
        for value in VALUES:
            opened(folder, TABLES | {name: table | {key: value}})


@pytest.mark.parametrize("option", OPTIONS)
def test_options_are_refused_by_their_name(folder, option):
    """Or taken, or not the map's."""
    opened(folder, TABLES)
    for value in (*VALUES, None):
        opened(folder, TABLES, **{option: value})
    words, fits = KINDS[OPTIONS[option]]
    wrong = next(value for value in VALUES if not fits(value))
    with pytest.raises(DataError, match=f"{option}: expected {words}( such as .*)?, got"):
        read_parts(folder / "map.toml", **{option: wrong})


def test_each_option_and_key_has_a_kind():
    assert {*Changes._fields, "gnss", "map", *(option for row in READERS for option in row.options)} == set(OPTIONS)
    streams = {key for key in TOP if key not in OF}
    assert streams == set() and {*OF.values(), *OPTIONS.values()} <= set(KINDS)
    assert {key for keys in KEYS.values() for key in keys} - {"position", "velocity"} <= set(OF)


def test_true_and_nan_are_no_numbers():
    number, three = KINDS["number"][1], KINDS["three"][1]
    assert number(2) and number(2.5) and not number(True) and not number(float("nan"))
    assert three([1, 2.0, 3]) and three(np.zeros(3)) and not three([1, 2]) and not three([1, 2, "3"])
