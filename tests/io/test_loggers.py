"""Loggers' own files: VectorNav's binary output, FlySight 2, Racelogic VBO."""

import struct
from binascii import crc_hqx
from pathlib import Path

import numpy as np
import pytest

from jaxnav.io.formats import vectornav
from jaxnav.io.readers import read_parts
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.maths.units import DEG, G0
from jaxnav.reading.read import read
from jaxnav.types import DataError

TOW, A_WEEK = 316515.0, 2311
START = GPS_EPOCH + A_WEEK * WEEK + TOW


def vectornav_message(groups: dict[int, dict[int, bytes]]) -> bytes:
    """Return a message of outputs by group and bit."""
    head = bytes([sum(1 << group for group in groups)])
    head += b"".join(struct.pack("<H", sum(1 << bit for bit in outputs)) for outputs in groups.values())
    body = head + b"".join(outputs[bit] for outputs in groups.values() for bit in sorted(outputs))
    return b"\xfa" + body + struct.pack(">H", crc_hqx(body, 0))


def vectornav_log(seconds: int = 4, dated: bool = True, increments: bool = False, extra: dict | None = None) -> bytes:
    """Return an IMU at 20 Hz and a receiver at 5 Hz, 10 m/s to the north, with an ASCII line in front."""
    out = b"$VNYPR,+010.071,+000.278,-002.026*60\r\n"
    for k in range(20 * seconds):
        now = k / 20
        clock = struct.pack("<Q", round((START - GPS_EPOCH + now) * 1e9)) if dated else b""
        gyro, accel = struct.pack("<3f", 0.01, 0.02, 0.03 + k * 1e-4), struct.pack("<3f", 0.1, 0.2, -9.8)
        outputs = {0: struct.pack("<Q", round((5.0 + now) * 1e9))} | ({1: clock} if dated else {})
        if increments:
            turn = struct.pack("<3f", *(np.array([0.01, 0.02, 0.03]) / 20 / DEG))
            outputs |= {11: struct.pack("<f", 0.05) + turn + struct.pack("<3f", 0.005, 0.01, -0.49)}
        else:
            outputs |= {5: gyro, 8: accel}
        out += vectornav_message({0: outputs} | (extra or {}))
        if k % 4 == 0:
            lla = struct.pack("<3d", 48.0 + now * 1e-4, 11.0, 500.0)
            fix = {1: struct.pack("<Q", round((TOW + now) * 1e9)), 2: struct.pack("<H", A_WEEK),
                   4: bytes([3 if k else 0]), 5: lla, 7: struct.pack("<3f", 10.0, 1.0, -0.5),
                   9: struct.pack("<3f", 1.0, 2.0, 3.0), 10: struct.pack("<f", 0.1)}  # fmt: skip
            out += vectornav_message({0: {0: outputs[0]}, 3: fix})
    return out


def test_vectornav(tmp_path):
    file = tmp_path / "a.bin"
    file.write_bytes(vectornav_log())
    parts = read_parts(file)
    t = START - parts.zero + np.arange(80) / 20
    np.testing.assert_allclose(parts.imu.t, t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(parts.imu.gyro[5], [0.01, 0.02, 0.0305], rtol=1e-6)
    np.testing.assert_allclose(parts.imu.accel[5], [0.1, 0.2, -9.8], rtol=1e-6)
    position, velocity = parts.aiding["position"], parts.aiding["velocity"]
    np.testing.assert_allclose(position.t, t[4::4], rtol=0, atol=1e-6)  # the first has no fix
    np.testing.assert_allclose(position.value[0], [48.00002 * DEG, 11 * DEG, 500.0], rtol=1e-12)
    np.testing.assert_allclose(position.sd[0], [2.0, 1.0, 3.0])
    np.testing.assert_allclose(velocity.value[0], [1.0, 10.0, 0.5])
    np.testing.assert_allclose(velocity.sd[0], 0.1, rtol=1e-6)
    assert any("1 outputs of the receiver have no fix" in str(note) for note in parts.notes)


def test_vectornav_without_gps_time(tmp_path):
    file = tmp_path / "a.bin"
    file.write_bytes(vectornav_log(dated=False))
    parts = read_parts(file)
    np.testing.assert_allclose(parts.imu.t, 5.0 + np.arange(80) / 20, rtol=0, atol=1e-9)
    np.testing.assert_allclose(parts.aiding["position"].t, 5.2 + np.arange(19) / 5, rtol=0, atol=1e-9)
    assert any("dated by the message" in str(note) for note in parts.notes)


def test_vectornav_fixes_alone(tmp_path):
    """Messages of the receiver without an IMU are the fixes of another file; without GPS time, since start-up."""
    lla = struct.pack("<3d", 48.0, 11.0, 500.0)
    for dated in (True, False):
        out = b""
        for k in range(9):
            when = {1: struct.pack("<Q", (316515 + k) * 10**9), 2: struct.pack("<H", A_WEEK)} if dated else {}
            out += vectornav_message(
                {0: {0: struct.pack("<Q", (5 + k) * 10**9)}, 3: when | {5: lla[:-8] + struct.pack("<d", 500.0 + k)}}
            )
        (tmp_path / "a.bin").write_bytes(out)
        parts = read_parts(tmp_path / "a.bin")
        assert parts.imu is None
        expected = (START if dated else 5.0) + np.arange(9)
        np.testing.assert_allclose(parts.aiding["position"].t + parts.zero, expected, rtol=0, atol=1e-6)


def test_vectornav_repeats_of_a_fix_are_one(tmp_path):
    """A receiver at 1 Hz in every message of an IMU at 20 Hz: rows are new by their time, else by their position."""
    for tow in (True, False):
        out = b""
        for k in range(60):
            second = k // 20
            lla = struct.pack("<3d", 48.0 + 1e-4 * second, 11.0, 500.0)
            when = {1: struct.pack("<Q", (316515 + second) * 10**9), 2: struct.pack("<H", A_WEEK)} if tow else {}
            clock = {0: struct.pack("<Q", k * 50_000_000 + 10**9), 1: struct.pack("<Q", 10**18 + k * 50_000_000)}
            imu = {5: struct.pack("<3f", 0.01, 0.0, 0.0), 8: struct.pack("<3f", 0.0, 0.0, -9.8)}
            out += vectornav_message({0: clock | imu, 3: when | {5: lla}})
        (tmp_path / "a.bin").write_bytes(out)
        parts = read_parts(tmp_path / "a.bin")
        assert parts.imu.t.size == 60 and parts.aiding["position"].t.size == 3


def test_vectornav_increments(tmp_path):
    file = tmp_path / "a.bin"
    file.write_bytes(vectornav_log(increments=True))
    parts = read_parts(file)
    assert parts.imu.sampling == "increments"
    np.testing.assert_allclose(parts.imu.gyro[0] * 20, [0.01, 0.02, 0.03], rtol=1e-6)
    np.testing.assert_allclose(parts.imu.accel[0] * 20, [0.1, 0.2, -9.8], rtol=1e-6)


def test_every_output_of_vectornav_has_its_length(tmp_path):
    extra = {group: {bit: bytes(size) for bit, size in enumerate(sizes)} for group, sizes in vectornav.LENGTHS.items()}
    message = vectornav_message(extra)
    found, lost = vectornav.messages(message)
    assert (sum(map(len, found.values())), lost) == (1, 0)
    assert len(message) == 1 + 1 + 2 * 7 + sum(map(sum, vectornav.LENGTHS.values())) + 2


def test_damaged_messages_of_vectornav_are_counted(tmp_path):
    file, data = tmp_path / "a.bin", bytearray(vectornav_log())
    data[len(data) // 2] ^= 255
    file.write_bytes(data)
    assert any("damaged" in str(note) for note in read_parts(file).notes)
    file.write_bytes(vectornav_message({4: {1: bytes(12)}}) * 9)
    with pytest.raises(DataError, match="log AngularRate"):
        read_parts(file)


def flysight(folder: Path, seconds: int = 4) -> Path:
    """Write the two files: sensors by a counter, the track in UTC, 18 s behind GPS time."""
    folder.mkdir(exist_ok=True)
    sensors = ["$FLYS,1", "$VAR,FIRMWARE_VER,v2024", "$COL,IMU,time,wx,wy,wz,ax,ay,az,temperature",
               "$UNIT,IMU,s,deg/s,deg/s,deg/s,g,g,g,deg C", "$COL,TIME,time,tow,week", "$DATA"]  # fmt: skip
    for k in range(50 * seconds):
        now = 60077.615 + k / 50
        sensors.append(f"$IMU,{now:.3f},1.000,2.000,{3 + k * 0.01:.3f},-0.01,-0.02,0.99,25.6")
        if k % 50 == 0:
            sensors += [f"$TIME,{now:.3f},{TOW + k / 50:.3f},{A_WEEK}", f"$BARO,{now:.3f},{95000 - k},25.0"]
    utc = np.datetime64(round((START - 18) * 1000), "ms")
    rows = [
        f"$GNSS,{utc + np.timedelta64(200 * k, 'ms')}Z,{48 + k * 1e-5:.7f},11.0000000,600.0,-3.0,4.0,5.0,2.0,3.0,0.5,9"
        for k in range(5 * seconds)
    ]
    track = ["$FLYS,1", "$COL,GNSS,time,lat,lon,hMSL,velN,velE,velD,hAcc,vAcc,sAcc,numSV", "$DATA", *rows]
    (folder / "SENSOR.CSV").write_text("\n".join(sensors) + "\n")
    (folder / "TRACK.CSV").write_text("\n".join(track) + "\n")
    return folder


def test_flysight(tmp_path):
    folder = flysight(tmp_path / "04-20-00")
    parts = read_parts(folder)
    np.testing.assert_allclose(parts.imu.t + parts.zero, START + np.arange(200) / 50, rtol=0, atol=2e-3)
    np.testing.assert_allclose(parts.imu.gyro[0], np.array([1.0, 2.0, 3.0]) * DEG, rtol=1e-9)
    np.testing.assert_allclose(parts.imu.accel[0], np.array([-0.01, -0.02, 0.99]) * G0, rtol=1e-9)
    assert parts.axes == "flu"  # its accelerometer reads +1 g on z at rest
    position, velocity = parts.aiding["position"], parts.aiding["velocity"]
    np.testing.assert_allclose(position.t + parts.zero, START + np.arange(20) / 5 - 18, rtol=0, atol=1e-6)
    assert (position.scale, parts.imu.scale) == ("utc", "gps")
    np.testing.assert_allclose(velocity.value[0], [4.0, -3.0, -5.0])
    np.testing.assert_allclose(position.sd[0], [2.0, 2.0, 3.0])
    assert parts.aiding["barometer"].t.size == 4
    alone = read_parts(folder / "SENSOR.CSV")
    assert alone.imu is not None and "position" not in alone.aiding


def test_stated_scales_are_converted_in_a_recording_shorter_than_the_leap_seconds(tmp_path):
    """Nine seconds of sensors in GPS time and fixes in UTC, 18 s behind it."""
    rec = read(flysight(tmp_path / "04-20-00", 9))
    np.testing.assert_allclose(rec.aiding["position"].t[[0, -1]], rec.imu.t[0] + np.array([0.0, 8.8]), atol=0.03)


def test_flysight_without_a_date(tmp_path):
    folder = flysight(tmp_path / "a")
    text = (folder / "SENSOR.CSV").read_text()
    (folder / "SENSOR.CSV").write_text("\n".join(row for row in text.split("\n") if not row.startswith("$TIME")))
    with pytest.raises(DataError, match="TIME"):
        read_parts(folder)


def vbo(path: Path, imu: bool = True, seconds: int = 4) -> Path:
    """Write a drive to the north at 36 km/h, longitude 1 deg east."""
    names = "sats time lat long velocity heading height" + " x_acc y_acc z_acc roll_rate pitch_rate yaw_rate" * imu
    lines = ["File created on 12/05/2021 at 10:21:05", "", "[header]", "satellites", "time", "", "[comments]", "VBOX",
             "", "[column names]", names, "", "[data]"]  # fmt: skip
    for k in range(20 * seconds):
        row = f"009 1021{5 + k / 20:06.3f} {48 * 60 + k * 1e-4:+013.6f} {-60.0:+013.6f} 036.000 000.00 +0088.40"
        lines.append(row + " +1.0E-02 +2.0E-02 -9.9E-01 +1.0E+00 +2.0E+00 +3.0E+00" * imu)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_vbo(tmp_path):
    parts = read_parts(vbo(tmp_path / "a.vbo"))
    utc = np.datetime64("2021-05-12T10:21:05") - np.datetime64(0, "s")
    position = parts.aiding["position"]
    np.testing.assert_allclose(
        position.t + parts.zero, utc / np.timedelta64(1, "s") + np.arange(80) / 20, rtol=0, atol=1e-5
    )
    np.testing.assert_allclose(position.value[0], [48 * DEG, 1 * DEG, 88.4], rtol=1e-12)
    np.testing.assert_allclose(parts.aiding["velocity"].value[0], [0.0, 10.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(parts.imu.gyro[0], np.array([1, 2, 3]) * DEG, rtol=1e-9)
    np.testing.assert_allclose(parts.imu.accel[0], np.array([0.01, 0.02, -0.99]) * G0, rtol=1e-9)
    assert read_parts(vbo(tmp_path / "b.vbo", imu=False)).imu is None


def test_vbo_without_a_column(tmp_path):
    file = vbo(tmp_path / "a.vbo")
    file.write_text(file.read_text().replace(" long ", " lng "))
    with pytest.raises(DataError, match="no column long"):
        read_parts(file)
