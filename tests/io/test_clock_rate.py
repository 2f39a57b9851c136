"""Board time at another rate than GPS time is rescaled; jumps and repeated stamps are reported."""

import numpy as np
import pytest

from jaxnav.io.clock_rate import at_gps_rate
from jaxnav.io.readers import read_parts
from jaxnav.maths.units import DEG
from jaxnav.reading.read import read
from jaxnav.types import Track

from .conftest import fixes

GPS = 1.4e9 + 0.2 * np.arange(300)  # s, fixes at 5 Hz


def parts(drive):
    made = fixes(drive)
    return made._replace(truth=Track(*(a[:50] for a in drive.truth)))


@pytest.mark.parametrize("slow", [12 / 13, 1.0, 1.0003, 1.05])
def test_times_run_as_gps_time_does(drive, slow):
    """Own stamps jitter by 50 ms, as those of a serial line do."""
    board = 5.0 + slow * (GPS - GPS[0]) + np.random.default_rng(0).uniform(0.0, 0.05, GPS.size)
    was = parts(drive)
    got = at_gps_rate(was, board, GPS)
    rate = 1.0 if abs(slow - 1) < 1e-3 else 1 / slow
    for own, other in ((got.imu, was.imu), (got.aiding["position"], was.aiding["position"]), (got.truth, was.truth)):
        np.testing.assert_allclose(own.t, other.t * rate, rtol=2e-3)
        if rate == 1.0:
            np.testing.assert_array_equal(own.t, other.t)
    np.testing.assert_allclose(got.imu.dt, was.imu.dt * rate, rtol=2e-3)
    assert [f"time runs at {slow:.2f}" in str(note) for note in got.notes] == ([] if rate == 1.0 else [True])


def test_jumps_and_repeated_stamps_are_reported_and_do_not_rescale(drive):
    board = 5.0 + (GPS - GPS[0])
    later = GPS + np.where(np.arange(300) > 200, 3.0, 0.0)
    got = at_gps_rate(parts(drive), board, later)
    (said,) = got.notes
    assert said.message == "GPS time jumps against board time 1 time(s), first by +3.0 s at t = 45.20 s"
    still = board.copy()
    still[100:110] = still[100]
    (said,) = at_gps_rate(parts(drive), still, GPS).notes
    assert said.message == "board time repeats in 9 of 300 fixes"
    restarted = np.r_[board[:150], board[:150]]
    assert "jumps against board time 1 time(s), first by +30.0 s" in str(
        at_gps_rate(parts(drive), restarted, GPS).notes[0]
    )
    for own, other in ((board[:10], GPS[:10]), (board, np.full(300, np.nan)), (np.zeros(300), GPS)):
        few = at_gps_rate(was := parts(drive), own, other)
        assert few.notes == () and few.imu.t is was.imu.t


def test_a_dataflash_log_at_twelve_thirteenths(drive, tmp_path):
    """Its IMU and fixes come back at GPS time's rate, and fit each other."""
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 130, 60, IMU, Qffffff, TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
        "FMT, 132, 60, GPS, QBIHLLffff, TimeUS,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs,VZ",
    ]
    us = lambda t: round(t * 12 / 13 * 1e6)
    for t, w, f in zip(drive.imu.t, drive.imu.gyro.tolist(), drive.imu.accel.tolist()):
        lines.append(f"IMU, {us(t)}, " + ", ".join(f"{x:.9f}" for x in (*w, *f)))
    for t, lla, v in zip(*drive.aiding["position"][:2], drive.aiding["velocity"].value):
        course = np.degrees(np.arctan2(v[0], v[1])) % 360
        lines.append(
            f"GPS, {us(t)}, 3, {round(1000 * (345600 + t))}, 2100, {lla[0] / DEG:.9f}, {lla[1] / DEG:.9f}, "
            f"{lla[2]:.4f}, {np.hypot(*v[:2]):.6f}, {course:.6f}, {-v[2]:.6f}"
        )
    (tmp_path / "a.log").write_text("\n".join(lines) + "\n")
    rec = read(tmp_path / "a.log")
    assert "board time runs at 0.92308 of the rate of GPS time" in rec.notes
    np.testing.assert_allclose(np.diff(rec.imu.t), 0.02, atol=3e-6)
    np.testing.assert_allclose(rec.imu.t, drive.imu.t, atol=1e-4)
    got, sent = rec.aiding["velocity"], drive.aiding["velocity"]
    np.testing.assert_allclose(got.t, sent.t[: got.t.size], atol=1e-4)
    (tmp_path / "b.log").write_text("\n".join(line.replace(", 2100,", ", 0,") for line in lines) + "\n")
    assert "0.92308" in " ".join(
        map(str, read_parts(tmp_path / "b.log").notes)
    )  # an unknown week is the same in every row
