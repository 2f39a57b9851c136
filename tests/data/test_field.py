"""Inputs of public problem reports, and their neighbours: read right, or refused in words that help."""

import os
from pathlib import Path

import numpy as np
import pytest

from jaxnav.app import cli
from jaxnav.app.config import resolve
from jaxnav.app.sources import load
from jaxnav.data.canonical import write_recording
from jaxnav.data.checkup import checkup
from jaxnav.data.formats.rtklib import write_pos
from jaxnav.data.read import read
from jaxnav.types import DataError, Recording

FIELD = Path(os.environ.get("JAXNAV_DATA_DIR", "")).parent / "field"
needs_field = pytest.mark.skipif(not FIELD.is_dir(), reason="needs the inputs of the reports beside JAXNAV_DATA_DIR")


@pytest.fixture(scope="module")
def drive() -> Recording:
    """A simulated drive of 60 s, fixes at 1 Hz."""
    options = {"duration_s": 60.0, "imu_rate_hz": 50.0, "gnss_rate_hz": 1.0, "outages_s": []}
    return load(resolve([("", {"data": {"source": "urban_short", "options": options}})]))[0]


def until(rec: Recording, seconds: float) -> Recording:
    """Return the first ``seconds`` of a recording's fixes."""
    last = rec.imu.t[0] + seconds
    first = lambda samples: type(samples)(*(a[samples.t <= last] for a in samples))
    return rec._replace(aiding={name: first(samples) for name, samples in rec.aiding.items()})


def jaxnav_in(folder: Path, *argv: str) -> int:
    """Run a command with the folder as the working directory."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        return cli.main(argv)
    finally:
        os.chdir(before)


# ---------------------------------------------------------------------------- short logs


@needs_field
def test_a_short_log_is_checked(tmp_path, capsys):
    assert jaxnav_in(FIELD / "check_short_recording", "check", "rec", "--out", str(tmp_path / "out")) == 0
    assert "turns of the course against the gyros" in capsys.readouterr().out


@pytest.mark.parametrize("seconds", [3.0, 11.0, 12.0, 20.0, 39.0, 41.0])
def test_fixes_of_any_length_are_checked(drive, seconds):
    codes = {finding.code for finding in checkup(until(drive, seconds))}
    assert codes and (seconds < 20.0 or "gyro" in {code.split(".")[0] for code in codes})


# ---------------------------------------------------------------------------- IMU and receiver in two files

ZERO = 1_700_000_000  # s since 1970


def euroc(path: Path, rec: Recording) -> None:
    """Write an IMU in EuRoC's columns, ns since 1970."""
    head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_RS_S_x [m s^-2],a_y,a_RS_S_z [m s^-2]"
    rows = zip(rec.imu.t, np.hstack([rec.imu.gyro, rec.imu.accel]), strict=True)
    lines = [f"{ZERO * 10**9 + round(t * 1e9)},{','.join(f'{v:.9f}' for v in row)}" for t, row in rows]
    path.write_text("\n".join([head, *lines]) + "\n")


@needs_field
def test_fixes_of_another_file_count_from_the_same_time_as_a_maps_imu():
    folder = FIELD / "gnss_option_map"
    rec = read(folder / "imu.toml", gnss=folder / "fixes.ubx")
    assert rec.aiding["position"].t.size == 51 and "no row is left" not in rec.notes


def test_fixes_of_another_file_count_from_the_same_time_as_eurocs_imu(drive, tmp_path):
    """Whole, and where the first fix is before the first sample."""
    euroc(tmp_path / "imu.csv", drive)
    write_pos(tmp_path / "fixes.pos", drive.aiding["position"], drive.aiding.get("velocity"), t0=float(ZERO))
    rec = read(tmp_path / "imu.csv", gnss=tmp_path / "fixes.pos")
    expected = drive.aiding["position"]
    shift = rec.imu.t[0] - drive.imu.t[0]
    np.testing.assert_allclose(rec.aiding["position"].t - shift, expected.t, atol=1e-3)
    late = drive._replace(imu=type(drive.imu)(*(a[drive.imu.t > drive.imu.t[0] + 10.0] for a in drive.imu)))
    euroc(tmp_path / "imu.csv", late)
    fewer = read(tmp_path / "imu.csv", gnss=tmp_path / "fixes.pos")
    assert fewer.aiding["position"].t.size == np.count_nonzero(expected.t > late.imu.t[0] - late.imu.dt[0])


def test_a_stream_that_ends_empty_says_why(drive, tmp_path, capsys):
    """Fixes of another day: check says so, and a filter's refusal carries the reader's words."""
    position = drive.aiding["position"]
    rec = drive._replace(aiding={"position": position._replace(t=position.t + 86400.0)}, truth=None)
    with pytest.raises(DataError):
        write_recording(tmp_path / "refused", rec)
    write_pos(tmp_path / "fixes.pos", position, None, t0=float(ZERO + 86400))
    euroc(tmp_path / "imu.csv", drive)
    option = ["--set", f'data.options={{gnss="{tmp_path / "fixes.pos"}", axes="frd"}}']
    assert jaxnav_in(tmp_path, "check", "imu.csv", "--out", "checked", *option) == 0
    said = capsys.readouterr().out
    assert "! position: no row is left of" in said and "nothing looks wrong" not in said
    assert jaxnav_in(tmp_path, "filter", "--data", "imu.csv", "--out", "run", *option) == 3
    said = capsys.readouterr().err
    assert "needs a stream of positions" in said and "no row is left of" in said and "the IMU's are at" in said


# ---------------------------------------------------------------------------- formats


@needs_field
def test_old_dataflash_logs_have_the_boards_time_in_another_column():
    rec = read(FIELD / "dataflash_old_gps_time" / "old.log")
    assert rec.aiding["position"].t.size == 45


# ---------------------------------------------------------------------------- options


def test_check_and_convert_take_the_readers_options(drive, tmp_path):
    """The configuration that check writes has them too, with whole paths."""
    turned = drive._replace(
        imu=drive.imu._replace(accel=drive.imu.accel * [1, -1, -1], gyro=drive.imu.gyro * [1, -1, -1])
    )
    write_recording(tmp_path / "flu", turned)
    option = ["--set", 'data.options={axes="flu"}']
    assert jaxnav_in(tmp_path, "convert", "flu", "--out", "frd", *option) == 0
    np.testing.assert_allclose(read(tmp_path / "frd").imu.accel, drive.imu.accel, atol=1e-9)
    assert jaxnav_in(tmp_path, "check", "flu", "--out", "checked", *option) == 0
    assert 'options = { axes = "flu" }' in (tmp_path / "checked" / "config.toml").read_text()
    assert jaxnav_in(tmp_path, "filter", "--config", "checked/config.toml", "--set", "filter.grade='consumer'") == 0
