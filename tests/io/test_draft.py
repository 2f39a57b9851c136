"""Drafts of column maps: ten tables of other names, units, orders, separators and times give the recording back."""

import contextlib
import datetime
import json
import sys
import tomllib

import jax
import numpy as np
import pytest
from scipy.io import savemat

from jaxnav import read
from jaxnav.app import cli
from jaxnav.io.column_map import read_map
from jaxnav.io.draft import _unit_by_turns, draft
from jaxnav.io.mend import mended
from jaxnav.io.naming import named_column, words_of
from jaxnav.maths.units import DEG, G0
from jaxnav.simulate.gnss import Receiver
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording
from jaxnav.types import DataError

FLU = np.array([1.0, -1.0, -1.0])
BEGIN = 1_748_779_200.0  # s since 1970


@pytest.fixture(scope="module")
def rec():
    what = URBAN_SHORT._replace(duration_s=90.0, gnss=Receiver(position_sd_m=(0.5, 0.5, 1.0)))
    return to_recording(simulate_jit(jax.random.key(0), what), what)


def lines(path, names, columns, mark=",", form="%.9g", unit_line=None, comma=False):
    """Write a table."""
    text = [mark.join(names), *([mark.join(unit_line)] if unit_line else [])]
    cell = lambda value: value if isinstance(value, str) else form % value
    rows = [mark.join(cell(v) for v in row) for row in zip(*columns, strict=True)]
    body = "\n".join([*text, *(row.replace(".", ",") if comma else row for row in rows)])
    path.write_text(body + "\n", encoding="utf-8")
    return path


def fixes(rec):
    """Return time, lat, lon (deg), height, east, north, up, speed, course (deg)."""
    p, v = rec.aiding["position"], rec.aiding["velocity"]
    e, n, u = v.value.T
    return (
        p.t,
        p.value[:, 0] / DEG,
        p.value[:, 1] / DEG,
        p.value[:, 2],
        e,
        n,
        u,
        np.hypot(e, n),
        np.degrees(np.arctan2(e, n)) % 360,
    )


def held(rec, columns):
    """Return columns of the fixes at the IMU's rate, the last value repeated."""
    t = rec.aiding["position"].t
    i = np.clip(np.searchsorted(t, rec.imu.t + 1e-9, "right") - 1, 0, None)
    return [np.asarray(c)[i] for c in columns]


def one_table(rec, folder):
    t, lat, lon, h, e, n, u, speed, course = fixes(rec)
    names = ["Timestamp [ms]", "GyrX [°/s]", "GyrY [°/s]", "GyrZ [°/s]", "AccX [m/s²]", "AccY [m/s²]", "AccZ [m/s²]",
             "Lat [°]", "Lon [°]", "Alt [m]", "Speed [km/h]", "Course [°]"]  # fmt: skip
    columns = [np.round(1e3 * rec.imu.t), *(rec.imu.gyro / DEG).T, *rec.imu.accel.T,
               *held(rec, [lat, lon, h, 3.6 * speed, course])]  # fmt: skip
    columns = [column[rec.imu.t >= t[0]] for column in columns]
    return [lines(folder / "log.csv", names, columns, ";", "%.9f", comma=True)]


def short_names(rec, folder):
    t, lat, lon, h, e, n, u, *_ = fixes(rec)
    imu = lines(
        folder / "imu.txt",
        ["t", "ax", "ay", "az", "wx", "wy", "wz"],
        [rec.imu.t, *rec.imu.accel.T, *rec.imu.gyro.T],
        "\t",
    )
    gnss = lines(
        folder / "gnss.txt", ["#", "t", "lat", "lon", "h", "vn", "ve", "vd"], [t, lat, lon, h, n, e, -u], " ", "%.9f"
    )
    gnss.write_text(gnss.read_text().replace("# t", "#t", 1))
    return [imu, gnss]


def rostopic(rec, folder):
    t, lat, lon, h, *_ = fixes(rec)
    stamp = lambda t: [str(round((BEGIN + x) * 1e9)) for x in t]
    axes = lambda name: [f"field.{name}.{a}" for a in "xyz"]
    names = ["%time", "field.header.seq", *axes("angular_velocity"), *axes("linear_acceleration")]
    columns = [stamp(rec.imu.t), np.arange(rec.imu.t.size), *(rec.imu.gyro * FLU).T, *(rec.imu.accel * FLU).T]
    imu = lines(folder / "imu.csv", names, columns)
    names = ["%time", "field.latitude", "field.longitude", "field.altitude"]
    gnss = lines(folder / "fix.csv", names, [stamp(t), lat, lon, h], form="%.9f")
    return [imu, gnss]


def receivers_units(rec, folder):
    t, lat, lon, h, e, n, u, *_ = fixes(rec)
    names = ["time_us", *(f"gyro_{a}_mdps" for a in "xyz"), *(f"acc_{a}_mg" for a in "xyz")]
    columns = [1e6 * rec.imu.t, *(1e3 * rec.imu.gyro / DEG).T, *(1e3 * rec.imu.accel / G0).T]
    imu = lines(folder / "sensors.csv", names, columns, form="%.6f")
    names = [
        "time_ms",
        "lat_1e-7deg",
        "lon_1e-7deg",
        "height_mm",
        "velN_mm/s",
        "velE_mm/s",
        "velD_mm/s",
        "hAcc_mm",
        "vAcc_mm",
    ]
    sd = [np.full(t.size, 2000.0), np.full(t.size, 4000.0)]
    gnss = lines(
        folder / "pvt.csv",
        names,
        [1e3 * t, 1e7 * lat, 1e7 * lon, 1e3 * h, 1e3 * n, 1e3 * e, -1e3 * u, *sd],
        form="%.3f",
    )
    return [imu, gnss]


def iso_dates(rec, folder):
    t, lat, lon, h, e, n, u, speed, course = fixes(rec)
    moment = lambda t: [datetime.datetime.fromtimestamp(BEGIN + x, datetime.UTC).isoformat() for x in t]
    imu = lines(folder / "a.csv", ["DateTime", "Omega X", "Omega Y", "Omega Z", "F X", "F Y", "F Z"],
                [moment(rec.imu.t), *rec.imu.gyro.T, *rec.imu.accel.T],
                unit_line=["-", *["rad/s"] * 3, *["m/s^2"] * 3])  # fmt: skip
    gnss = lines(folder / "b.csv", ["UTC Time", "Latitude", "Longitude", "Altitude", "Ground Speed (kt)", "Track"],
                 [moment(t), lat, lon, h, speed * 3600 / 1852, course], form="%.9f")  # fmt: skip
    return [imu, gnss]


def matlab(rec, folder):
    t, lat, lon, h, e, n, u, *_ = fixes(rec)
    imu = {"time": rec.imu.t, "gyro": rec.imu.gyro, "acc": rec.imu.accel}
    gps = {"time": t, "latitude": lat, "longitude": lon, "height": h, "vel_n": n, "vel_e": e, "vel_d": -u}
    savemat(folder / "drive.mat", {"imu": imu, "gps": gps})
    return [folder / "drive.mat"]


def a_file_a_sensor(rec, folder):
    t, lat, lon, h, e, n, u, speed, course = fixes(rec)
    for name, values in (("Gyroscope.csv", rec.imu.gyro * FLU), ("TotalAcceleration.csv", rec.imu.accel * FLU)):
        lines(folder / name, ["seconds_elapsed", "z", "y", "x"], [rec.imu.t, *values.T[::-1]])
    names = ["seconds_elapsed", "speed", "bearing", "altitude", "longitude", "latitude", "horizontalAccuracy"]
    lines(folder / "Position.csv", names, [t, speed, course, h, lon, lat, np.full(t.size, 2.0)], form="%.9f")
    return [folder]


def phyphox(rec, folder):
    """Names in quotes, degrees as a sign, an accuracy of the height in the wrong unit, speed and direction."""
    t, lat, lon, h, e, n, u, speed, course = fixes(rec)
    three = lambda name, unit: ['"Time (s)"', *(f'"{name} {a} ({unit})"' for a in "xyz")]
    names = ["Time (s)", "Latitude (°)", "Longitude (°)", "Height (m)", "Velocity (m/s)", "Direction (°)",
             "Horizontal Accuracy (m)", "Vertical Accuracy (°)"]  # fmt: skip
    columns = [t, lat, lon, h, speed, course, np.full(t.size, 2.0), np.full(t.size, 4.0)]
    force = three("Acceleration", "m/s^2")
    return [
        lines(folder / "Gyroscope.csv", three("Gyroscope", "rad/s"), [rec.imu.t, *rec.imu.gyro.T], form="%.9e"),
        lines(folder / "Accelerometer.csv", force, [rec.imu.t, *rec.imu.accel.T], form="%.9e"),
        lines(folder / "Location.csv", [f'"{name}"' for name in names], columns, form="%.13e"),
    ]


def date_and_time(rec, folder):
    t, lat, lon, h, *_ = fixes(rec)
    moment = lambda t: [datetime.datetime.fromtimestamp(BEGIN + x, datetime.UTC) for x in t]
    day, clock = lambda t: [f"{m:%Y-%m-%d}" for m in moment(t)], lambda t: [f"{m:%H:%M:%S.%f}" for m in moment(t)]
    names = ["Date", "Time", *(f"angular rate {a} (deg/s)" for a in "xyz"), *(f"acceleration {a} (g)" for a in "xyz")]
    imu = lines(
        folder / "x.csv", names, [day(rec.imu.t), clock(rec.imu.t), *(rec.imu.gyro / DEG).T, *(rec.imu.accel / G0).T]
    )
    gnss = lines(folder / "y.csv", ["Date", "Time", "LAT", "LNG", "HGT"], [day(t), clock(t), lat, lon, h], form="%.9f")
    return [imu, gnss]


def radians(rec, folder):
    t, lat, lon, h, e, n, u, *_ = fixes(rec)
    imu = lines(folder / "i.tsv", ["timestamp", "rotation_rate_x", "rotation_rate_y", "rotation_rate_z",
                                   "specific_force_x", "specific_force_y", "specific_force_z"],
                [1e6 * rec.imu.t, *(rec.imu.gyro / DEG * 10).T / 10, *rec.imu.accel.T], "\t", "%.9f",
                unit_line=["us", *["deg/s"] * 3, *["m/s2"] * 3])  # fmt: skip
    names = ["timestamp", "latitude_rad", "longitude_rad", "height_m", "vel_e_m_s", "vel_n_m_s", "vel_u_m_s"]
    gnss = lines(folder / "g.tsv", names, [1e6 * t, lat * DEG, lon * DEG, h, e, n, u], "\t", "%.12f")
    return [imu, gnss]


def no_speed_unit(rec, folder):
    """Km/h without a word: the way between the positions says it."""
    t, lat, lon, h, e, n, u, speed, course = fixes(rec)
    names = ["elapsed", *(f"gyro{a}(rad/s)" for a in "XYZ"), *(f"accel{a}(m/s^2)" for a in "XYZ")]
    imu = lines(folder / "1.csv", names, [rec.imu.t, *rec.imu.gyro.T, *rec.imu.accel.T])
    gnss = lines(
        folder / "2.csv",
        ["elapsed", "lat", "lon", "alt", "spd", "cog"],
        [t, lat, lon, h, 3.6 * speed, course],
        form="%.9f",
    )
    return [imu, gnss]


def times_of_day(rec, folder):
    """Without a date."""
    t, lat, lon, h, *_ = fixes(rec)
    form = lambda t, how: [f"{datetime.datetime.fromtimestamp(BEGIN + x, datetime.UTC):{how}}"[:-3] for x in t]
    names = ["time", *(f"g{a}(dps)" for a in "xyz"), *(f"a{a}(g)" for a in "xyz")]
    imu = lines(
        folder / "x.csv", names, [form(rec.imu.t, "%H:%M:%S.%f"), *(rec.imu.gyro / DEG).T, *(rec.imu.accel / G0).T]
    )
    names = ["time", "latitude", "longitude", "altitude"]
    return [imu, lines(folder / "y.csv", names, [form(t, "%H:%M:%S.%f"), lat, lon, h], form="%.9f")]


def json_lines(rec, folder):
    """Sensors mixed as they came, vectors as lists, no unit of the gyro."""
    t, lat, lon, h, *_ = fixes(rec)
    rows = [(x, {"type": "imu", "ts_us": round(1e6 * x), "gyro": list(w), "accel": list(f)})
            for x, w, f in zip(rec.imu.t, rec.imu.gyro.tolist(), rec.imu.accel.tolist(), strict=True)]  # fmt: skip
    rows += [(x, {"type": "gps", "ts_us": round(1e6 * x), "lat": a, "lon": b, "alt": c})
             for x, a, b, c in zip(t, lat, lon, h, strict=True)]  # fmt: skip
    path = folder / "log.jsonl"
    path.write_text("\n".join(json.dumps(row) for _, row in sorted(rows, key=lambda row: row[0])) + "\n")
    return [path]


def json_document(rec, folder):
    """A list of objects a sensor."""
    t, lat, lon, h, *_ = fixes(rec)
    vector = lambda a: dict(zip("xyz", a, strict=True))
    imu = [{"t": x, "gyro": vector(w), "acc": vector(f)}
           for x, w, f in zip(rec.imu.t, rec.imu.gyro.tolist(), rec.imu.accel.tolist(), strict=True)]  # fmt: skip
    gps = [{"t": x, "latitude": a, "longitude": b, "ele": c} for x, a, b, c in zip(t, lat, lon, h, strict=True)]
    path = folder / "log.json"
    path.write_text(json.dumps({"about": {"version": 2}, "imu": imu, "gps": gps}))
    return [path]


def json_arrays(rec, folder):
    """An array a quantity."""
    t, lat, lon, h, *_ = fixes(rec)
    imu = {"t": rec.imu.t.tolist(), "gyro": rec.imu.gyro.tolist(), "acc": rec.imu.accel.tolist()}
    gps = {"t": t.tolist(), "latitude": lat.tolist(), "longitude": lon.tolist(), "altitude": h.tolist()}
    path = folder / "log.json"
    path.write_text(json.dumps({"imu": imu, "gps": gps}))
    return [path]


def parts_of_time(rec, folder):
    """Year to second in columns of their own, seconds with nine digits."""
    t, lat, lon, h, *_ = fixes(rec)
    moment = [datetime.datetime.fromtimestamp(BEGIN + x, datetime.UTC) for x in rec.imu.t]
    of = lambda name: [str(getattr(m, name)) for m in moment]
    second = [f"{m.second + m.microsecond / 1e6:.9f}" for m in moment]
    names = ["Year", "Month", "Day", "Hour", "Minute", "Second", *(f"gyro_{a}_dps" for a in "xyz"),
             *(f"acc_{a}_g" for a in "xyz"), "lat", "lon", "alt"]  # fmt: skip
    times = [*map(of, ("year", "month", "day", "hour", "minute")), second]
    columns = [*times, *(rec.imu.gyro / DEG).T, *(rec.imu.accel / G0).T, *held(rec, [lat, lon, h])]
    rows = rec.imu.t >= t[0]
    return [lines(folder / "x.csv", names, [np.asarray(column)[rows] for column in columns], form="%.9f")]


TABLES = (one_table, short_names, rostopic, receivers_units, iso_dates, matlab, a_file_a_sensor, phyphox, date_and_time,
          radians, no_speed_unit, times_of_day, json_lines, json_document, json_arrays, parts_of_time)  # fmt: skip


@pytest.mark.parametrize("write", TABLES, ids=lambda write: write.__name__)
def test_a_draft_opens_as_it_is(write, rec, tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    found = draft(write(rec, folder), tmp_path)
    assert not found.unsure, found.text()
    (tmp_path / "draft.toml").write_text(found.text(), encoding="utf-8")
    got = mended(read_map(tmp_path / "draft.toml", read))
    n = got.imu.t.size
    assert n > 0.98 * rec.imu.t.size
    first = int(np.argmin(np.abs(rec.imu.accel - got.imu.accel[0]).sum(1)))
    same = slice(first, first + n)
    np.testing.assert_allclose(got.imu.gyro, rec.imu.gyro[same], atol=1e-6)
    np.testing.assert_allclose(got.imu.accel, rec.imu.accel[same], atol=1e-5)
    np.testing.assert_allclose(np.diff(got.imu.t), np.diff(rec.imu.t[same]), atol=2e-3)
    position, true = got.aiding["position"], rec.aiding["position"]
    late = got.imu.t[0] - rec.imu.t[first]
    rows = np.searchsorted(true.t, position.t - late - 1e-2)
    assert rows.size > 0.9 * true.t.size
    np.testing.assert_allclose(position.t - late, true.t[rows], atol=3e-3)
    np.testing.assert_allclose(position.value * [1e6, 1e6, 1.0], true.value[rows] * [1e6, 1e6, 1.0], rtol=0, atol=2e-2)
    if "velocity" in got.aiding:
        v, w = got.aiding["velocity"], rec.aiding["velocity"]
        rows = np.searchsorted(w.t, v.t - late - 1e-2)
        np.testing.assert_allclose(v.value[:, :2], w.value[rows, :2], atol=1e-4)


def test_a_small_rate_without_a_unit_is_not_sure_at_rest(rec, tmp_path):
    rest = rec.imu.t < 4.0
    names = ["t", *(f"gyro_{a}" for a in "xyz"), *(f"acc_{a}" for a in "xyz"), "lat", "lon", "alt"]
    columns = [rec.imu.t, *rec.imu.gyro.T, *rec.imu.accel.T, *held(rec, fixes(rec)[1:4])]
    path = lines(tmp_path / "a.csv", names, [column[rest] for column in columns])
    found = draft([path])
    assert [line.partition(":")[0] for line in found.unsure] == ["gyro_unit"] and "# ? gyro_unit" in found.text()
    assert tomllib.loads(found.text())["imu"]["gyro_unit"] == "rad/s"
    with pytest.raises(DataError, match="jaxnav map"):
        read(path)


def test_whole_seconds_next_to_a_time_of_week_are_no_time(rec, tmp_path):
    """As in a table of a receiver's NAV-PVT, at 4 Hz; without the time of week they are all that there is."""
    short_names(rec, tmp_path)
    t, lat, lon, h, *_ = fixes(rec)
    clock = [np.full(t.size, 10), (t // 60).astype(int), (t % 60).astype(int)]
    names, columns = ["hour", "min", "sec", "lat", "lon", "alt"], [*clock, lat, lon, h]
    for more, column, time in ((["iTOW"], [np.round(1e3 * t)], "iTOW"), ([], [], ["hour", "min", "sec"])):
        path = lines(tmp_path / "gnss.txt", [*more, *names], [*column, *columns], form="%.9f")
        rows = path.read_text().replace(".000000000", "")
        path.write_text(rows)
        assert draft([tmp_path / "imu.txt", path], tmp_path).tables["position"]["time"] == time


def test_turns_of_a_fast_course_show_the_unit_of_the_gyro_where_a_slow_one_does_not():
    """A walk by fixes of 4 m, then a drive: the course between two fixes is the surer, the farther they are."""
    rng, t = np.random.default_rng(0), np.arange(400.0)
    turned = np.cumsum(0.1 * np.sin(t / 10))
    speed, slow = np.where(t < 250, 0.8, 15.0), t < 250
    north, east = (np.cumsum(speed * f(turned)) + rng.normal(0.0, 4.0, t.size) for f in (np.cos, np.sin))
    assert _unit_by_turns(t, turned / DEG, t, north, east) == "deg/s"
    assert _unit_by_turns(t[slow], turned[slow] / DEG, t[slow], north[slow], east[slow]) == ""


def test_a_header_against_the_numbers_is_not_sure(rec, tmp_path):
    path = lines(tmp_path / "a.csv", ["t", *(f"gyro_{a}_dps" for a in "xyz"), *(f"acc_{a}_g" for a in "xyz")],
                 [rec.imu.t, *rec.imu.gyro.T, *rec.imu.accel.T])  # fmt: skip
    assert any("the header says g, the numbers m/s^2" in line for line in draft([path]).unsure)


def test_a_header_against_the_motion_is_not_sure(rec, tmp_path):
    """Rad/s under a header of deg/s, and m/s under one of km/h; an IMU that starts after the last fix."""
    t, lat, lon, h, *_, speed, course = fixes(rec)
    names = ["t", *(f"gyro_{a}_dps" for a in "xyz"), *(f"acc_{a}" for a in "xyz")]
    late = lambda by: lines(tmp_path / "a.csv", names, [rec.imu.t + by, *rec.imu.gyro.T, *rec.imu.accel.T])
    gnss = lines(tmp_path / "b.csv", ["t", "lat", "lon", "alt", "speed_kmh", "course"], [t, lat, lon, h, speed, course],
                 form="%.9f")  # fmt: skip
    said = draft([late(0.0), gnss]).unsure
    assert [line.partition(":")[0] for line in said] == ["velocity", "gyro_unit"]
    assert "km/h by the header, m/s by the way" in said[0] and "deg/s by the header or size, rad/s by" in said[1]
    assert any("do not meet" in line for line in draft([late(500.0), gnss]).unsure)


def test_hints_of_size_and_of_other_columns(rec, tmp_path):
    """Sensors with times of other names, heights in millimetres and a course in radians without a word, HDOP."""
    t, lat, lon, h, *_, speed, course = fixes(rec)
    lines(tmp_path / "g.csv", ["timestamp", *(f"w{a} (rad/s)" for a in "xyz")], [rec.imu.t, *rec.imu.gyro.T])
    lines(tmp_path / "a.csv", ["time", "ax", "ay", "az"], [rec.imu.t, *rec.imu.accel.T])
    names = ["time", "lat", "lon", "alt", "speed_mps", "course", "HDOP"]
    lines(tmp_path / "f.csv", names, [t, lat, lon, 1e3 * h, speed, course * DEG, np.ones(t.size)], form="%.9f")
    found = draft([tmp_path], tmp_path)
    imu, position, velocity = (found.tables[name] for name in ("imu", "position", "velocity"))
    assert not found.unsure and imu["time"] == "g:timestamp" and imu["accel_time"] == "a:time"
    assert position["h_unit"] == "mm" and position["sd_enu"][2] == {"column": "HDOP", "times": 5.0}
    assert velocity["course_unit"] == "rad"


def test_two_recordings_in_a_folder_are_not_sure(rec, tmp_path):
    short_names(rec, tmp_path)
    for name in ("imu", "gnss"):
        (tmp_path / f"{name}2.txt").write_bytes((tmp_path / f"{name}.txt").read_bytes())
    said = draft([tmp_path], tmp_path).unsure
    assert [line.partition(":")[0] for line in said] == ["gyro", "accel", "position"] and "others are imu2.txt" in said[
        0
    ]


def test_gravity_that_a_logger_took_out_is_said(rec, tmp_path):
    still = rec.imu.accel - np.median(rec.imu.accel, 0)
    path = lines(tmp_path / "a.csv", ["t", *(f"gyro_{a}_dps" for a in "xyz"), *(f"user_acc_{a}" for a in "xyz")],
                 [rec.imu.t, *rec.imu.gyro.T, *still.T])  # fmt: skip
    with pytest.raises(DataError, match=r"a.csv: columns user_acc_x.*gravity was taken out"):
        draft([path])
    names = ["t", *(f"gyro_{a}_dps" for a in "xyz"), *(f"user_acc_{a}" for a in "xyz"), *(f"acc_{a}" for a in "xyz")]
    both = lines(path, names, [rec.imu.t, *rec.imu.gyro.T, *still.T, *rec.imu.accel.T])
    assert draft([both]).tables["imu"]["accel"] == ["acc_x", "acc_y", "acc_z"]


def test_tables_without_an_imu_name_their_columns(tmp_path):
    path = lines(tmp_path / "a.csv", ["time", "price"], [np.arange(9.0), np.arange(9.0)])
    with pytest.raises(DataError, match="neither an IMU nor fixes among the columns: time, price"):
        draft([path])


AXES = (f"{sensor}{axis}" for sensor in ("gyro_", "w", "a", "acc_") for axis in "xyz")
NAMES = (*AXES, "time", "t", "date", "lat", "lon", "alt", "speed", "speed_kmh", "course", "vn", "ve", "vd", "hdop",
         "hAcc", "x", "q", "utc")  # fmt: skip


@pytest.mark.parametrize("seed", range(40))
def test_any_table_is_drafted_or_refused(seed, tmp_path):
    """Columns of nothing, one number, dates, words, counts, huge numbers: no traceback and no warning."""
    rng = np.random.default_rng(seed)
    n = int(rng.choice([2, 3, 5, 50, 300]))
    kinds = [[word] * n for word in ("", "nan", "abc", "0", "1e300", "-9.81")]
    kinds += [[f"2024-01-01 00:00:{i % 60:02d}" for i in range(n)], [str(10 * i) for i in range(n)]]
    kinds += [[f"{48 + 1e-5 * i:.6f}" for i in range(n)]]
    for file in ("a.csv", "b.csv"):
        names = list(rng.permutation(NAMES)[: rng.integers(6, len(NAMES))])
        noise = lambda: [f"{x:.4f}" for x in rng.normal(size=n)]
        lines(tmp_path / file, names, [kinds[rng.integers(9)] if rng.random() < 0.5 else noise() for _ in names])
    with contextlib.suppress(DataError):
        assert tomllib.loads(draft([tmp_path], tmp_path).text())


@pytest.mark.parametrize(
    ("name", "words", "unit"),
    [
        ("GPSTime(s)", ["gps", "time"], "s"),
        ("TimeUS", ["time", "us"], ""),
        ("locationHorizontalAccuracy(m)", ["location", "horizontal", "accuracy"], "m"),
        ("gyro_x [°/s]", ["gyro", "x"], "deg s"),
        ("log.imu.w[2]", ["log", "imu", "w", "z"], ""),
    ],
)
def test_words_of_a_name(name, words, unit):
    assert words_of(name) == (words, unit)


def test_words_behind_a_quantity_have_to_be_a_unit():
    of = lambda name: named_column("a.csv", name, *words_of(name))
    assert of("lat_error") is None and of("gyro_x_raw") is None
    assert (of("height_m").quantity, of("height_m").unit) == ("height", "m") and of("acc_x_g").axis == "x"


def test_a_folder_that_is_sure_is_read_as_it_is(rec, tmp_path, monkeypatch):
    a_file_a_sensor(rec, tmp_path)
    (tmp_path / "Gyroscope.csv").rename(tmp_path / "gyro.csv")  # no app's folder
    opened = []
    draft_module = sys.modules["jaxnav.io.draft"]
    monkeypatch.setattr(draft_module, "draft", lambda *args: opened.append(args) or draft(*args))
    got = read(tmp_path)
    assert len(opened) == 1  # for the recogniser and the reader
    assert "jaxnav map" in got.notes and got.imu.t.size > 1400 and "position" in got.aiding


def test_the_command_prints_the_map(rec, tmp_path, capsys, monkeypatch):
    short_names(rec, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["map", "imu.txt", "gnss.txt"]) == 0
    (tmp_path / "draft.toml").write_text(capsys.readouterr().out, encoding="utf-8")
    assert {"position", "velocity"} <= read("draft.toml").aiding.keys()
    assert cli.main(["map", "nowhere.csv"]) == 3
    assert "nowhere.csv" in capsys.readouterr().err


def test_an_imu_and_its_fixes_are_two_paths(rec, tmp_path, capsys, monkeypatch):
    receivers_units(rec, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["convert", "sensors.csv", "pvt.csv", "--out", "out", "--quiet"]) == 0
    assert {"position", "velocity"} <= read("out").aiding.keys()
    assert cli.main(["convert", "a", "b", "c", "--out", "other"]) == 2
    assert "a recording and a file with its fixes, got 3 paths" in capsys.readouterr().err
