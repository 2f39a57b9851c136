"""What docs/formats.md promises and no other test names: column names, units, streams of autopilots."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy import constants

from jaxnav.io import read_recording, write_recording
from jaxnav.io.canonical import ACCEL, DTHETA, GYRO, RPH
from jaxnav.io.column_map import described
from jaxnav.io.formats import dataflash, novatel, ulog
from jaxnav.io.units import PRESSURE, UNITS
from jaxnav.maths.units import DEG
from jaxnav.measurements import with_data
from jaxnav.types import Samples

PAGE = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()


def renamed(path: Path, written: str, other: str, factor: float) -> None:
    """Write a column of a CSV file under its other name, in that name's unit."""
    head, *rows = path.read_text().splitlines()
    names = head.split(",")
    at = names.index(written)
    names[at] = other
    lines = [line.split(",") for line in rows]
    for cells in lines:
        cells[at] = repr(float(cells[at]) / factor)
    path.write_text("\n".join([",".join(names), *map(",".join, lines)]) + "\n")


@pytest.mark.parametrize("name", with_data())
def test_a_stream_has_its_file_and_each_name_of_its_columns(drive, tmp_path, name):
    row, t = with_data()[name], np.arange(1.0, 9.0)
    value = np.linspace(0.1, 0.4, t.size * row.size).reshape(t.size, -1)
    if name in drive.aiding:
        value = drive.aiding[name].value[: t.size]
    samples = Samples(t, value, 0.5 + 0 * value, 0 * value)
    write_recording(tmp_path / "own", drive._replace(aiding=drive.aiding | {name: samples}))
    file = tmp_path / "own" / f"{name}.csv"
    assert f"`{name}.csv`" in PAGE
    for column in row.columns:
        for names in (column.names, column.sd_names):
            written, *others = names
            for other, factor in others:
                renamed(file, written[0], other, factor)
                np.testing.assert_allclose(read_recording(tmp_path / "own").aiding[name].value, value, rtol=1e-12)
                renamed(file, other, written[0], 1 / factor)
    head = file.read_text().partition("\n")[0].split(",")
    mentioned = [h for h in head if f"`{h}`" in PAGE or f"`{h}`/" in PAGE or "sd_" in h]
    assert len(mentioned) == len(head), set(head) - set(mentioned)


@pytest.mark.parametrize("columns, file", [(GYRO, "imu"), (ACCEL, "imu"), (RPH, "truth")])
def test_the_imu_and_truth_in_their_other_units(drive, tmp_path, columns, file):
    write_recording(tmp_path / "own", drive)
    for (written, _), (other, factor) in columns:
        renamed(tmp_path / "own" / f"{file}.csv", written, other, factor)
    back = read_recording(tmp_path / "own")
    for a, b in zip((*back.imu, *back.truth), (*drive.imu, *drive.truth), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("degrees", [False, True])
def test_increments_are_divided_by_their_interval(drive, tmp_path, degrees):
    write_recording(tmp_path / "own", drive)
    dt = float(np.median(drive.imu.dt))
    for (rate, _), (force, _), names, axis in zip(
        (g[0] for g in GYRO), (a[0] for a in ACCEL), DTHETA, "xyz", strict=True
    ):
        name, factor = names[int(degrees)]
        renamed(tmp_path / "own" / "imu.csv", rate, name, factor / dt)
        renamed(tmp_path / "own" / "imu.csv", force, f"dv_{axis}_mps", 1 / dt)
    np.testing.assert_allclose(read_recording(tmp_path / "own").imu.gyro, drive.imu.gyro, rtol=1e-9)
    np.testing.assert_allclose(read_recording(tmp_path / "own").imu.accel, drive.imu.accel, rtol=1e-9)


def test_every_unit_of_the_page_is_known_and_is_its_size():
    """By scipy's constants."""
    known = {unit: factor for units in UNITS.values() for unit, factor in units.items()} | PRESSURE
    said = re.findall(r"`unit`: ([^|;.]+)", PAGE)
    named = {word.strip() for text in said for word in re.split(r",| or ", text.split(" of the standard")[0])}
    assert {"km/h", "kPa", "mdeg/s"} <= named
    assert named - {""} <= set(known), named - set(known)
    expected = {
        "mph": constants.mph, "knots": constants.knot, "km/h": constants.kmh, "ft": constants.foot, "g": constants.g,
        "mg": constants.g / 1000, "deg/s": constants.degree, "mdeg/s": constants.degree / 1000, "mm/s": 1e-3,
        "nT": 1e-3,
        "gauss": 100.0, "mgauss": 0.1, "T": 1e6, "cm": 0.01, "hPa": 100.0, "kPa": 1000.0, "1e-7 deg": 1e-7 * DEG,
    }  # fmt: skip
    for unit, factor in expected.items():
        assert known[unit] == pytest.approx(factor, rel=1e-12), unit


def test_a_map_turns_the_truth_of_each_axes(tmp_path):
    (tmp_path / "t.csv").write_text("t,lat,lon,h,a,b,c,r,p,y\n1,48,11,500,1,2,3,5,-5,90\n2,48,11,500,1,2,3,5,-5,90\n")
    place = {"file": "t.csv", "time": "t", "lla": ["lat", "lon", "h"], "rph": ["r", "p", "y"]}
    of = lambda **more: described({"truth": place | more}, "map.toml", tmp_path).truth
    np.testing.assert_array_equal(of(velocity_enu=["a", "b", "c"]).vel[0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(of(velocity_ned=["a", "b", "c"]).vel[0], [2.0, 1.0, -3.0])
    np.testing.assert_allclose(of(velocity_enu=["a", "b", "c"]).rph[0], np.radians([5.0, -5.0, 90.0]))
    np.testing.assert_allclose(of(velocity_enu=["a", "b", "c"], rph_unit="rad").rph[0], [5.0, -5.0, 90.0])


def test_a_ulog_without_sensor_combined_has_its_imu_elsewhere():
    stamp = np.array([1_000_000, 1_005_000, 1_010_000])
    axes = lambda name, rows: {f"{name}[{i}]": rows[:, i] for i in range(3)}
    turned, pushed = 0.005 * np.arange(9.0).reshape(3, 3), 0.005 * np.full((3, 3), -9.8)
    vehicle = {"timestamp": stamp, "delta_angle_dt": np.full(3, 5000), "delta_velocity_dt": np.full(3, 5000),
               **axes("delta_angle", turned), **axes("delta_velocity", pushed)}  # fmt: skip
    rows = ulog._imu({"vehicle_imu": vehicle})
    np.testing.assert_allclose(rows.gyro, turned / 0.005)
    np.testing.assert_allclose(rows.accel, pushed / 0.005)
    gyro = {"timestamp": stamp} | dict(zip("xyz", np.arange(9.0).reshape(3, 3)))
    accel = {"timestamp": stamp[[0, 2]]} | {a: np.array([1.0, 3.0]) for a in "xyz"}
    rows = ulog._imu({"sensor_gyro": gyro, "sensor_accel": accel})
    np.testing.assert_allclose(rows.accel, [[1.0] * 3, [2.0] * 3, [3.0] * 3], rtol=1e-12)
    assert ulog._imu({"sensor_gyro": gyro}) is None


def test_a_dataflash_log_has_airspeed_and_heading_of_two_antennas(tmp_path):
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 130, 60, IMU, Qffffff, TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
        "FMT, 131, 60, GPS, QBIHLLfffff, TimeUS,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw",
        "FMT, 132, 60, ARSP, Qf, TimeUS,Airspeed",
    ]
    for i in range(300):
        us = 1_000_000 + 20_000 * i
        lines.append(f"IMU, {us}, 0.0, 0.0, 0.0, 0.0, 0.0, -9.8")
        if i % 10 == 0:
            lines.append(f"ARSP, {us}, {15.0 + i}")
            yaw = 0.0 if i == 50 else 270.0
            lines.append(f"GPS, {us}, 3, {345600000 + 20 * i}, 2100, 48.0, 11.0, 500.0, 15.0, 90.0, 0.0, {yaw}")
    (tmp_path / "a.log").write_text("\n".join(lines) + "\n")
    aiding = dataflash.read(tmp_path / "a.log").aiding
    np.testing.assert_array_equal(aiding["airspeed"].value[:2, 0], [15.0, 25.0])
    assert len(aiding["heading"].t) == 29  # 0 is none
    np.testing.assert_allclose(aiding["heading"].value, np.radians(270.0))


def test_every_log_of_novatel_on_the_page_is_a_row():
    known = {*novatel.RAW, *novatel.POSITIONS, *novatel.VELOCITIES, *novatel.SOLUTIONS}
    row = next(line for line in PAGE.splitlines() if line.startswith("| NovAtel ASCII"))
    said = {word for word in re.findall(r"`([A-Z]{6,})`", row)}
    assert said == known
