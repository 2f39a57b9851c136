"""Random settings and files: a configuration or one ConfigError, a recording or one DataError, nothing else.

`make fuzz` tries twenty times as many.
"""

import os
import string

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as how
from hypothesis import strategies as st

from jaxnav.app import config, settings
from jaxnav.io import read_recording, write_recording
from jaxnav.types import ConfigError, DataError, ImuLog, Recording, Samples

TRIES = int(os.environ.get("JAXNAV_FUZZ", "1"))
KEYS = [(s.name, k.name) for s in settings.sections() for k in s.settings]
PLAIN = st.one_of(
    st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.sampled_from(["ekf15", "motion", "nll", "log"])
)
NESTED = lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=2)
VALUES = st.recursive(PLAIN, NESTED, max_leaves=6)
FEW = how(max_examples=300 * TRIES, deadline=None, suppress_health_check=list(HealthCheck))


def tree_of(rows) -> dict:
    tree: dict = {}
    for (section, key), value in rows:
        (tree.setdefault(section, {}) if section else tree)[key] = value
    return tree


@FEW
@given(st.lists(st.tuples(st.sampled_from(KEYS), VALUES), min_size=1, max_size=3))
def test_any_value_of_any_setting(rows):
    try:
        found = config.resolve([("fuzz", tree_of(rows))])
    except ConfigError as error:
        assert "\n" not in str(error) and len(str(error)) > 10
    else:
        assert config.resolve([("again", config.as_dict(found))]) == found


@FEW
@given(st.text(alphabet=string.printable, max_size=40))
def test_any_text_of_set(text):
    try:
        config.resolve([(f"--set {text!r}", config.parse_set(text))])
    except ConfigError as error:
        assert "Traceback" not in str(error)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A minute at rest."""
    t = np.arange(1, 601) / 10.0
    imu = ImuLog(t, np.full(600, 0.1), np.zeros((600, 3)), np.tile([0.0, 0.0, -9.81], (600, 1)))
    fix = Samples(np.arange(1.0, 60.0), np.tile([0.8, 0.3, 100.0], (59, 1)), np.ones((59, 3)), np.zeros((59, 3)))
    path = tmp_path_factory.mktemp("fuzz") / "rest"
    write_recording(path, Recording("rest", imu, {"position": fix}, None, np.zeros(3)))
    return path


@FEW
@given(st.data())
def test_any_cell_and_any_cut_of_a_file(folder, data):
    name = data.draw(st.sampled_from(["imu.csv", "position.csv", "recording.json"]))
    path, whole = folder / name, (folder / name).read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1))
    with_it = data.draw(
        st.one_of(st.binary(max_size=6), st.sampled_from([b",", b"\n", b"nan", b"1e999", b"-", b"\x00"]))
    )
    gone = data.draw(st.sampled_from([0, 1, 3, 40, 10**9]))
    path.write_bytes(whole[:at] + with_it + whole[at + gone :])
    try:
        rec = read_recording(folder)
    except DataError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(rec.imu.gyro).all() and (np.diff(rec.imu.t) > 0).all()
    finally:
        path.write_bytes(whole)
