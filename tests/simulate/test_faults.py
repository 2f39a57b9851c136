"""Faults of a receiver that have a shape of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.simulate.faults import Slide, offsets

T = jnp.arange(1, 2001) / 100.0  # 20 s


@pytest.mark.parametrize("back, end", [(True, 0.0), (False, 60.0)])
def test_a_slides_velocity_is_that_of_its_position(back, end):
    """By central differences; it begins at rest, and is there and back, or all the way out, when it stops."""
    fault = Slide(5.0, 15.0, (60.0, -30.0, 0.0), back=back)
    found = np.asarray(offsets(jax.random.key(0), (fault,), T, jnp.zeros((T.size, 6))))
    inside = slice(501, 1498)
    slope = (found[2:, :3] - found[:-2, :3]) / 0.02
    np.testing.assert_allclose(found[1:-1, 3:][inside], slope[inside], atol=1e-3)
    assert not found[:500].any() and not found[1500:].any()
    assert np.abs(found[500]).max() < 0.5 and found[1499, 0] == pytest.approx(end, abs=0.01)
    assert found[:, 0].max() == pytest.approx(60.0, abs=0.01) and np.abs(found[1499, 3:]).max() < 0.01
