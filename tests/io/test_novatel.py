"""NovAtel's ASCII logs: printed lines of the manual, and a drive written by the manual's scale factors."""

import numpy as np
import pytest

from jaxnav.io.formats.novatel import IMUS, crc32
from jaxnav.io.readers import recognise
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.maths.units import DEG
from jaxnav.reading.read import read
from jaxnav.types import DataError

PRINTED = (
    "%RAWIMUSXA,1692,484620.664;00,11,1692,484620.664389000,00801503,43110635,-817242,-202184,-215194,-41188,-9895"
)
WEEK_NO, START = 2100, 1000.0  # s of the week
UNDULATION = 42.0  # m


def line(name, body, t=START, week=WEEK_NO):
    """Return a line with its checksum; short headers begin with %."""
    short = name.startswith("%")
    head = f"{week},{t:.3f}" if short else f"COM1,0,60.0,FINESTEERING,{week},{t:.3f},02000000,b1f6,32768"
    text = f"{name.lstrip('%')}A,{head};{body}"
    return f"{'%' if short else '#'}{text}*{crc32(text.encode()):08x}\r\n"


def write(path, drive, imu="HG1700_AG58", raw="%RAWIMUSX", kind="SINGLE", best="BESTGNSSPOS"):
    """Write a drive; the sensor's axes are right, forward, up."""
    number, rad, mps = IMUS[imu]
    to_rfu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    text = []
    for t, dt, w, f in zip(drive.imu.t, drive.imu.dt, drive.imu.gyro, drive.imu.accel):
        counts = np.round(np.r_[to_rfu @ f * dt / mps, to_rfu @ w * dt / rad]).astype(int)
        x, y, z, gx, gy, gz = counts
        typed = f"00,{number}," if raw.endswith("X") else ""
        text.append(line(raw, f"{typed}{WEEK_NO},{START + t:.9f},00000077,{z},{-y},{x},{gz},{-gy},{gx}", START + t))
    position, velocity, truth = drive.aiding["position"], drive.aiding["velocity"], drive.truth
    for t, lla, sd in zip(position.t, position.value, position.sd):
        lat, lon, h = lla / [DEG, DEG, 1.0]
        body = f"SOL_COMPUTED,{kind},{lat:.12f},{lon:.12f},{h - UNDULATION:.4f},{UNDULATION},WGS84"
        text.append(line(best, f'{body},{sd[1]:.4f},{sd[0]:.4f},{sd[2]:.4f},"0",0.0,0.0,8,8,0,0,0,06,0,03', START + t))
    for t, (e, n, u) in zip(velocity.t, velocity.value):
        course = np.degrees(np.arctan2(e, n)) % 360
        body = f"SOL_COMPUTED,SINGLE,0.150,0.000,{np.hypot(e, n):.6f},{course:.8f},{u:.6f},0.0"
        text.append(line(best.replace("POS", "VEL"), body, START + t + 0.15))
    for t, lla, vel, rph in zip(truth.t, truth.lla, truth.vel, truth.rph):
        values = [*(lla / [DEG, DEG, 1.0]), vel[1], vel[0], vel[2], *(rph / DEG)]
        body = ",".join(f"{v:.12f}" for v in values)
        text.append(line("%INSPVAS", f"{WEEK_NO},{START + t:.9f},{body},INS_SOLUTION_GOOD", START + t))
    path.write_text("".join(text))
    return path


def test_the_checksum_is_that_of_a_printed_line():
    assert crc32(PRINTED[1:].encode()) == 0xA5DB8C7B


def test_counts_of_a_printed_line_are_gravity(tmp_path):
    """An HG1700-AG58 at 100 Hz at rest: 43,110,635 counts along z are 9.79 m/s^2."""
    later = [PRINTED.replace("484620.664", f"484620.{664 + 10 * k}") for k in range(4)]
    lines = [f"{p}*{crc32(p[1:].encode()):08x}\n" for p in later]
    (tmp_path / "a.log").write_text("".join(lines))
    rec = read(tmp_path / "a.log")
    np.testing.assert_allclose(rec.imu.accel[0, 2], -9.79, atol=0.01)
    assert "imu is of type HG1700_AG58, by the log." in rec.notes


@pytest.mark.parametrize("imu", ["HG1700_AG58", "STIM300", "ADIS16488", "EPSON_G370", "HG4930_AN01"])
def test_a_drive_comes_back(drive, tmp_path, imu):
    rec = read(write(tmp_path / "a.log", drive, imu))
    dt = drive.imu.dt[:, None]
    _, rad, mps = IMUS[imu]
    assert np.abs(rec.imu.gyro - drive.imu.gyro).max() < 1.001 * rad / dt.min()
    assert np.abs(rec.imu.accel - drive.imu.accel).max() < 1.001 * mps / dt.min()
    for name in ("position", "velocity"):
        got, sent = rec.aiding[name], drive.aiding[name]
        n = got.t.size  # the last may lie a microsecond behind the IMU
        assert n >= sent.t.size - 1
        np.testing.assert_allclose(got.value, sent.value[:n], rtol=1e-13, atol=1e-5 if name == "velocity" else 1e-4)
        np.testing.assert_allclose(got.t - rec.imu.t[0], sent.t[:n] - drive.imu.t[0], atol=1e-6)
    np.testing.assert_allclose(rec.aiding["position"].sd[0], drive.aiding["position"].sd[0], atol=1e-4)
    np.testing.assert_allclose(rec.truth.rph, drive.truth.rph, atol=1e-9)
    np.testing.assert_allclose(rec.truth.vel, drive.truth.vel, atol=1e-9)


def test_short_raw_logs_need_the_name_of_the_imu(drive, tmp_path):
    path = write(tmp_path / "a.log", drive, "LN200", "%RAWIMUS")
    with pytest.raises(DataError, match="states no type of IMU: option imu = one of HG1700_AG11"):
        read(path)
    with pytest.raises(DataError, match="imu: .*LN200"):
        read(path, imu="LN20")
    rec = read(path, imu="LN200")
    assert np.abs(rec.imu.accel - drive.imu.accel).max() < 1.001 * 2.0**-14 / drive.imu.dt.min()


def test_an_unknown_type_is_said(drive, tmp_path):
    path = write(tmp_path / "a.log", drive)
    text = path.read_text().splitlines()
    first = [t for t in text if t.startswith("%RAWIMUSX")]
    other = []
    for t in first:
        body = t[1:].partition("*")[0].replace(";00,11,", ";00,99,")
        other.append(f"%{body}*{crc32(body.encode()):08x}\n")
    path.write_text("".join(other))
    with pytest.raises(DataError, match="has an IMU of type 99, with an unknown scale"):
        read(path)


def test_positions_made_with_the_ins_are_left_out_where_others_are(drive, tmp_path):
    path = write(tmp_path / "a.log", drive, kind="INS_PSRSP", best="BESTPOS")
    assert "BESTPOS: 60 of 60 positions are made with the INS: taken" in read(path).notes.replace(
        "61 of 61", "60 of 60"
    )
    with open(path, "a") as file:
        lat, lon, h = drive.aiding["position"].value[5] / [DEG, DEG, 1.0]
        file.write(line("BESTPOS", f"SOL_COMPUTED,SINGLE,{lat},{lon},{h},0,WGS84,1,1,2,a,0,0,8,8", START + 5.5))
    rec = read(path)
    assert rec.aiding["position"].t.size == 1 and "left out" in rec.notes


def test_damaged_lines_and_those_without_a_time_are_counted(drive, tmp_path):
    path = write(tmp_path / "a.log", drive)
    text = path.read_text().replace("SOL_COMPUTED,SINGLE,", "SOL_COMPUTED,SINGLF,", 3)
    text = line("BESTPOS", "SOL_COMPUTED,SINGLE,0,0,0,0,WGS84,1,1,1", 0.0, 0).replace("FINESTEERING", "UNKNOWN") + text
    body = text[1:].partition("*")[0]
    path.write_text(f"#{body}*{crc32(body.encode()):08x}" + text[text.index("*") + 9 :])
    notes = read(path).notes
    assert "3 lines are damaged and left out" in notes
    assert "1 lines from before the receiver knew the time are left out." in notes


def test_a_log_of_nmea_with_a_line_of_another_log_is_nmea(tmp_path):
    version = line("VERSION", 'GPSCARD,"D2LR0RTT0S1","BFN","OEM","7.05","1.0","2019","09:00"')
    (tmp_path / "a.log").write_text(version + "$GPGGA,100000.00,4806.0,N,01136.0,E,1,10,0.8,475.8,M,45.0,M,,*63\r\n")
    (tmp_path / "b.log").write_text(version + line("BESTPOS", "INSUFFICIENT_OBS,NONE,0,0,0,0,WGS84,0,0,0"))
    assert recognise(tmp_path / "a.log").name == "NMEA" and recognise(tmp_path / "b.log").name == "NovAtel ASCII"


def test_fixes_alone_go_with_another_imu_in_gps_time(drive, tmp_path):
    path = write(tmp_path / "a.log", drive)
    text = [t for t in path.read_text().splitlines(keepends=True) if "RAWIMU" not in t]
    path.write_text("".join(text))
    folder = tmp_path / "imu0"
    folder.mkdir()
    head = ",".join(["#timestamp [ns]", *(f"{kind}_RS_S_{a} [x]" for kind in "wa" for a in "xyz")])
    stamps = ((GPS_EPOCH + WEEK_NO * WEEK + START - 18 + drive.imu.t) * 1e9).astype(np.int64)  # UTC in 2020
    rows = [",".join(map(repr, row)) for row in np.hstack([drive.imu.gyro, drive.imu.accel]).tolist()]
    (folder / "data.csv").write_text("\n".join([head, *(f"{t},{row}" for t, row in zip(stamps, rows))]) + "\n")
    rec = read(tmp_path, gnss=path, time_scale="utc")
    late = rec.aiding["position"].t[0] - rec.imu.t[0]
    assert late == pytest.approx(drive.aiding["position"].t[0] - drive.imu.t[0], abs=1e-3)
