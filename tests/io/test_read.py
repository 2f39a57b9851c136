"""`read`: recognition, tolerance said aloud, options, and that a new format is one row."""

import json
import shutil

import numpy as np
import pytest

from jaxnav import io
from jaxnav.checkup import checkup
from jaxnav.io import mend, readers
from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.io.readers import Reader, read_parts, recognise
from jaxnav.maths.axes import euler, lla_to_local, local_to_lla, rotation
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.maths.rotations import from_rph, to_dcm
from jaxnav.maths.units import DEG
from jaxnav.reading.read import read
from jaxnav.types import DataError, Track

from .test_formats import assert_same, recording


def parts(n: int = 400, **changes) -> Parts:
    """A made-up recording as rows; fixes within its time, without sd."""
    rec = recording(n=n)
    k = np.arange(0, n, 50)[1:]
    lla = np.tile([0.7, -1.9, 200.0], (len(k), 1)) + np.arange(len(k))[:, None] * 1e-6
    stream = Stream(rec.imu.t[k], lla)
    return Parts("a.log", ImuRows(rec.imu.t, rec.imu.gyro, rec.imu.accel), {"position": stream})._replace(**changes)


def rows(**changes) -> Parts:
    whole = parts()
    return whole._replace(imu=whole.imu._replace(**changes))


# ---------------------------------------------------------------------------- a format is a row


def test_a_reader_of_a_new_format_is_one_row(tmp_path, monkeypatch):
    def is_mine(path, head):
        return head.startswith(b"MADE UP 1\n")

    def read_mine(path, scale=1.0):
        t, *values = np.loadtxt(path, skiprows=1).T
        gyro, accel = np.array(values[:3]).T * scale, np.array(values[3:]).T
        return Parts(str(path), ImuRows(t, gyro, accel), axes="flu")

    monkeypatch.setattr(readers, "READERS", (*readers.READERS, Reader("made up", is_mine, read_mine, ("scale",))))
    imu = recording().imu
    table = np.column_stack([imu.t, imu.gyro, imu.accel * [1.0, -1.0, -1.0]])
    np.savetxt(tmp_path / "x", table, header="MADE UP 1", comments="", fmt="%.17g")
    rec = read(tmp_path / "x", scale=2.0, lever_arm=(1.0, 0.0, 0.0))
    np.testing.assert_allclose(rec.imu.accel, imu.accel)
    np.testing.assert_allclose(rec.imu.gyro, 2.0 * imu.gyro * [1.0, -1.0, -1.0])
    assert rec.lever_arm[0] == 1.0 and rec.name == "x"
    with pytest.raises(DataError, match="x: made up: no option scael: did you mean scale"):
        read(tmp_path / "x", scael=2.0)


def test_a_reader_that_breaks_is_one_error(tmp_path, monkeypatch):
    def breaks(path):
        raise KeyError("inside\nthe format")

    monkeypatch.setattr(readers, "READERS", (Reader("made up", lambda path, head: True, breaks),))
    (tmp_path / "x").write_text("1\n")
    with pytest.raises(DataError, match="x: cannot be read as made up: KeyError: 'inside.*the format'$"):
        read(tmp_path / "x")


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    import sys

    for package in ("pyulog", "rosbags.highlevel", "pyubx2", "pynmeagps"):
        monkeypatch.setitem(sys.modules, package, None)
    contents = {
        "pyulog": b"ULog\x01\x12\x35" + bytes(20),
        "rosbags.highlevel": b"#ROSBAG V2.0\n",
        "pynmeagps": b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n",
    }
    for package, content in contents.items():
        (tmp_path / "x").write_bytes(content)
        with pytest.raises(DataError, match=rf"x: .* needs the package {package}: pip install"):
            read(tmp_path / "x")


def test_files_of_no_known_format_say_what_to_do(tmp_path):
    file = tmp_path / "a.csv"
    with pytest.raises(DataError, match="a.csv: cannot be read"):
        read(file)
    file.write_bytes(b"")
    with pytest.raises(DataError, match="a.csv: is empty"):
        read(file)
    file.write_text("time,wx,wy\n1,2,3\n2,3,4\n")
    with pytest.raises(DataError, match=r"a.csv: a table that no reader knows.*column map.*time, wx, wy"):
        read(file)
    file.write_bytes(bytes(range(256)))
    with pytest.raises(DataError, match="a.csv: of no known format: .*ROS bag"):
        read(file)
    with pytest.raises(DataError, match="a folder of no known format, with a.csv"):
        read(tmp_path)
    np.save(tmp_path / "a.npy", np.zeros((5, 6)))
    with pytest.raises(DataError, match="a.npy: a table that no reader knows"):
        read(tmp_path / "a.npy")


def test_formats_are_known_by_their_contents(tmp_path):
    imu = recording().imu
    table = np.column_stack([imu.t, imu.gyro * 0.01, imu.accel * 0.01])
    np.savetxt(tmp_path / "a.dat", table, fmt="%.15g")
    np.savetxt(tmp_path / "b.dat", np.tile([0, 48.0, 11.0, 500.0, 1.0, 1.0, 2.0], (9, 1)) + np.eye(9, 7) * 0, fmt="%g")
    assert recognise(tmp_path / "a.dat").name == "KF-GINS IMU"
    assert recognise(tmp_path / "b.dat").name == "KF-GINS GNSS"
    io.write_recording(tmp_path / "c.dat.npz", recording())
    (tmp_path / "c.dat.npz").rename(tmp_path / "c.dat")
    assert recognise(tmp_path / "c.dat").name == "our .npz"
    io.write_recording(tmp_path / "d", recording())
    assert recognise(tmp_path / "d").name == "our folder of CSV"
    assert recognise(tmp_path / "d" / "imu.csv").name == "our imu.csv"


# ---------------------------------------------------------------------------- tolerance, said aloud


def test_a_usable_recording_has_nothing_said_but_the_sd():
    rec = mend.mended(parts())
    assert rec.remarks == "" and rec.notes.endswith("There is no velocity: position only.")
    assert [(f.code, f.subject) for f in rec.findings] == [("stream.assumed_sd", "position"), ("velocity.none", "")]
    assert checkup(rec)[0] == rec.findings[0] and "assumed are 3, 3, 6 m" in rec.findings[0].message
    np.testing.assert_allclose(rec.imu.t, recording().imu.t)
    np.testing.assert_allclose(rec.imu.dt, 0.01)


def test_gaps_stay_gaps():
    imu = parts().imu
    t = imu.t + 30.0 * (np.arange(400) >= 200) + 0.1 * (np.arange(400) >= 300)
    rec = mend.mended(rows(t=t))
    np.testing.assert_allclose(rec.imu.dt, 0.01, atol=1e-9)
    assert rec.imu.t[200] - rec.imu.dt[200] - rec.imu.t[199] == pytest.approx(30.0)
    assert "The IMU has 2 gaps, the longest 30 s long, 2.0 s after its start." in rec.notes


def test_gaps_are_for_some_rows_and_not_for_all():
    imu = recording().imu
    short = imu._replace(dt=np.where(np.arange(400) % 20 == 5, 0.5, 1.0) * imu.dt)
    io.check_imu(short, io.files.Source("x"))
    with pytest.raises(DataError, match="x: imu row 1: .*expected dt the time since the row before"):
        io.check_imu(imu._replace(dt=0.5 * imu.dt), io.files.Source("x"))


def test_a_lost_sample_is_covered_by_the_next():
    t = np.delete(np.arange(1, 402) * 0.01, 100)
    rec = mend.mended(rows(t=t)._replace(aiding={}))
    assert rec.imu.dt[100] == pytest.approx(0.02) and rec.notes == ""


@pytest.mark.parametrize("count, verb", [(1, "note"), (100, "error")])
def test_rows_that_cannot_be_read(count, verb):
    gyro = parts().imu.gyro.copy()
    gyro[50 : 50 + count, 1] = np.nan
    if verb == "error":
        with pytest.raises(DataError, match="a.log: row 50: imu: 100 of 400 rows that cannot be read"):
            mend.mended(rows(gyro=gyro))
    else:
        rec = mend.mended(rows(gyro=gyro))
        assert len(rec.imu.t) == 399 and "1 of 400 rows that cannot be read are left out, the first at row" in rec.notes


def test_repeated_and_swapped_and_wild_times():
    t = parts().imu.t.copy()
    t[10] = t[9]
    t[20], t[21] = t[21], t[20]
    t[30] = 1e9
    rec = mend.mended(rows(t=t))
    assert len(rec.imu.t) == 397 and (np.diff(rec.imu.t) > 0).all()
    assert "1 of 400 rows at the time of the row before" in rec.notes
    assert "2 of 400 rows with a time before the row before" in rec.notes


def test_reversed_times_are_refused():
    with pytest.raises(DataError, match="a.log: row 1: imu: 399 of 400 rows with a time before the row before"):
        mend.mended(rows(t=parts().imu.t[::-1]))


def test_a_clock_that_was_set_during_the_recording():
    t = parts().imu.t + 1.7e9 * (np.arange(400) >= 5)
    rec = mend.mended(rows(t=t)._replace(aiding={}))
    assert len(rec.imu.t) == 395 and "5 rows that are more than an hour from the rest" in rec.notes
    assert rec.imu.t[0] == pytest.approx(0.01) and "t = 0 is 17" in rec.notes


def test_polled_rows_are_counted():
    gyro, accel = (np.repeat(v[::2], 2, axis=0) for v in (parts().imu.gyro, parts().imu.accel))
    assert "imu: 200 of 400 rows repeat the row before" in mend.mended(rows(gyro=gyro, accel=accel)).notes


def test_fixes_outside_the_imu_and_without_sd():
    whole = parts()
    fixes = whole.aiding["position"]
    early = fixes._replace(t=fixes.t - 1.0, sd=np.where(np.arange(7)[:, None] == 5, np.nan, [1.0, 1.0, 2.0]))
    rec = mend.mended(whole._replace(aiding={"position": early}))
    assert "position: 1 of 7 rows are before the IMU's first sample or after its last." in rec.notes
    assert "position: 1 of 7 rows without a usable sd are left out." in rec.notes
    assert len(rec.aiding["position"].t) == 5
    late = mend.mended(whole._replace(aiding={"position": fixes._replace(t=fixes.t + 100.0)}))
    assert "position" not in late.aiding and "no row is left" in late.notes


def test_times_in_milliseconds_are_said():
    """Of the fixes alone they lie outside of the IMU's time; of the IMU they are no samples of an IMU."""
    whole = parts()
    fixes = whole.aiding["position"]
    off = fixes._replace(t=1000 * (fixes.t - fixes.t[0]) + 50.0)
    rec = mend.mended(whole._replace(aiding={"position": off}))
    assert "position" not in rec.aiding and "milliseconds? set time_unit" in rec.notes
    with pytest.raises(DataError, match="times in milliseconds"):
        mend.mended(rows(t=1000 * whole.imu.t)._replace(aiding={}))


def test_gravity_on_the_wrong_axis_is_said():
    accel = parts().imu.accel
    assert "look like 'flu'" in mend.mended(rows(accel=accel * [1, -1, -1])).notes
    assert "mounted on its side" in mend.mended(rows(accel=accel[:, [1, 2, 0]])).notes


def test_increments_and_instantaneous_values():
    imu = parts().imu
    rec = mend.mended(rows(gyro=imu.gyro * 0.01, accel=imu.accel * 0.01, sampling="increments"))
    np.testing.assert_allclose(rec.imu.gyro, imu.gyro, rtol=1e-9)
    t = imu.t + 1.0 * (np.arange(400) >= 200)
    rec = mend.mended(rows(t=t, sampling="instantaneous"))
    np.testing.assert_allclose(rec.imu.gyro[1:200], 0.5 * (imu.gyro[1:200] + imu.gyro[:199]))
    np.testing.assert_allclose(rec.imu.gyro[200], imu.gyro[200])  # no neighbour behind the gap


def test_seconds_of_the_week_beside_seconds_since_1970():
    whole = parts()
    fixes = whole.aiding["position"]
    week = GPS_EPOCH + 2000 * WEEK
    rec = mend.mended(whole._replace(aiding={"position": fixes._replace(t=fixes.t + week)}))
    np.testing.assert_allclose(rec.aiding["position"].t, fixes.t, atol=1e-6)
    assert "seconds of GPS week 2000" in rec.notes


def test_a_cut_last_line_of_our_own_folder_is_said(tmp_path):
    io.write_recording(tmp_path / "run", recording())
    file = tmp_path / "run" / "imu.csv"
    file.write_text(file.read_text()[:-9])
    rec = read(tmp_path / "run")
    assert len(rec.imu.t) == 399 and "imu.csv: the last line has no line end" in rec.notes


def test_a_misspelt_file_is_said(tmp_path):
    io.write_recording(tmp_path / "run", recording())
    (tmp_path / "run" / "velocity.csv").rename(tmp_path / "run" / "vel.csv")
    (tmp_path / "run" / "lidar.csv").write_text("t\n1\n")
    rec = read(tmp_path / "run")
    assert "vel.csv is not read; did you mean velocity.csv?" in rec.notes
    assert "lidar.csv is not read." in rec.notes and "velocity" not in rec.aiding


@pytest.mark.parametrize("file", ["run", "run.npz"])
def test_written_files_are_read(tmp_path, file):
    rec = recording()
    io.write_recording(tmp_path / file, rec)
    assert_same(read(tmp_path / file), rec)


def test_options_of_a_recording(tmp_path):
    io.write_recording(tmp_path / "run", recording())
    rec = read(tmp_path / "run", sd={"position": [1.0, 2.0, 3.0]}, axes="x,-y,-z", time_shift_s=0.005, name="me")
    np.testing.assert_array_equal(rec.aiding["position"].sd[3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(rec.imu.accel, recording().imu.accel * [1, -1, -1])
    assert rec.name == "me" and rec.imu.t[0] == pytest.approx(recording().imu.t[0] + 0.005)
    with pytest.raises(DataError, match="sd: no stream positoin"):
        read(tmp_path / "run", sd={"positoin": 1.0})
    with pytest.raises(DataError, match="sd: position: expected 1 or 3 numbers"):
        read(tmp_path / "run", sd={"position": [1.0, 2.0]})


def test_fixes_of_another_file_beside_an_imu(tmp_path):
    rec = recording()
    io.write_recording(tmp_path / "run", rec)
    position = rec.aiding["position"]._replace(corr=np.zeros((8, 3)))
    io.write_pos(tmp_path / "a.pos", position, t0=1e9)
    shutil.copyfile(tmp_path / "run" / "imu.csv", tmp_path / "imu.csv")
    both = read(tmp_path / "imu.csv", gnss=tmp_path / "a.pos", time_shift_s=1e9)
    assert set(both.aiding) == {"position"}
    np.testing.assert_allclose(both.aiding["position"].value, position.value, atol=1e-8)
    with pytest.raises(DataError, match=r"a.pos: holds position and no IMU: read the IMU's file with gnss='.*a.pos'"):
        read(tmp_path / "a.pos")
    assert read_parts(tmp_path / "a.pos").imu is None


# ---------------------------------------------------------------------------- axes


def test_axes_in_every_spelling():
    v = np.array([1.0, 2.0, 3.0])
    for text, expected in [
        ("frd", v), ("flu", [1, -2, -3]), ("rfu", [2, 1, -3]), ("x,-y,-z", [1, -2, -3]), ("-z,x,-y", [-3, 1, -2]),
        ("rub", [-3, 1, -2]), ([180.0, 0.0, 0.0], [1, -2, -3]), ([0.0, 0.0, 90.0], [2, -1, 3]),
    ]:  # fmt: skip
        np.testing.assert_allclose(rotation(text) @ v, expected, atol=1e-12)
    np.testing.assert_allclose(rotation([10.0, 20.0, 30.0]), euler(np.array([10.0, 20.0, 30.0]) * DEG))
    for bad in ("fru", "x,y", "abc", "x,x,z", [1.0, 2.0], "ffd"):
        with pytest.raises(DataError, match="axes: expected"):
            rotation(bad)


def test_local_metres_there_and_back():
    from pymap3d import enu2geodetic

    enu = np.array([[0.0, 0.0, 0.0], [1000.0, -2000.0, 50.0], [-5e4, 3e4, 1e3]])
    origin = np.array([0.8, -2.0, 300.0])
    lla = local_to_lla(enu, origin)
    expected = np.stack(enu2geodetic(*enu.T, *origin, deg=False), axis=1)
    np.testing.assert_allclose(lla / [1e-6, 1e-6, 1.0], expected / [1e-6, 1e-6, 1.0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(lla_to_local(lla, origin), enu, atol=1e-6)


# ---------------------------------------------------------------------------- writers


def track() -> Track:
    t = np.arange(5.0)
    lla = local_to_lla(np.stack([10 * t, 20 * t, t], axis=1), np.array([0.8, 0.2, 100.0]))
    rph = np.stack([0.1 * t, -0.2 * t, 1.0 + t], axis=1)
    return Track(t, lla, np.zeros((5, 3)), rph)


def test_geojson_has_the_line_and_the_fixes(tmp_path):
    io.write_geojson(tmp_path / "a.geojson", track(), recording().aiding["position"], name="run")
    read_back = json.loads((tmp_path / "a.geojson").read_text())
    line, points = read_back["features"]
    assert line["geometry"]["type"] == "LineString" and points["geometry"]["type"] == "MultiPoint"
    np.testing.assert_allclose(
        np.array(line["geometry"]["coordinates"])[:, :2] * DEG, track().lla[:, [1, 0]], atol=1e-11
    )
    assert line["properties"]["name"] == "run" and len(points["properties"]["t_s"]) == 8
    io.write_solution(tmp_path / "b.geojson", track(), "geojson")
    assert len(json.loads((tmp_path / "b.geojson").read_text())["features"]) == 1


def test_tum_is_body_flu_in_enu(tmp_path):
    io.write_solution(tmp_path / "a.tum", track(), "tum")
    table = np.loadtxt(tmp_path / "a.tum")
    np.testing.assert_allclose(table[:, 1:4], np.arange(5.0)[:, None] * [10, 20, 1], atol=1e-5)
    for row, rph in zip(table, track().rph):
        C = np.asarray(to_dcm(row[[7, 4, 5, 6]]))  # FLU -> ENU
        expected = np.asarray(to_dcm_of(rph)) @ np.diag([1.0, -1.0, -1.0])
        np.testing.assert_allclose(C, expected, atol=1e-9)
    with pytest.raises(DataError, match="a.tum: .*nan"):
        io.write_tum(tmp_path / "a.tum", track()._replace(rph=np.full((5, 3), np.nan)))


def to_dcm_of(rph: np.ndarray) -> np.ndarray:
    """Body FRD -> ENU."""
    return from_rph(rph)


def test_every_reader_has_a_name_of_its_own():
    names = [row.name for row in readers.READERS]
    assert len(set(names)) == len(names)


def test_a_written_recording_says_each_note_once(tmp_path):
    rec = mend.mended(parts())
    io.write_recording(tmp_path / "again", rec)
    again = read(tmp_path / "again")
    assert "There is no velocity: position only." in again.remarks and again.findings
    assert sorted(set(again.notes.splitlines())) == sorted(again.notes.splitlines())
