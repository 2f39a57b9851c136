"""Streams by the rows of measurements: a new one is a row, in files, column maps, checks and messages."""

import numpy as np
import pytest

from jaxnav import read
from jaxnav.io import read_recording, write_recording
from jaxnav.io.recording import recording
from jaxnav.measurements import MEASUREMENTS, SPEED, with_data
from jaxnav.measurements.columns import QUANTITIES, column
from jaxnav.types import DataError

T = np.arange(1, 401) / 20
IMU = (T, np.zeros((400, 3)), np.tile([0.0, 0.0, -9.8], (400, 1)))
FIXES = np.arange(1.0, 20.0)


@pytest.fixture
def radar(monkeypatch):
    """Speed over ground by a Doppler radar: the model of the wheel speed with columns of its own."""
    row = SPEED._replace(name="radar", columns=(column("ground_mps", "speed", 0.4),))
    monkeypatch.setitem(MEASUREMENTS, "radar", row)


def test_a_stream_of_a_new_row_is_written_read_mapped_and_checked(radar, tmp_path):
    position = (FIXES, np.tile([0.7, 0.2, 50.0], (19, 1)), 2.0)
    rec = recording(IMU, position=position, radar=(FIXES, np.ones(19), 0.25))
    write_recording(tmp_path / "own", rec)
    assert (tmp_path / "own" / "radar.csv").read_text().splitlines()[0] == "t_s,ground_mps,sd_mps"
    np.testing.assert_array_equal(read_recording(tmp_path / "own").aiding["radar"].sd, np.full((19, 1), 0.25))
    rows = "\n".join(f"{t},{3.6 * t}" for t in FIXES)
    (tmp_path / "own" / "kmh.csv").write_text(f"t,v\n{rows}\n")
    (tmp_path / "map.toml").write_text(
        'folder = "own"\n[imu]\nfile = "imu.csv"\ntime = "t_s"\n'
        'gyro = ["gyro_x_radps", "gyro_y_radps", "gyro_z_radps"]\ngyro_unit = "rad/s"\n'
        'accel = ["accel_x_mps2", "accel_y_mps2", "accel_z_mps2"]\naccel_unit = "m/s^2"\n'
        '[position]\nfile = "position.csv"\ntime = "t_s"\nlla = ["lat_rad", "lon_rad", "h_m"]\nunit = "rad"\n'
        '[radar]\nfile = "kmh.csv"\ntime = "t"\nvalue = "v"\nunit = "km/h"\n'
    )
    mapped = read(tmp_path / "map.toml")
    np.testing.assert_allclose(mapped.aiding["radar"].value[:, 0], FIXES, rtol=1e-12)
    assert (
        mapped.aiding["radar"].sd == 0.4
    ).all() and "radar: the file states no sd; assumed are 0.4 m/s" in mapped.notes
    with pytest.raises(DataError, match="radar.*1"):
        recording(IMU, position=position, radar=(FIXES, np.ones((19, 2)), 0.25))


def test_every_stream_has_a_column_for_each_channel():
    """Quantities are known, names end in the unit, and what is assumed is positive."""
    for name, row in with_data().items():
        assert len(row.columns) == row.size, name
        for each in row.columns:
            assert each.quantity in QUANTITIES and each.sd > 0
            assert each.names[0][1] == 1.0 and each.sd_names[0][1] == 1.0, name
    assert {row.name for row in with_data().values() if row.correlated} == {"position", "velocity"}


def test_rows_that_a_mask_hides_are_none():
    """A fix that numpy masks is left out; a masked sample of the IMU is nan, which is refused with its row."""
    value = np.ma.masked_array(np.tile([0.7, 0.2, 50.0], (19, 1)))
    value[3, 2], value.data[3, 2] = np.ma.masked, 9e9
    rec = recording(IMU, position=(FIXES, value, 2.0))
    np.testing.assert_array_equal(rec.aiding["position"].t, np.delete(FIXES, 3))
    sd = np.ma.masked_greater(np.r_[np.full(18, 0.3), 99.0], 50.0)[:, None]
    rec = recording(IMU, position=(FIXES, value.data[:3].repeat(7, 0)[:19], 2.0), speed=(FIXES, np.ones(19), sd))
    assert rec.aiding["speed"].t.size == 18
    with pytest.raises(DataError, match="gyro"):
        recording((T, np.ma.masked_equal(np.zeros((400, 3)), 0.0), IMU[2]), position=(FIXES, value, 2.0))
