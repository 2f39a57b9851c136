"""WGS-84 against published figures, python-ins and pymap3d."""

import jax
import numpy as np
import pymap3d
import pytest
from pyins import earth as pyins_earth

from jaxnav.analysis.metrics import errors
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.types import Track

POINTS = np.array(
    [(lat, lon, h) for lat in (-89.9999, -55, -1e-9, 0, 45, 89.9999) for lon in (-179, 0, 91) for h in (-100, 0, 9e3)]
    + [(58.0, 37.0, 4e5), (0.0, 180.0, 2e4), (-89.0, 10.0, 1e5)]
) * [DEG, DEG, 1.0]  # fmt: skip
gravity, radii, axes = jax.jit(earth.gravity), jax.jit(earth.radii), jax.jit(earth.axes)
difference, move, scale = jax.jit(earth.enu_difference), jax.jit(earth.move), jax.jit(earth.metres_per_radian)
ecef_jacobian, lla_jacobian = jax.jit(jax.jacfwd(earth.lla_to_ecef)), jax.jit(jax.jacrev(earth.ecef_to_lla))
to_ecef = jax.jit(jax.vmap(earth.lla_to_ecef))
to_lla = jax.jit(jax.vmap(earth.ecef_to_lla))


@pytest.mark.parametrize(
    "lat, h, expected",
    [
        (0, 0, 9.7803253359),
        (90, 0, 9.8321849378),
        (45, 0, 9.80619776934378),
        (50, 100, 9.810394500211505),
        (58, 150, 9.817113838512896),
    ],
)
def test_gravity_figures(lat, h, expected):
    assert gravity(lat * DEG, float(h)) == pytest.approx(expected, rel=1e-14)


def test_gravity_over_a_grid():
    lat, h = (a.ravel() for a in np.meshgrid(np.linspace(-90, 90, 19), [-300, 0, 1e3, 1e4]))
    ours = jax.vmap(earth.gravity)(lat * DEG, h)
    np.testing.assert_allclose(ours, pyins_earth.gravity(lat, h), rtol=1e-13)


def test_gravity_falls_as_the_free_air_gradient():
    np.testing.assert_allclose(jax.grad(earth.gravity, 1)(0.7, 0.0), -3.08e-6, rtol=5e-3)  # 0.308 mGal a metre


def test_radii():
    np.testing.assert_allclose(radii(45 * DEG), [6367381.815619549, 6388838.290121148], rtol=1e-14)
    e2, a = 6.6943799901413e-3, 6378137.0
    np.testing.assert_allclose(radii(0.0), [a * (1 - e2), a], rtol=1e-13)
    np.testing.assert_allclose(radii(90 * DEG), [a / np.sqrt(1 - e2)] * 2, rtol=1e-13)


def test_ecef_figure():
    expected = [2928958.905642093, 2207128.845931247, 5202612.251268706]
    np.testing.assert_allclose(to_ecef(np.array([[55 * DEG, 37 * DEG, 1500.0]]))[0], expected, rtol=1e-14)


def test_lla_to_ecef_is_pymap3d():
    expected = np.stack(pymap3d.geodetic2ecef(*POINTS.T, deg=False), 1)
    np.testing.assert_allclose(to_ecef(POINTS), expected, rtol=0, atol=2e-8)


def test_ecef_to_lla_is_pymap3d_and_inverts():
    r = np.stack(pymap3d.geodetic2ecef(*POINTS.T, deg=False), 1)
    lla = np.asarray(to_lla(r))
    # the angle of longitude loses digits near the axis: compare metres there
    np.testing.assert_allclose(to_ecef(lla), r, rtol=0, atol=5e-9)
    np.testing.assert_allclose(lla[:, 0], POINTS[:, 0], rtol=0, atol=1e-15 * 2)
    np.testing.assert_allclose(lla[:, 2], POINTS[:, 2], rtol=0, atol=5e-9)
    theirs = np.stack(pymap3d.ecef2geodetic(*r.T, deg=False), 1)
    np.testing.assert_allclose(lla[:, [0, 2]], theirs[:, [0, 2]], rtol=0, atol=1e-8)


def test_ecef_to_lla_at_a_pole_has_the_polar_radius():
    b = 6356752.314245179
    lat, _, h = to_lla(np.array([[1e-6, 0.0, b + 12.0], [0.0, 1e-6, -b - 12.0]])).T
    np.testing.assert_allclose(lat, [np.pi / 2, -np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(h, 12.0, atol=2e-9)


def test_axes_are_the_derivative_of_position():
    lla = np.array([0.9, -2.0, 300.0])
    per_metre = ecef_jacobian(lla) / scale(lla)[None]
    np.testing.assert_allclose(axes(lla[0], lla[1]), np.asarray(per_metre)[:, [1, 0, 2]], atol=1e-13)


def test_enu_difference_is_the_ecef_difference_and_first_order():
    here = np.array([-0.6, 2.5, 400.0])
    C = axes(here[0], here[1])
    for d in (100.0, 10.0):
        there = here + np.array([d / 6.37e6, -2 * d / 6.37e6, 0.3 * d])
        exact = C.T @ (to_ecef(here[None]) - to_ecef(there[None]))[0]
        np.testing.assert_allclose(difference(here, there), exact, rtol=0, atol=(2.3 * d) ** 2 / 1.2e7)


def test_move_is_the_inverse_of_enu_difference():
    here, d = np.array([0.7, 0.2, 50.0]), np.array([30.0, -40.0, 5.0])
    np.testing.assert_allclose(difference(here, move(here, -d)), d, rtol=0, atol=2e-9)
    # seen from the other end it is second order in the distance
    np.testing.assert_allclose(difference(move(here, d), here), d, rtol=0, atol=50.0**2 / 3e6)


def test_the_date_line_is_no_distance():
    here, there = np.array([-0.3, np.pi - 1e-6, 5.0]), np.array([-0.3, -np.pi + 2e-6, 1.0])
    np.testing.assert_allclose(difference(here, there), difference(here, there + [0, 2 * np.pi, 0]), rtol=0, atol=1e-8)
    np.testing.assert_allclose(difference(here + [0, 4 * np.pi, 0], there)[0], -3e-6 * 6.1e6, rtol=1e-2)
    # nor between the samples of a truth
    t, zero = np.arange(2.0), np.zeros((2, 3))
    truth = Track(t, np.stack([here, there]), zero, zero)
    middle = Track(np.array([0.5]), np.array([[-0.3, -np.pi + 5e-7, 3.0]]), zero[:1], zero[:1])
    np.testing.assert_allclose(errors(middle, truth).position, 0, rtol=0, atol=1e-8)


def test_rates_are_pyins():
    lla, vel = POINTS[::4], np.array([30.0, -20.0, 4.0])
    lat_deg = lla[:, 0] / DEG
    ned = pyins_earth.rate_n(lat_deg)
    np.testing.assert_allclose(jax.vmap(earth.earth_rate)(lla[:, 0]), ned[:, [1, 0, 2]] * [1, 1, -1], atol=1e-19)
    curvature = pyins_earth.curvature_matrix(lat_deg, lla[:, 2])
    ned = curvature @ np.array([vel[1], vel[0], -vel[2]])
    ours = jax.vmap(lambda lat, h: earth.transport_rate(lat, h, np.asarray(vel)))(lla[:, 0], lla[:, 2])
    np.testing.assert_allclose(ours, ned[:, [1, 0, 2]] * [1, 1, -1], rtol=1e-12, atol=1e-20)


def test_gradients_are_finite_at_the_equator_and_off_the_axis():
    for lla in ([0.0, 0.0, 0.0], [1.5707, np.pi, -50.0], [-0.5, -np.pi / 2, 1e5]):
        J = ecef_jacobian(np.array(lla))
        K = lla_jacobian(to_ecef(np.array([lla]))[0])
        m = np.asarray(scale(np.array(lla)))  # rad and m alike
        np.testing.assert_allclose(m[:, None] * (K @ J) / m, np.eye(3), atol=1e-7)
        assert np.isfinite(jax.jit(jax.grad(earth.gravity))(lla[0], lla[2]))
