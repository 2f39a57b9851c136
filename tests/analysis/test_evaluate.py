"""Errors in north, east, down and their standard deviations, each where it belongs; shares inside 3 sd."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from jaxnav.analysis.evaluate import ERRORS, Trace, error_metrics, ned_errors, trace
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.run import initial_nav
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.types import Info, Track
from tests.conftest import GRADE


def test_errors_and_sd_are_north_east_down_and_roll_pitch_heading():
    lla, enu, vel = np.array([0.8, 0.2, 100.0]), np.array([1.0, -2.0, 3.0]), np.array([0.1, 0.2, -0.3])
    t = np.array([0.0, 1.0])
    rph = np.array([0.01, -0.02, 3.13])
    truth = Track(t, np.tile(lla, (2, 1)), np.zeros((2, 3)), np.tile(rph, (2, 1)))
    moved = np.asarray(earth.move(jnp.asarray(lla), jnp.asarray(enu)))
    # heading passes 180 degrees
    off = rph + np.array([1.0, -2.0, 3.0]) * DEG
    off[2] -= 2 * np.pi
    estimate = Track(t, np.tile(moved, (2, 1)), np.tile(vel, (2, 1)), np.tile(off, (2, 1)))
    sd = np.tile([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.07, 0.08, 0.09], (2, 1))
    sol = Trace(estimate, sd, np.tile([0.1, 0.2, 0.3], (2, 1)) * DEG, None)
    error, found = ned_errors(sol, truth)
    np.testing.assert_allclose(error[0, :6], [-2.0, 1.0, -3.0, 0.2, 0.1, 0.3], rtol=1e-6)
    np.testing.assert_allclose(error[0, 6:], [1.0, -2.0, 3.0], atol=0.06)  # to first order those of Euler angles
    np.testing.assert_allclose(found[0], [2.0, 1.0, 3.0, 5.0, 4.0, 6.0, 0.1, 0.2, 0.3], rtol=1e-12)


@pytest.mark.parametrize("heading, roll, pitch", [(0.0, 0.2, 0.1), (90.0, 0.1, 0.2), (180.0, 0.2, 0.1)])
def test_roll_is_about_the_nose_and_pitch_about_the_right_wing(heading, roll, pitch):
    """sd of 0.1 about east, 0.2 about north: flying north, roll is about north; flying east, about east."""
    nav = jax.tree.map(lambda a: a[None], initial_nav([0.8, 0.2, 100.0], (0, 0, 0), (0.0, 0.0, heading * DEG)))
    P = np.zeros((1, 15, 15))
    P[0, range(6, 9), range(6, 9)] = np.array([0.1, 0.2, 0.3]) ** 2
    blank = dict.fromkeys(Info._fields, jnp.zeros(1))
    found = trace(Info(**blank | {"nav": nav, "P": jnp.asarray(P)}), datasheet_params(GRADE))
    np.testing.assert_allclose(found.sd_rph[0], [roll, pitch, 0.3], rtol=1e-12)


def test_the_share_inside_3_sd_is_that_of_a_gaussian():
    rng = np.random.default_rng(0)
    sd = np.tile(np.arange(1.0, 10.0), (20_000, 1))
    found = error_metrics(rng.normal(size=sd.shape) * sd, sd, np.zeros(20_000, bool))
    for name in ERRORS:
        assert found[name]["inside_3sd"] == pytest.approx(norm.cdf(3) - norm.cdf(-3), abs=1.5e-3)
        assert found[name]["rms"] == pytest.approx(1.0 + list(ERRORS).index(name), rel=0.02)
