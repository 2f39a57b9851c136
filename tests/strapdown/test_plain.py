"""The fast form of local level navigation against the plain one, which reads like its equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.run import initial_nav
from jaxnav.maths import earth, rotations
from jaxnav.states.table import zeros
from jaxnav.strapdown import local_level as plain
from jaxnav.strapdown.fast import local_level as fast
from jaxnav.types import Forcing, Imu


def a_minute(lat: float, speed: float, rate: float = 100.0) -> tuple:
    """Turns, climbs and pushes; the last samples are padding; biases and scale errors to take out."""
    rng, n = np.random.default_rng(1), round(60 * rate)
    t = np.arange(n) / rate
    gyro = 0.2 * np.stack([np.sin(t), np.cos(0.7 * t), np.sin(0.3 * t)], 1) + 1e-3 * rng.normal(size=(n, 3))
    accel = np.stack([np.sin(0.5 * t), np.cos(t), -9.8 + 0.5 * np.sin(2 * t)], 1) + 1e-2 * rng.normal(size=(n, 3))
    dt = np.where(np.arange(n) < n - 7, 1 / rate, 0.0)
    nav = initial_nav([lat, 2e-3, 500.0], [speed, 0.5 * speed, 1.0], [0.1, -0.2, 1.0], t=5.0)
    errors = zeros(("gyro_bias", "accel_bias", "gyro_scale")) | {
        "gyro_bias": jnp.array([1e-3, -2e-3, 5e-4]),
        "gyro_scale": jnp.array([1e-3, 2e-3, -1e-3]),
    }
    return nav._replace(errors=errors), Imu(jnp.asarray(dt), jnp.asarray(gyro), jnp.asarray(accel))


def apart(nav, imu, u):
    """Largest differences of position m, velocity m/s and attitude rad at the end, and the two paths."""
    (a, path_a), (b, path_b) = (jax.jit(form.propagate)(nav, u, imu) for form in (fast, plain))
    turn = rotations.log(rotations.multiply(a.q, rotations.conjugate(b.q)))
    off = earth.enu_difference(a.pos, b.pos), a.vel - b.vel, turn
    return [float(np.abs(x).max()) for x in off], path_a, path_b


PUSH = Forcing(np.zeros(3), np.array([0.01, 0.02, -0.01]))


@pytest.mark.full
@pytest.mark.parametrize("u", [None, PUSH])
@pytest.mark.parametrize(
    # near zero a float tells 1e-11 m apart, elsewhere 3,000 additions round to some 1e-8 m and more
    "lat, speed, bound",
    [(1e-3, 20.0, 1e-9), (0.6, 20.0, 1e-7), (-1.3, 60.0, 1e-7)],
)
def test_the_fast_form_is_the_plain_one(lat, speed, bound, u):
    (position, velocity, attitude), path_a, path_b = apart(*a_minute(lat, speed), u)
    assert position < bound and velocity < 1e-9 and attitude < 1e-12
    for name in ("C", "force", "gyro", "accel"):
        np.testing.assert_allclose(getattr(path_a, name), getattr(path_b, name), rtol=0, atol=1e-9)


def test_an_observers_spin_is_of_second_order_in_the_fast_form():
    """It turns about ENU of a block's first sample there, about ENU as it is here: s w t^2 / 2 for each block."""
    spins = [Forcing(f * np.array([1e-4, -2e-4, 1e-4]), np.zeros(3)) for f in (1.0, 0.1)]
    large, small = (apart(*a_minute(0.6, 20.0), u)[0][2] for u in spins)
    assert large < 2e-6 and large / small == pytest.approx(10, rel=0.1)


def test_gravity_holds_what_stands():
    """An IMU at rest that feels gravity and the Earth's rate stays where it is, and one that falls, falls."""
    nav = initial_nav([0.7, 0.2, 100.0])
    g = float(earth.gravity(nav.pos[0], nav.pos[2]))
    C = rotations.to_dcm(nav.q)
    still = C.T @ jnp.array([0.0, 0.0, g])
    rate = C.T @ earth.earth_rate(nav.pos[0])
    n, dt = 200, 0.01
    imu = Imu(jnp.full(n, dt), jnp.tile(rate, (n, 1)), jnp.tile(still, (n, 1)))
    rest = jax.jit(plain.propagate)(nav, None, imu)[0]
    np.testing.assert_allclose(rest.vel, 0, atol=1e-9)
    fallen = jax.jit(plain.propagate)(nav, None, imu._replace(accel=0 * imu.accel))[0]
    assert float(fallen.pos[2]) == pytest.approx(100 - 0.5 * g * (n * dt) ** 2, abs=1e-3)
