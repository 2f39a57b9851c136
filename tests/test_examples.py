"""The recording of `examples/`: files as its script makes them, maps that read them, and README's first command."""

import csv
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from jaxnav import read
from jaxnav.app import cli
from jaxnav.maths import earth
from jaxnav.types import Track

FOLDER = Path(__file__).parents[1] / "examples"
spec = importlib.util.spec_from_file_location("make_examples", FOLDER / "make.py")
make = importlib.util.module_from_spec(spec)
spec.loader.exec_module(make)


@pytest.fixture(scope="module")
def simulated():
    return make.simulated()


def with_receiver(name: str, folder: Path, files: Path = FOLDER) -> Path:
    """Return a copy of receiver.toml with a log of the receiver in ``files``."""
    text = (FOLDER / "receiver.toml").read_text()
    for old, new in (("drive.ubx", files / name), ("drive_imu.csv", FOLDER / "drive_imu.csv")):
        text = text.replace(f'"{old}"', f'"{new.as_posix()}"')
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


@pytest.mark.full
def test_the_files_are_those_of_the_script(simulated, tmp_path):
    make.write_tables(simulated, tmp_path)
    make.write_receiver(simulated, tmp_path)
    for name in ("drive_imu.csv", "drive_gnss.csv"):
        made, kept = (np.loadtxt(folder / name, delimiter=",", skiprows=1) for folder in (tmp_path, FOLDER))
        digits = [len(cell.partition(".")[2]) for cell in (FOLDER / name).read_text().split()[1].split(",")]
        assert made.shape == kept.shape and (np.abs(made - kept) < 1.01 * 10.0 ** -np.array(digits) + 1e-6).all()
    for name in ("drive.ubx", "drive.nmea"):
        made, kept = (read(with_receiver(name, tmp_path, folder)) for folder in (tmp_path, FOLDER))
        for stream in made.aiding:
            np.testing.assert_allclose(made.aiding[stream].value, kept.aiding[stream].value, atol=0.02)
    assert sum(file.stat().st_size for file in FOLDER.iterdir() if file.is_file()) < 1_000_000


@pytest.mark.parametrize("name", ["drive.ubx", "drive.nmea"])
def test_the_receivers_logs_are_those_fixes_at_their_own_times(name, simulated, tmp_path):
    rec, fixes = read(with_receiver(name, tmp_path)), simulated.aiding["position"]
    got = rec.aiding["position"]
    np.testing.assert_allclose(got.t, fixes.t[np.isin(np.round(fixes.t, 2), np.round(got.t, 2))], atol=2e-3)
    true = np.stack([np.interp(got.t, fixes.t, column) for column in fixes.value.T], 1)
    off = earth.enu_path(got.value, got.value[0]) - earth.enu_path(true, got.value[0])
    assert np.abs(off[:, :2]).max() < 0.02
    level = np.hypot(0.4, 0.8)
    np.testing.assert_allclose(got.sd[:, :2], level, atol=0.01)


def test_the_map_reads_units_axes_and_times(simulated):
    rec = read(FOLDER / "drive.toml")
    n = rec.imu.t.size
    np.testing.assert_allclose(rec.imu.t - rec.imu.t[0], simulated.imu.t[:n] - simulated.imu.t[0], atol=1.1e-3)
    np.testing.assert_allclose(rec.imu.accel, simulated.imu.accel[:n], atol=1e-3)
    np.testing.assert_allclose(rec.imu.gyro, simulated.imu.gyro[:n], atol=1e-4)


def errors(out: Path, truth: Track) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, horizontal errors (m) and the stated sd north of the solution in a folder."""
    with (out / "solution.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    t, lat, lon, sd = (np.array([float(row[key]) for row in rows]) for key in ("t_s", "lat_deg", "lon_deg", "sd_n_m"))
    error = np.stack([np.radians(a) - np.interp(t, truth.t, truth.lla[:, i]) for i, a in enumerate((lat, lon))], 1)
    return t, np.linalg.norm(error * np.asarray(earth.metres_per_radian(truth.lla[0]))[:2], axis=1), sd


@pytest.mark.full
def test_the_default_filter_finds_the_delay(simulated, tmp_path):
    argv = ["--data", str(FOLDER / "drive.toml"), "--quiet", "--out", str(tmp_path / "out")]
    assert cli.main(["filter", *argv]) == 0
    t, error, _ = errors(tmp_path / "out", simulated.truth)
    # 0.13 s are 2 m at the car's speed
    assert np.median(error) < 1.0 and error[t < make.ASTRAY[0]].max() < 1.5


@pytest.mark.slow
def test_solve_finds_the_faults_and_where_the_car_is(simulated, tmp_path):
    """Delay, reflections and tunnel; 0.8 m of slow errors are not to be seen, and are stated."""
    out = tmp_path / "out"
    assert cli.main(["solve", str(FOLDER / "drive.toml"), "--fast", "--quiet", "--out", str(out)]) == 0
    found = json.loads((out / "metrics.json").read_text())
    assert found["verdict"].startswith("consistent")
    (fault,) = [f for f in found["findings"] if f["code"] == "solve.fault"]
    ((first, last),) = json.loads((out / "run.json").read_text())["filter"]["outages"]
    assert first < make.ASTRAY[0] + 1.0 and make.ASTRAY[1] - 1.0 < last and fault["subject"] == "position"
    _, error, sd = errors(out, simulated.truth)
    assert error.max() < 1.2 and 0.5 < np.median(sd) < 1.0
