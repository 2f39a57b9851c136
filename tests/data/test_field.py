"""Inputs of public problem reports, and their neighbours: read right, or refused in words that help."""

import datetime
import os
from pathlib import Path

import numpy as np
import pytest

from jaxnav import build, navigate
from jaxnav.app import cli
from jaxnav.app.config import resolve
from jaxnav.app.sources import load
from jaxnav.data import mend
from jaxnav.data.canonical import write_recording
from jaxnav.data.checkup import checkup
from jaxnav.data.formats.rosbag import receivers_own
from jaxnav.data.formats.rtklib import write_pos
from jaxnav.data.gps_time import WEEK, leap_seconds
from jaxnav.data.parts import ImuRows, Parts, Stream, with_fixes
from jaxnav.data.read import read, read_parts
from jaxnav.data.sheet import numbers, open_sheet
from jaxnav.types import DataError, Recording

FIELD = Path(os.environ.get("JAXNAV_DATA_DIR", "")).resolve().parent / "field"
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


# ---------------------------------------------------------------------------- what stands for no fix


def fixes(drive: Recording, **columns) -> Parts:
    """Return the drive as a reader hands it over, with columns of its positions replaced."""
    position = drive.aiding["position"]
    stream = Stream(position.t, position.value.copy(), position.sd.copy())._replace(**columns)
    return Parts("a.log", ImuRows(drive.imu.t, drive.imu.gyro, drive.imu.accel, dt=drive.imu.dt), {"position": stream})


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
        rec = mend.recording(fixes(drive, value=marked))
        np.testing.assert_array_equal(rec.aiding["position"].value, np.delete(value, gone, 0))
        assert f"position: {gone.size} of {len(value)} rows have no value, or a mark for none" in rec.notes


@pytest.mark.parametrize("axis", [0, 1])
def test_the_equator_and_greenwich_are_places(drive, axis):
    value = drive.aiding["position"].value.copy()
    rec = mend.recording(fixes(drive, value=np.where(np.arange(3) == axis, 0.0, value)))
    assert len(rec.aiding["position"].t) == len(value)


def test_degrees_taken_for_radians_are_no_marks(drive):
    degrees = drive.aiding["position"].value * np.array([180 / np.pi, 180 / np.pi, 1.0])
    with pytest.raises(DataError, match="degrees as radians"):
        mend.recording(fixes(drive, value=degrees))


@pytest.mark.parametrize("height", [-9999.0, -32768.0, 1e7, np.nan])
def test_a_height_that_is_missing_is_interpolated_and_unsure(drive, height):
    value = drive.aiding["position"].value
    marked = value.copy()
    marked[10:13, 2] = height
    position = mend.recording(fixes(drive, value=marked)).aiding["position"]
    np.testing.assert_allclose(position.value[:, :2], value[:, :2])
    np.testing.assert_allclose(position.value[9:14, 2], np.linspace(value[9, 2], value[13, 2], 5))
    assert (position.sd[10:13, 2] == 1000.0).all() and (position.sd[:10, 2] < 10.0).all()


@pytest.mark.parametrize("rows", [slice(20, 21), slice(20, 26), slice(0, 4), slice(-3, None)])
def test_a_position_that_no_vehicle_reaches_is_left_out(drive, rows):
    """200 km away: one row, six, the first four, the last three; a swift vehicle stays whole."""
    value = drive.aiding["position"].value.copy()
    value[rows, 0] += 200.0 / 6371.0
    rec = mend.recording(fixes(drive, value=value))
    far = np.zeros(len(value), bool)
    far[rows] = True
    np.testing.assert_array_equal(rec.aiding["position"].t, drive.aiding["position"].t[~far])
    assert f"position: {far.sum()} of {len(value)} rows are farther" in rec.notes
    swift = drive.aiding["position"].value + np.array([2500.0 / 6.371e6, 0.0, 0.0]) * np.arange(len(value))[:, None]
    assert len(mend.recording(fixes(drive, value=swift)).aiding["position"].t) == len(value)


def test_an_axis_without_sd_has_the_assumed_one(drive):
    sd = drive.aiding["position"].sd.copy()
    sd[:, 2] = 0.0
    sd[5, 0] = -1.0
    rec = mend.recording(fixes(drive, sd=sd))
    position = rec.aiding["position"]
    assert len(position.t) == len(sd) and (position.sd[:, 2] == 6.0).all() and position.sd[5, 0] == 3.0
    np.testing.assert_array_equal(np.delete(position.sd[:, 0], 5), np.delete(sd[:, 0], 5))
    assert f"position: {len(sd)} of {len(sd)} rows state no sd on an axis" in rec.notes
    rec = mend.recording(fixes(drive, sd=np.zeros_like(sd)))
    assert (rec.aiding["position"].sd == [3.0, 3.0, 6.0]).all() and "the file states no sd" in rec.notes


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
        ("nmea_altitude_empty", 44, "1 GGA have no height and are left out"),
        ("nmea_zda", 45, "velocity: NMEA states no sd"),
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


@pytest.mark.parametrize("weeks", [1, -1, 1024, -1024, 2048])
def test_fixes_of_another_week(drive, weeks):
    """Of a receiver whose weeks rolled over, or that counts from another Sunday; two weeks apart stays apart."""
    position = drive.aiding["position"]
    rec = mend.recording(fixes(drive, t=position.t + weeks * WEEK))
    np.testing.assert_allclose(rec.aiding["position"].t, position.t, atol=1e-6)
    assert f"{weeks:+g} weeks from the IMU's" in rec.notes
    assert "position" not in mend.recording(fixes(drive, t=position.t + 2 * WEEK)).aiding


SENTENCES = ("GNGGA,100000.00,4806.0,N,01136.0,E,1,10,{hdop},475.8,M,45.0,M,,", "GNVTG,90.0,T,,M,10.0,N,18.5,K,A",
             "GNZDA,100000.00,01,06,2024,00,00")  # fmt: skip


def nmea(hdop: str = "0.8", order: tuple[int, ...] = (0, 1, 2)) -> list[str]:
    """Return twenty seconds of sentences without checksum."""
    bursts = [
        [SENTENCES[i].format(hdop=hdop).replace("100000.00", f"1000{k:02d}.00") for i in order] for k in range(20)
    ]
    return [line for burst in bursts for line in burst]


def checked(line: str) -> str:
    """Return a sentence with its checksum."""
    total = 0
    for byte in line.encode():
        total ^= byte
    return f"${line}*{total:02X}"


@pytest.mark.parametrize(
    ("written", "count", "words"),
    [
        (lambda lines: [checked(line) for line in lines], 20, None),
        (lambda lines: [f"${line}" for line in lines], 20, "60 sentences have no checksum and are taken"),
        (lambda lines: [f"12:00:01.5 RX {checked(line)}" for line in lines], 20, None),
        (lambda lines: [f"\\s:r1,c:1717236000*1A\\{checked(line)}" for line in lines], 20, None),
        (lambda lines: [checked(line) for line in lines[:-3]] + [f"${line}" for line in lines[-3:]], 19,
         "3 sentences have no checksum and are left out"),
        (lambda lines: [checked(line) for line in lines[:-3]] + ["$GNGGA,1000*00"], 19, "1 sentences are damaged"),
    ],
)  # fmt: skip
def test_nmea_as_loggers_write_it(tmp_path, written, count, words):
    (tmp_path / "log.txt").write_text("\r\n".join(written(nmea())) + "\r\n")
    parts = read_parts(tmp_path / "log.txt")
    position, velocity = (parts.aiding[name] for name in ("position", "velocity"))
    start = 1717236000.0 + 18.0
    np.testing.assert_allclose(position.t, start + np.arange(count), rtol=0, atol=1e-6)
    assert velocity.t[-1] == pytest.approx(start + count - 1, rel=0, abs=1e-6)
    np.testing.assert_allclose(velocity.value[-1], [10 * 1852 / 3600, 0.0, 0.0], atol=1e-9)
    assert words is None or any(words in note for note in parts.notes)


def test_an_empty_hdop_is_an_assumed_sd(tmp_path, drive):
    (tmp_path / "log.txt").write_text("\r\n".join(checked(line) for line in nmea(hdop="")) + "\r\n")
    stream = read_parts(tmp_path / "log.txt").aiding["position"]
    assert len(stream.t) == 20
    span = stream._replace(t=stream.t - stream.t[0] + drive.imu.t[0] + 5.0)
    rec = mend.recording(fixes(drive)._replace(aiding={"position": span}))
    assert (rec.aiding["position"].sd == [3.0, 3.0, 6.0]).all()


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


@pytest.mark.parametrize(
    ("shares", "chosen"),
    [((1.0, 1.0), "a 0"), ((0.0, 1.0), "a 1"), ((0.6, 1.0), "a 0"), ((0.3, 0.4), "a 1"), ((0.0, 0.0), "a 0")],
)
def test_a_dead_first_receiver_does_not_hide_the_second(shares, chosen):
    masks = {f"a {i}": np.arange(100) < 100 * share for i, share in enumerate(shares)}
    notes: list[str] = []
    assert with_fixes(masks, None, notes) == chosen and "of a 0, a 1 (option receiver)" in notes[0]
    assert with_fixes(masks, "a 1", notes) == "a 1"
    with pytest.raises(DataError, match="receiver: no b, it has a 0, a 1"):
        with_fixes(masks, "b", notes)


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


@pytest.mark.parametrize(
    ("receiver", "estimate"),
    [
        ("/mavros/global_position/raw/fix", "/mavros/global_position/global"),
        ("/gps/fix", "/gps/filtered"),
        ("/fix", "/odometry/gps"),
        ("/gnss", "/ekf/global"),
    ],
)
def test_words_of_a_receivers_topic(receiver, estimate):
    assert receivers_own(receiver) > receivers_own(estimate)


@needs_field
def test_a_rocket_that_falls_freely_is_read():
    rec = read(FIELD / "free_fall_rocket" / "rec")
    found = {f.code: f for f in checkup(rec)}
    assert not found["imu.gravity_size"].bad and "free fall" in found["imu.gravity_size"].means


@pytest.mark.parametrize("bias", [-1.9, 1.9])
def test_an_accelerometer_that_is_far_off_is_a_finding(drive, bias):
    """By 0.19 g: read and said; by a third: refused."""
    off = lambda by: fixes(drive)._replace(
        imu=ImuRows(drive.imu.t, drive.imu.gyro, drive.imu.accel - [0.0, 0.0, by], dt=drive.imu.dt)
    )
    found = {f.code: f for f in checkup(mend.recording(off(bias)))}
    assert found["imu.gravity_size"].bad
    with pytest.raises(DataError, match="must show gravity"):
        mend.recording(off(np.sign(bias) * 3.3))


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


@pytest.mark.parametrize(
    ("text", "a", "b", "words"),
    [
        ("a,b\n1.5,2\n-3.5,4\n", [1.5, -3.5], [2, 4], None),
        ("a;b\n1,5;2\n-3,5;4\n", [1.5, -3.5], [2, 4], "decimal points"),
        ("a\tb\n1,5e-1\t2\n-3,5\t4\n", [0.15, -3.5], [2, 4], "decimal points"),
        ("sep=;\na;b\n1.5;2\n-3.5;4\n", [1.5, -3.5], [2, 4], None),
        (
            "made by X\nrate,30,Hz\na,b\n1.5,2\n-3.5,4\n0.5,6\n1,1\n",
            [1.5, -3.5, 0.5, 1],
            [2, 4, 6, 1],
            "2 lines before",
        ),
        ("a,b\n[m],[s]\n1.5,2\n-3.5,4\n", [1.5, -3.5], [2, 4], "line of units"),
        ("a b\n1.5 2\n-3.5 4\n", [1.5, -3.5], [2, 4], None),
    ],
)
def test_tables_as_people_write_them(tmp_path, text, a, b, words):
    (tmp_path / "x.csv").write_text(text)
    sheet = open_sheet(tmp_path / "x.csv")
    np.testing.assert_array_equal(numbers(sheet, "a"), a)
    np.testing.assert_array_equal(numbers(sheet, "b"), b)
    assert words is None and not sheet.notes or words is not None and any(words in note for note in sheet.notes)
