"""Misalignment and g-sensitivity: what is read with them, and taken out again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import STATES
from jaxnav.filters.run import initial_nav
from jaxnav.maths.units import DEG_PER_HOUR, G0, MRAD
from jaxnav.states.g_sensitivity import PER_G
from jaxnav.states.misalignment import PAIRS
from jaxnav.states.sensors import corrected
from jaxnav.states.state import Reading, UserUnit, constant
from jaxnav.types import Imu

W, F = jnp.array([[0.3, -0.2, 0.9]]), jnp.array([[1.0, 2.0, -9.5]])


def test_each_angle_turns_one_axis_towards_another():
    for i, (row, seen) in enumerate(PAIRS):
        M = STATES["gyro_misalignment"].effect(Reading(W[0], F[0]))
        expected = np.zeros(3)
        expected["xyz".index(row)] = W[0]["xyz".index(seen)]
        np.testing.assert_array_equal(M[:, i], expected)


def test_a_gyro_feels_force_by_its_own_row():
    G = 30 * DEG_PER_HOUR / G0 * np.arange(1.0, 10.0)
    M = STATES["gyro_g_sensitivity"].effect(Reading(W[0], F[0]))
    np.testing.assert_allclose(M @ G, G.reshape(3, 3) @ F[0], rtol=1e-14)
    assert PER_G == pytest.approx(DEG_PER_HOUR / 9.80665)


def test_simulated_errors_of_a_reading_are_taken_out_again():
    rng = np.random.default_rng(0)
    s = {name: jnp.asarray(3 * MRAD * rng.normal(size=6)) for name in ("gyro_misalignment", "accel_misalignment")}
    s["gyro_g_sensitivity"] = jnp.asarray(300 * PER_G * rng.normal(size=9))
    s["accel_bias"] = jnp.array([0.1, -0.2, 0.3])
    effect = lambda name, w, other: STATES[name].effect(Reading(w, other)) @ s[name]
    accel = F + effect("accel_misalignment", F, W) + s["accel_bias"]
    gyro = W + effect("gyro_misalignment", W, F) + effect("gyro_g_sensitivity", W, F)
    back = jax.jit(corrected)(Imu(jnp.ones(1), gyro, accel), initial_nav(np.zeros(3))._replace(errors=s))
    np.testing.assert_allclose(back.accel, F, atol=1e-9)
    np.testing.assert_allclose(back.gyro, W, atol=1e-9)


def test_a_constant_is_not_driven_until_it_is_told_so():
    state = constant("sag", ("down",), 2.0, UserUnit("cm", 0.01, "cm"))
    assert state.defaults == (0.02, 0.0, float("inf"))
