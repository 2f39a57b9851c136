"""UTM by what defines it: conformal, and 0.9996 of the meridian's length along the central meridian."""

import numpy as np
import pytest
from scipy.integrate import quad

from jaxnav.maths.axes import utm_to_lla
from jaxnav.maths.earth import E2, A


def meridian_radius(lat):
    """Radius of curvature of the meridian, m."""
    return A * (1 - E2) / (1 - E2 * np.sin(lat) ** 2) ** 1.5


@pytest.mark.parametrize("lat", [-1.3, -0.4, 0.0, 0.8, 1.4])
def test_utm_has_the_meridians_length(lat):
    south = lat < 0
    northing = 0.9996 * quad(meridian_radius, 0.0, lat, epsabs=1e-6)[0] + 1e7 * south
    found = utm_to_lla(np.array([[5e5, northing, 12.0]]), 32, south)[0]
    np.testing.assert_allclose(found, [lat, np.deg2rad(9.0), 12.0], atol=1e-11)  # 0.06 mm


def test_utm_is_conformal():
    """A step of 1 m east and north turns and stretches by the same: to 1e-8 up to 330 km from the meridian."""
    here = np.array([[170e3, 5.3e6, 0.0], [830e3, 1.0e6, 0.0], [420e3, 8.0e6, 0.0]])
    step = np.diag([50.0, 50.0, 0.0])
    slopes = [(utm_to_lla(here + d, 10) - utm_to_lla(here - d, 10)) / 100.0 for d in step[:2]]
    lat = utm_to_lla(here, 10)[:, 0]
    prime = A / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    east, north = ((s[:, 1] * prime * np.cos(lat), s[:, 0] * meridian_radius(lat)) for s in slopes)
    np.testing.assert_allclose(east[0], north[1], rtol=1e-8)
    np.testing.assert_allclose(east[1], -north[0], rtol=0, atol=1e-8)
    assert 0.9995 < np.hypot(east[0], east[1])[2] ** -1 < 1.0 < np.hypot(east[0], east[1])[0] ** -1
