"""Marks for no fix, heights and sd that are missing, positions out of reach, other weeks, gravity."""

import datetime

import numpy as np
import pytest

from jaxnav.checkup import checkup
from jaxnav.io import mend
from jaxnav.io.canonical import write_recording
from jaxnav.io.parts import ImuRows, Stream
from jaxnav.maths.gps_time import WEEK, leap_seconds
from jaxnav.reading.read import read
from jaxnav.types import DataError
from tests.io.conftest import fixes


@pytest.mark.parametrize(
    "mark", [(0.0, 0.0, 0.0), (91.0, 181.0, 0.0), (-91.0, 181.0, 0.0), (48.0, 181.0, 0.0), (np.nan, np.nan, np.nan)]
)
def test_a_mark_for_no_fix_is_no_fix(drive, mark):
    """Six rows in the middle, and all but six: left out and counted, however many."""
    value = drive.aiding["position"].value
    scale = np.array([np.pi / 180, np.pi / 180, 1.0])
    for gone in (np.arange(20, 26), np.arange(6, len(value))):
        marked = value.copy()
        marked[gone] = np.array(mark) * scale
        rec = mend.mended(fixes(drive, value=marked))
        np.testing.assert_array_equal(rec.aiding["position"].value, np.delete(value, gone, 0))
        assert f"position: {gone.size} of {len(value)} rows have no value, or a mark for none" in rec.notes


@pytest.mark.parametrize("axis", [0, 1])
def test_the_equator_and_greenwich_are_places(drive, axis):
    value = drive.aiding["position"].value.copy()
    rec = mend.mended(fixes(drive, value=np.where(np.arange(3) == axis, 0.0, value)))
    assert len(rec.aiding["position"].t) == len(value)


def test_degrees_taken_for_radians_are_no_marks(drive):
    degrees = drive.aiding["position"].value * np.array([180 / np.pi, 180 / np.pi, 1.0])
    with pytest.raises(DataError, match="degrees as radians"):
        mend.mended(fixes(drive, value=degrees))


@pytest.mark.parametrize("height", [-9999.0, -32768.0, 1e7, np.nan])
def test_a_height_that_is_missing_is_interpolated_and_unsure(drive, height):
    value = drive.aiding["position"].value
    marked = value.copy()
    marked[10:13, 2] = height
    position = mend.mended(fixes(drive, value=marked)).aiding["position"]
    np.testing.assert_allclose(position.value[:, :2], value[:, :2])
    np.testing.assert_allclose(position.value[9:14, 2], np.linspace(value[9, 2], value[13, 2], 5))
    assert (position.sd[10:13, 2] == 1000.0).all() and (position.sd[:10, 2] < 10.0).all()


@pytest.mark.parametrize("rows", [slice(20, 21), slice(20, 26), slice(0, 4), slice(-3, None)])
def test_a_position_that_no_vehicle_reaches_is_left_out(drive, rows):
    """200 km away: one row, six, the first four, the last three; a swift vehicle stays whole."""
    value = drive.aiding["position"].value.copy()
    value[rows, 0] += 200.0 / 6371.0
    rec = mend.mended(fixes(drive, value=value))
    far = np.zeros(len(value), bool)
    far[rows] = True
    np.testing.assert_array_equal(rec.aiding["position"].t, drive.aiding["position"].t[~far])
    assert f"position: {far.sum()} of {len(value)} rows are farther" in rec.notes
    swift = drive.aiding["position"].value + np.array([2500.0 / 6.371e6, 0.0, 0.0]) * np.arange(len(value))[:, None]
    assert len(mend.mended(fixes(drive, value=swift)).aiding["position"].t) == len(value)


@pytest.mark.parametrize(
    "name, usual, bad", [("barometer", 120.0, -9999.0), ("barometer", 120.0, 3e5), ("rangefinder", 8.0, 0.0),
                         ("rangefinder", 8.0, -0.1), ("airspeed", 20.0, 65535.0), ("heading", 1.0, 655.35)],
)  # fmt: skip
def test_a_value_that_is_a_mark_or_implausible_is_none(drive, name, usual, bad):
    """By its row: a few are left out and counted, the strict reader refuses them."""
    t = np.arange(drive.imu.t[0] + 1, drive.imu.t[-1] - 1)
    value = np.where((np.arange(t.size) > 3) & (np.arange(t.size) < 7), bad, usual)[:, None]
    parts = fixes(drive)
    rec = mend.mended(parts._replace(aiding=parts.aiding | {name: Stream(t, value)}))
    assert rec.aiding[name].t.size == t.size - 3 and (rec.aiding[name].value == usual).all()
    assert f"{name}: 3 of {t.size} rows have no value" in rec.notes


def test_mostly_implausible_values_are_of_another_unit(drive):
    t = np.arange(drive.imu.t[0] + 1, drive.imu.t[-1] - 1)
    parts, degrees = fixes(drive), np.linspace(20.0, 350.0, t.size)[:, None]
    with pytest.raises(DataError, match="heading.*heading_rad within -13 and 13 .another unit"):
        mend.mended(parts._replace(aiding=parts.aiding | {"heading": Stream(t, degrees)}))


def test_an_axis_without_sd_has_the_assumed_one(drive):
    sd = drive.aiding["position"].sd.copy()
    sd[:, 2] = 0.0
    sd[5, 0] = -1.0
    rec = mend.mended(fixes(drive, sd=sd))
    position = rec.aiding["position"]
    assert len(position.t) == len(sd) and (position.sd[:, 2] == 6.0).all() and position.sd[5, 0] == 3.0
    np.testing.assert_array_equal(np.delete(position.sd[:, 0], 5), np.delete(sd[:, 0], 5))
    assert f"position: {len(sd)} of {len(sd)} rows state no sd on an axis" in rec.notes
    rec = mend.mended(fixes(drive, sd=np.zeros_like(sd)))
    assert (rec.aiding["position"].sd == [3.0, 3.0, 6.0]).all()
    assert [f.code for f in rec.findings] == ["stream.assumed_sd", "velocity.none"]


def test_a_speed_that_stands_for_none_is_none(drive, tmp_path):
    position = drive.aiding["position"]
    columns = np.column_stack([position.t, np.full(position.t.size, 5.0), np.full(position.t.size, 90.0)])
    columns[[3, 8, 12, 20], 1] = -1.0, 999.0, 511.0, 102.3
    np.savetxt(tmp_path / "speed.csv", columns, delimiter=",", header="t,speed,course", comments="")
    write_recording(tmp_path / "drive", drive._replace(aiding={"position": position}))
    (tmp_path / "map.toml").write_text(
        '[read]\nfile = "drive"\n[velocity]\nfile = "speed.csv"\ntime = "t"\nspeed_course = ["speed", "course"]\n'
    )
    velocity = read(tmp_path / "map.toml").aiding["velocity"]
    np.testing.assert_allclose(velocity.value, np.tile([5.0, 0.0, 0.0], (position.t.size - 4, 1)), atol=1e-12)


@pytest.mark.parametrize("weeks", [1, -1, 1024, -1024, 2048])
def test_fixes_of_another_week(drive, weeks):
    """Of a receiver whose weeks rolled over, or that counts from another Sunday; two weeks apart stays apart."""
    position = drive.aiding["position"]
    rec = mend.mended(fixes(drive, t=position.t + weeks * WEEK))
    np.testing.assert_allclose(rec.aiding["position"].t, position.t, atol=1e-6)
    assert f"{weeks:+g} weeks from the IMU's" in rec.notes
    assert "position" not in mend.mended(fixes(drive, t=position.t + 2 * WEEK)).aiding


@pytest.mark.parametrize(
    ("date", "seconds"),
    [
        ((1980, 1, 6), 0),
        ((1999, 1, 1), 13),
        ((2005, 12, 31), 13),
        ((2014, 6, 1), 16),
        ((2016, 12, 31), 17),
        ((2017, 1, 1), 18),
    ],
)
def test_leap_seconds_are_those_of_the_date(date, seconds):
    assert leap_seconds(datetime.datetime(*date, tzinfo=datetime.UTC).timestamp()) == seconds


@pytest.mark.parametrize("bias", [-1.9, 1.9])
def test_an_accelerometer_that_is_far_off_is_a_finding(drive, bias):
    """By 0.19 g: read and said; by a third: refused."""
    off = lambda by: fixes(drive)._replace(
        imu=ImuRows(drive.imu.t, drive.imu.gyro, drive.imu.accel - [0.0, 0.0, by], dt=drive.imu.dt)
    )
    found = {f.code: f for f in checkup(mend.mended(off(bias)))}
    assert found["imu.gravity_size"].warns
    with pytest.raises(DataError, match="must show gravity"):
        mend.mended(off(np.sign(bias) * 3.3))
