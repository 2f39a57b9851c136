"""Thirty damaged copies of each format: a recording with a sentence, or one DataError that names the file."""

import datetime
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxnav import io
from jaxnav.io.files import format_csv
from jaxnav.maths.units import DEG
from jaxnav.reading.read import read
from jaxnav.types import DataError, Recording

from .test_formats import data, recording
from .test_kitti import write as write_kitti
from .test_loggers import flysight, vbo, vectornav_log
from .test_novatel import write as write_novatel
from .test_readers import nmea, write_ros1, write_ros2, write_ubx
from .test_receivers import sbf_log
from .test_sensor_logger import write as write_phone

COPIES = 30


def damaged(content: bytes, seed: int) -> bytes:
    """A copy cut short, with bytes flipped, with a piece doubled or missing, with lines reversed or a column gone."""
    rng = np.random.default_rng(seed)
    kind = ("cut", "flip", "many", "double", "hole", "reverse", "column")[seed % 7]
    i, j = sorted(int(x) for x in rng.integers(0, len(content), 2))
    if kind == "cut":
        return content[:j]
    if kind in ("flip", "many"):
        out = bytearray(content)
        for at in rng.integers(0, len(content), 3 if kind == "flip" else max(3, len(content) // 300)):
            out[at] ^= int(rng.integers(1, 256))
        return bytes(out)
    if kind == "double":
        return content[:j] + content[i:]
    if kind == "hole":
        return content[:i] + content[min(j, i + 500) :]
    lines = content.split(b"\n")
    if kind == "reverse":
        return b"\n".join([lines[0], *lines[:0:-1]])
    mark = b"," if b"," in lines[-2 if len(lines) > 1 else 0] else b" "
    return b"\n".join(mark.join(line.split(mark)[:-1]) for line in lines)


def imu_file(folder: Path) -> Path:
    io.write_recording(folder / "imu", recording())
    return folder / "imu" / "imu.csv"


def gnss_half(write: Callable[[Path], None]) -> Callable:
    def make(folder: Path) -> tuple[Path, Callable]:
        imu = imu_file(folder)
        write(folder / "fixes")
        return folder / "fixes", lambda: read(imu, gnss=folder / "fixes", time_shift_s=T0)

    return make


T0 = 1700092800.0 - 10.0  # s, of the receivers' files: the made-up IMU runs from 10 to 14 s


def write_pos(path: Path) -> None:
    position = recording().aiding["position"]
    io.write_pos(path, position, t0=T0)


def write_nmea(path: Path) -> None:
    bodies = []
    for k in range(4):
        stamp = f"{235942 + k:06d}.00"
        bodies.append(f"GPGGA,{stamp},4807.0380,N,01131.0000,W,1,08,0.9,545.4,M,46.9,M,,")
        bodies.append(f"GPRMC,{stamp},A,4807.0380,N,01131.0000,W,010.0,090.0,151123,,")
    path.write_text(nmea(*bodies))


def folder_of(file: str) -> Callable:
    def make(folder: Path) -> tuple[Path, Callable]:
        io.write_recording(folder / "run", recording())
        return folder / "run" / file, lambda: read(folder / "run")

    return make


def npz(folder: Path) -> tuple[Path, Callable]:
    io.write_recording(folder / "a.npz", recording())
    return folder / "a.npz", lambda: read(folder / "a.npz")


def mapped(damage_the_map: bool) -> Callable:
    def make(folder: Path) -> tuple[Path, Callable]:
        rec = recording()
        k = len(rec.imu.t)
        fixes = np.repeat(rec.aiding["position"].value, k // 8, axis=0) / [DEG, DEG, 1.0]
        names = ["ms", "wx", "wy", "wz", "fx", "fy", "fz", "lat", "lon", "h"]
        table = np.column_stack([rec.imu.t * 1e3, rec.imu.gyro, rec.imu.accel, fixes])
        (folder / "log.csv").write_text(format_csv(names, table))
        (folder / "map.toml").write_text(
            '[imu]\nfile = "log.csv"\ntime = "ms"\ntime_unit = "ms"\ngyro = ["wx", "wy", "wz"]\ngyro_unit = "rad/s"\n'
            'accel = ["fx", "fy", "fz"]\naccel_unit = "m/s^2"\n[position]\nfile = "log.csv"\ntime = "ms"\n'
            'time_unit = "ms"\nlla = ["lat", "lon", "h"]\nnew_where = ["lat"]\nsd = 2.0\n'
        )
        return folder / ("map.toml" if damage_the_map else "log.csv"), lambda: read(folder / "map.toml")

    return make


def ekf2(folder: Path) -> tuple[Path, Callable]:
    rec, lines = recording(), []
    for t, w, f in zip(rec.imu.t, rec.imu.gyro.tolist(), rec.imu.accel.tolist()):
        lines.append(",".join([f"{t * 1e6:.0f}", "imu", *map(repr, f + w)]))
    lines.insert(90, "10900000,gps,488103.0,85456073.0,473977508.0,-0.01,-0.01,0.0")
    (folder / "a.csv").write_text("\n".join(lines) + "\n")
    return folder / "a.csv", lambda: read(folder / "a.csv")


def euroc(folder: Path) -> tuple[Path, Callable]:
    imu = recording().imu
    head = "#timestamp [ns]," + ",".join(f"{kind}_RS_S_{a}" for kind in "wa" for a in "xyz")
    rows = [",".join(map(repr, row)) for row in np.hstack([imu.gyro, imu.accel]).tolist()]
    text = "\n".join([head, *(f"{1403636579758555392 + 5000000 * k},{row}" for k, row in enumerate(rows))])
    (folder / "data.csv").write_text(text + "\n")
    return folder / "data.csv", lambda: read(folder / "data.csv")


def navego(folder: Path) -> tuple[Path, Callable]:
    from scipy.io import savemat

    imu = recording().imu
    savemat(folder / "a.mat", {"imu": {"t": imu.t, "wb": imu.gyro, "fb": imu.accel}}, do_compression=True)
    return folder / "a.mat", lambda: read(folder / "a.mat")


def kfgins(folder: Path) -> tuple[Path, Callable]:
    imu = recording().imu
    np.savetxt(folder / "a.txt", np.column_stack([imu.t, imu.gyro * 0.01, imu.accel * 0.01]), fmt="%.12g")
    return folder / "a.txt", lambda: read(folder / "a.txt")


def write_kfgins_gnss(path: Path) -> None:
    t, lla, *_ = recording().aiding["position"]
    table = np.column_stack([t + T0, lla / [DEG, DEG, 1.0], np.full((len(t), 3), 2.0)])
    np.savetxt(path, table, fmt="%.12g")


def write_gpx(path: Path) -> None:
    points = []
    for t, (lat, lon, h) in zip(*recording().aiding["position"][:2]):
        stamp = f"{datetime.datetime.fromtimestamp(t + T0, datetime.UTC):%Y-%m-%dT%H:%M:%S.%f}Z"
        points.append(f'<trkpt lat="{lat / DEG}" lon="{lon / DEG}"><ele>{h}</ele><time>{stamp}</time></trkpt>')
    path.write_text("\n".join(["<gpx><trk><trkseg>", *points, "</trkseg></trk></gpx>"]) + "\n")


def gnss_logger(folder: Path) -> tuple[Path, Callable]:
    rec, lines = recording(), ["# UncalGyro,utcTimeMillis,elapsedRealtimeNanos," + ",".join(
        f"UncalGyro{a}RadPerSec" for a in "XYZ"), "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos," + ",".join(
        f"UncalAccel{a}Mps2" for a in "XYZ"), "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,"
        "AccuracyMeters,BearingDegrees,UnixTimeMillis,elapsedRealtimeNanos"]  # fmt: skip
    for t, w, f in zip(rec.imu.t, rec.imu.gyro.tolist(), rec.imu.accel.tolist()):
        for kind, row in (("Gyro", w), ("Accel", f)):
            lines.append(f"Uncal{kind},0,{round(t * 1e9)}," + ",".join(map(repr, row)))
    for t, (lat, lon, h) in zip(*rec.aiding["position"][:2]):
        lines.append(f"Fix,GPS,{lat / DEG!r},{lon / DEG!r},{h},1.5,3.0,90.0,0,{round(t * 1e9)}")
    (folder / "log.txt").write_text("\n".join(lines) + "\n")
    return folder / "log.txt", lambda: read(folder / "log.txt")


def sbf(folder: Path) -> tuple[Path, Callable]:
    (folder / "a.sbf").write_bytes(sbf_log(9))  # no copy ends with a block, which nobody could see
    return folder / "a.sbf", lambda: read(folder / "a.sbf")


def novatel(folder: Path) -> tuple[Path, Callable]:
    return write_novatel(folder / "a.log", recording()), lambda: read(folder / "a.log")


def kitti(folder: Path) -> tuple[Path, Callable]:
    write_kitti(folder / "drive", recording())
    return folder / "drive" / "oxts" / "timestamps.txt", lambda: read(folder / "drive")


def sensor_logger(folder: Path) -> tuple[Path, Callable]:
    write_phone(folder / "phone", recording())
    return folder / "phone" / "Gyroscope.csv", lambda: read(folder / "phone")


def ros2(storage: str) -> Callable:
    def make(folder: Path) -> tuple[Path, Callable]:
        pytest.importorskip("rosbags")
        write_ros2(folder / "bag", storage)
        (file,) = [*(folder / "bag").glob("*.db3"), *(folder / "bag").glob("*.mcap")]
        return file, lambda: read(folder / "bag")

    return make


def ros1(folder: Path) -> tuple[Path, Callable]:
    pytest.importorskip("rosbags")
    write_ros1(folder / "a.bag")
    return folder / "a.bag", lambda: read(folder / "a.bag")


def recorded(name: str, file: str) -> Callable:
    def make(folder: Path) -> tuple[Path, Callable]:
        (folder / file).write_bytes((data(name) / file).read_bytes())
        return folder / file, lambda: read(folder / file)

    return make


def streams(rec: Recording) -> list[np.ndarray]:
    return [rec.imu.t, *(stream.t for stream in rec.aiding.values())]


def vectornav(folder: Path) -> tuple[Path, Callable]:
    (folder / "a.vnb").write_bytes(vectornav_log(9))
    return folder / "a.vnb", lambda: read(folder / "a.vnb")


def of_flysight(name: str) -> Callable:
    def write(folder: Path) -> tuple[Path, Callable]:
        flysight(folder, 9)
        return folder / name, lambda: read(folder)

    return write


def of_vbo(folder: Path) -> tuple[Path, Callable]:
    return vbo(folder / "a.vbo", seconds=9), lambda: read(folder / "a.vbo")


FORMATS: dict[str, Callable] = {
    "folder, imu.csv": folder_of("imu.csv"),
    "folder, position.csv": folder_of("position.csv"),
    "npz": npz,
    "column map": mapped(True),
    "mapped csv": mapped(False),
    "ros1": ros1,
    "ros2 sqlite": ros2("sqlite3"),
    "ros2 mcap": ros2("mcap"),
    "ulog": recorded("ulog_samples", "sample_px4_events.ulg"),
    "dataflash": recorded("dataflash_sample", "test.BIN"),
    "pos": gnss_half(write_pos),
    "ubx": gnss_half(write_ubx),
    "nmea": gnss_half(write_nmea),
    "kfgins gnss": gnss_half(write_kfgins_gnss),
    "gpx": gnss_half(write_gpx),
    "gnss logger": gnss_logger,
    "sbf": sbf,
    "vectornav": vectornav,
    "flysight, sensors": of_flysight("SENSOR.CSV"),
    "flysight, track": of_flysight("TRACK.CSV"),
    "vbo": of_vbo,
    "ekf2 replay": ekf2,
    "euroc": euroc,
    "navego": navego,
    "kfgins": kfgins,
    "novatel": novatel,
    "kitti, timestamps.txt": kitti,
    "sensor logger, Gyroscope.csv": sensor_logger,
}


@pytest.mark.filterwarnings("default")  # of the optional packages: a user sees them as such
@pytest.mark.parametrize("format", FORMATS)
def test_damaged_copies_are_read_with_a_sentence_or_refused_with_one(format, tmp_path):
    file, reader = FORMATS[format](tmp_path)
    whole = reader()
    content = file.read_bytes()
    read_, refused, silent = 0, 0, []
    for seed in range(COPIES):
        file.write_bytes(damaged(content, seed))
        try:
            rec = reader()
        except DataError as error:
            assert file.name in str(error) or str(tmp_path) in str(error), f"copy {seed}: {error}"
            assert "\n" not in str(error)
            refused += 1
        else:
            lost = sum(map(len, streams(whole))) - sum(map(len, streams(rec)))
            if lost > 0 and rec.notes == whole.notes:
                silent.append((seed, lost))
            read_ += 1
    print(f"{format}: {read_} read, {refused} refused {silent}")
    assert read_ + refused == COPIES and refused and not silent
