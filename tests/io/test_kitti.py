"""KITTI's folder of one file a sample, written from a simulated drive in its conventions."""

import datetime

import numpy as np
import pytest

from jaxnav.maths.axes import rotation
from jaxnav.maths.units import DEG
from jaxnav.reading.read import read
from jaxnav.types import DataError

BEGIN = datetime.datetime(2011, 9, 26, 13, 2, 25, 594360)


def write(folder, drive, step=5):
    """Write each ``step``-th sample: forward, left, up; yaw counterclockwise from east, nose down positive."""
    (folder / "oxts" / "data").mkdir(parents=True)
    truth, stamps = drive.truth, []
    flu = rotation("flu").T
    for k, i in enumerate(range(0, drive.imu.t.size, step)):
        t = drive.imu.t[i]
        lla, vel, rph = (np.array([np.interp(t, truth.t, c) for c in a.T]) for a in (truth.lla, truth.vel, truth.rph))
        rph[2] = truth.rph[np.abs(truth.t - t).argmin(), 2]
        gyro, accel = drive.imu.gyro[i] @ flu.T, drive.imu.accel[i] @ flu.T
        row = [lla[0] / DEG, lla[1] / DEG, lla[2], rph[0], -rph[1], np.pi / 2 - rph[2], vel[1], vel[0], 0, 0, vel[2]]
        row += [*accel, 0, 0, 0, *gyro, 0, 0, 0, 0.25, 0.05, 4, 11, 6, 6, 6]
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{v:.14g}" for v in row) + "\n")
        stamps.append(f"{BEGIN + datetime.timedelta(seconds=float(t))}375")
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    return folder


def test_a_drive_comes_back_with_its_attitude(drive, tmp_path):
    for path in (write(tmp_path / "0027_sync", drive), tmp_path / "0027_sync" / "oxts"):
        rec = read(path)
        assert rec.name == "0027_sync"
        np.testing.assert_allclose(rec.imu.accel, drive.imu.accel[::5], atol=1e-9)
        np.testing.assert_allclose(rec.imu.gyro, drive.imu.gyro[::5], atol=1e-9)
        np.testing.assert_allclose(np.diff(rec.imu.t), 0.1, atol=2e-6)
        at = np.abs(drive.truth.t[:, None] - drive.imu.t[::5]).argmin(axis=0)
        turn = (rec.truth.rph - drive.truth.rph[at] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(turn).max() < 0.02  # rad: the nearest epoch of the truth
        np.testing.assert_allclose(rec.aiding["velocity"].value, rec.truth.vel)
        np.testing.assert_allclose(rec.aiding["position"].sd[0], 0.25)
        assert "errors against this truth do not measure accuracy" in rec.notes


def test_a_missing_file_keeps_the_times_of_the_others(drive, tmp_path):
    whole = read(write(tmp_path / "a", drive))
    (tmp_path / "a" / "oxts" / "data" / "0000000100.txt").unlink()
    np.testing.assert_allclose(read(tmp_path / "a").imu.t, np.delete(whole.imu.t, 100))


def test_damage_is_said_with_the_file(drive, tmp_path):
    write(tmp_path / "a", drive)
    last = tmp_path / "a" / "oxts" / "data" / "0000000007.txt"
    content = last.read_text()
    last.write_text(content.rpartition(" ")[0])
    with pytest.raises(DataError, match="0000000007.txt: expected 30 numbers, got 29"):
        read(tmp_path / "a")
    last.write_text(content)
    stamps = tmp_path / "a" / "oxts" / "timestamps.txt"
    stamps.write_text("\n".join(stamps.read_text().splitlines()[:300]) + "\n")
    with pytest.raises(DataError, match="600 files up to 0000000599.txt, 300 lines of timestamps.txt"):
        read(tmp_path / "a")
