"""Receivers' own formats, and which of several receivers is read."""

import binascii
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from jaxnav.io import mend
from jaxnav.io.formats import rosbag
from jaxnav.io.formats.rosbag import from_receiver
from jaxnav.io.parts import with_fixes
from jaxnav.io.readers import read_parts
from jaxnav.types import DataError
from tests.io.conftest import fixes

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
    assert words is None or any(words in str(note) for note in parts.notes)


def test_an_empty_hdop_is_an_assumed_sd(tmp_path, drive):
    (tmp_path / "log.txt").write_text("\r\n".join(checked(line) for line in nmea(hdop="")) + "\r\n")
    stream = read_parts(tmp_path / "log.txt").aiding["position"]
    assert len(stream.t) == 20
    span = stream._replace(t=stream.t - stream.t[0] + drive.imu.t[0] + 5.0)
    rec = mend.mended(fixes(drive)._replace(aiding={"position": span}))
    assert (rec.aiding["position"].sd == [3.0, 3.0, 6.0]).all()


@pytest.mark.parametrize(
    ("shares", "chosen"),
    [((1.0, 1.0), "a 0"), ((0.0, 1.0), "a 1"), ((0.6, 1.0), "a 0"), ((0.3, 0.4), "a 1"), ((0.0, 0.0), "a 0")],
)
def test_a_dead_first_receiver_does_not_hide_the_second(shares, chosen):
    masks = {f"a {i}": np.arange(100) < 100 * share for i, share in enumerate(shares)}
    notes: list[str] = []
    assert with_fixes("a.log", masks, None, notes) == chosen and "of a 0, a 1 (option receiver)" in str(notes[0])
    assert with_fixes("a.log", masks, "a 1", notes) == "a 1"
    with pytest.raises(DataError, match="a.log: receiver: no b, it has a 0, a 1"):
        with_fixes("a.log", masks, "b", notes)


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
    assert from_receiver(receiver) > from_receiver(estimate)


# ---------------------------------------------------------------------------- ROS messages of receivers' drivers


def test_position_and_velocity_of_a_message_of_both():
    """NavPVT in 1e-7 deg, mm and mm/s with names of ROS 1 and 2; GPSFix with course, speed and accuracies at 95 %."""
    expected = [np.deg2rad(48.1), np.deg2rad(11.5), 500.0, 1.5, 1.5, 2.5, 2.0, 1.0, 0.3, *[0.12] * 3]
    two = dict(lat=481000000, lon=115000000, height=500000, h_acc=1500, v_acc=2500, vel_n=1000, vel_e=2000, vel_d=-300,
               s_acc=120, flags=1, fix_type=3)  # fmt: skip
    one = {"".join([w if i == 0 else w.capitalize() for i, w in enumerate(k.split("_"))]): v for k, v in two.items()}
    for fields in (one, two):
        np.testing.assert_allclose(rosbag._pvt(SimpleNamespace(**fields)), expected, rtol=1e-12)
        assert not np.isfinite(rosbag._pvt(SimpleNamespace(**fields | {"flags": 0}))).any()
    fix = SimpleNamespace(
        status=SimpleNamespace(status=0), latitude=48.1, longitude=11.5, altitude=500.0, position_covariance_type=0,
        position_covariance=np.zeros(9), err_horz=3.0, err_vert=5.0, track=np.degrees(np.arctan2(2.0, 1.0)),
        speed=np.hypot(2.0, 1.0), climb=0.3, err_speed=0.24,
    )  # fmt: skip
    np.testing.assert_allclose(rosbag._gps_fix(fix), expected, rtol=1e-12)
    fix.position_covariance_type, fix.position_covariance = 2, np.diag([4.0, 9.0, 16.0]).ravel()
    np.testing.assert_allclose(rosbag._gps_fix(fix)[3:6], [2.0, 3.0, 4.0])
    fix.status.status = -1
    assert not np.isfinite(rosbag._gps_fix(fix)).any()


def test_topics_that_are_not_read_are_named_where_there_is_no_position():
    topics = [SimpleNamespace(topic=f"/a{i:02d}", msgtype="x/msg/Y", msgcount=i) for i in range(14)]
    imu = SimpleNamespace(topic="/imu", msgtype=rosbag.IMU, msgcount=9)
    notes: list[str] = []
    assert rosbag._choose(Path("bag"), [imu, *topics], {}, notes) == {"imu": "/imu"}
    assert str(notes[-2]) == "position: no topic has a type that is read: record sensor_msgs/NavSatFix"
    assert notes[-1].code == "file.unread" and notes[-1].message.endswith(" and 2 more")
    assert ": /a13 of x/msg/Y (13), /a12 of" in notes[-1].message
    fix = SimpleNamespace(topic="/fix", msgtype="sensor_msgs/msg/NavSatFix", msgcount=5)
    other = SimpleNamespace(topic="/novatel/bestpos", msgtype="novatel/msg/BESTPOS", msgcount=5)
    rosbag._choose(Path("bag"), [imu, fix, other, *topics], {}, notes := [])
    assert len(notes) == 1 and notes[0].message.endswith(": /novatel/bestpos of novatel/msg/BESTPOS (5)")


# ---------------------------------------------------------------------------- sentences and messages of other kinds

GNS = "GNGNS,1000{k:02d}.00,4806.0,N,01136.0,E,AA,10,0.8,475.8,45.0,,"
RMC = "GNRMC,1000{k:02d}.00,A,4806.0,N,01136.0,E,10.0,90.0,010624,,,A"
GLL = "GNGLL,4806.0,N,01136.0,E,1000{k:02d}.00,A,A"
GGA = "GNGGA,1000{k:02d}.00,4806.0,N,01136.0,E,1,10,0.8,475.8,M,45.0,M,,"


@pytest.mark.parametrize(
    ("bodies", "height", "sd"),
    [((RMC,), np.nan, np.nan), ((GLL, RMC), np.nan, np.nan), ((GNS, RMC), 520.8, 2.0), ((GGA, GNS, RMC), 520.8, 2.0)],
)  # fmt: skip
def test_positions_of_any_sentence(tmp_path, bodies, height, sd):
    """The best kind of those that have most of the fixes; text before and behind a sentence is none of it."""
    lines = [f"12:00:{k:02d} {checked(body.format(k=k))} rssi=-60" for k in range(20) for body in bodies]
    (tmp_path / "a.log").write_text("\r\n".join(lines) + "\r\n")
    position = read_parts(tmp_path / "a.log").aiding["position"]
    assert len(position.t) == 20 and position.t[0] == 1717236018.0
    np.testing.assert_allclose(position.value[0], [np.deg2rad(48.1), np.deg2rad(11.6), height], rtol=1e-12)
    np.testing.assert_allclose(position.sd[0], [sd, sd, 2 * sd])


def test_a_few_sentences_of_a_better_kind_are_not_the_track(tmp_path):
    lines = [checked((GGA if k == 5 else RMC).format(k=k)) for k in range(20)]
    (tmp_path / "a.log").write_text("\r\n".join(lines) + "\r\n")
    assert len(read_parts(tmp_path / "a.log").aiding["position"].t) == 19


def pvt(k: int, name: str = "NAV-PVT") -> bytes:
    """A fix at second k of a week, moving east."""
    import pyubx2

    own = {"second": k % 60, "gnssFixOk": 1} if name == "NAV-PVT" else {"sec": k % 60, "gnssFixOK": 1}
    return pyubx2.UBXMessage(
        "NAV", name, pyubx2.GET, iTOW=1000 * k + 345600000, year=2023, month=11, day=16, hour=0, min=k // 60,
        validDate=1, fixType=3, lat=48.1, lon=11.5 + 1e-5 * k, height=500000, hAcc=1500, vAcc=2500, velE=700, sAcc=120,
        **own,
    ).serialize()  # fmt: skip


def esf(rows: list[tuple[int, dict[int, int]]]) -> bytes:
    """An ESF-RAW with samples of (tag, value by data type)."""
    import pyubx2

    words = [((kind << 24) | (value & 0xFFFFFF), tag % 2**32) for tag, row in rows for kind, value in row.items()]
    body = bytes(4) + np.array(words, "<u4").tobytes()
    return pyubx2.UBXMessage("ESF", "ESF-RAW", pyubx2.GET, payload=body).serialize()


@pytest.mark.parametrize(("tick", "first", "batch"), [(1e-3, 5000, 1), (1 / 25600, 2**32 - 70000, 10)])
def test_the_inertial_sensors_of_a_receiver(tmp_path, tick, first, batch):
    """By type, sign and unit; ten samples in a message, a counter that wraps, settings of the receiver between."""
    pyubx2 = pytest.importorskip("pyubx2")
    sample = lambda k: {14: -4096 * 3, 13: 4096 * 2, 5: k, 16: -1024, 17: 512, 18: 10035, 12: 2500}
    out, step = b"", round(0.05 / tick)
    setting = pyubx2.UBXMessage.config_set(1, 0, [("CFG_RATE_MEAS", 100)]).serialize()
    for k in range(0, 200, batch):
        out += esf([(first + (k + i) * step, sample(k + i)) for i in range(batch)])
        if (k + batch) % 20 == 0:
            out += setting + pvt((k + batch) // 20)
    (tmp_path / "a.ubx").write_bytes(out)
    parts = read_parts(tmp_path / "a.ubx")
    imu = parts.imu
    assert len(imu.t) == 200 and len(parts.aiding["position"].t) == 10
    np.testing.assert_allclose(np.diff(imu.t), 0.05, rtol=1e-5)
    assert imu.t[-1] == pytest.approx(parts.aiding["position"].t[-1], abs=1e-6)  # which came right behind it
    np.testing.assert_allclose(imu.gyro[7], np.deg2rad([-3.0, 2.0, 7 / 4096]), rtol=1e-12)
    np.testing.assert_allclose(imu.accel[7], [-1.0, 0.5, 10035 / 1024], rtol=1e-12)


def test_the_same_sensors_in_two_kinds_of_messages(tmp_path):
    """ESF-MEAS, compensated and slower, is read where there is no ESF-RAW, and not mixed with it."""
    pyubx2 = pytest.importorskip("pyubx2")
    sample = {14: 4096, 13: 0, 5: 0, 16: 0, 17: 0, 18: 10035}

    def meas(tag: int) -> bytes:
        fields = [(kind << 24) | (2 * value & 0xFFFFFF) for kind, value in sample.items()]
        body = struct.pack("<IHH6I", tag, len(fields) << 11, 0, *fields)
        return pyubx2.UBXMessage("ESF", "ESF-MEAS", pyubx2.GET, payload=body).serialize()

    both = [meas(500 * k) + pvt(k // 2) for k in range(20)]
    (tmp_path / "a.ubx").write_bytes(b"".join(both))
    alone = read_parts(tmp_path / "a.ubx").imu
    assert len(alone.t) == 20 and alone.gyro[3, 0] == pytest.approx(np.deg2rad(2.0))
    raw = [esf([(500 * k + 7, sample)]) + message for k, message in enumerate(both)]
    (tmp_path / "a.ubx").write_bytes(b"".join(raw))
    imu = read_parts(tmp_path / "a.ubx").imu
    assert len(imu.t) == 20 and np.all(imu.gyro[:, 0] == imu.gyro[0, 0]) and imu.gyro[0, 0] == np.deg2rad(1.0)


def test_inertial_sensors_without_a_date_are_said(tmp_path):
    pytest.importorskip("pyubx2")
    sample = {14: 0, 13: 0, 5: 0, 16: 0, 17: 0, 18: 10035}
    (tmp_path / "a.ubx").write_bytes(esf([(50 * k, sample) for k in range(20)]) + pvt(1) + pvt(2) + pvt(3))
    parts = read_parts(tmp_path / "a.ubx")
    assert parts.imu is None and "fewer than 3 fixes date their time tags" in str(parts.notes[0])
    partial = [esf([(50 * k, {14: 0, 18: 10035})]) + pvt(k) for k in range(20)]
    (tmp_path / "a.ubx").write_bytes(b"".join(partial))
    assert "no sample has all six axes" in str(read_parts(tmp_path / "a.ubx").notes[0])


def test_nav_pvat_is_a_fix_and_nmea_beside_ubx_is_read(tmp_path):
    pyubx2 = pytest.importorskip("pyubx2")
    (tmp_path / "a.ubx").write_bytes(b"".join(pvt(k, "NAV-PVAT") for k in range(5)))
    position = read_parts(tmp_path / "a.ubx").aiding["position"]
    np.testing.assert_allclose(position.t, 1700092800.0 + np.arange(5.0), atol=1e-6)
    state = pyubx2.UBXMessage("MON", "MON-HW2", pyubx2.GET).serialize()
    text = "".join(checked(GGA.format(k=k)) + "\r\n" + checked(RMC.format(k=k)) + "\r\n" for k in range(20))
    (tmp_path / "b.ubx").write_bytes(state + text.encode() + state)
    assert len(read_parts(tmp_path / "b.ubx").aiding["position"].t) == 20


def test_a_track_of_gpx(tmp_path):
    point = '<trkpt lat="{lat}" lon="11.5"><ele>500.5</ele><time>2024-06-01T10:00:{k:02d}.5+02:00</time></trkpt>\n'
    points = "".join(point.format(lat=48 + k / 1e4, k=k) for k in range(10))
    text = f'<?xml version="1.0"?>\n<gpx xmlns="x"><trk><trkseg>\n{points}<trkpt lat="48" lon="11"/>'
    (tmp_path / "a.gpx").write_text(f"{text}</trkseg></trk></gpx>")
    parts = read_parts(tmp_path / "a.gpx")
    position = parts.aiding["position"]
    np.testing.assert_allclose(position.t, 1717228800.5 + np.arange(10.0), atol=1e-6)
    np.testing.assert_allclose(position.value[3], [np.deg2rad(48.0003), np.deg2rad(11.5), 500.5], rtol=1e-12)
    words = "position: 1 of 11 track points, without a time or a position, are left out"
    assert [str(note) for note in parts.notes] == [words]
    (tmp_path / "a.gpx").write_text(text[:-15])
    assert "cut or damaged behind 10 track points" in str(read_parts(tmp_path / "a.gpx").notes[-1])
    (tmp_path / "a.gpx").write_text("<gpx><trk>")
    with pytest.raises(DataError, match="a.gpx: cannot be read as XML"):
        read_parts(tmp_path / "a.gpx")


# ---------------------------------------------------------------------------- SBF


def sbf_block(number: int, milliseconds: int, body: bytes) -> bytes:
    """A block of Septentrio at a time of week 2288, padded to four bytes."""
    body = struct.pack("<IH", milliseconds, 2288) + body
    body += bytes(-(len(body) + 8) % 4)
    rest = struct.pack("<HH", number, len(body) + 8) + body
    return b"$@" + struct.pack("<H", binascii.crc_hqx(rest, 0)) + rest


def sbf_log(seconds: int = 8) -> bytes:
    """Fixes at 1 Hz with covariances and heading, an IMU at 10 Hz; another block and text in between."""
    out = b"$R: exeSNMEAOutput\r\n" + sbf_block(4014, 0, bytes(20))
    for k in range(10 * seconds):
        tow = 345600000 + 100 * k
        part = lambda kind, *xyz: struct.pack("<BBBB3d", 1, 2, kind, 0, *xyz)
        samples = part(0, 0.5, -0.25, -9.8) + part(1, 3.0, -2.0, 0.1 * k)
        out += sbf_block(4050, tow, struct.pack("<BB", 2, 28) + samples)
        if k % 10 == 0:
            mode = 0 if k == 0 else 4
            place = struct.pack("<BB3d4f", mode, 0, 0.8, 0.2 + 1e-7 * k, 500.0, 45.0, 1.0, 2.0, 0.3)
            out += sbf_block(4007, tow, place + struct.pack("<fdfBBBBHHIBBHHHHB", 63.4, 0, 0, 0, 0, 9, *[0] * 11))
            out += sbf_block(5906, tow, struct.pack("<BB10f", mode, 0, 4.0, 9.0, 16.0, *[0.0] * 7))
            out += sbf_block(5908, tow, struct.pack("<BB10f", mode, 0, 0.01, 0.04, 0.09, *[0.0] * 7))
            out += sbf_block(5938, tow, struct.pack("<BBHBB6f", 9, 0, 2, 0, 0, 63.5, *[0.0] * 5))
    return out


def test_sbf_against_what_was_written(tmp_path):
    (tmp_path / "a.sbf").write_bytes(sbf_log())
    parts = read_parts(tmp_path / "a.sbf")
    position, velocity, imu = parts.aiding["position"], parts.aiding["velocity"], parts.imu
    start = 315964800 + 2288 * 604800 + 345600.0
    np.testing.assert_allclose(position.t, start + np.arange(1.0, 8.0), atol=1e-6)
    np.testing.assert_allclose(position.value[0], [0.8, 0.2 + 1e-6, 500.0], rtol=1e-12)
    np.testing.assert_allclose(position.sd[0], [3.0, 2.0, 4.0])
    np.testing.assert_allclose(velocity.value[0], [2.0, 1.0, 0.3], rtol=1e-6)
    np.testing.assert_allclose(velocity.sd[0], [0.2, 0.1, 0.3], rtol=1e-6)
    np.testing.assert_allclose(parts.aiding["heading"].value[:, 0], np.deg2rad(63.5))
    assert len(imu.t) == 80 and imu.t[1] - imu.t[0] == pytest.approx(0.1, abs=1e-6)
    np.testing.assert_allclose(imu.gyro[7], np.deg2rad([3.0, -2.0, 0.7]), rtol=1e-12)
    np.testing.assert_allclose(imu.accel[7], [0.5, -0.25, -9.8])
    assert str(parts.notes[0]) == "1 PVTGeodetic have no fix in three dimensions"
    whole = sbf_log()
    (tmp_path / "a.sbf").write_bytes(whole[:1000] + b"\0" + whole[1001:-10])
    assert "2 blocks are damaged and left out" in map(str, read_parts(tmp_path / "a.sbf").notes)
    (tmp_path / "a.sbf").write_bytes(sbf_block(4014, 0, bytes(20)))
    with pytest.raises(
        DataError, match="a.sbf: has no PVTGeodetic with a fix in three dimensions and no ExtSensorMeas"
    ):
        read_parts(tmp_path / "a.sbf")


def test_sbf_as_another_reader_has_it(tmp_path):
    """Of the fixed blocks, by pysbf2."""
    pysbf2 = pytest.importorskip("pysbf2")
    found = []
    with open(tmp_path / "a.sbf", "w+b") as file:
        file.write(sbf_log())
        file.seek(0)
        found = [block for _, block in pysbf2.SBFReader(file, quitonerror=0) if block is not None]
    kinds = {name: [b for b in found if getattr(b, "identity", "") == name] for name in ("PVTGeodetic", "AttEuler")}
    (tmp_path / "a.sbf").write_bytes(sbf_log())
    parts = read_parts(tmp_path / "a.sbf")
    fix, turned = kinds["PVTGeodetic"][3], kinds["AttEuler"][3]
    np.testing.assert_allclose(parts.aiding["position"].value[2], [fix.Latitude, fix.Longitude, fix.Height])
    np.testing.assert_allclose(parts.aiding["velocity"].value[2], [fix.Ve, fix.Vn, fix.Vu], rtol=1e-6)
    assert parts.aiding["heading"].value[3, 0] == pytest.approx(np.deg2rad(turned.Heading), rel=1e-6)


def test_an_older_gnss_logger_has_one_clock_for_all_its_rows(tmp_path):
    """Its fixes state UTC alone: then so do its sensors, whose other clock counts from the phone's start."""
    lines = [f"# {kind},utcTimeMillis,elapsedRealtimeNanos,{','.join(f'{kind}{axis}{unit}' for axis in 'XYZ')}"
             for kind, unit in (("UncalGyro", "RadPerSec"), ("UncalAccel", "Mps2"))]  # fmt: skip
    lines.append("# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,"
                 "BearingDegrees,UnixTimeMillis")  # fmt: skip
    for k in range(200):
        stamp = f"{1717236000000 + 50 * k},{5000 + 50000000 * k}"
        lines += [f"UncalGyro,{stamp},0.1,0.2,0.3", f"UncalAccel,{stamp},0.0,0.0,9.8"]
        if k % 20 == 0:
            lines += [f"Fix,{name},48.0,11.0,500.0,1.5,3.0,90.0,{1717236000000 + 50 * k}" for name in ("NLP", "GPS")]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    parts = read_parts(tmp_path / "log.txt")
    assert len(parts.imu.t) == 200 and len(parts.aiding["position"].t) == 10
    np.testing.assert_allclose(parts.aiding["position"].t - parts.imu.t[0], np.arange(10.0), atol=1e-6)


# ---------------------------------------------------------------------------- odometry, and types that are not read


@pytest.mark.parametrize(
    ("left", "read_", "words"),
    [(0.0, True, None), (0.2, True, None), (5.0, False, "move sideways: in the world's axes")],
)
def test_a_twist_that_moves_sideways_is_no_wheel(left, read_, words):
    course = np.linspace(0.1, 1.4, 50)
    rows = [[5 * np.cos(c), np.nan, left * np.sin(c)] for c in course]
    notes: list = []
    parts = rosbag._parts("a.bag", {"speed": rows}, {"speed": list(range(0, 50 * 10**8, 10**8))}, notes)
    assert ("speed" in parts.aiding) == read_
    assert words is None or words in str(notes[-1])
    if read_:
        assert parts.aiding["speed"].value.shape == (50, 1)
    for row in rows:
        row[0] = row[2] = np.nan  # a driver without a twist
    unknown = rosbag._parts("a.bag", {"speed": rows}, {"speed": list(range(0, 50 * 10**8, 10**8))}, [])
    assert np.isnan(unknown.aiding["speed"].value).all()  # which mending leaves out


def test_an_odometry_of_a_filter_is_read_only_where_it_is_named():
    topic = lambda name, kind, count=9: SimpleNamespace(topic=name, msgtype=kind, msgcount=count)
    imu, odometry = topic("/imu", rosbag.IMU), topic("/odometry/filtered", "nav_msgs/msg/Odometry", 99)
    wheels, fix = topic("/wheel/odom", "nav_msgs/msg/Odometry"), topic("/fix", "sensor_msgs/msg/NavSatFix")
    choose = lambda each, topics=None: rosbag._choose(Path("bag"), each, topics or {}, [])
    assert choose([imu, fix, odometry, wheels])["speed"] == "/wheel/odom"
    assert "speed" not in choose([imu, fix, odometry])
    assert choose([imu, fix, odometry], {"speed": "/odometry/filtered"})["speed"] == "/odometry/filtered"


def test_types_that_are_not_read_are_counted(tmp_path):
    import pyubx2

    said = lambda name: [
        n.message for n in read_parts(tmp_path / name).notes if getattr(n, "code", "") == "file.unread"
    ]
    dop = pyubx2.UBXMessage("NAV", "NAV-DOP", pyubx2.GET, iTOW=1, gDOP=100).serialize()
    setting = pyubx2.UBXMessage("MON", "MON-VER", pyubx2.GET, swVersion=b"1" * 30, hwVersion=b"1" * 10).serialize()
    (tmp_path / "a.ubx").write_bytes(b"".join(pvt(k) + dop + setting for k in range(9)))
    assert [text.split(": ")[1] for text in said("a.ubx")] == ["NAV-DOP (9)"]
    lines = [checked(line.format(k=k)) for k in range(20) for line in (GGA, RMC, "GNGSA,A,3,,,,,,,,,,,,,1.0,0.8,0.6")]
    (tmp_path / "a.nmea").write_text("\r\n".join(lines) + "\r\n")
    assert [text.split(": ")[1] for text in said("a.nmea")] == ["GSA (20)"]
    (tmp_path / "a.sbf").write_bytes(sbf_log())
    assert [text.split(": ")[1] for text in said("a.sbf")] == ["block 4014 (1)"]
