"""Sensor Logger's files, written from a simulated drive as Android and as an iPhone write them."""

import zipfile

import numpy as np
import pytest

from jaxnav.maths.axes import rotation
from jaxnav.maths.units import DEG, G0
from jaxnav.reading.read import read

ZERO = 1717236000  # s since 1970
RFU = rotation("rfu").T
ACCELERATION = {
    "android": {"TotalAcceleration": 1.0},
    "ios": {"Accelerometer": -0.3, "Gravity": -0.7},
    "ios uncalibrated": {"AccelerometerUncalibrated": -1.0 / G0},
    "ios standardised": {"Accelerometer": 0.3, "Gravity": 0.7},
    "ios, no metadata": {"Accelerometer": -0.3, "Gravity": -0.7},
}


def table(path, t, columns):
    """Write columns by name under the app's two of time."""
    lines = [",".join(["time", "seconds_elapsed", *columns])]
    for stamp, *row in zip(t, *columns.values()):
        lines.append(f"{ZERO * 10**9 + round(stamp * 1e9)},{stamp:.4f}," + ",".join(f"{v:.12g}" for v in row))
    path.write_text("\n".join(lines) + "\n")


def xyz(rows):
    return {axis: rows[:, "xyz".index(axis)] for axis in "zyx"}


def write(folder, drive, kind="android", late=0.003):
    """Write the folder; the accelerometer's times are ``late`` s behind the gyro's."""
    folder.mkdir()
    t = drive.imu.t
    table(folder / "Gyroscope.csv", t, xyz(drive.imu.gyro @ RFU.T))
    accel = np.stack([np.interp(t + late, t, a) for a in drive.imu.accel.T], axis=1)
    for name, share in ACCELERATION[kind].items():
        table(folder / f"{name}.csv", t + late, xyz(share * accel @ RFU.T))
    if "metadata" not in kind:
        said = f"{kind.split()[0]},{'true' if 'standardised' in kind else 'false'}"
        (folder / "Metadata.csv").write_text(f"version,platform,standardisation\n3,{said}\n")
    p, v = drive.aiding["position"], drive.aiding["velocity"].value
    sd = np.full(p.t.size, 3.0)
    bearing = np.degrees(np.arctan2(v[:, 0], v[:, 1])) % 360
    bearing[3] = -1.0
    columns = {
        "bearingAccuracy": sd, "speedAccuracy": 0.1 * sd, "verticalAccuracy": 2 * sd, "horizontalAccuracy": sd,
        "speed": np.hypot(v[:, 0], v[:, 1]), "bearing": bearing,
        "altitude": p.value[:, 2], "longitude": p.value[:, 1] / DEG, "latitude": p.value[:, 0] / DEG,
    }  # fmt: skip
    table(folder / "Location.csv", p.t, columns)
    table(folder / "Barometer.csv", t[::10], {"relativeAltitude": 0 * t[::10], "pressure": 1013.25 + 0 * t[::10]})
    table(folder / "Magnetometer.csv", t, xyz(np.tile([20.0, 5.0, 40.0], (t.size, 1)) @ RFU.T))
    return folder


@pytest.mark.parametrize("kind", ACCELERATION)
def test_a_drive_comes_back(drive, tmp_path, kind):
    rec = read(write(tmp_path / "phone", drive, kind))
    n = rec.imu.t.size
    assert n >= drive.imu.t.size - 2
    first = np.abs(drive.imu.t - rec.imu.t[0] - (drive.aiding["position"].t[0] - rec.aiding["position"].t[0])).argmin()
    np.testing.assert_allclose(rec.imu.gyro, drive.imu.gyro[first : first + n], atol=1e-9)
    assert (
        np.sqrt(np.mean((rec.imu.accel - drive.imu.accel[first : first + n]) ** 2)) < 0.06
    )  # m/s^2, interpolated twice
    np.testing.assert_allclose(rec.aiding["position"].value, drive.aiding["position"].value, rtol=1e-11)
    np.testing.assert_array_equal(rec.aiding["position"].sd[0], [3.0, 3.0, 6.0])
    assert rec.aiding["velocity"].t.size == drive.aiding["velocity"].t.size - 1  # the row without a bearing
    np.testing.assert_allclose(rec.aiding["velocity"].value[5, :2], drive.aiding["velocity"].value[6, :2], atol=1e-6)
    assert rec.aiding["velocity"].sd[0, 2] > 100.0  # nothing measures the vertical
    np.testing.assert_allclose(rec.aiding["magnetometer"].value[0], [20.0, 5.0, 40.0])
    np.testing.assert_allclose(rec.aiding["barometer"].value, 0.0, atol=1e-6)
    turned = kind.startswith("ios") and "standardised" not in kind
    assert ("sign of an iPhone" in rec.notes) is turned


def test_the_zip_that_the_app_shares_and_another_mounting(drive, tmp_path):
    folder = write(tmp_path / "phone", drive)
    with zipfile.ZipFile(tmp_path / "phone.zip", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, file.name)
    rec, other = read(folder), read(tmp_path / "phone.zip", axes="rub")
    np.testing.assert_allclose(other.imu.accel, rec.imu.accel @ RFU.T @ rotation("rub").T)
    np.testing.assert_allclose(
        other.aiding["magnetometer"].value, rec.aiding["magnetometer"].value @ RFU.T @ rotation("rub").T
    )


def test_the_receivers_file_goes_before_the_fused_one(drive, tmp_path):
    folder = write(tmp_path / "phone", drive)
    rows = (folder / "Location.csv").read_text().splitlines()
    (folder / "LocationGps.csv").write_text("\n".join(rows[:21]) + "\n")
    assert read(folder).aiding["position"].t.size == 20
