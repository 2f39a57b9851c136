"""Each format against its oracle, value by value, on recorded files and on ones that the oracle's writer made."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from benchmarks.recordings.wild import sources
from jaxnav import io, reading
from jaxnav.io.formats import dataflash, ulog
from jaxnav.io.readers import READERS, read_parts, recognise
from jaxnav.maths.axes import rotation
from jaxnav.maths.units import DEG
from jaxnav.reading.read import read
from jaxnav.types import DataError

from .test_formats import assert_same, data, recording

MAPS = [path for path in sources().values() if path.suffix == ".toml"]


# ---------------------------------------------------------------------------- the wild


@pytest.mark.parametrize("recipe", MAPS, ids=lambda path: path.stem)
def test_every_recipe_reads_and_round_trips(recipe, tmp_path):
    folder = tomllib.loads(recipe.read_text())["folder"].removeprefix("$JAXNAV_DATA_DIR").strip("/")
    data(folder.split("/")[0] or "navego_canada")
    rec = read(recipe)
    assert "position" in rec.aiding and rec.imu.accel[:, 2].mean() < -9.0  # FRD
    io.write_recording(tmp_path / "run.npz", rec)
    assert_same(io.read_recording(tmp_path / "run.npz"), rec)
    again = read(tmp_path / "run.npz")
    assert set(rec.notes.split("\n")) <= set(again.notes.split("\n"))
    np.testing.assert_array_equal(again.imu.gyro, rec.imu.gyro)
    np.testing.assert_array_equal(again.imu.dt, rec.imu.dt)


@pytest.mark.parametrize("recipe, least", [("kitti", 0.98), ("kth", 0.97), ("phone", 0.95), ("morpinet", 0.97)])
def test_the_axes_of_a_recipe_turn_with_the_track(recipe, least):
    data("gtsam_kitti")
    rec = read(sources()[recipe])
    position = rec.aiding["position"]
    every = max(1, round(1.0 / float(np.median(np.diff(position.t)))))
    t, lla = position.t[::every], position.value[::every]
    east, north = np.gradient(lla[:, 1], t) * np.cos(lla[0, 0]), np.gradient(lla[:, 0], t)
    course = np.unwrap(np.arctan2(east, north))
    angle = np.interp(t, rec.imu.t, np.cumsum(rec.imu.gyro[:, 2] * rec.imu.dt))
    speed = np.hypot(east, north)
    moving = speed > 0.4 * np.median(speed[speed > 0.1 * speed.max()])
    rate = np.gradient(angle, t)
    assert np.corrcoef(rate[moving], np.gradient(course, t)[moving])[0, 1] > least


def test_a_gap_and_an_absolute_first_step_are_said():
    data("gtsam_kitti")
    rec = read(sources()["kitti"])
    assert rec.imu.dt.max() < 0.03 and "The IMU has one gap, the longest 1.92 s long" in rec.notes


def test_a_map_may_mend_a_polled_log_with_a_time_tag():
    data("rtkexplorer_drive")
    rec = reading.load("rtkexplorer_drive")
    assert "1138 repeated rows are taken out and 1419 lost samples filled in" in rec.notes
    assert "13 of 2197 rows are before" in rec.notes and np.median(rec.imu.dt) == pytest.approx(0.009952, abs=1e-6)


# ---------------------------------------------------------------------------- PX4 ULog


@pytest.mark.parametrize("name", ["sample", "sample_log_small", "sample_px4_events"])
def test_ulog_against_pyulog(name):
    pyulog = pytest.importorskip("pyulog")
    path = data("ulog_samples") / f"{name}.ulg"
    rec, log = read(path), pyulog.ULog(str(path))
    imu = log.get_dataset("sensor_combined").data
    assert len(rec.imu.t) == len(imu["timestamp"])
    np.testing.assert_allclose(np.diff(rec.imu.t), np.diff(imu["timestamp"].astype(np.int64)) / 1e6, atol=1e-6)
    for i in range(3):
        np.testing.assert_allclose(rec.imu.gyro[:, i], imu[f"gyro_rad[{i}]"])
        np.testing.assert_allclose(rec.imu.accel[:, i], imu[f"accelerometer_m_s2[{i}]"])
    if name == "sample":  # no receiver; the magnetometer stands in sensor_combined
        new = np.r_[True, np.diff(imu["timestamp"].astype(int) + imu["magnetometer_timestamp_relative"]) > 0]
        assert set(rec.aiding) == {"magnetometer"}
        np.testing.assert_allclose(rec.aiding["magnetometer"].value[:, 0], imu["magnetometer_ga[0]"][new][1:] * 100.0)
        return
    gps = log.get_dataset("vehicle_gps_position").data
    fixed = gps["fix_type"] >= 3
    position, velocity = rec.aiding["position"], rec.aiding["velocity"]
    modern = "latitude_deg" in gps
    lat, height = (
        (gps["latitude_deg"], gps["altitude_ellipsoid_m"]) if modern else (gps["lat"] / 1e7, gps["alt_ellipsoid"] / 1e3)
    )
    np.testing.assert_allclose(position.value[:, 0] / DEG, lat[fixed], rtol=1e-12)
    np.testing.assert_allclose(position.value[:, 2], height[fixed])
    np.testing.assert_allclose(position.sd[:, 2], gps["epv"][fixed])
    np.testing.assert_allclose(velocity.value[:, 0], gps["vel_e_m_s"][fixed])
    np.testing.assert_allclose(velocity.value[:, 2], -gps["vel_d_m_s"][fixed])
    np.testing.assert_allclose(velocity.sd[:, 0], gps["s_variance_m_s"][fixed])
    assert {"barometer", "magnetometer"} <= set(rec.aiding)


def test_ulog_truth_of_a_simulation_agrees_with_its_fixes():
    pytest.importorskip("pyulog")
    rec = read(data("ulog_samples") / "sample_logging_tagged_and_default_params.ulg")
    position, truth = rec.aiding["position"], rec.truth
    at = np.stack([np.interp(position.t, truth.t, x) for x in truth.lla.T], axis=1)
    assert np.abs((position.value - at) * [6.4e6, 4.3e6, 0.0]).max() < 1.0
    assert "The simulator's truth has no height" in rec.notes
    assert np.abs(truth.rph[:, :2]).max() < 0.1  # stands level


# ---------------------------------------------------------------------------- ArduPilot DataFlash


def logged(path: Path) -> dict[str, list]:
    DFReader = pytest.importorskip("pymavlink.DFReader")
    reader = DFReader.DFReader_binary(str(path)) if path.suffix == ".BIN" else DFReader.DFReader_text(str(path))
    out: dict[str, list] = {}
    while (message := reader.recv_msg()) is not None:
        out.setdefault(message.get_type(), []).append(message.to_dict())
    reader.close() if hasattr(reader, "close") else None
    return out


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_dataflash_against_pymavlink():
    path = data("dataflash_sample") / "test.BIN"
    theirs, ours = logged(path), dataflash.read_messages(path)
    compared = 0
    for name, columns in ours.items():
        if name == "FMT":
            continue
        assert len(theirs[name]) == len(next(iter(columns.values())))
        for column, values in columns.items():
            expected = np.array([row[column] for row in theirs[name]], float)
            np.testing.assert_allclose(values, expected, rtol=1e-12, atol=1e-12, err_msg=f"{name}.{column}")
            compared += values.size
    assert set(ours) | {"FMT"} == set(theirs) and compared > 5000
    rec = read(path)
    np.testing.assert_allclose(rec.imu.gyro[:, 1], [row["GyrY"] for row in theirs["IMU"]])
    np.testing.assert_allclose(rec.aiding["position"].sd[:, 2], [row["VAcc"] for row in theirs["GPA"]])
    np.testing.assert_allclose(rec.aiding["position"].sd[:, 1], [row["HAcc"] for row in theirs["GPA"]])
    np.testing.assert_allclose(rec.aiding["magnetometer"].value[:, 0], [0.1 * row["MagX"] for row in theirs["MAG"]])
    np.testing.assert_allclose(read(path, instance=1).imu.accel[:, 2], [row["AccZ"] for row in theirs["IMU2"]])
    with pytest.raises(DataError, match="test.BIN: has no IMU 5"):
        read(path, instance=5)


def dataflash_text(path: Path) -> str:
    """The same log as a ground station writes it as text: what the format's characters scale is scaled."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    wanted = {
        "IMU": ("QffffffIIfBBHH", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
        "GPS": ("QBIHBcLLefffB", "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U"),
    }
    messages = dataflash.read_messages(path)
    rows = []
    for number, (name, (codes, columns)) in enumerate(wanted.items(), start=130):
        lines.append(f"FMT, {number}, 60, {name}, {codes}, {columns}")
        table = [messages[name][c] for c in columns.split(",")]
        rows += [
            (row[0], f"{name}, {int(row[0])}, " + ", ".join(f"{x!r}" for x in row[1:]))
            for row in zip(*(c.tolist() for c in table))
        ]
    return "\n".join([*lines, *(line for _, line in sorted(rows))]) + "\n"


def test_dataflash_text_is_the_binary(tmp_path):
    path = data("dataflash_sample") / "test.BIN"
    (tmp_path / "a.log").write_text(dataflash_text(path))
    text, binary = read(tmp_path / "a.log"), read(path)
    np.testing.assert_allclose(text.imu.accel, binary.imu.accel)
    np.testing.assert_allclose(text.aiding["position"].value, binary.aiding["position"].value)
    np.testing.assert_allclose(text.aiding["velocity"].value, binary.aiding["velocity"].value)


def test_dataflash_rangefinders_that_look_down_and_headings_of_two_antennas(tmp_path):
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
             "FMT, 130, 60, IMU, Qffffff, TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
             "FMT, 131, 60, RFND, QBfBBb, TimeUS,Instance,Dist,Stat,Orient,Quality",
             "FMT, 132, 60, GPS, QBLLeffff, TimeUS,Status,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw"]  # fmt: skip
    lines += [f"IMU, {10_000 * k}, 0.0, 0.0, 0.0, 0.0, 0.0, -9.8" for k in range(1, 500)]
    seen = [(1.5, 4, 25), (1.6, 2, 25), (9.0, 4, 0), (1.7, 4, 25)]  # distance, status, orientation
    lines += [f"RFND, {1_000_000 + 100_000 * k}, 0, {d}, {s}, {o}, 100" for k, (d, s, o) in enumerate(seen)]
    lines += [
        f"GPS, {1_000_000 + 200_000 * k}, 3, 48.0, 11.0, 500.0, 0.0, 0.0, 0.0, {y}" for k, y in enumerate((0, 90))
    ]
    (tmp_path / "a.log").write_text("\n".join(lines) + "\n")
    aiding = read_parts(tmp_path / "a.log").aiding
    np.testing.assert_allclose(aiding["rangefinder"].value[:, 0], [1.5, 1.7])
    np.testing.assert_allclose(aiding["rangefinder"].t, [1.0, 1.3])
    np.testing.assert_allclose(aiding["heading"].value, [[np.pi / 2]])
    np.testing.assert_allclose(aiding["heading"].t, [1.2])


def test_ulog_topics_of_heading_range_and_wheels():
    """As pyulog gives them; nothing writes a ULog."""
    stamp = np.array([1_000_000, 1_100_000, 1_200_000], np.uint64)
    gps = {"timestamp": stamp, "heading": np.array([np.nan, 1.0, 2.0]), "heading_accuracy": np.array([0, 0.02, np.nan])}
    heading = ulog._heading({"sensor_gps": gps})
    np.testing.assert_allclose(heading.t, [1.1, 1.2])
    np.testing.assert_allclose(heading.value[:, 0], [1.0, 2.0])
    np.testing.assert_allclose(heading.sd[:, 0], [0.02, np.nan])
    assert ulog._heading({"sensor_gps": {"timestamp": stamp}}) is None
    one = np.ones(3)
    down = {"timestamp": stamp, "current_distance": np.array([2.0, 50.0, 3.0]), "min_distance": 0.1 * one,
            "max_distance": 40.0 * one, "variance": 0.04 * one, "orientation": np.full(3, 25)}  # fmt: skip
    found = ulog._rangefinder({"distance_sensor": down})
    np.testing.assert_allclose(found.value[:, 0], [2.0, 3.0])
    np.testing.assert_allclose(found.sd[:, 0], 0.2)
    turns = {"timestamp": stamp, "wheel_speed[0]": 10.0 * one, "wheel_speed[1]": 12.0 * one}  # right, left
    np.testing.assert_allclose(ulog._wheels({"wheel_encoders": turns}, 0.1, []).value[0], [1.2, 1.0])
    assert ulog._wheels({"wheel_encoders": turns}, 0.0, notes := []) is None and "wheel_radius_m" in str(notes[0])
    bad = down | {"signal_quality": np.array([0, 100, -1])}
    np.testing.assert_allclose(ulog._rangefinder({"distance_sensor": bad}).value[:, 0], [3.0])


# ---------------------------------------------------------------------------- ROS


def test_ros1_bag_against_rosbags():
    highlevel = pytest.importorskip("rosbags.highlevel")
    path = data("husky_bag") / "test1.bag"
    rec = read(path, axes="-z,x,-y")
    with highlevel.AnyReader([path]) as bag:
        messages = {c.topic: [] for c in bag.connections}
        for c, _, raw in bag.messages():
            messages[c.topic].append(bag.deserialize(raw, c.msgtype))
    imu = messages["/imu/data"]
    assert len(rec.imu.t) == len(imu) == 11865
    np.testing.assert_allclose(rec.imu.gyro[:, 2], [-m.angular_velocity.y for m in imu])
    np.testing.assert_allclose(rec.imu.accel[:, 0], [-m.linear_acceleration.z for m in imu])
    stamps = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in imu])
    np.testing.assert_allclose(rec.imu.t - rec.imu.t[0], (stamps - stamps[0]) / 1e9, atol=1e-9)
    fixes = messages["/fix"]
    np.testing.assert_allclose(rec.aiding["position"].value[:, 0], [m.latitude * DEG for m in fixes])
    np.testing.assert_allclose(rec.aiding["position"].sd[:, 2] ** 2, [m.position_covariance[8] for m in fixes])
    odometry = np.array([m.twist.twist.linear.x for m in messages["/husky_velocity_controller/odom"]])
    np.testing.assert_allclose(rec.aiding["speed"].value[:, 0], odometry[:-1])
    with pytest.raises(DataError, match="topics: imu: no /imu, it has /imu/data"):
        read(path, topics={"imu": "/imu"})


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_ros2_bags_of_both_storages(tmp_path, storage):
    pytest.importorskip("rosbags")
    write_ros2(tmp_path / "bag", storage)
    assert "say topics={'velocity': '/vel'}" in read(tmp_path / "bag").notes
    rec, expected = read(tmp_path / "bag", topics={"velocity": "/vel"}), recording()
    np.testing.assert_allclose(rec.imu.gyro, expected.imu.gyro)
    np.testing.assert_allclose(rec.imu.accel, expected.imu.accel)
    np.testing.assert_allclose(np.diff(rec.imu.t), 0.01, atol=1e-9)
    assert set(rec.aiding) == {"position", "velocity", "magnetometer", "barometer"}
    assert "/below is not read: if it is a sensor that looks down" in rec.notes
    over = read(tmp_path / "bag", topics={"body_velocity": "/vel"}).aiding["body_velocity"].value[0]
    np.testing.assert_allclose(over, expected.aiding["velocity"].value[0] * [1, -1, -1])  # as forward, left, up
    below = read(tmp_path / "bag", topics={"rangefinder": "/below"}).aiding["rangefinder"]
    np.testing.assert_allclose(below.value[:, 0], 7.0)
    assert below.t.size == rec.aiding["barometer"].t.size - 1  # one is beyond its reach
    assert " is /" not in rec.notes  # which topic of several: there is one of each
    np.testing.assert_allclose(rec.aiding["position"].value[0], expected.aiding["position"].value[0])
    np.testing.assert_allclose(rec.aiding["velocity"].value[0], expected.aiding["velocity"].value[0])
    np.testing.assert_allclose(rec.aiding["magnetometer"].value[0], [20.0, -5.0, 40.0])
    np.testing.assert_allclose(rec.aiding["barometer"].value[0], 111.0, atol=1.0)  # 100 kPa
    (file,) = [*(tmp_path / "bag").glob("*.db3"), *(tmp_path / "bag").glob("*.mcap")]
    assert recognise(file).name == "ROS bag"
    turned = read(file, axes="-z,x,-y")  # the magnetometer turns with the IMU
    np.testing.assert_allclose(turned.aiding["magnetometer"].value[0], [40.0, 20.0, -5.0])
    np.testing.assert_array_equal(read(file).imu.gyro, rec.imu.gyro)


def write_ros2(folder: Path, storage: str) -> None:
    """The made-up recording in a ROS 2 bag."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}[storage]
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        write_messages(writer, store, store.serialize_cdr, {})


def write_ros1(file: Path) -> None:
    """The made-up recording in a ROS 1 bag."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(file) as writer:
        write_messages(writer, store, store.serialize_ros1, {"seq": 0})


def write_messages(writer, store, serialize, extra: dict) -> None:
    connections: dict = {}
    for t, topic, message in messages(store.types, extra):
        kind = message.__msgtype__
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], ZERO + round(t * 1e9), serialize(message, kind))


ZERO = 1_700_000_000_000_000_000  # ns since 1970


def messages(kinds: dict, extra: dict):
    """The made-up recording in standard messages, FLU."""
    expected = recording()
    flu, q = [1.0, -1.0, -1.0], kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    status = kinds["sensor_msgs/msg/NavSatStatus"](status=0, service=1)

    def header(t):
        ns = ZERO + round(t * 1e9)
        stamp = kinds["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="base", **extra)

    fields = kinds["sensor_msgs/msg/Range"].__dataclass_fields__
    more = {"variance": 0.0} if "variance" in fields else {}  # of newer ones

    def vector(v):
        return kinds["geometry_msgs/msg/Vector3"](*(float(x) for x in v))

    for t, w, f in zip(expected.imu.t, expected.imu.gyro * flu, expected.imu.accel * flu):
        c = np.zeros(9)
        yield t, "/imu", kinds["sensor_msgs/msg/Imu"](header(t), q, c, vector(w), c, vector(f), c)
    for t, (lat, lon, h), v in zip(*expected.aiding["position"][:2], expected.aiding["velocity"].value):
        fix = kinds["sensor_msgs/msg/NavSatFix"](header(t), status, lat / DEG, lon / DEG, h, np.eye(3).ravel(), 2)
        yield t, "/fix", fix
        twist = kinds["geometry_msgs/msg/Twist"](vector(v), vector([0, 0, 0]))
        yield t, "/vel", kinds["geometry_msgs/msg/TwistStamped"](header(t), twist)
        field = vector(np.array([20.0, 5.0, -40.0]) * 1e-6)
        yield t, "/mag", kinds["sensor_msgs/msg/MagneticField"](header(t), field, np.zeros(9))
        far = 7.0 if t > expected.aiding["position"].t[0] else 99.0
        yield t, "/below", kinds["sensor_msgs/msg/Range"](header(t), 1, 0.1, 0.2, 40.0, far, **more)
        yield t, "/air", kinds["sensor_msgs/msg/FluidPressure"](header(t), 1e5, 0.0)


# ---------------------------------------------------------------------------- receivers


def write_ubx(path: Path, rows: int = 8) -> None:
    pyubx2 = pytest.importorskip("pyubx2")
    out = b"$GPTXT,01,01,02,hello*59\r\n"
    for k in range(rows):
        out += pyubx2.UBXMessage(
            "NAV", "NAV-PVT", pyubx2.GET, iTOW=345600000 + 250 * k, year=2023, month=11, day=16, hour=0, min=0,
            second=0, validDate=1, validTime=1, fixType=3 if k else 0, gnssFixOk=1, numSV=12,
            lat=48.1 + 1e-5 * k, lon=11.5,
            height=500000, hMSL=450000, hAcc=1500, vAcc=2500, velN=1000, velE=2000, velD=-300, sAcc=120,
        ).serialize()  # fmt: skip
        out += pyubx2.UBXMessage(
            "NAV", "NAV-RELPOSNED", pyubx2.GET, version=1, iTOW=345600000 + 250 * k, relPosHeading=11.25 + k,
            accHeading=0.5, relPosValid=1, relPosHeadingValid=k != 3, isMoving=k != 4,
        ).serialize()  # fmt: skip
    path.write_bytes(out)


def test_ubx_against_what_was_written(tmp_path):
    write_ubx(tmp_path / "a.ubx")
    assert recognise(tmp_path / "a.ubx").name == "UBX"
    parts = read_parts(tmp_path / "a.ubx")
    position, velocity = parts.aiding["position"], parts.aiding["velocity"]
    assert len(position.t) == 7 and list(map(str, parts.notes)) == ["1 messages have no fix in three dimensions"]
    # 2023-11-16 is a Thursday, four days into its week: 00:00:00.25 GPS time
    np.testing.assert_allclose(position.t, 1700092800.0 + 0.25 * np.arange(1, 8), atol=1e-6)
    np.testing.assert_allclose(position.value[0], [48.10001 * DEG, 11.5 * DEG, 500.0], rtol=1e-10)
    np.testing.assert_allclose(position.sd[0], [1.5, 1.5, 2.5])
    np.testing.assert_allclose(velocity.value[0], [2.0, 1.0, 0.3])
    np.testing.assert_allclose(velocity.sd[0], 0.12)
    heading = parts.aiding["heading"]  # 3 says that it is none, of 4 the base stands
    np.testing.assert_allclose(heading.t, 1700092800.0 + 0.25 * np.array([0, 1, 2, 5, 6, 7]), atol=1e-6)
    np.testing.assert_allclose(heading.value[:, 0] / DEG, 11.25 + np.array([0, 1, 2, 5, 6, 7]), atol=2e-5)
    np.testing.assert_allclose(heading.sd[0], 0.5 * DEG, atol=2e-7)  # told to 1e-5 deg


def test_ubx_of_a_receiver_without_nav_pvt(tmp_path):
    """Position, velocity and status in messages of their own; the week is NAV-SOL's."""
    pyubx2 = pytest.importorskip("pyubx2")
    message = lambda name, **fields: pyubx2.UBXMessage("NAV", name, pyubx2.GET, **fields).serialize()
    out, bare = b"", b""
    for k in range(6):
        tow = 345600000 + 200 * k
        place = {"lon": 11.5, "lat": 48.1 + 1e-5 * k, "height": 500000, "hMSL": 450000, "hAcc": 1500, "vAcc": 2500}
        fix = message("NAV-POSLLH", iTOW=tow, **place)
        if k != 4:
            fix += message("NAV-VELNED", iTOW=tow, velN=100, velE=200, velD=-30, speed=226, gSpeed=224, sAcc=12)
        bare += fix
        out += fix + message("NAV-SOL", iTOW=tow, week=2288, gpsFix=3 if k else 2, gpsfixOK=1, wknSet=1, towSet=1)
    (tmp_path / "a.ubx").write_bytes(out)
    parts = read_parts(tmp_path / "a.ubx")
    position, velocity = parts.aiding["position"], parts.aiding["velocity"]
    assert list(map(str, parts.notes)) == ["1 messages have no fix in three dimensions"]
    np.testing.assert_allclose(position.t, 1700092800.0 + 0.2 * np.arange(1, 6), atol=1e-6)
    np.testing.assert_allclose(position.value[0], [48.10001 * DEG, 11.5 * DEG, 500.0], rtol=1e-10)
    np.testing.assert_allclose(position.sd[0], [1.5, 1.5, 2.5])
    np.testing.assert_allclose(velocity.value[0], [2.0, 1.0, 0.3])
    assert velocity.t.size == 4 and velocity.sd[0, 0] == pytest.approx(0.12)
    (tmp_path / "b.ubx").write_bytes(bare)  # no status and no week: every fix, in seconds of the week
    np.testing.assert_allclose(read_parts(tmp_path / "b.ubx").aiding["position"].t, 345600.0 + 0.2 * np.arange(6))


def nmea(*bodies: str) -> str:
    out = []
    for body in bodies:
        check = 0
        for byte in body.encode():
            check ^= byte
        out.append(f"${body}*{check:02X}\r\n")
    return "".join(out)


def test_nmea_over_midnight_with_and_without_gst(tmp_path):
    pytest.importorskip("pynmeagps")
    (tmp_path / "a.txt").write_text(
        nmea(
            "GPGGA,235959.00,4807.0380,N,01131.0000,W,1,08,0.9,545.4,M,46.9,M,,",
            "GPGST,235959.00,1.0,,,,2.0,3.0,4.0",
            "GPRMC,235959.00,A,4807.0380,N,01131.0000,W,010.0,090.0,151123,,",
            "GPHDT,91.5,T",
            "GPGGA,000000.00,4807.0380,N,01131.0000,W,1,08,2.0,545.4,M,46.9,M,,",
            "GPRMC,000000.00,A,4807.0380,N,01131.0000,W,010.0,000.0,161123,,",
            "GPTHS,77.0,V",
            "GPTHS,1.5,A",
            "GPGGA,000001.00,,,,,0,00,99.9,,M,,M,,",
            "GPGGA,000002.00,4807.0380,N,01131.0000,W,1,08,2.0,545.4,M,46.9,M,,",
        )
    )
    parts = read_parts(tmp_path / "a.txt")
    position, velocity = parts.aiding["position"], parts.aiding["velocity"]
    midnight = 1700092800.0 + 18.0
    np.testing.assert_allclose(position.t, midnight + np.array([-1.0, 0.0, 2.0]), atol=1e-6)
    np.testing.assert_allclose(position.value[0], [48.1173 * DEG, -11.516666667 * DEG, 592.3], rtol=1e-8)
    np.testing.assert_allclose(position.sd, [[3.0, 2.0, 4.0], [5.0, 5.0, 10.0], [5.0, 5.0, 10.0]])
    knots = 1852 / 3600
    np.testing.assert_allclose(velocity.value, [[10 * knots, 0.0, 0.0], [0.0, 10 * knots, 0.0]], atol=1e-12)
    heading = parts.aiding["heading"]
    np.testing.assert_allclose(heading.t, velocity.t)
    np.testing.assert_allclose(heading.value[:, 0] / DEG, [91.5, 1.5])
    assert any("2 of 3 rows state no sd" in str(note) for note in parts.notes)


# ---------------------------------------------------------------------------- the others


def test_ekf2_replay_against_its_rows():
    path = data("ecl_replay") / "iris_gps.csv"
    rec = read(path)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    imu = np.array([[float(c) for c in (row[0], *row[2:])] for row in rows if row[1] == "imu"])
    np.testing.assert_allclose(rec.imu.accel, imu[:, 1:4])
    np.testing.assert_allclose(rec.imu.gyro, imu[:, 4:])
    np.testing.assert_allclose(rec.imu.t, imu[:, 0] / 1e6)
    assert rec.aiding["position"].value[0] / DEG == pytest.approx([47.3977508, 8.5456073, 488.103 / DEG])


def test_euroc_folder_with_nanoseconds(tmp_path):
    imu = recording().imu
    folder = tmp_path / "mav0" / "imu0"
    folder.mkdir(parents=True)
    stamps = 1403636579758555392 + np.arange(400) * 5_000_000
    units = {"w": "rad s^-1", "a": "m s^-2"}
    head = ",".join(["#timestamp [ns]", *(f"{kind}_RS_S_{a} [{units[kind]}]" for kind in "wa" for a in "xyz")])
    rows = [",".join(map(repr, row)) for row in np.hstack([imu.gyro, imu.accel]).tolist()]
    text = "\n".join([head, *(f"{t},{row}" for t, row in zip(stamps, rows))]) + "\n"
    (folder / "data.csv").write_text(text)
    for path in (tmp_path, folder / "data.csv"):
        rec = read(path)
        np.testing.assert_array_equal(rec.imu.gyro, imu.gyro)
        np.testing.assert_allclose(np.diff(rec.imu.t), 0.005, rtol=1e-12)  # a float would round to 256 ns
    turned = read(tmp_path, axes="rfu")
    np.testing.assert_allclose(turned.imu.accel, imu.accel @ rotation("rfu").T)


def test_navego_by_what_its_structs_hold():
    folder = data("navego_synthetic")
    rec, mat = read(folder, imu="imu2"), loadmat(folder / "gnss.mat", squeeze_me=True)["gnss"]
    assert not np.array_equal(rec.imu.gyro, read(folder).imu.gyro)
    np.testing.assert_array_equal(rec.aiding["velocity"].value, mat["vel"].item()[:, [1, 0, 2]] * [1.0, 1.0, -1.0])
    np.testing.assert_array_equal(rec.aiding["position"].value[:, 0], mat["lat"].item())
    assert "the imu is imu1, of imu1, imu2." in read(folder).notes
    with pytest.raises(DataError, match="imu: no struct imu3, it has imu1, imu2"):
        read(folder, imu="imu3")


def test_kfgins_imu_beside_its_fixes(tmp_path):
    imu = recording().imu
    table = np.column_stack([imu.t + 456000.0, imu.gyro * 0.01, imu.accel * 0.01])
    np.savetxt(tmp_path / "imu.txt", table, fmt="%.15g")
    fixes = np.column_stack([456000.0 + 10.5 + np.arange(3), np.tile([30.0, 114.0, 20.0, 1.0, 2.0, 3.0], (3, 1))])
    np.savetxt(tmp_path / "gnss.txt", fixes, fmt="%.15g")
    rec = read(tmp_path / "imu.txt", gnss=tmp_path / "gnss.txt")
    np.testing.assert_allclose(rec.imu.gyro, imu.gyro, rtol=1e-6)
    np.testing.assert_array_equal(rec.aiding["position"].sd[0], [2.0, 1.0, 3.0])


def test_no_code_knows_the_name_of_a_recording():
    """Names of data sets are data: the maps and hashes of jaxnav/reading/recordings."""
    home = os.environ.get("JAXNAV_DATA_DIR")
    names = [path.name for path in Path(home).iterdir() if path.is_dir()] if home and Path(home).is_dir() else []
    files = [p for part in ("jaxnav", "tuning") for p in (Path(__file__).parents[2] / part).rglob("*.py")]
    assert len(READERS) > 10 and len(files) > 100
    assert not [(file.name, name) for file in files for name in names if name in file.read_text()]


def test_a_named_stream_may_have_numbered_columns(tmp_path):
    """As folders have them that were written before the stream had a name of its own."""
    rows = "\n".join(f"{0.01 * i:.2f},0,0,0,0,0,-9.8" for i in range(1, 500))
    axes = ",".join([*(f"gyro_{a}_radps" for a in "xyz"), *(f"accel_{a}_mps2" for a in "xyz")])
    (tmp_path / "imu.csv").write_text(f"t_s,{axes}\n{rows}\n")
    place = "\n".join(f"{t},0.8,0.1,100,1,1,1" for t in (1, 2, 3, 4))
    (tmp_path / "position.csv").write_text(f"t_s,lat_rad,lon_rad,h_m,sd_e_m,sd_n_m,sd_u_m\n{place}\n")
    (tmp_path / "aiding_barometer.csv").write_text("t_s,value_0,sd_0\n1,250,0.5\n2,251,0.5\n")
    (tmp_path / "heading.csv").write_text("t_s,heading_deg,sd_deg\n1,90,1\n2,180,1\n")
    rec = io.read_recording(tmp_path)
    np.testing.assert_array_equal(rec.aiding["barometer"].value[:, 0], [250, 251])
    np.testing.assert_allclose(rec.aiding["heading"].value[:, 0], [np.pi / 2, np.pi])
    np.testing.assert_allclose(rec.aiding["heading"].sd[:, 0], np.pi / 180)
