"""Readers against facts of the files and of physics, writers against their readers."""

import os
import shutil
import struct
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.recordings.navego import datasheet
from jaxnav import io, reading
from jaxnav.checkup.inertial import quiet_force
from jaxnav.io.column_map import described
from jaxnav.io.formats import navego
from jaxnav.maths.axes import local_to_lla, rotation
from jaxnav.maths.units import DEG, G0
from jaxnav.reading.datasets import DATA_DIR, DATASETS
from jaxnav.types import ImuLog, Recording, Samples, Track


def data(name: str) -> Path:
    """The folder of a data set, or a skip that says what to set."""
    folder = os.environ.get(DATA_DIR)
    if not folder or not (Path(folder) / name).is_dir():
        pytest.skip(f"data set {name} not found: set {DATA_DIR} to the folder that holds it")
    return Path(folder) / name


def rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.square(x), axis=0))


def metres(lla: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """(K, 3) east, north, up from reference, with the radii of WGS 84."""
    s = np.sin(reference[:, 0])
    w = np.sqrt(1.0 - 6.69437999014e-3 * s**2)
    meridian, normal = 6378137.0 * (1.0 - 6.69437999014e-3) / w**3, 6378137.0 / w
    d, h = lla - reference, reference[:, 2]
    east = d[:, 1] * (normal + h) * np.cos(reference[:, 0])
    return np.stack([east, d[:, 0] * (meridian + h), d[:, 2]], axis=1)


def interpolate(t: np.ndarray, tp: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(t, tp, column) for column in values.T], axis=1)


def recording(seed: int = 0, n: int = 400) -> Recording:
    """A made-up run at 100 Hz with every stream a file can hold."""
    rng = np.random.default_rng(seed)
    t = 10.0 + 0.01 * np.arange(1, n + 1)
    force = np.array([0.0, 0.0, -9.8]) + 0.01 * rng.normal(size=(n, 3))
    imu = ImuLog(t, np.full(n, 0.01), 0.01 * rng.normal(size=(n, 3)), force)
    k = 8
    tk = 10.0 + 0.4 * np.arange(1, k + 1)
    lla = np.array([0.7, -1.9, 200.0]) + rng.normal(size=(k, 3)) * np.array([1e-6, 1e-6, 1.0])
    corr = 0.5 * rng.uniform(-1.0, 1.0, size=(k, 3))
    aiding = {
        "position": Samples(tk, lla, rng.uniform(1.0, 2.0, size=(k, 3)), corr),
        "velocity": Samples(tk, rng.normal(size=(k, 3)), rng.uniform(0.1, 0.2, size=(k, 3)), -corr),
        "speed": Samples(tk, rng.normal(size=(k, 1)), np.full((k, 1), 0.3), np.zeros((k, 1))),
        "zero_rate": Samples(tk, np.zeros((k, 3)), np.full((k, 3), 0.1), corr),
    }
    rph = rng.uniform(-3.0, 3.0, size=(k, 3))
    rph[2] = np.nan
    truth = Track(tk, lla, aiding["velocity"].value, rph)
    return Recording("made up", imu, aiding, truth, np.array([0.1, -0.2, 0.3]), "two\nlines, µ")


def assert_same(a: Recording, b: Recording) -> None:
    assert (a.name, a.notes, list(sorted(a.aiding))) == (b.name, b.notes, list(sorted(b.aiding)))
    pairs = [(a.imu, b.imu), (a.truth, b.truth), *((a.aiding[name], b.aiding[name]) for name in a.aiding)]
    for left, right in pairs:
        assert (left is None) == (right is None)
        for x, y in zip(left or (), right or ()):
            np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(a.lever_arm, b.lever_arm)


# ---------------------------------------------------------------------------- recorded and reference data


def test_drive_has_the_rows_and_mounting_of_the_data_sheet():
    data("rtkexplorer_drive")
    rec = reading.load("rtkexplorer_drive")
    position, velocity = rec.aiding["position"], rec.aiding["velocity"]
    assert len(rec.imu.t) == 54860 - 2 - 1138 + 1419 and len(position.t) == len(velocity.t) == 2197 - 13
    assert rec.imu.t[-1] - rec.imu.t[0] == pytest.approx(548.731, abs=0.01)  # the last tick of the tag
    still = rec.imu.t < rec.imu.t[0] + 30.0
    np.testing.assert_allclose(rec.imu.accel[still].mean(axis=0), [-0.007, 0.202, -9.932], atol=7e-4)
    whole = io.read_pos(data("rtkexplorer_drive") / "gnss_1934_sf.pos").aiding
    # sdn sde of the file are north first: both are 0.0098995, up 0.01
    np.testing.assert_allclose(whole["position"].sd[0], [0.0098995, 0.0098995, 0.01])
    np.testing.assert_allclose(np.rad2deg(whole["position"].value[0, :2]), [40.0966268, -105.1474483], atol=1e-9)
    np.testing.assert_allclose(whole["velocity"].value[0], [-0.002, 0.010, 0.009])  # east first


def test_drive_body_axes_agree_with_the_motion():
    data("rtkexplorer_drive")
    rec = reading.load("rtkexplorer_drive")
    v, t = rec.aiding["velocity"].value, rec.aiding["velocity"].t
    speed = np.hypot(v[:, 0], v[:, 1])
    assert speed.max() == pytest.approx(16.3, abs=0.1)
    middle = 0.5 * (t[1:] + t[:-1]) - 0.125  # the velocity is 0.125 s old
    kernel = np.ones(25) / 25.0
    force = np.interp(middle, rec.imu.t, np.convolve(rec.imu.accel[:, 0], kernel, "same"))
    rate = np.interp(middle, rec.imu.t, np.convolve(rec.imu.gyro[:, 2], kernel, "same"))
    assert np.corrcoef(force, np.diff(speed) / 0.25)[0, 1] > 0.85
    course = np.diff(np.unwrap(np.arctan2(v[:, 0], v[:, 1]))) / 0.25
    moving = speed[1:] > 3.0
    assert np.corrcoef(rate[moving], course[moving])[0, 1] > 0.98


def test_drive_velocity_is_the_difference_of_the_preceding_positions():
    data("rtkexplorer_drive")
    rec = reading.load("rtkexplorer_drive")
    lla, v = rec.aiding["position"].value, rec.aiding["velocity"].value
    backward = metres(lla[1:], lla[:-1]) / 0.25
    # the file rounds positions to 1e-7 deg, 1 cm
    assert rms(backward - v[1:])[:2].max() < 0.25 * rms(backward - v[:-1])[:2].min()


def test_angles_of_a_mounting_are_the_printed_matrix():
    printed = [[-0.988660, -0.092586, 0.118231], [-0.093239, 0.995644, 0.0], [-0.117716, -0.011024, -0.992986]]
    np.testing.assert_allclose(rotation([180.0, -6.79, 185.35]), printed, atol=6e-7)


def test_ticks_of_a_log_are_stretched_to_its_time_tag(tmp_path):
    ticks = np.arange(0, 100, 10)
    (tmp_path / "log.csv").write_text("".join(f"0.0,0.0,1.0,1.0,2.0,3.0,{1000 + tick}\n" for tick in ticks))
    pairs = np.array([[5, 0], [140, 9]], dtype="<u4").tobytes()
    tag = b"TIMETAG RTKLIB".ljust(64, b"\0") + struct.pack("<Id", 1000, 0.5) + pairs
    (tmp_path / "log.csv.tag").write_bytes(tag)
    imu = {"file": "log.csv", "time": 7, "time_unit": "ms", "time_tag": "log.csv.tag", "time_shift_s": -0.1,
           "skip": [1, 1], "accel": [1, 2, 3], "accel_unit": "g", "gyro": [4, 5, 6], "gyro_unit": "deg/s",
           }  # fmt: skip
    rows = described({"imu": imu}, "map.toml", tmp_path).imu
    np.testing.assert_allclose(rows.t, 1000.4 + np.linspace(0.0, 0.14, 8), atol=1e-12)
    np.testing.assert_allclose(rows.gyro[0], np.array([1.0, 2.0, 3.0]) * DEG)
    np.testing.assert_allclose(rows.accel[0], [0.0, 0.0, G0])


def test_pos_keeps_the_quality():
    pos = io.read_pos(data("rtkexplorer_drive") / "gnss_1934_sf.pos")
    assert np.count_nonzero(pos.quality == 1) == 2189 and set(pos.quality) == {1, 2}
    assert pos.aiding["position"].t[0] == pytest.approx(1752003258.499, abs=1e-6)  # no leap seconds


@pytest.mark.parametrize("imu", ["imu1", "imu2"])
def test_navego_has_its_rows_and_noise(imu):
    data("navego_synthetic")
    rec = reading.load("navego_synthetic", imu=imu)
    truth, position, velocity = rec.truth, rec.aiding["position"], rec.aiding["velocity"]
    assert len(rec.imu.t) == len(truth.t) == 87450 and len(position.t) == 2187
    np.testing.assert_allclose(rec.imu.dt, 0.005, atol=1e-9)
    error = metres(position.value, interpolate(position.t, truth.t, truth.lla))
    np.testing.assert_allclose(rms(error), [5.0432, 5.0104, 9.8534], atol=2e-4)
    error = velocity.value - interpolate(velocity.t, truth.t, truth.vel)
    np.testing.assert_allclose(rms(error), [0.0508, 0.0515, 0.0513], atol=6e-5)
    np.testing.assert_array_equal(position.sd[0], [5.0, 5.0, 10.0])
    np.testing.assert_array_equal(rec.lever_arm, np.zeros(3))


def test_navego_velocity_is_the_rate_of_the_position():
    data("navego_synthetic")
    truth = reading.load("navego_synthetic").truth
    k = np.arange(0, len(truth.t), 20)
    moved = metres(truth.lla[k[1:]], truth.lla[k[:-1]])
    mean = 0.1 * 0.5 * (truth.vel[k[1:]] + truth.vel[k[:-1]])
    assert (rms(moved - mean) < 0.01 * rms(mean)).all()


def test_navego_datasheet_is_float64_without_wraps():
    sheet = datasheet(data("navego_synthetic"), "imu2")
    assert all(field.dtype == np.float64 and field.shape == (3,) for field in sheet)
    np.testing.assert_array_equal(sheet.gb_corr**2, 1e4)  # 16 as uint8
    np.testing.assert_allclose(sheet.gb_sta, 0.2 * DEG, rtol=1e-6)
    np.testing.assert_allclose(sheet.ini_align_err, np.array([0.5, 0.5, 1.0]) * DEG, rtol=1e-6)


def test_umn_has_its_fixes_and_no_placeholder():
    data("umn_thor75")
    rec = reading.load("umn_thor75")
    position, truth = rec.aiding["position"], rec.truth
    assert len(rec.imu.t) == 34811 and len(position.t) == 674 and len(truth.t) == 33473
    assert position.t[0] == pytest.approx(22.041, abs=1e-3) and np.diff(position.t).max() == pytest.approx(
        2.0, abs=0.01
    )
    assert np.rad2deg(position.value[:, 0]).min() > 45.3  # the placeholder is 45
    assert truth.t[0] == pytest.approx(24.8, abs=0.05)
    np.testing.assert_allclose(rec.imu.dt, 0.02, atol=1e-4)
    assert quiet_force(rec.imu) == pytest.approx(9.81, abs=0.1)
    still = rec.imu.t < 170.0
    assert rec.imu.accel[still, 2].mean() == pytest.approx(-9.7, abs=0.2)  # FRD; the tail sits low
    error = metres(interpolate(position.t[5:], truth.t, truth.lla), position.value[5:])
    assert rms(error[:, :2]).max() < 10.0  # radians and degrees, east and north in their places
    error = interpolate(position.t[5:], truth.t, truth.vel) - rec.aiding["velocity"].value[5:]
    assert rms(error).max() < 2.0


def test_kth_is_a_car_whose_wheel_agrees_with_its_positions():
    data("kth_gnss_ins")
    rec = reading.load("kth_gnss_ins")
    position, speed = rec.aiding["position"], rec.aiding["speed"]
    assert (len(rec.imu.t), len(position.t), len(speed.t)) == (29849, 299, 1194)
    gaps = np.diff(rec.imu.t)
    assert gaps.max() == pytest.approx(0.53, abs=1e-9) and rec.imu.t[np.argmax(gaps)] > 146.0
    assert quiet_force(rec.imu) == pytest.approx(9.79, abs=0.05)
    moved = np.linalg.norm(metres(position.value[1:], position.value[:-1])[:, :2], axis=1)
    assert moved.sum() == pytest.approx(2260.0, rel=0.01)
    middle = np.interp(0.5 * (position.t[1:] + position.t[:-1]), speed.t, speed.value[:, 0])
    assert np.mean(moved / np.diff(position.t)) == pytest.approx(np.mean(middle), rel=0.02)


def test_rtk_track_is_an_hour_at_one_hertz():
    track = io.read_rtk_track(data("leador_rtk_track") / "GNSS-RTK.txt")
    assert len(track.t) == 3413 and set(np.diff(track.t)) == {1.0} and track.t[0] == 456250.0
    np.testing.assert_array_equal(track.sd[0], [0.009, 0.010, 0.019])  # the file: north first


@pytest.mark.parametrize("name", [name for name, dataset in DATASETS.items() if not dataset.fixes_only])
def test_every_data_set_loads_by_name(name):
    data(name)
    rec = reading.load(name)
    assert isinstance(rec, Recording) and "position" in rec.aiding


# ---------------------------------------------------------------------------- our own formats, and writers


@pytest.mark.parametrize("file", ["run", "run.npz"])
def test_a_recording_round_trips_to_the_last_bit(tmp_path, file):
    rec = recording()
    io.write_recording(tmp_path / file, rec)
    assert_same(io.read_recording(tmp_path / file), rec)
    assert [path.name for path in tmp_path.iterdir()] == [file]  # no temporary left


def test_a_recording_without_truth_round_trips(tmp_path):
    rec = recording()._replace(truth=None, aiding={})
    for file in ("run", "run.npz"):
        io.write_recording(tmp_path / file, rec)
        back = io.read_recording(tmp_path / file)
        assert back.truth is None and back.aiding == {}


def test_imu_csv_takes_degrees_g_and_increments(tmp_path):
    rec = recording(n=300)
    t, gyro, accel = rec.imu.t, rec.imu.gyro, rec.imu.accel
    forms = {
        "gyro_{}_degps accel_{}_g": np.column_stack([t, gyro / DEG, accel / G0]),
        "dtheta_{}_rad dv_{}_mps": np.column_stack([t, gyro * 0.01, accel * 0.01]),
    }
    for form, columns in forms.items():
        names = ["t_s", *(part.format(axis) for part in form.split() for axis in "xyz")]
        text = "\n".join([",".join(names), *(",".join(map(repr, row)) for row in columns.tolist())]) + "\n"
        (tmp_path / "imu.csv").write_text(text)
        imu = io.read_recording(tmp_path).imu
        np.testing.assert_allclose(imu.gyro, gyro, rtol=1e-8)
        np.testing.assert_allclose(imu.accel, accel, rtol=1e-8)
        np.testing.assert_allclose(imu.dt, 0.01, rtol=1e-8)


def test_pos_round_trips_with_its_correlations(tmp_path):
    rec = recording()
    position, velocity = rec.aiding["position"], rec.aiding["velocity"]
    io.write_pos(tmp_path / "a.pos", position, velocity, quality=2, satellites=9, t0=1752003258.0)
    pos = io.read_pos(tmp_path / "a.pos")
    for name, stream in (("position", position), ("velocity", velocity)):
        back = pos.aiding[name]
        np.testing.assert_allclose(back.t, stream.t + 1752003258.0, atol=1e-6)
        np.testing.assert_allclose(back.value, stream.value, atol=1e-6)
        np.testing.assert_allclose(back.sd, stream.sd, atol=1e-6)
        np.testing.assert_allclose(back.corr, stream.corr, atol=1e-3)
    assert set(pos.quality) == {2} and set(pos.satellites) == {9}
    io.write_pos(tmp_path / "b.pos", position)
    assert list(io.read_pos(tmp_path / "b.pos").aiding) == ["position"]


def test_pos_covariances_are_signed_roots_of_the_named_pairs(tmp_path):
    head = (
        "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
    )
    (tmp_path / "a.pos").write_text(head + "\n" + "2374 243258.5 40 -105 1600 1 9 2.0 1.0 4.0 0.5 -1.0 2.0 0 0\n")
    stream = io.read_pos(tmp_path / "a.pos").aiding["position"]
    assert stream.t[0] == 315964800.0 + 2374 * 604800.0 + 243258.5
    np.testing.assert_array_equal(stream.sd, [[1.0, 2.0, 4.0]])
    np.testing.assert_allclose(stream.corr, [[0.25 / 2.0, 4.0 / 8.0, -1.0 / 4.0]])


def test_kfgins_files_round_trip(tmp_path):
    rec = recording()
    track = rec.truth._replace(rph=np.nan_to_num(rec.truth.rph))
    io.write_kfgins_nav(tmp_path / "a.nav", track, week=2017)
    back = io.read_kfgins_nav(tmp_path / "a.nav")
    for x, y in zip(back, track):
        np.testing.assert_allclose(x, y, atol=1e-6)
    imu = rec.imu
    np.savetxt(tmp_path / "imu.txt", np.column_stack([imu.t, imu.gyro * 0.01, imu.accel * 0.01]), fmt="%.15g")
    back = io.read_kfgins_imu(tmp_path / "imu.txt")
    np.testing.assert_allclose(back.gyro, imu.gyro, rtol=1e-8)
    np.testing.assert_allclose(back.accel, imu.accel, rtol=1e-8)


def test_a_gap_in_increments_holds_the_mean(tmp_path):
    imu = recording().imu
    t = imu.t + 0.2 * (np.arange(len(imu.t)) >= 100)
    np.savetxt(tmp_path / "imu.txt", np.column_stack([t, imu.gyro * 0.01, imu.accel * 0.01]), fmt="%.15g")
    back = io.read_kfgins_imu(tmp_path / "imu.txt")
    assert back.dt[100] == pytest.approx(0.21)
    np.testing.assert_allclose(back.accel, imu.accel, rtol=1e-8)


def test_solution_csv_reads_back_as_truth(tmp_path):
    track = recording().truth
    sd = np.tile(np.arange(1.0, 10.0), (len(track.t), 1))
    io.write_solution(tmp_path / "a.csv", track, "csv", sd)
    names, row = (line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines()[:2])
    cells = dict(zip(names, map(float, row)))
    assert (cells["sd_n_m"], cells["sd_e_m"], cells["sd_vd_mps"]) == (2.0, 1.0, 6.0)
    assert cells["sd_heading_deg"] == pytest.approx(9.0 / DEG)
    assert cells["vd_mps"] == -track.vel[0, 2]
    io.write_csv(tmp_path / "truth.csv", track)
    back, _ = io.read_truth(tmp_path / "truth.csv")
    for x, y in zip(back, track):
        np.testing.assert_allclose(x, y, rtol=1e-14)


def test_kml_is_well_formed_and_escaped(tmp_path):
    rec = recording()
    io.write_kml(tmp_path / "a.kml", rec.truth, rec.aiding["position"], name="a < b & c")
    root = ElementTree.parse(tmp_path / "a.kml").getroot()
    space = "{http://www.opengis.net/kml/2.2}"
    assert root.find(f".//{space}name").text == "a < b & c"
    line = root.find(f".//{space}LineString/{space}coordinates").text.split()
    np.testing.assert_allclose(np.array(line[0].split(","), float), np.rad2deg([-1.9, 0.7, 0.0]) + [0, 0, 200], atol=5)
    assert len(root.findall(f".//{space}Point")) == len(rec.aiding["position"].t)


def test_solution_as_pos_and_nav(tmp_path):
    track = recording().truth._replace(rph=np.zeros((8, 3)))
    sd = np.tile(np.arange(1.0, 10.0), (8, 1))
    io.write_solution(tmp_path / "a.pos", track, "pos", sd)
    np.testing.assert_allclose(io.read_pos(tmp_path / "a.pos").aiding["velocity"].sd[0], [4.0, 5.0, 6.0])
    io.write_solution(tmp_path / "a.nav", track, "nav")
    np.testing.assert_allclose(io.read_kfgins_nav(tmp_path / "a.nav").lla, track.lla, atol=1e-6)


@pytest.mark.parametrize("t0, date", [(0.0, 315964800.0), (1.6e9, 0.0)])
def test_a_pos_solution_has_the_date_of_its_time(tmp_path, t0, date):
    """Seconds that are no date of GPS time count from its start; those that are one are kept."""
    t, zero = t0 + np.arange(3.0), np.zeros((3, 3))
    track = Track(t, np.tile([0.6, 0.2, 50.0], (3, 1)), zero, zero)
    io.write_solution(tmp_path / "s.pos", track, "pos", np.ones((3, 9)))
    np.testing.assert_allclose(io.read_pos(tmp_path / "s.pos").aiding["position"].t, t + date, rtol=0, atol=1e-3)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    io.atomic_write(tmp_path / "a.txt", "old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(io.checks.DataError, match="a.txt.*disk full"):
        io.atomic_write(tmp_path / "a.txt", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"] and (tmp_path / "a.txt").read_text() == "old"


def test_fetch_takes_pinned_files_into_the_cache(tmp_path, monkeypatch):
    import pooch

    source, calls = data("rtkexplorer_drive"), []

    def retrieve(url, known_hash, fname, path):
        calls.append((url, known_hash))
        Path(path).mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / fname, Path(path) / fname)

    monkeypatch.setattr(pooch, "os_cache", lambda project: tmp_path / project)
    monkeypatch.setattr(pooch, "retrieve", retrieve)
    monkeypatch.delenv(DATA_DIR)
    assert (
        reading.fetch("rtkexplorer_drive")
        == reading.locate("rtkexplorer_drive")
        == tmp_path / "jaxnav" / "rtkexplorer_drive"
    )
    dataset = DATASETS["rtkexplorer_drive"]
    assert len(calls) == len(dataset.files)
    assert all(dataset.commit in url and known_hash.startswith("sha256:") for url, known_hash in calls)


def test_a_kfgins_navigation_goes_over_the_end_of_a_week(tmp_path):
    rows = ["2100 604799.5 30.0 114.0 20.0 1 2 3 0 0 90", "2101 0.25 30.0 114.0 20.0 1 2 3 0 0 90"]
    (tmp_path / "truth.nav").write_text("\n".join(rows) + "\n")
    assert np.diff(io.read_kfgins_nav(tmp_path / "truth.nav").t) == pytest.approx(0.75, abs=1e-9)


def test_down_of_a_local_position_is_less_height():
    """And a minute of arc of latitude is a nautical mile."""
    north_down = local_to_lla(np.array([[0.0, 1852.0, -5.0]]), np.array([0.9, 0.3, 100.0]))[0]
    assert north_down[2] == pytest.approx(95.0, abs=0.3) and north_down[0] - 0.9 == pytest.approx(DEG / 60, rel=0.01)


def test_navego_states_its_sd_in_north_east_down(tmp_path):
    gnss = {
        "t": np.array([1.0, 2.0]), "lat": np.full(2, 0.8), "lon": np.full(2, 0.3), "h": np.full(2, 5.0),
        "vel": np.tile([1.0, 2.0, 3.0], (2, 1)), "stdm": np.array([1.0, 2.0, 3.0]), "stdv": np.array([0.1, 0.2, 0.3]),
        "larm": np.zeros(3),
    }  # fmt: skip
    imu = {"t": np.array([1.0, 2.0]), "wb": np.zeros((2, 3)), "fb": np.zeros((2, 3))}
    savemat(tmp_path / "drive.mat", {"gnss": gnss, "imu": imu})
    aiding = navego.read(tmp_path / "drive.mat").aiding
    np.testing.assert_array_equal(aiding["position"].sd, np.tile([2.0, 1.0, 3.0], (2, 1)))
    np.testing.assert_array_equal(aiding["velocity"].sd, np.tile([0.2, 0.1, 0.3], (2, 1)))
    np.testing.assert_array_equal(aiding["velocity"].value[0], [2.0, 1.0, -3.0])
