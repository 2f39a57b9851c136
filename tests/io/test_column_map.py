"""A column map: every key does what the page says, and every mistake is one sentence."""

import re
import shutil
import tomllib
import zipfile
from pathlib import Path

import chex
import numpy as np
import pytest
from scipy.io import savemat

from jaxnav.io.column_map import KEYS, TOP
from jaxnav.io.files import format_csv
from jaxnav.io.readers import READERS, read_parts
from jaxnav.io.units import UNITS, pressure_height
from jaxnav.maths.axes import enu_to_ecef, local_to_lla, rotation
from jaxnav.maths.gps_time import GPS_EPOCH
from jaxnav.maths.units import DEG, G0
from jaxnav.measurements import with_data
from jaxnav.reading.read import read
from jaxnav.types import DataError

from .test_formats import recording

EXAMPLES = Path(__file__).parents[2] / "examples"

IMU = """[imu]
file = "imu.csv"
time = "t"
gyro = ["wx", "wy", "wz"]
gyro_unit = "rad/s"
accel = ["fx", "fy", "fz"]
accel_unit = "m/s^2"
"""


def imu_table() -> np.ndarray:
    imu = recording().imu
    return np.column_stack([imu.t, imu.gyro, imu.accel])


NAMES = ["t", "wx", "wy", "wz", "fx", "fy", "fz"]


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "imu.csv").write_text(format_csv(NAMES, imu_table()))
    return tmp_path


def mapped(folder: Path, text: str, **options):
    (folder / "map.toml").write_text(text)
    return read(folder / "map.toml", **options)


def error(folder: Path, text: str) -> str:
    with pytest.raises(DataError) as caught:
        mapped(folder, text)
    return str(caught.value)


def test_the_imu_of_a_map(folder):
    rec = mapped(folder, 'name = "run"\nlever_arm_frd_m = [1.0, 2.0, 3.0]\nnotes = "Said by hand."\n' + IMU)
    np.testing.assert_array_equal(rec.imu.gyro, recording().imu.gyro)
    np.testing.assert_array_equal(rec.lever_arm, [1.0, 2.0, 3.0])
    assert rec.name == "run" and rec.notes == "Said by hand." and rec.aiding == {}


@pytest.mark.parametrize(
    "old, new, gyro, accel",
    [
        ('"rad/s"', '"deg/s"', DEG, 1.0),
        ('"m/s^2"', '"g"', 1.0, G0),
        ('"m/s^2"', '"mg"', 1.0, 1e-3 * G0),
        ('["fx"', 'axes = "flu"\naccel = ["fx"', 1.0, 1.0),
    ],
)
def test_units_and_axes_of_the_imu(folder, old, new, gyro, accel):
    table = imu_table()
    turn = rotation("flu") if "flu" in new else np.eye(3)
    table[:, 1:4] = table[:, 1:4] @ turn / gyro
    table[:, 4:] = table[:, 4:] @ turn / accel
    (folder / "imu.csv").write_text(format_csv(NAMES, table))
    text = IMU.replace('accel = ["fx"', '["fx"').replace(old, new) if "flu" in new else IMU.replace(old, new)
    rec = mapped(folder, text)
    np.testing.assert_allclose(rec.imu.gyro, recording().imu.gyro, rtol=1e-12)
    np.testing.assert_allclose(rec.imu.accel, recording().imu.accel, rtol=1e-12)


def test_increments_by_number_without_times_in_an_array(folder):
    np.save(folder / "imu.npy", imu_table()[:, 1:] * 0.01)
    text = '[imu]\nfile = "imu.npy"\nrate_hz = 100\ngyro = [1, 2, 3]\ngyro_unit = "rad"\naccel = [4, 5, 6]\n'
    rec = mapped(folder, text + 'accel_unit = "m/s"\nsampling = "increments"\n')
    np.testing.assert_allclose(rec.imu.gyro, recording().imu.gyro, rtol=1e-9)
    assert rec.imu.t[0] == pytest.approx(0.01)


@pytest.mark.parametrize("delimiter", [";", "\t", " "])
def test_delimiters_and_a_header_behind_a_mark(folder, delimiter):
    rows = [delimiter.join(map(repr, row)) for row in imu_table().tolist()]
    (folder / "imu.csv").write_text("\n".join(["% made up", "# " + delimiter.join(NAMES), *rows]) + "\n")
    np.testing.assert_array_equal(mapped(folder, IMU).imu.gyro, recording().imu.gyro)


def test_whole_microseconds_since_1970_keep_their_digits(folder):
    table = imu_table()
    stamps = 1_700_000_000_123_456 + np.arange(400) * 10_000
    rows = [f"{t}," + ",".join(map(repr, row)) for t, row in zip(stamps, table[:, 1:].tolist())]
    (folder / "imu.csv").write_text("\n".join([",".join(NAMES), *rows]) + "\n")
    rec = mapped(folder, IMU + 'time_unit = "us"\n')
    np.testing.assert_allclose(np.diff(rec.imu.t), 0.01, rtol=1e-11)
    assert "t = 0 is 1700000000 s in the file's time." in rec.notes


def test_dates(folder):
    stamps = [f"2023-11-14T22:13:{k // 100:02d}.{k % 100:02d}+00:00" for k in range(400)]
    rows = [f"{t}," + ",".join(map(repr, row)) for t, row in zip(stamps, imu_table()[:, 1:].tolist())]
    (folder / "imu.csv").write_text("\n".join([",".join(NAMES), *rows]) + "\n")
    rec = mapped(folder, IMU + 'time_unit = "iso"\n')
    np.testing.assert_allclose(np.diff(rec.imu.t), 0.01, atol=1e-6)
    assert rec.imu.t[0] == pytest.approx(0.0, abs=1e-6) and "t = 0 is 1699999980 s" in rec.notes


@pytest.mark.parametrize("kind", ["two columns", "rtklib", "excel", "matlab"])
def test_dates_of_other_programs(folder, kind):
    """Date and time of day apart, with slashes and without leading zeros, and days as Excel and MATLAB count them."""
    tick = 0.25 * np.arange(400)  # s
    first, unit = '"t"', "iso"
    if kind in ("excel", "matlab"):
        unit = kind
        day = {"excel": 45240.0, "matlab": 739200.0}[kind] + 22 / 24  # 2023-11-10 22:00
        stamps, names = [repr(x) for x in (day + tick / 86400).tolist()], NAMES
    else:
        clock = [f"{22 + int(s // 3600)}:{int(s // 60) % 60}:{s % 60:06.3f}" for s in tick]
        between, names = {"two columns": (",", ["d", *NAMES]), "rtklib": (" ", NAMES)}[kind]
        date = "2023-11-10" if kind == "two columns" else "2023/11/10"
        stamps = [f"{date}{between}{c}" for c in clock]
        first = '["d", "t"]' if kind == "two columns" else first
    rows = [f"{t}," + ",".join(map(repr, row)) for t, row in zip(stamps, imu_table()[:, 1:].tolist())]
    (folder / "imu.csv").write_text("\n".join([",".join(names), *rows]) + "\n")
    rec = mapped(folder, IMU.replace('time = "t"', f"time = {first}") + f'time_unit = "{unit}"\n')
    np.testing.assert_allclose(np.diff(rec.imu.t), 0.25, atol=3e-5)  # days leave 10 us
    zero = int(re.search(r"t = 0 is (\d+) s", rec.notes).group(1))
    assert zero + rec.imu.t[0] == pytest.approx(1699653600.0, abs=1e-4)


FIXES = np.array(
    [
        [11.0, 48.0, 11.0, 500.0, 3, 1.5],
        [12.0, 48.001, 11.001, 501.0, 3, 2.0],
        [13.0, 48.001, 11.001, 501.0, 3, 2.0],
        [13.5, 48.002, 11.002, 502.0, 1, 2.0],
    ]
)


def with_fixes(folder: Path, text: str, table: np.ndarray = FIXES, origin: str = ""):
    (folder / "fix.csv").write_text(format_csv(["t", "lat", "lon", "h", "status", "hdop"], table))
    return mapped(folder, origin + IMU + '[position]\nfile = "fix.csv"\ntime = "t"\n' + text)


def test_rows_that_are_new_and_valid_and_sd_from_hdop(folder):
    rec = with_fixes(
        folder,
        'lla = ["lat", "lon", "h"]\nwhere = { status = ">=3" }\nnew_where = ["lat", "h"]\n'
        'sd_enu = [{ column = "hdop", times = 2.0 }, "hdop", 4.0]\n',
    )
    position = rec.aiding["position"]
    np.testing.assert_allclose(position.t, [11.0, 12.0])
    np.testing.assert_allclose(position.value[1], [48.001 * DEG, 11.001 * DEG, 501.0])
    np.testing.assert_allclose(position.sd, [[3.0, 1.5, 4.0], [4.0, 2.0, 4.0]])


def test_sd_in_the_order_of_ned(folder):
    rec = with_fixes(folder, 'lla = ["lat", "lon", "h"]\nsd_ned = [1.0, 2.0, 3.0]\ntime_shift_s = -0.5\n')
    np.testing.assert_allclose(rec.aiding["position"].sd[0], [2.0, 1.0, 3.0])
    assert rec.aiding["position"].t[0] == 10.5


@pytest.mark.parametrize("key, order, sign", [("enu", [0, 1, 2], 1.0), ("ned", [1, 0, 2], -1.0)])
def test_local_metres_and_ecef(folder, key, order, sign):
    origin = np.array([0.8, 0.2, 100.0])
    enu = np.array([[10.0, 20.0, 3.0], [11.0, 22.0, 4.0]])
    local = enu[:, order] * [1.0, 1.0, sign]
    (folder / "xyz.csv").write_text(format_csv(["t", "x", "y", "z"], np.column_stack([[11.0, 12.0], local])))
    text = f'origin_deg = [{0.8 / DEG!r}, {0.2 / DEG!r}, 100.0]\n{IMU}[position]\nfile = "xyz.csv"\ntime = "t"\n'
    rec = mapped(folder, text + f'{key} = ["x", "y", "z"]\nsd = 1.0\n')
    np.testing.assert_allclose(rec.aiding["position"].value, local_to_lla(enu, origin), rtol=1e-12)
    assert "need origin_deg" in error(folder, text.split("\n", 1)[1] + f'{key} = ["x", "y", "z"]\n')


@pytest.mark.parametrize(
    "key, refs, expected",
    [
        ("enu", ["a", "b", "c"], [1.0, 2.0, 3.0]),
        ("neu", ["b", "a", "c"], [1.0, 2.0, 3.0]),
        ("ned", ["b", "a", "c"], [1.0, 2.0, -3.0]),
        ("speed_course", ["s", "k"], [2.5, 0.0, 0.0]),
    ],
)
def test_velocities(folder, key, refs, expected):
    (folder / "v.csv").write_text("t,a,b,c,s,k\n11,1,2,3,2.5,90\n12,1,2,3,2.5,90\n")
    rec = mapped(folder, IMU + f'[velocity]\nfile = "v.csv"\ntime = "t"\n{key} = {refs}\nsd = 0.1\n'.replace("'", '"'))
    np.testing.assert_allclose(rec.aiding["velocity"].value[0], expected, atol=1e-12)
    assert rec.aiding["velocity"].sd[0, 2] == (1000.0 if key == "speed_course" else 0.1)
    text = f'[velocity]\nfile = "v.csv"\ntime = "t"\n{key} = {refs}\nnorth_deg = 90\n'.replace("'", '"')
    east, north, up = mapped(folder, IMU + text).aiding["velocity"].value[0]  # what was north is east
    np.testing.assert_allclose([-north, east, up], expected, atol=1e-12)


def test_streams_that_no_filter_takes_yet_are_kept(folder):
    (folder / "x.csv").write_text("t,p,l,r,m,n,o,psi\n11,1013.25,3.6,7.2,0.2,0,0.4,90\n12,1000,3.6,7.2,0.2,0,0.4,90\n")
    head = 'file = "x.csv"\ntime = "t"\n'
    rec = mapped(
        folder,
        f'{IMU}[barometer]\n{head}value = "p"\nunit = "hPa"\n[speed]\n{head}value = ["l", "r"]\nunit = "km/h"\n'
        f'[magnetometer]\n{head}value = ["m", "n", "o"]\nunit = "gauss"\naxes = "flu"\n'
        f'[heading]\n{head}value = "-psi"\nnorth_deg = 180\n',
    )
    np.testing.assert_allclose(rec.aiding["barometer"].value[:, 0], [0.0, 110.9], atol=0.1)
    np.testing.assert_allclose(rec.aiding["speed"].value[0], [1.5])
    np.testing.assert_allclose(rec.aiding["magnetometer"].value[0], [20.0, 0.0, -40.0], atol=1e-12)
    np.testing.assert_allclose(rec.aiding["heading"].value[0], [np.pi / 2])
    assert [f.code for f in rec.findings] == 4 * ["stream.assumed_sd"]


def test_truth_in_ecef(folder):
    lla = np.array([[0.8, 0.2, 100.0], [0.8, 0.2, 100.0]])
    from jaxnav.maths.axes import ecef

    v = enu_to_ecef(lla[0]) @ np.array([1.0, 2.0, 3.0])
    table = np.column_stack([[11.0, 12.0], ecef(lla), np.tile(v, (2, 1))])
    (folder / "truth.csv").write_text(format_csv(["t", "x", "y", "z", "u", "v", "w"], table))
    text = '[truth]\nfile = "truth.csv"\ntime = "t"\necef = ["x", "y", "z"]\nvelocity_ecef = ["u", "v", "w"]\n'
    truth = mapped(folder, IMU + text).truth
    np.testing.assert_allclose(truth.lla, lla, rtol=1e-12)
    np.testing.assert_allclose(truth.vel[0], [1.0, 2.0, 3.0], atol=1e-9)
    assert np.isnan(truth.rph).all()


def test_columns_of_structs_archives_and_several_files(folder):
    imu = recording().imu
    savemat(folder / "a.mat", {"log": {"imu": {"w": imu.gyro.T, "f": imu.accel, "t": imu.t}}})
    text = IMU.replace("imu.csv", "a.mat").replace('"t"', '"log.imu.t"')
    for a, i in (("x", 0), ("y", 1), ("z", 2)):
        text = text.replace(f'"w{a}"', f'"log.imu.w[{i}]"').replace(f'"f{a}"', f'"log.imu.f[{i}]"')
    np.testing.assert_array_equal(mapped(folder, text).imu.gyro, imu.gyro)
    with zipfile.ZipFile(folder / "all.zip", "w") as archive:
        archive.write(folder / "imu.csv", "inner/imu.csv")
    np.testing.assert_array_equal(mapped(folder, 'folder = "all.zip/inner"\n' + IMU).imu.gyro, imu.gyro)
    np.save(folder / "t", imu.t)
    (folder / "t.npy").rename(folder / "t")
    text = IMU.replace('file = "imu.csv"', 'file = { clock = "t", log = "imu.csv" }').replace(
        '"t"\ngyro', '"clock:1"\ngyro'
    )
    for name in NAMES[1:]:
        text = text.replace(f'"{name}"', f'"log:{name}"')
    np.testing.assert_array_equal(mapped(folder, text).imu.t, imu.t)


def test_a_map_over_another_reader(folder):
    (folder / "fix.csv").write_text(format_csv(["t", "lat", "lon", "h"], FIXES[:, :4]))
    table = imu_table()
    table[:, 5:] *= -1.0
    table[:, 2:4] *= -1.0
    (folder / "own.csv").write_text(
        format_csv(["t_s", *(f"gyro_{a}_radps" for a in "xyz"), *(f"accel_{a}_mps2" for a in "xyz")], table)
    )
    rec = mapped(
        folder,
        '[read]\nfile = "own.csv"\naxes = "flu"\n'
        '[position]\nfile = "fix.csv"\ntime = "t"\nlla = ["lat", "lon", "h"]\nsd = 1\n',
    )
    np.testing.assert_allclose(rec.imu.accel, recording().imu.accel)
    assert len(rec.aiding["position"].t) == 4
    other = folder / "elsewhere"
    other.mkdir()
    with pytest.raises(DataError, match="elsewhere/own.csv: cannot be read"):
        read(folder / "map.toml", folder=other)


@pytest.mark.parametrize(
    "old, new, expected",
    [
        ("gyro_unit", "gyro_unti", "imu: gyro_unti: unknown key; did you mean gyro_unit?"),
        (
            '"rad/s"',
            '"m"',
            "imu: gyro_unit: expected one of rad/s, deg/s, mdeg/s, or a multiple such as '1/131 deg/s', got 'm'",
        ),
        ('gyro_unit = "rad/s"\n', "", "imu: gyro_unit: expected one of"),
        ('"wx"', '"wxx"', "imu.csv: no column wxx: did you mean wx?"),
        ('["wx", ', "[", "imu: gyro: expected a list of 3 columns"),
        ("imu.csv", "none.csv", "none.csv: cannot be read"),
        ("imu.csv", "*.nothing", "expected one file, found 0"),
        ('time = "t"\n', "", "imu: expected a key time, or rate_hz"),
        ("[imu]", "[imuu]\n[imu]", "map.toml: imuu: unknown key; did you mean imu?"),
        ("[imu]", "[imu]\nsampling = 'mean'", "imu: sampling: known are rates, increments, instantaneous"),
        (
            "[imu]",
            "[imu]\ntime_unit = 'min'",
            "time_unit: expected one of s, ms, us, ns, excel, matlab, iso, a multiple such as '1/25600 s'",
        ),
        ("[imu]", "[imu]\naxes = 'fru'", "got 'fru'; of left-handed axes give a column the other sign"),
        ("[imu]", "lever_arm_frd_m = [1]\n[imu]", "lever_arm_frd_m: expected 3 numbers"),
        ("[imu]", "folder = '$NOT_SET_ANYWHERE'\n[imu]", "folder: .NOT_SET_ANYWHERE names an environment variable"),
        ("[imu]", "[imu]\nskip = [300, 200]", "imu: skip: expected rows to leave out at start and end, got [300, 200]"),
        ("[imu]", "[imu]\ntime_tag = 'none.tag'", "none.tag: cannot be read"),
        ("[imu]", "[imu]\nwhere = { fx = 'many' }", "imu: where: fx: no row has the text 'many'"),
    ],
)
def test_mistakes_in_a_map_are_one_sentence(folder, old, new, expected):
    assert expected.replace(".NOT", "$NOT") in error(folder, IMU.replace(old, new, 1))


def test_a_map_that_is_no_toml(folder):
    assert "map.toml: cannot be read as TOML" in error(folder, IMU + "= 3\n")


def test_a_wrong_cell_and_a_short_line_are_left_out_and_said(folder):
    lines = (folder / "imu.csv").read_text().splitlines()
    lines[100] = lines[100].replace(",", ",x", 1)
    lines[200] = lines[200].rsplit(",", 1)[0]
    (folder / "imu.csv").write_text("\n".join([*lines, "14.01,0.0"]))
    rec = mapped(folder, IMU)
    assert len(rec.imu.t) == 398
    assert "imu: 1 of 399 rows that cannot be read are left out, the first at line 101." in rec.notes
    assert "imu.csv: 1 lines of another width left out, first line 201." in rec.notes
    assert "imu.csv: the last line has no line end" in rec.notes


def test_units_are_what_they_say():
    assert UNITS["speed"]["knots"] == pytest.approx(0.514444, rel=1e-5)
    assert UNITS["field"]["mgauss"] * 1000 == pytest.approx(100.0) == UNITS["field"]["gauss"]
    np.testing.assert_allclose(pressure_height(np.array([101325.0, 89874.6, 54019.9])), [0.0, 1000.0, 5000.0], atol=1.0)
    assert GPS_EPOCH == 315964800.0


def test_the_page_shows_keys_that_are_known():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    (block,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    table = tomllib.loads(block)
    assert set(table) <= {*TOP, *with_data()}
    for name in ("imu", "position", "velocity"):
        assert set(table[name]) <= set(KEYS[name])
    said = page.split("## The column map")[1].split("## Our own")[0]
    keys = {key for keys in KEYS.values() for key in keys} | {*TOP, *with_data()}
    assert not [key for key in keys if key not in said]
    assert not [unit for kind in UNITS.values() for unit in kind if unit not in said]


def test_the_page_names_every_reader():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    for row in READERS:
        assert row.name.split()[-1] in page


def test_wheels_of_both_sides_in_metres_or_turns_and_a_range(folder):
    """Left and right, each a column or the mean of an axle's; angles by the radius."""
    rows = "\n".join(f"{11 + 0.1 * k},{10 + k},{12 + k},20,3" for k in range(5))
    (folder / "w.csv").write_text(f"t,fl,rl,r,d\n{rows}\n")
    head = '[wheels]\nfile = "w.csv"\ntime = "t"\nleft = ["fl", "rl"]\nright = "r"\n'
    below = '[rangefinder]\nfile = "w.csv"\ntime = "t"\nvalue = "d"\nunit = "ft"\n'
    rec = mapped(folder, IMU + head + 'unit = "km/h"\n' + below)
    np.testing.assert_allclose(rec.aiding["wheels"].value, np.column_stack([11 + np.arange(5.0), np.full(5, 20)]) / 3.6)
    np.testing.assert_allclose(rec.aiding["rangefinder"].value[:, 0], 0.9144)
    turning = mapped(folder, IMU + head + 'radius = 0.3\nunit = "deg/s"\n').aiding["wheels"]
    np.testing.assert_allclose(turning.value[:, 1], 20 * DEG * 0.3)
    for text, said in ((head + "radius = -1\n", "wheels: radius: expected metres, got -1"),
                       (head.replace("left", "unit"), "wheels")):  # fmt: skip
        with pytest.raises(DataError, match=said):
            mapped(folder, IMU + text)


def two_files(folder, accel_times, more=""):
    """A gyro at 20 Hz whose z is its time, an accelerometer with times of its own whose x is ten times its time."""
    gyro = "\n".join(f"{t:.3f},0,0,{t / 100}" for t in np.arange(0, 20, 0.05))
    accel = "\n".join(f"{t:.4f},{t / 10},0,-9.8" for t in accel_times)
    (folder / "g.csv").write_text(f"time,x,y,z\n{gyro}\n")
    (folder / "a.csv").write_text(f"time,x,y,z\n{accel}\n")
    (folder / "phone.toml").write_text(
        '[imu]\nfile = { g = "g.csv", a = "a.csv" }\ntime = "g:time"\ngyro = ["g:x", "g:y", "g:z"]\n'
        f'gyro_unit = "rad/s"\naccel = ["a:x", "a:y", "a:z"]\naccel_unit = "m/s^2"\n{more}\n'
    )
    return read_parts(folder / "phone.toml").imu


@pytest.mark.parametrize("more", ["", 'accel_time = "a:time"'])
def test_an_accelerometer_in_a_file_of_its_own_is_joined_by_time(tmp_path, more):
    """Other rates, and as many rows at other times: linear between its own times, none outside of them."""
    for times in (np.arange(0.31, 19.0, 0.03), np.arange(0.31, 20.31, 0.05)[:400]):
        imu = two_files(tmp_path, times, more)
        np.testing.assert_allclose(imu.accel[:, 0], imu.t / 10, atol=1e-6)
        np.testing.assert_allclose(imu.gyro[:, 2], imu.t / 100, atol=1e-12)
        assert imu.t[0] == pytest.approx(0.35) and imu.t[-1] <= times[-1] + 1e-4


def test_no_acceleration_is_made_up_in_a_hole_of_the_accelerometer(tmp_path):
    times = np.arange(0.0, 20.0, 0.05)
    own = times[(times < 7.99) | (times > 9.01)]
    np.testing.assert_allclose(two_files(tmp_path, own).t, own, atol=1e-9)
    with pytest.raises(DataError, match="no time of the gyro is within those of the accelerometer"):
        two_files(tmp_path, times + 100.0)


def test_a_map_reads_other_files_in_place_of_its_own(tmp_path):
    shutil.copy(EXAMPLES / "drive_imu.csv", tmp_path / "a.csv")
    shutil.copy(EXAMPLES / "drive_gnss.csv", tmp_path / "b.csv")
    shutil.copytree(EXAMPLES, tmp_path / "today")
    want = read(EXAMPLES / "drive.toml")
    one = read(tmp_path / "a.csv", gnss=tmp_path / "b.csv", map=EXAMPLES / "drive.toml")
    folder = read(tmp_path / "today", map=EXAMPLES / "drive.toml")
    arm, imu, fixes = (EXAMPLES / "drive.toml").read_text().replace("[position]", "[imu]", 1).split("[imu]")
    folder_of = 'folder = "$NOT_SET"\n'  # of the map's files, which are not read
    (tmp_path / "turned.toml").write_text(f"{folder_of}{arm}[position]{fixes}\n[imu]{imu}")
    turned = read(tmp_path / "a.csv", gnss=tmp_path / "b.csv", map=tmp_path / "turned.toml")
    assert (one.name, folder.name) == ("a", "today")
    for rec in (one, folder, turned):
        chex.assert_trees_all_equal((rec.imu, rec.aiding, rec.lever_arm), (want.imu, want.aiding, want.lever_arm))
    with pytest.raises(DataError, match=r"the map names 2 files \(drive_imu.csv, drive_gnss.csv\), in their place"):
        read(tmp_path / "a.csv", map=EXAMPLES / "drive.toml")
    (tmp_path / "tagged.toml").write_text(IMU + 'time_tag = "of_yesterday.tag"\n')
    with pytest.raises(DataError, match=r"2 files \(imu.csv, of_yesterday.tag\)"):
        read(tmp_path / "a.csv", map=tmp_path / "tagged.toml")
    with pytest.raises(DataError, match="expected a column map"):
        read(tmp_path / "a.csv", map=EXAMPLES / "drive_imu.csv")


def test_signs_and_counts_of_columns(folder):
    want = recording().imu.gyro * [-1.0, 0.5, 2.0]
    text = IMU.replace('["wx", "wy", "wz"]', '["-wx", { column = "wy", times = 0.5 }, { column = "-4", times = -2 }]')
    np.testing.assert_allclose(mapped(folder, text).imu.gyro, want, rtol=1e-12)
    files = IMU.replace('file = "imu.csv"', 'file = { i = "imu.csv" }')
    for name in "t wx wy wz fx fy fz".split():
        files = files.replace(f'"{name}"', f'"i:{name}"')
    text = files.replace("i:wx", "i:-wx")
    np.testing.assert_allclose(mapped(folder, text).imu.gyro[:, 0], want[:, 0], rtol=1e-12)
    assert "no column -w" in error(folder, IMU.replace('"wx"', '"-w"'))
    assert "expected { column" in error(folder, IMU.replace('"wx"', "{ times = 2 }"))
    assert "time: unknown key; did you mean times" in error(folder, IMU.replace('"wx"', '{ column = "wx", time = 2 }'))


def test_sd_of_variances(folder):
    text = 'lla = ["lat", "lon", "h"]\nwhere = { status = ">=3" }\nnew_where = ["lat", "h"]\nsd_enu = '
    sd = (
        with_fixes(folder, text + '[{ column = "hdop", variance = true, times = 4 }, "hdop", 4.0]\n')
        .aiding["position"]
        .sd
    )
    np.testing.assert_allclose(sd, [[np.sqrt(6.0), 1.5, 4.0], [np.sqrt(8.0), 2.0, 4.0]])


@pytest.mark.parametrize("text", ['lla = ["lat", "lon"]\n', 'enu = ["lat", "lon"]\n'])
def test_positions_without_a_height(folder, text):
    origin = "origin_deg = [48.0, 11.0, 500.0]\n"
    rec = with_fixes(folder, text, origin=origin)
    position = rec.aiding["position"]
    assert (position.value[:, 2] == 0.0).all() and (position.sd[:, 2] == 1e3).all() and (position.sd[:, :2] < 10).all()
    assert f"{len(position.t)} rows have no height" in rec.notes
    three = with_fixes(folder, text.replace('"lon"', '"lon", "h"'), origin=origin).aiding["position"]
    np.testing.assert_allclose(position.value[:, :2], three.value[:, :2], atol=1e-6)


def test_rows_of_kinds_that_differ_in_number_and_width(tmp_path):
    """The accelerometer comes twice as often, and the fixes have more cells."""
    lines = [f"G,{k},0.1,0.2,0.3" for k in range(20)] + [f"A,{k / 2},0,0,-9.8" for k in range(40)]
    lines += [f"F,{k},48.0,11.0,500.0,3,RTK" for k in range(1, 20)] + ["F,19.5,48.0,11.0,500.0,1,none"]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "map.toml").write_text(
        'header = false\n[imu]\nfile = { g = "log.txt", a = "log.txt" }\ntime = "g:2"\naccel_time = "a:2"\n'
        'where = { "g:1" = "G", "a:1" = "A" }\ngyro = ["g:3", "g:4", "g:5"]\ngyro_unit = "rad/s"\n'
        'accel = ["a:3", "a:4", "a:5"]\naccel_unit = "m/s^2"\n'
        '[position]\nfile = "log.txt"\ntime = "2"\nlla = ["3", "4", "5"]\nwhere = { 1 = "F", 7 = "RTK" }\n'
    )
    parts = read_parts(tmp_path / "map.toml")
    assert parts.imu.t.size == 20 and np.all(parts.imu.accel[:, 2] == -9.8)
    np.testing.assert_array_equal(parts.aiding["position"].t, np.arange(1.0, 20.0))


def test_utm_south_of_the_equator_counts_from_ten_thousand_kilometres(folder):
    """As many metres south as north: the other latitude."""
    found = []
    for zone, northing in (("32 north", 5.3e6), ("32 south", 1e7 - 5.3e6), ("32H", 1e7 - 5.3e6)):
        (folder / "g.csv").write_text(f"t,e,n,h\n11,650000,{northing},7\n12,650000,{northing},7\n")
        text = f'[position]\nfile = "g.csv"\ntime = "t"\nutm = ["e", "n", "h"]\nzone = "{zone}"\nsd = 1.0\n'
        found.append(mapped(folder, IMU + text).aiding["position"].value[0])
    np.testing.assert_allclose(found[1], found[0] * [-1, 1, 1], rtol=1e-14)
    np.testing.assert_array_equal(found[2], found[1])
