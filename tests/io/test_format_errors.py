"""Bad input gives exactly one DataError that names the file and the line or field; never another exception."""

import hashlib
import struct
from pathlib import Path

import numpy as np
import pytest

from jaxnav import io, reading
from jaxnav.io.formats import navego
from jaxnav.io.formats.rtklib import read_tag
from jaxnav.maths.units import DEG, G0
from jaxnav.reading import datasets
from jaxnav.reading.datasets import DATA_DIR, DataFile, Dataset
from jaxnav.types import DataError

from .test_formats import recording

POS_HEAD = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio\n"
)
POS_ROW = "2025/07/08 19:34:{:06.3f} 40.0 -105.0 1600.0 1 9 1.0 1.0 2.0 0.1 -0.1 0.1 0.0 0.0\n"


@pytest.fixture
def folder(tmp_path) -> Path:
    """A good recording in CSV files, to be damaged."""
    io.write_recording(tmp_path / "run", recording())
    return tmp_path / "run"


def edit(file: Path, line: int, column: str, cell: str) -> None:
    """Put text into one cell; lines count from 1, the header is line 1."""
    lines = file.read_text().splitlines()
    cells = lines[line - 1].split(",")
    cells[lines[0].split(",").index(column)] = cell
    lines[line - 1] = ",".join(cells)
    file.write_text("\n".join(lines) + "\n")


def error(path: Path, read=io.read_recording) -> str:
    with pytest.raises(DataError) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("file", "line", "column", "cell", "expected"),
    [
        ("imu", 7, "t_s", "10.0", "time later"),
        ("imu", 7, "gyro_x_radps", "nan", "finite"),
        ("imu", 7, "accel_z_mps2", "inf", "finite"),
        ("imu", 7, "accel_z_mps2", "-9.8x", "a number"),
        ("imu", 7, "accel_z_mps2", "1_0", "a number"),
        ("imu", 7, "accel_z_mps2", "", "a number"),
        ("imu", 7, "gyro_y_radps", "36.0", "rad/s"),
        ("imu", 7, "dt_s", "0.0", "dt in"),
        ("imu", 7, "dt_s", "0.5", "time since"),
        ("position", 3, "t_s", "10.4", "time later"),
        ("position", 3, "sd_n_m", "0.0", "sd > 0"),
        ("position", 3, "sd_n_m", "-1.0", "sd > 0"),
        ("position", 3, "lat_rad", "40.1", "latitude"),
        ("position", 3, "lon_rad", "-105.1", "longitude"),
        ("position", 3, "corr_en", "1.0", "correlations"),
        ("velocity", 3, "vu_mps", "nan", "finite"),
        ("speed", 3, "sd_mps", "0", "sd > 0"),
        ("truth", 3, "ve_mps", "nan", "finite"),
        ("truth", 3, "heading_rad", "320.0", "heading"),
    ],
)
def test_a_bad_cell_is_named_by_file_and_line(folder, file, line, column, cell, expected):
    edit(folder / f"{file}.csv", line, column, cell)
    message = error(folder)
    assert f"{file}.csv: line {line}: " in message and expected in message


def test_correlations_that_no_covariance_has(folder):
    for column in ("corr_en", "corr_nu", "corr_ue"):
        edit(folder / "position.csv", 4, column, "-0.9")
    assert "position.csv: line 4: " in (message := error(folder)) and "positive definite" in message


@pytest.mark.parametrize(
    ("scale", "guess"), [((1.0, 1.0 / G0), "looks like g "), ((0.01, 0.01), "increments"), ((1.0, 3.28084), "feet")]
)
def test_wrong_units_of_the_imu_are_guessed(folder, scale, guess):
    rec = recording()
    imu = rec.imu._replace(gyro=rec.imu.gyro * scale[0], accel=rec.imu.accel * scale[1])
    with pytest.raises(DataError, match=f"made up: imu accel must show gravity.*{guess}"):
        io.check_recording(rec._replace(imu=imu))


def test_a_steady_turn_is_not_taken_for_rest():
    rec = recording(n=1000)
    turn = np.arange(1000) < 500  # perfectly constant, 14 m/s^2, 0.5 rad/s; then noisy rest
    accel = np.where(turn[:, None], [0.0, 10.0, -9.8], rec.imu.accel + 0.3 * np.sin(np.arange(1000))[:, None])
    gyro = np.where(turn[:, None], [0.0, 0.0, 0.5], rec.imu.gyro)
    io.check_imu(rec.imu._replace(accel=accel, gyro=gyro), io.files.Source("x"))


def test_gyro_in_degrees_per_second():
    rec = recording()
    imu = rec.imu._replace(gyro=np.full_like(rec.imu.gyro, 1.0 / DEG))
    with pytest.raises(DataError, match="made up: imu row 0: .*degrees per second"):
        io.check_recording(rec._replace(imu=imu))


def test_an_infinite_value_in_memory():
    rec = recording()
    velocity = rec.aiding["velocity"]
    velocity = velocity._replace(value=np.where(np.arange(8)[:, None] == 3, np.inf, velocity.value))
    with pytest.raises(DataError, match="made up: row 3: expected velocity value finite"):
        io.check_recording(rec._replace(aiding={"velocity": velocity}))


def test_streams_with_another_zero_of_time():
    rec = recording()
    position = rec.aiding["position"]
    with pytest.raises(DataError, match="position runs from 1010.* zero of time"):
        io.check_recording(rec._replace(aiding={"position": position._replace(t=position.t + 1000.0)}))


def test_missing_and_doubled_columns(folder):
    text = (folder / "position.csv").read_text()
    (folder / "position.csv").write_text(text.replace("sd_u_m", "sd_up"))
    assert "position.csv: expected one column sd_u_m" in error(folder)
    (folder / "position.csv").write_text(text.replace("sd_u_m", "sd_n_m"))
    assert "position.csv: line 1: a column name stands twice" in error(folder)
    (folder / "position.csv").write_text(text.replace("h_m", "lat_deg"))
    assert "position.csv: expected one column lat_rad or lat_deg" in error(folder)
    (folder / "position.csv").write_text("\n".join(text.splitlines()[1:]) + "\n")
    assert "position.csv: line 1: expected a header" in error(folder)


def test_cut_empty_binary_and_absent_files(folder):
    file = folder / "imu.csv"
    text = file.read_text()
    file.write_text(text[:-9])  # inside the last number: every cell still reads
    assert "imu.csv: line 401: has no line end" in error(folder)
    file.write_text(text.rsplit(",", 2)[0] + "\n")
    assert "imu.csv: line 401: expected 8 columns, got 6" in error(folder)
    for content, expected in [("", "empty"), ("t_s\n", "no rows")]:
        file.write_text(content)
        assert "imu.csv: " in (message := error(folder)) and expected in message
    file.write_bytes(b"t_s\n1\n\xff\xfe\n")
    assert "imu.csv: line 3: expected UTF-8" in error(folder)
    file.unlink()
    assert "imu.csv: cannot be read" in error(folder)
    assert "nowhere: cannot be read" in error(folder / "nowhere")


def test_damaged_recording_json(folder):
    for text in (
        "{",
        "[]",
        '{"lever_arm_frd_m": [1, 2]}',
        '{"name": 3}',
        '{"nmae": "x"}',
        '{"lever_arm_frd_m": [1, 2, 1e999]}',
    ):
        (folder / "recording.json").write_text(text)
        error(folder)


def test_too_large_a_file_is_refused_before_reading(folder, monkeypatch):
    monkeypatch.setattr(io.files, "MAX_BYTES", 1000)
    assert "imu.csv: " in (message := error(folder)) and "at most 1000" in message


def test_an_existing_folder_is_not_mixed_with_a_new_recording(folder):
    with pytest.raises(DataError, match="run: exists"):
        io.write_recording(folder, recording())


# ---------------------------------------------------------------------------- npz


def save(path: Path, **changes) -> Path:
    io.write_recording(path, recording())
    with np.load(path) as arrays:
        kept = {key: array for key, array in arrays.items() if key not in changes}
    np.savez(path, **kept, **{key: array for key, array in changes.items() if array is not None})
    return path


def test_npz_with_missing_misshapen_or_object_arrays(tmp_path):
    path = tmp_path / "run.npz"
    assert "run.npz: expected an array imu/gyro" in error(save(path, **{"imu/gyro": None}))
    assert "run.npz" in error(save(path, **{"imu/gyro": np.zeros((3, 3))}))
    assert "imu/gyro" in error(save(path, **{"imu/gyro": np.zeros((400, 3), dtype=int)}))
    assert "imu/gyro" in error(save(path, **{"imu/gyro": np.array([{}], dtype=object)}))
    assert "lever_arm" in error(save(path, lever_arm=np.full(3, 1e4)))
    assert "lever_arm" in error(save(path, lever_arm=np.full(3, np.nan)))


def test_npz_header_that_asks_for_more_memory_than_there_is(tmp_path):
    import zipfile

    path = tmp_path / "run.npz"
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }"
    header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("imu/gyro.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    assert "imu/gyro.npy: expected floats" in error(path)


# ---------------------------------------------------------------------------- foreign formats


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (POS_HEAD + POS_ROW.format(1) + POS_ROW.format(1), "line 3: position: expected time later"),
        (POS_HEAD + POS_ROW.format(1).replace("1.0 1.0", "0.0 1.0"), "line 2: position: expected sd > 0"),
        (POS_HEAD + POS_ROW.format(1).replace("40.0", "140.0"), "line 2: position: expected latitude"),
        (POS_HEAD + POS_ROW.format(1).replace("40.0", "nan"), "line 2: column latitude: expected a finite number"),
        (POS_HEAD + POS_ROW.format(1).replace("0.1", "9.1"), "line 2: position: expected a covariance below"),
        (POS_HEAD + POS_ROW.format(1).replace("07/08", "13/08"), "line 2: expected a time"),
        (POS_HEAD + POS_ROW.format(1)[:-5] + "\n", "line 2: expected 13 columns, got 12"),
        (POS_HEAD + POS_ROW.format(1)[:-1], "line 2: has no line end"),
        (POS_HEAD.replace("GPST", "TAI") + POS_ROW.format(1), "expected times in GPST, UTC, JST, got TAI"),
        (
            POS_HEAD.replace("latitude(deg)", "x-ecef(m)") + POS_ROW.format(1),
            "expected columns latitude(deg) longitude(deg) height(m), x-ecef(m)",
        ),
        (POS_HEAD.replace("sdne(m)", "extra") + POS_ROW.format(1), "expected a column sdne"),
        (POS_ROW.format(1), "expected a header line"),
        (POS_HEAD, "has no rows"),
    ],
)
def test_bad_pos_files(tmp_path, text, expected):
    (tmp_path / "a.pos").write_text(text)
    message = error(tmp_path / "a.pos", io.read_pos)
    assert "a.pos: " in message and expected in message


@pytest.mark.parametrize("reader", [io.read_kfgins_imu, io.read_kfgins_gnss, io.read_kfgins_nav])
def test_bad_kfgins_files(tmp_path, reader):
    file = tmp_path / "a.txt"
    width = 11 if reader is io.read_kfgins_nav else 7
    for text, expected in [
        ("1 2 3\n", f"line 1: expected {width} columns, got 3"),
        (" ".join(["1"] * (width - 1)) + " x\n", f"line 1: column {width}: expected a number"),
        (" ".join(["1"] * width) + "\n" + " ".join(["1"] * width) + "\n", "line 2: "),
    ]:
        file.write_text(text)
        message = error(file, reader)
        assert "a.txt: " in message and expected in message


def test_writers_refuse_what_their_format_cannot_hold(tmp_path):
    track = recording().truth
    with pytest.raises(DataError, match="a.nav.*attitude|a.nav.*heading"):
        io.write_solution(tmp_path / "a.nav", track, "nav")
    with pytest.raises(DataError, match="a.pos.*standard deviations"):
        io.write_solution(tmp_path / "a.pos", track, "pos")
    with pytest.raises(DataError, match="a.csv: sd must have shape"):
        io.write_csv(tmp_path / "a.csv", track, np.zeros((3, 9)))
    with pytest.raises(DataError, match="format must be one of"):
        io.write_solution(tmp_path / "a.x", track, "x")
    with pytest.raises(DataError, match="cannot be written"):
        io.write_csv(tmp_path / "no" / "a.csv", track)
    assert list(tmp_path.iterdir()) == []


def time_tag(ticks: np.ndarray) -> bytes:
    """An RTKLIB time tag of ticks, ms, each 5 ms later in the file."""
    pairs = np.column_stack([ticks + 5, ticks]).astype("<u4").tobytes()
    return b"TIMETAG RTKLIB".ljust(64, b"\0") + struct.pack("<Id", 1752003261, 0.5) + pairs


def test_a_damaged_time_tag(tmp_path):
    good = time_tag(np.arange(0, 400, 10))
    for bad in (good[:-3], good[:70], b"nothing", good[:76]):
        (tmp_path / "log.tag").write_bytes(bad)
        assert "log.tag: byte " in error(tmp_path / "log.tag", read_tag)


def test_matlab_files_that_are_none_or_lack_a_field(tmp_path):
    from scipy.io import savemat

    file, t = tmp_path / "a.mat", np.arange(5.0)
    file.write_bytes(b"MATLAB 5.0" + bytes(500))
    assert "a.mat: cannot be read as a MATLAB file" in error(file, navego.read)
    savemat(file, {"imu": {"t": t, "wb": np.zeros((4, 3)), "fb": np.zeros((5, 3))}})
    assert "a.mat: field wb: expected shape" in error(file, navego.read)
    savemat(file, {"imu": {"t": np.array(["a", "b"]), "wb": np.zeros((2, 3)), "fb": np.zeros((2, 3))}})
    assert "a.mat: field t: expected numbers" in error(file, navego.read)
    imu, gnss = {"t": t, "wb": np.zeros((5, 3)), "fb": np.zeros((5, 3))}, dict.fromkeys(("t", "lat", "stdm", "vel"), t)
    savemat(file, {"imu": imu, "gnss": gnss})
    assert "a.mat: expected a field lon" in error(file, navego.read)


# ---------------------------------------------------------------------------- data sets


def test_absent_and_unknown_data_sets_say_what_to_do(tmp_path, monkeypatch):
    import pooch

    monkeypatch.setattr(pooch, "os_cache", lambda project: tmp_path / "cache")
    monkeypatch.setenv(DATA_DIR, str(tmp_path))
    assert "`jaxnav data fetch umn_thor75`" in error("umn_thor75", reading.load)
    assert "did you mean umn_thor75?" in error("umn_thor57", reading.load)


def test_a_changed_data_set_is_refused(tmp_path, monkeypatch):
    content = b"1 2 3\n"
    file = DataFile("a.txt", "a.txt", hashlib.sha256(content).hexdigest(), len(content))
    monkeypatch.setitem(datasets.DATASETS, "small", Dataset("a/b", "0", "none", (file,), fixes_only=True))
    monkeypatch.setenv(DATA_DIR, str(tmp_path))
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / "a.txt").write_bytes(content)
    assert reading.verify("small") == tmp_path / "small"
    assert "has no IMU" in error("small", reading.load)
    (tmp_path / "small" / "a.txt").write_bytes(b"1 2 4\n")
    assert "a.txt: expected sha256" in error("small", reading.load)


def test_a_failed_download_is_one_error(tmp_path, monkeypatch):
    import pooch

    def retrieve(*_, **__):
        raise ConnectionError("no route")

    monkeypatch.setattr(pooch, "os_cache", lambda project: tmp_path)
    monkeypatch.setattr(pooch, "retrieve", retrieve)
    assert "cannot be fetched: no route" in error("kth_gnss_ins", reading.fetch)


def test_float32_arrays_are_refused(tmp_path):
    io.write_recording(tmp_path / "rec.npz", recording())
    arrays = dict(np.load(tmp_path / "rec.npz"))
    arrays["aiding/position/value"] = arrays["aiding/position/value"].astype(np.float32)
    np.savez(tmp_path / "small.npz", **arrays)
    with pytest.raises(DataError, match=r"small\.npz: aiding/position/value\.npy: expected float64, got float32"):
        io.read_recording(tmp_path / "small.npz")
