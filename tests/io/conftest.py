"""What tests of readers share."""

import pytest

from jaxnav.app.config import resolve
from jaxnav.app.sources import load
from jaxnav.io.parts import ImuRows, Parts, Stream
from jaxnav.types import Recording


@pytest.fixture(scope="session")
def drive() -> Recording:
    """A simulated drive of 60 s, fixes at 1 Hz."""
    options = {"duration_s": 60.0, "imu_rate_hz": 50.0, "gnss_rate_hz": 1.0, "outages_s": []}
    return load(resolve([("", {"data": {"source": "urban_short", "options": options}})]))


def fixes(drive: Recording, **columns) -> Parts:
    """Return the drive as a reader hands it over, with columns of its positions replaced."""
    position = drive.aiding["position"]
    stream = Stream(position.t, position.value.copy(), position.sd.copy())._replace(**columns)
    return Parts("a.log", ImuRows(drive.imu.t, drive.imu.gyro, drive.imu.accel, dt=drive.imu.dt), {"position": stream})
