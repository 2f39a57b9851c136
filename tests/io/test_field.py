"""Inputs of public problem reports, and their neighbours: read right, or refused in words that help."""

import os
from pathlib import Path

import numpy as np
import pytest

from jaxnav import build, navigate
from jaxnav.app import cli
from jaxnav.checkup import checkup
from jaxnav.findings import line
from jaxnav.initialization.initialize import initialize
from jaxnav.io.canonical import write_recording
from jaxnav.io.formats.rtklib import write_pos
from jaxnav.maths.rotations import to_dcm, to_rph
from jaxnav.navigation import metrics
from jaxnav.reading.read import read
from jaxnav.types import DataError, Recording

FIELD = Path(os.environ.get("JAXNAV_DATA_DIR", "")).resolve().parent / "field"
needs_field = pytest.mark.skipif(not FIELD.is_dir(), reason="needs JAXNAV_DATA_DIR/../field")


def until(rec: Recording, seconds: float) -> Recording:
    """Return the first ``seconds`` of a recording's fixes."""
    last = rec.imu.t[0] + seconds
    first = lambda log: type(log)(*(None if a is None else a[log.t <= last] for a in log))
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
    assert jaxnav_in(FIELD / "check_short_recording", "check", "rec", "--verbose", "--out", str(tmp_path / "out")) == 0
    assert "the course" in capsys.readouterr().out


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
    assert "WARNING stream.empty  position: no row is left of" in said and "no faults found" not in said
    assert jaxnav_in(tmp_path, "filter", "--data", "imu.csv", "--out", "run", *option) == 3
    said = capsys.readouterr().err
    assert "has no positions to start from" in said and "no row is left of" in said and "the IMU's are at" in said


# ---------------------------------------------------------------------------- formats


@needs_field
def test_old_dataflash_logs_have_the_boards_time_in_another_column():
    rec = read(FIELD / "dataflash_old_gps_time" / "old.log")
    assert rec.aiding["position"].t.size == 45


# ---------------------------------------------------------------------------- options


@pytest.mark.full
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


# ---------------------------------------------------------------------------- what stands for no fix


@pytest.mark.full
@needs_field
@pytest.mark.parametrize(
    ("case", "file", "options", "count"),
    [
        ("marker_zero_zero", "map.toml", {}, None),
        ("marker_altitude", "map.toml", {}, None),
        ("empty_between_fixes", "map.toml", {}, 51),
        ("pos_epoch_twice", "map.toml", {}, 45),
        ("kfgins_std_0", "imu.txt", {"gnss": "gnss.txt"}, None),
        ("ros_vertical_variance_0", "bag", {}, 47),
    ],
)
def test_fixes_of_the_reports(case, file, options, count):
    folder = FIELD / case
    rec = read(folder / file, **{key: folder / value for key, value in options.items()})
    assert count is None or rec.aiding["position"].t.size == count
    if (folder / "true_path.csv").exists():
        solution = navigate(rec, build("ekf15"))
        truth = np.genfromtxt(folder / "true_path.csv", delimiter=",", names=True)
        there = (solution.t > 5.0) & (solution.t < truth["t_s"][-1])
        at = lambda name: np.interp(solution.t[there], truth["t_s"], truth[name])
        north, east = (solution.lla[there, i] * 180 / np.pi - at(name) for i, name in enumerate(("lat_deg", "lon_deg")))
        off = np.hypot(north, east * np.cos(solution.lla[0, 0])) * 111e3
        assert np.sqrt(np.mean(off**2)) < 3.0


@needs_field
def test_a_name_above_two_columns_is_refused():
    with pytest.raises(DataError, match="the name x stands above several columns"):
        read(FIELD / "names_twice" / "map.toml")


# ---------------------------------------------------------------------------- receivers' own formats


@needs_field
@pytest.mark.parametrize(
    ("case", "count", "words"),
    [
        ("nmea_altitude_empty", 44, "1 GGA without a height, in two dimensions, are left out"),
        ("nmea_zda", 45, "velocity: the file states no sd"),
        ("nmea_2014_leap", 44, "UTC is taken as GPS time less 16 s"),
        ("ubx_bytes_lost", 192, "28 NAV-PVT are damaged"),
    ],
)
def test_receivers_files_of_the_reports(case, count, words):
    rec = read(FIELD / case / "map.toml")
    assert abs(rec.aiding["position"].t.size - count) <= 1 and "velocity" in rec.aiding
    assert words in rec.notes


@needs_field
def test_seconds_of_the_week_go_on_over_its_end():
    folder = FIELD / "week_rolls_over"
    rec = read(folder / "imu.txt", gnss=folder / "gnss.txt")
    assert np.diff(rec.imu.t).max() < 1.0 and "they go on" in rec.notes
    assert rec.aiding["position"].t.size >= len((folder / "gnss.txt").read_text().splitlines()) - 1


@needs_field
def test_the_second_receiver_of_a_ulog():
    log = FIELD / "ulog_second_gps" / "log.ulg"
    rec = read(log)
    assert rec.aiding["position"].t.size >= 44 and "position is sensor_gps 1 with 45 fixes" in rec.notes
    assert "position" not in read(log, receiver="sensor_gps 0").aiding


@needs_field
def test_a_receivers_topic_goes_before_a_filters_estimate():
    rec = read(FIELD / "ros_fused_topic" / "bag")
    assert "position is /mavros/global_position/raw/fix, of" in rec.notes
    assert np.median(np.diff(rec.aiding["position"].t)) == pytest.approx(1.0, abs=0.1)


@needs_field
def test_a_rocket_that_falls_freely_is_read():
    rec = read(FIELD / "free_fall_rocket" / "rec")
    found = {f.code: f for f in checkup(rec)}
    assert not any(f.warns for f in found.values() if f.code == "imu.gravity_size")


# ---------------------------------------------------------------------------- text tables


@needs_field
@pytest.mark.parametrize(
    ("case", "file"),
    [("decimal_comma", "map.toml"), ("decimal_comma", "map_delimiter.toml"),
     ("lines_before_header", "excel.toml"), ("lines_before_header", "keys.toml")],
)  # fmt: skip
def test_tables_of_the_reports(case, file):
    rec = read(FIELD / case / file)
    assert rec.imu.t.size == 1321 and np.linalg.norm(rec.imu.accel.mean(0)) == pytest.approx(9.8, abs=0.5)


@needs_field
def test_a_phone_s_sensors_in_files_of_their_own(tmp_path):
    rec = read(FIELD / "phone_two_files" / "map.toml")
    assert len(rec.imu.t) == 1312 and rec.imu.t[0] == pytest.approx(0.3, abs=1e-6)
    np.testing.assert_allclose(rec.imu.accel[0], [0.03513, -0.03609, -9.76923], atol=1e-4)


@needs_field
@pytest.mark.parametrize(
    ("case", "file", "rows", "fixes", "words"),
    [
        ("gopro_header", "map.toml", 600, 0, ""),
        ("quoted_comma", "map.toml", 800, 40, ""),
        ("micros_wrap", "map.toml", 800, 40, "times fall by 4294.967296 s, 2^32 us"),
        ("zip_of_a_folder", "drive_2024.zip", 800, 40, ""),
        ("rows_of_several_kinds", "gnss_log.txt", 800, 40, "phone is assumed flat"),
        ("sign_of_a_column", "map.toml", 800, 40, ""),
        ("position_without_height", "map.toml", 800, 40, "40 of 40 rows have no height"),
        ("ros_navpvt_unsaid", "bag", 400, 20, ""),
        ("ros_gyro_accel_topics", "bag", 398, 19, "the accelerometer of /camera/accel/sample: the other half of each"),
        ("ros_odometry_without_twist", "bag", 1000, 50, "speed is not read: the twists of the odometry are all 0"),
        ("ubx_esf_raw", "drive.ubx", 800, 40, "imu is dated by the messages that bring it, by ESF's ticks of 1 ms"),
    ],
)  # fmt: skip
def test_logs_of_the_reports(case, file, rows, fixes, words):
    rec = read(FIELD / case / file)
    assert rec.imu.t.size == rows and words in rec.notes
    assert (rec.aiding["position"].t.size if fixes else len(rec.aiding)) == fixes
    assert np.diff(rec.imu.t).max() < 0.11 and np.linalg.norm(rec.imu.accel.mean(0)) == pytest.approx(9.8, abs=0.5)


@needs_field
@pytest.mark.parametrize(
    ("case", "imu", "gnss"),
    [("nmea_rmc_alone", "imu.toml", "log.nmea"), ("ubx_cfg_valset", "imu.toml", "fixes.ubx"),
     ("gpx_fixes", "imu.toml", "track.gpx")],
)  # fmt: skip
def test_fixes_beside_an_imu_of_the_reports(case, imu, gnss):
    rec = read(FIELD / case / imu, gnss=FIELD / case / gnss)
    assert rec.aiding["position"].t.size == 40
    np.testing.assert_allclose(np.degrees(rec.aiding["position"].value[0, :2]), [48.0, 11.0], atol=1e-3)


def changed_map(case: str, folder: Path, **keys: str) -> Path:
    """Write the map of a case with other values of keys."""
    lines = (FIELD / case / "map.toml").read_text().splitlines()
    of = lambda line: line.partition(" =")[0]
    text = [f"{of(line)} = {keys[of(line)]}" if of(line) in keys else line for line in lines]
    (folder / "map.toml").write_text("\n".join(text) + "\n")
    return folder / "map.toml"


@needs_field
def test_eastings_and_northings_of_utm(tmp_path):
    with pytest.raises(DataError, match="position: local metres are 5358 km from origin_deg.*UTM"):
        read(FIELD / "utm_as_enu" / "map.toml")
    enu = '["easting", "northing", "h"]'
    for zone in ("32U", "32 north"):
        file = changed_map("utm_as_enu", tmp_path, enu=f'{enu}\nzone = "{zone}"')
        file.write_text(file.read_text().replace("enu =", "utm ="))
        rec = read(file, folder=FIELD / "utm_as_enu")
        first = np.degrees(rec.aiding["position"].value[0, :2])
        np.testing.assert_allclose(first, [48.0000041, 11.00003703], atol=1e-7)  # gps.csv of the other cases
    file.write_text(file.read_text().replace("32 north", "32"))
    with pytest.raises(DataError, match="position: zone: expected '32N' with the letter of the band"):
        read(file, folder=FIELD / "utm_as_enu")


@needs_field
def test_dates_of_another_order_and_multiples_of_units(tmp_path):
    with pytest.raises(DataError, match=r"rtcDate rtcTime: time_unit: expected dates as iso has them, got 06/01/2024"):
        read(FIELD / "openlog_artemis" / "map.toml")
    file = changed_map("openlog_artemis", tmp_path, time_unit='"%m/%d/%Y %H:%M:%S.%f"')
    rec = read(file, folder=FIELD / "openlog_artemis")
    assert rec.imu.t.size == 800 and abs(rec.aiding["position"].t.size - 40) <= 1
    assert 1717236000 == pytest.approx(float(rec.notes.split("t = 0 is ")[1].split()[0]), abs=1)  # 2024-06-01 10:00 UTC
    assert np.abs(rec.aiding["velocity"].value).max() < 30.0


@needs_field
def test_counts_of_a_sensor(tmp_path):
    with pytest.raises(DataError, match=r"counts of the sensor\? gyro_unit = '1/131 deg/s'"):
        read(FIELD / "raw_counts" / "map.toml")
    file = changed_map("raw_counts", tmp_path, gyro_unit='"1/131 deg/s"', accel_unit='"1/16384 g"')
    rec = read(file, folder=FIELD / "raw_counts")
    counts = np.genfromtxt(FIELD / "raw_counts" / "LOG003.CSV", delimiter=",", names=True)["gz"]
    np.testing.assert_allclose(rec.imu.gyro[:, 2], -counts / 131 * np.pi / 180, rtol=1e-9)
    assert np.linalg.norm(rec.imu.accel.mean(0)) == pytest.approx(9.8, abs=0.2)


@needs_field
def test_convert_takes_the_options_of_the_report(tmp_path):
    out = str(tmp_path / "out")
    command = ("convert", "rec", "--set", "data.options={axes='flu'}", "--out", out)
    assert jaxnav_in(FIELD / "convert_ignores_options", *command) == 0
    assert np.genfromtxt(tmp_path / "out" / "imu.csv", delimiter=",", names=True)["accel_z_mps2"][0] < -9.0


# ---------------------------------------------------------------------------- directions, gravity, other values


@needs_field
@pytest.mark.parametrize(
    ("case", "code", "value"),
    [("course_from_magnetic_north", "velocity.turned", -14.0), ("heading_crosswise", "heading.turned", 90.0)],
)
def test_directions_of_the_reports(case, code, value):
    found = {f.code: f for f in checkup(read(FIELD / case / "map.toml"))}
    assert found[code].value == pytest.approx(value, abs=1.5) and found[code].warns


@needs_field
def test_a_heading_across_does_not_start_a_filter():
    rec = read(FIELD / "heading_crosswise" / "map.toml")
    begin = initialize(rec)
    truth = np.genfromtxt(FIELD / "heading_crosswise" / "true_path.csv", delimiter=",", names=True)
    true = np.interp(begin.t, truth["t_s"], np.unwrap(np.deg2rad(truth["heading_deg"])))
    heading = float(to_rph(to_dcm(begin.navs.q[0]))[2])
    assert abs(np.angle(np.exp(1j * (heading - true)))) < 0.15 and "two antennas contradict" in begin.how


@needs_field
@pytest.mark.parametrize(
    ("case", "options", "words"),
    [
        ("gravity_taken_out", {}, "gravity was taken out by the logger.*AccelerometerUncalibrated"),
        ("map_value_of_another_kind", {}, "where: expected a table such as {.*}, got 'vn > -90'"),
        ("option_sd_number", {"sd": 2}, "sd: expected a table such as { position = 2.0 }, got 2"),
    ],
)
def test_refusals_of_the_reports(case, options, words):
    with pytest.raises(DataError, match=words):
        read(FIELD / case / "map.toml", **options)


# ---------------------------------------------------------------------------- the accelerometer's sign


def means_of(rec: Recording, code: str) -> str:
    """What a finding of `checkup` says that it means."""
    return next((line(finding) for finding in checkup(rec) if finding.code == code), "")


def test_the_sign_of_an_accelerometer_differs_from_other_axes(drive):
    """Gyro z agrees with the course: the sign; it does not: the axes."""
    sign = drive._replace(imu=drive.imu._replace(accel=-drive.imu.accel))
    flu = drive._replace(imu=drive.imu._replace(accel=drive.imu.accel * [1, -1, -1], gyro=drive.imu.gyro * [1, -1, -1]))
    assert "accel_sign = -1" in means_of(sign, "axes.gravity")
    assert 'axes = "flu"' in means_of(flu, "axes.gravity") and not means_of(drive, "axes.gravity")


@pytest.mark.full
@needs_field
def test_a_recording_with_the_accelerometer_s_other_sign(tmp_path, capsys):
    folder = FIELD / "accel_sign"
    assert jaxnav_in(folder, "check", "rec", "--out", str(tmp_path / "out")) == 0
    assert "accel_sign = -1" in capsys.readouterr().out
    rec = read(folder / "rec", accel_sign=-1)
    assert not means_of(rec, "axes.gravity")
    np.testing.assert_allclose(read(folder / "rec").imu.accel, -rec.imu.accel, rtol=1e-12)
    sol = navigate(rec, build("ekf15"))
    true = np.genfromtxt(folder / "true_path.csv", delimiter=",", names=True)
    apart = sol.rph[:, 2] - np.interp(sol.t, true["t_s"], np.unwrap(np.deg2rad(true["heading_deg"])))
    assert np.degrees(np.abs(np.angle(np.exp(1j * apart)))).max() < 15.0  # 100 as it is, and with axes="flu"
    with pytest.raises(DataError, match="accel_sign: expected 1 or -1, got 2"):
        read(folder / "rec", accel_sign=2)


@pytest.mark.full
@needs_field
def test_a_tail_sitter_s_roll_is_inside_its_sd():
    """Near 90 deg of pitch differences of Euler angles had 5 % of the rolls inside 3 sd; rotations have all."""
    rec = read(FIELD / "nose_up_table" / "rec")
    errors = metrics(navigate(rec, build("ekf15")))["errors"]
    assert min(errors[angle]["inside_3sd"] for angle in ("roll_deg", "pitch_deg", "heading_deg")) > 0.95
    assert errors["roll_deg"]["rms"] < 0.5  # 0.2 deg about the axes of the sd by the case's oracle
