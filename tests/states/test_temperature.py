"""A toy state that reads a temperature: one file with the class of its effect, one row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import build, initialize, navigate, read
from jaxnav.app.config import resolve
from jaxnav.app.sources import load
from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import installed
from jaxnav.filters.run import initial_nav
from jaxnav.io import write_recording
from jaxnav.maths.units import DEG, DEG_PER_HOUR
from jaxnav.measurements import with_data
from jaxnav.states.state import BODY, UserUnit, constant
from jaxnav.states.table import STATES, zeros
from jaxnav.strapdown.frames import FRAMES
from jaxnav.stream import Stream
from jaxnav.types import ConfigError, DataError, Fix, Imu, Recording, Samples

SLOPE = np.array([30.0, -20.0, 60.0]) * DEG_PER_HOUR  # rad/s per deg C
TOY = constant(
    "gyro_temperature", BODY, 50.0, UserUnit("deg_per_hour_per_degc", DEG_PER_HOUR, "deg/h/degC"), "gyro",
    lambda reading: reading.auxiliary["temperature"][..., None, None] * np.eye(3), ("temperature",),
)  # fmt: skip


@pytest.fixture(autouse=True)
def row(monkeypatch):
    monkeypatch.setitem(STATES, TOY.name, TOY)


def degrees(t: np.ndarray) -> np.ndarray:
    """An IMU that warms up, deg C."""
    return 35.0 * (1 - np.exp(-t / 60.0))


@pytest.fixture(scope="module")
def drive() -> Recording:
    """A drive of 150 s whose gyros drift with a temperature that is logged once a second."""
    plain = {"duration_s": 150.0, "imu_rate_hz": 50.0, "grade": "adis16465", "outages_s": []}
    rec = load(resolve([("", {"data": {"source": "urban_short", "options": plain}})]))
    t = np.arange(1.0, 151.0)
    warm = Samples(t, degrees(t)[:, None], np.ones((t.size, 1)), np.zeros((t.size, 1)))
    held = degrees(np.ceil(np.round(rec.imu.t, 6)))[:, None]  # an epoch has the temperature at its end
    imu = rec.imu._replace(gyro=rec.imu.gyro + held * SLOPE)
    return rec._replace(imu=imu, aiding=rec.aiding | {"temperature": warm})


@pytest.mark.full
@pytest.mark.parametrize("stride", [1, 10])
@pytest.mark.parametrize("frame", FRAMES)
def test_at_a_constant_temperature_it_is_a_bias(frame, stride):
    """Motion, the transition and rows of a late fix have the temperature times what the gyro bias has."""
    degc, names = 7.0, ("gyro_bias", "accel_bias", TOY.name)
    model = error_model(frame, names)
    rng = np.random.default_rng(1)
    gyro, force = 0.1 * rng.normal(size=(20, 3)), np.tile([0.5, 1.0, -9.8], (20, 1))
    imu = Imu(jnp.full(20, 0.01), jnp.asarray(gyro), jnp.asarray(force))
    params = build("ekf15", states=(TOY.name,)).params("consumer")
    nav = initial_nav([0.8, -1.3, 900.0], [60.0, -45.0, 5.0], [0.2, -0.3, 2.0], t=3.0, azimuth=0.3)
    nav = model.enter(nav._replace(errors=zeros(names), auxiliary={"temperature": jnp.array(degc)}))
    cold = nav._replace(errors=nav.errors | {"gyro_bias": degc * jnp.asarray(SLOPE)})
    warm = nav._replace(errors=nav.errors | {TOY.name: jnp.asarray(SLOPE)})
    for form in filter(None, (FRAMES[frame].propagate, FRAMES[frame].fast)):
        keep = jnp.array([18, 19])
        ends = [form(each, None, imu, stride, keep)[0] for each in (cold, warm)]
        for a, b in zip(jax.tree.leaves(ends[0][:6]), jax.tree.leaves(ends[1][:6]), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)
        past, path = form(nav, None, imu, stride, keep)
        Phi = model.discretize(params, path, imu.dt.reshape(-1, stride).sum(1), None)[0]
        np.testing.assert_allclose(Phi[:9, 15:18], degc * Phi[:9, 9:12], rtol=1e-9, atol=1e-12)
        late = params._replace(mounting=params.mounting._replace(time_offset=jnp.array(0.13), lever_arm=jnp.ones(3)))
        fix = Fix(jnp.ones(6), jnp.ones(6), jnp.zeros(6), jnp.ones(6, bool))
        H = model.observe(late, past, fix)[1]
        assert jnp.abs(H[:, 9:12]).max() > 1e-3
        np.testing.assert_allclose(H[:, 15:18], degc * H[:, 9:12], rtol=1e-9, atol=1e-12)


@pytest.mark.full
def test_the_slope_of_a_drive_is_found_through_its_files(drive, tmp_path):
    write_recording(tmp_path / "own", drive)
    assert (tmp_path / "own" / "temperature.csv").read_text().startswith("t_s,temperature_degc,sd_degc\n")
    rec = read(tmp_path / "own")
    np.testing.assert_array_equal(rec.aiding["temperature"].value, drive.aiding["temperature"].value)
    filt = build("ekf15", states=(TOY.name,), cov_stride=10)
    params = filt.params("adis16465")
    sol = navigate(rec, filt, params)
    found = np.asarray(sol.trace.info.nav.errors[TOY.name])[-1]
    sd = np.sqrt(np.diagonal(np.asarray(sol.trace.info.P)[-1])[15:])
    assert (np.abs(found - SLOPE) < 4 * sd).all() and sd.max() < 0.5 * 50 * DEG_PER_HOUR
    assert sol.trace.info.nav.auxiliary["temperature"][-1] == drive.aiding["temperature"].value[-1, 0]
    plain = build("ekf15", cov_stride=10)
    true = np.unwrap(rec.truth.rph[:, 2])

    def off(sol):
        """Largest error of the heading over the last 40 epochs."""
        error = sol.rph[-40:, 2] - np.interp(sol.t[-40:], rec.truth.t, true)
        return np.abs(np.angle(np.exp(1j * error))).max()

    assert off(sol) < 1.5 * DEG < off(navigate(rec, plain, plain.params("adis16465")))
    bare = rec._replace(aiding={name: s for name, s in rec.aiding.items() if name != "temperature"})
    with pytest.raises(DataError, match="has no stream temperature, which states of the filter read"):
        navigate(bare, filt, params)


@pytest.mark.full
def test_a_stream_holds_the_temperature_as_the_batch_does(drive):
    filt = build("ekf15", states=(TOY.name,), cov_stride=10)
    params = installed(filt.params("adis16465"), drive.lever_arm)
    begin = initialize(drive, params)
    stop = begin.t + 20.0
    sol = navigate(drive, filt, params, initialization=begin, stop=stop)
    live = Stream(filt, params, begin, rate=50.0)
    order = {"temperature": 0, "position": 1, "velocity": 1}
    rows = [(t, order[name], name, i) for name, s in drive.aiding.items() for i, t in enumerate(s.t)]
    rows += [(t, 2, "imu", i) for i, t in enumerate(drive.imu.t)]
    for t, _, name, i in sorted(rows):
        if name == "imu" and begin.t < t <= stop:
            live.push_imu(t, drive.imu.gyro[i], drive.imu.accel[i], drive.imu.dt[i])
        elif name == "temperature" or (name != "imu" and begin.t < t <= stop):
            live.push(name, t, drive.aiding[name].value[i], drive.aiding[name].sd[i])
    np.testing.assert_allclose(live.now.lla, sol.lla[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(live.now.vel, sol.vel[-1], rtol=0, atol=1e-4)
    again = Stream.from_bytes(live.to_bytes(), filt, params, begin)
    assert again.auxiliary == live.auxiliary


def test_a_column_map_has_a_table_for_it(drive, tmp_path):
    write_recording(tmp_path, drive)
    (tmp_path / "map.toml").write_text(
        '[read]\nfile = "."\n[temperature]\nfile = "temperature.csv"\ntime = "t_s"\nvalue = "temperature_degc"\n'
    )
    assert "temperature" in with_data() and "temperature" in read(tmp_path / "map.toml").aiding


def test_a_simulated_run_has_no_temperature():
    with pytest.raises(ConfigError, match="sensor_states: gyro_temperature reads temperature, which a simulated run"):
        load(resolve([("", {"data": {"source": "urban_short", "options": {"sensor_states": [TOY.name]}}})]))
