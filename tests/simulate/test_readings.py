"""Errors that are states, and other sensors, on top of a simulated run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.parameters import datasheet_states
from jaxnav.maths import earth, rotations
from jaxnav.measurements import MEASUREMENTS
from jaxnav.simulate.readings import expected, with_axes_error, with_equipment, with_sensor, with_states
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import matched_params, simulate_jit, to_recording
from jaxnav.states.grades import GRADES

NAMES = ("lever_arm_error", "clock_offset", "gyro_misalignment")


@pytest.fixture(scope="module")
def sim():
    return simulate_jit(jax.random.key(2), URBAN_SHORT)


@pytest.fixture(scope="module")
def params():
    known = matched_params(URBAN_SHORT)
    return known._replace(states=known.states | datasheet_states(GRADES["consumer"], (*NAMES, "vehicle_axes")))


@pytest.mark.full
def test_fixes_and_samples_have_the_errors_that_the_truth_says(sim, params):
    other = with_states(jax.random.key(1), sim, params, NAMES)
    e = {name: np.asarray(other.truth.errors[name][0]) for name in NAMES}
    C = np.asarray(jax.vmap(rotations.to_dcm)(sim.truth.q))
    moved = earth.enu_path(np.asarray(other.epochs.fix.value[:, :3]), np.asarray(sim.epochs.fix.value[:, :3]))
    late = float(e["clock_offset"][0])
    v = np.asarray(sim.truth.vel)
    steady = np.abs(np.gradient(v, axis=0)).max(1) < 0.3  # m/s^2: late by 0.1 s that is below 2 mm
    np.testing.assert_allclose(moved[steady], (C @ e["lever_arm_error"] - late * v)[steady], atol=3e-3)
    swing = np.einsum("eij,ej->ei", C, np.cross(np.asarray(sim.truth.omega), e["lever_arm_error"]))
    change = np.asarray(other.epochs.fix.value - sim.epochs.fix.value)[:, 3:6]
    np.testing.assert_allclose(change[steady], swing[steady], atol=0.03 * 0.5)
    w, more = np.asarray(sim.epochs.imu.gyro), np.asarray(other.epochs.imu.gyro - sim.epochs.imu.gyro)
    np.testing.assert_allclose(
        more[..., 0], e["gyro_misalignment"][0] * w[..., 1] + e["gyro_misalignment"][1] * w[..., 2]
    )
    np.testing.assert_array_equal(other.epochs.imu.accel, sim.epochs.imu.accel)


def test_an_imu_that_sits_askew_sees_the_same_drive(sim, params):
    """What it reads is the same in ENU, and wheels do not slip along the axes that its state tells."""
    angles = jnp.array([0.03, -0.05])
    other = with_axes_error(sim, params, angles)
    C, turned = (np.asarray(jax.vmap(rotations.to_dcm)(nav.q)) for nav in (sim.truth, other.truth))
    for name in ("omega", "force"):
        seen = [np.einsum("eij,ej->ei", M, np.asarray(getattr(nav, name)))
                for M, nav in ((C, sim.truth), (turned, other.truth))]  # fmt: skip
        np.testing.assert_allclose(*seen, atol=1e-9)
    sideways = lambda truth, known: np.abs(np.asarray(expected(MEASUREMENTS["nonholonomic"], known, truth))).max()
    errors = other.truth.errors | {"vehicle_axes": jnp.broadcast_to(angles, (other.truth.t.size, 2))}
    with_it = other.truth._replace(errors=errors)
    assert sideways(with_it, params) == pytest.approx(sideways(sim.truth, params), abs=1e-6)
    assert sideways(other.truth, params) > 0.3


def test_a_sensor_reads_what_is_expected_of_the_truth_and_noise(sim, params):
    other = with_sensor(jax.random.key(3), sim, params, "speed", 0.1)
    forward = np.einsum("eji,ej->ei", np.asarray(jax.vmap(rotations.to_dcm)(sim.truth.q)), np.asarray(sim.truth.vel))[
        :, 0
    ]
    noise = np.asarray(other.epochs.fix.value[:, 6]) - forward
    assert 0.07 < noise.std() < 0.13 and other.epochs.fix.value.shape == (sim.truth.t.size, 7)
    slow = with_sensor(jax.random.key(3), sim, params, "course", 0.05, least_speed=3.0)
    there = np.hypot(*np.asarray(sim.truth.vel)[:, :2].T) >= 3.0
    np.testing.assert_array_equal(slow.epochs.fix.valid[:, 6], there)
    assert 0 < there.sum() < there.size


def test_a_scenario_with_sensors_is_a_recording_with_their_streams():
    """In outages too, with the noise that is said about what their models expect; drawn states are in them."""
    scenario = URBAN_SHORT._replace(sensors=(("wheels", 0.1), ("barometer", 0.5)), sensor_states=("barometer_bias",))
    sim = with_equipment(jax.random.key(9), simulate_jit(jax.random.key(2), URBAN_SHORT), scenario)
    rec = to_recording(sim, scenario)
    assert list(rec.aiding) == ["position", "velocity", "wheels", "barometer"]
    assert rec.aiding["barometer"].t.size == 80 > rec.aiding["position"].t.size
    height = np.asarray(sim.truth.pos[:, 2])
    off = rec.aiding["barometer"].value[:, 0] - height - np.asarray(sim.truth.errors["barometer_bias"])[:, 0]
    assert np.std(off) == pytest.approx(0.5, rel=0.3) and abs(off.mean()) < 0.2
    speed = np.linalg.norm(np.asarray(sim.truth.vel), axis=1)
    np.testing.assert_allclose(rec.aiding["wheels"].value.mean(1), speed, atol=0.35)
    alone = to_recording(simulate_jit(jax.random.key(2), URBAN_SHORT), URBAN_SHORT)
    np.testing.assert_array_equal(alone.aiding["position"].value, rec.aiding["position"].value)
