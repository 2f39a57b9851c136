"""IMU stamps in UTC, fixes in GPS time: one scale, by what is stated, else by what the turns decide."""

from pathlib import Path

import numpy as np
import pytest

from jaxnav.app.config import Data
from jaxnav.app.jobs.check import configuration
from jaxnav.checkup import checkup
from jaxnav.io.parts import ImuRows, Parts, Stream, TimeScale
from jaxnav.maths import earth
from jaxnav.reading.read import read
from jaxnav.reading.timescale import in_one_scale
from jaxnav.types import DataError

FIELD = Path(__file__).parents[3] / "shared" / "field"
ZERO, LEAP = 1717236000, 18.0  # 1 June 2024


def parts(drive, behind: float = LEAP, imu=TimeScale.UNKNOWN, fixes=TimeScale.GPS, gyro=None) -> Parts:
    """The drive as a reader hands it over, the IMU's stamps behind the fixes'."""
    rows = ImuRows(drive.imu.t - behind, drive.imu.gyro if gyro is None else gyro, drive.imu.accel, scale=imu)
    streams = {name: Stream(*s, scale=fixes) for name, s in drive.aiding.items()}
    return Parts("a.log", rows, streams, zero=ZERO)


def behind(rec, drive) -> float:
    """By how much the positions of a recording are late against its IMU, s."""
    t = rec.aiding["position"].t - rec.imu.t[0]
    first = np.flatnonzero((drive.aiding["position"].value == rec.aiding["position"].value[0]).all(1))[0]
    return float(t[0] - (drive.aiding["position"].t[first] - drive.imu.t[0]))


@pytest.mark.parametrize("imu, fixes, moved", [
    (TimeScale.UTC, TimeScale.GPS, True), (TimeScale.UNKNOWN, TimeScale.GPS, True),
    (TimeScale.UTC, TimeScale.UTC, False),
    (TimeScale.GPS, TimeScale.GPS, False), (TimeScale.UNKNOWN, TimeScale.UNKNOWN, False),
])  # fmt: skip
def test_utc_and_gps_time_meet(drive, imu, fixes, moved):
    rec = in_one_scale(parts(drive, imu=imu, fixes=fixes))
    assert behind(rec, drive) == pytest.approx(0.0 if moved else LEAP, abs=1e-6)
    assert ("UTC is taken as GPS time less 18 s" in rec.notes) is moved


@pytest.mark.parametrize("late", [7200.0, -34200.0, 315964800.0 - 18.0, -315964800.0])
def test_fixes_in_another_zone_or_since_1980_are_moved(drive, late):
    """Two hours and minus nine and a half; seconds since 1980 with and without leap seconds."""
    made = parts(drive, 0.0, fixes=TimeScale.UNKNOWN)
    other = {name: s._replace(t=np.asarray(s.t) + late) for name, s in made.aiding.items()}
    rec = in_one_scale(made._replace(aiding=other))
    assert behind(rec, drive) == pytest.approx(0.0, abs=1e-6)
    (said,) = [f for f in rec.findings if f.code == "time.zone"]
    assert said.value == -late and not said.warns
    assert rec.aiding["position"].t.size == drive.aiding["position"].t.size


def test_a_stream_of_the_imus_clock_stays_where_the_fixes_are_moved(drive):
    made = parts(drive, 0.0, fixes=TimeScale.UNKNOWN)
    aiding = {n: s._replace(t=np.asarray(s.t) + 7200.0) for n, s in made.aiding.items()}
    baro = Stream(drive.aiding["position"].t, drive.aiding["position"].value[:, 2:])
    rec = in_one_scale(made._replace(aiding=aiding | {"barometer": baro}))
    np.testing.assert_allclose(rec.aiding["barometer"].t, rec.aiding["position"].t)
    np.testing.assert_array_equal(rec.aiding["barometer"].value, rec.aiding["position"].value[:, 2:])


def test_local_time_of_a_logger_against_gps_time_of_a_receiver(drive):
    """Two hours and the leap seconds."""
    rec = in_one_scale(parts(drive, LEAP - 7200.0))
    assert behind(rec, drive) == pytest.approx(0.0, abs=1e-6)
    (said,) = [f for f in rec.findings if f.code == "time.zone"]
    assert said.value == pytest.approx(7200.0 - LEAP) and "+2 h" in said.message


@pytest.mark.parametrize("late", [7000.0, 1e6])
def test_fixes_at_no_whole_quarter_hour_stay_where_they_are(drive, late):
    made = parts(drive, 0.0, fixes=TimeScale.UNKNOWN)
    rec = in_one_scale(made._replace(aiding={n: s._replace(t=np.asarray(s.t) + late) for n, s in made.aiding.items()}))
    assert "position" not in rec.aiding and "stream.empty" in {f.code for f in checkup(rec)}


def test_an_imu_in_gps_time_meets_fixes_in_utc(drive):
    rec = in_one_scale(parts(drive, -LEAP, TimeScale.GPS, TimeScale.UTC))
    assert behind(rec, drive) == pytest.approx(0.0, abs=1e-6)


def test_streams_of_the_imus_logger_stay_with_it(drive):
    """A barometer in UTC beside fixes in GPS time moves with neither; the truth has the IMU's clock."""
    made = parts(drive, imu=TimeScale.UTC)
    height = drive.aiding["position"].value[:, 2:]
    baro = Stream(drive.aiding["position"].t - LEAP, height, scale=TimeScale.UTC)
    rec = in_one_scale(made._replace(aiding=made.aiding | {"barometer": baro}))
    np.testing.assert_allclose(rec.aiding["barometer"].t, rec.aiding["position"].t)
    np.testing.assert_array_equal(rec.aiding["barometer"].value, rec.aiding["position"].value[:, 2:])


def test_stamps_that_are_gps_time_already_stay(drive):
    rec = in_one_scale(parts(drive, 0.0))
    assert behind(rec, drive) == pytest.approx(0.0, abs=1e-6) and "UTC" not in rec.notes


def test_an_undecided_time_scale_is_said(drive):
    still = 1e-4 * np.sin(drive.imu.t)[:, None] + np.zeros((1, 3))
    level = drive._replace(imu=drive.imu._replace(accel=still - [0.0, 0.0, 9.8]))
    rec = in_one_scale(parts(level, gyro=still))
    assert behind(rec, drive) == pytest.approx(LEAP, abs=1e-6)
    assert "its stamps may be UTC, 18 s behind" in rec.notes and "time_scale" in rec.notes


def test_a_time_scale_is_stated_by_an_option_or_a_map():
    case = FIELD / "utc_imu_ubx" / "map.toml"
    if not case.exists():
        pytest.skip("no shared data")
    pytest.importorskip("pyubx2")
    truth = np.genfromtxt(case.parent / "true_path.csv", delimiter=",", names=True)
    rec = read(case)
    assert rec.imu.t[0] == pytest.approx(0.0, abs=1e-6)  # its own clock
    t = rec.aiding["position"].t
    lla = np.stack([np.interp(t, truth["t_s"], truth[name]) for name in ("lat_deg", "lon_deg", "h_m")], 1)
    lla[:, :2] = np.radians(lla[:, :2])
    off = np.asarray([earth.enu_difference(a, b) for a, b in zip(rec.aiding["position"].value, lla, strict=True)])
    assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, 1))) < 3.0 and len(t) == 51
    np.testing.assert_allclose(read(case, time_scale="utc").aiding["position"].t, t)
    assert "UTC" not in read(case, time_scale="gps").notes
    with pytest.raises(DataError, match="time_scale: expected gps, utc, unknown, got 'tai'"):
        read(case, time_scale="tai")


def test_an_offset_of_another_size_is_written_into_the_configuration(drive):
    rec = in_one_scale(parts(drive, 12.0, TimeScale.UNKNOWN, TimeScale.UNKNOWN))
    found = checkup(rec)
    (offset,) = [f for f in found if f.code == "time.offset"]
    assert offset.value == pytest.approx(12.0, abs=0.3) and offset.setting == "data.options.time_shift_s"
    text = configuration(Data("a.csv"), rec, found)
    assert f"time_shift_s = {offset.value:.1f}" in text


def test_stamps_since_start_up_are_bridged_by_the_times_of_reception():
    pytest.importorskip("rosbags")
    if not (FIELD / "ros_imu_clock_since_boot").exists():
        pytest.skip("no shared data")
    rec = read(FIELD / "ros_imu_clock_since_boot" / "bag")
    assert "imu: its stamps count from start-up" in rec.notes and rec.aiding["position"].t.size > 40
