"""Functions that several checks use, by closed forms."""

import numpy as np
import pytest

from jaxnav.checkup.shared import level_velocity
from jaxnav.maths import earth
from jaxnav.types import Samples


@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_differences_of_positions_over_two_seconds_are_the_velocity(rate_hz):
    t = np.arange(0.0, 40.0, 1 / rate_hz)
    start = np.array([np.deg2rad(50.0), np.deg2rad(8.0), 100.0])
    north, east = (1 / np.asarray(earth.metres_per_radian(start)))[:2]
    lla = start + np.outer(t, [4.0 * north, 3.0 * east, 0.5])
    sd = np.full((t.size, 3), 0.2)
    found = level_velocity({"position": Samples(t, lla, sd, np.zeros((t.size, 3)))})
    np.testing.assert_allclose(found.value, np.tile([3.0, 4.0, 0.5], (found.t.size, 1)), rtol=1e-3)
    assert found.t[0] == pytest.approx(1.0) and found.sd[0, 0] == pytest.approx(1.5 * 0.2 / 2.0)
