"""Scale errors and misalignment of the inertial sensors, as noise.

A sensor with a scale error or a misaligned axis, of k, reads too much by k times the rate or the acceleration along or
across it: after a turn of a radian attitude is off by k. A filter may estimate it (`jaxnav.states.scale_factors`,
`jaxnav.states.misalignment`: 18 states); else it is noise that lasts as long as a turn or a braking, and as white noise
of the same power at low frequencies has the root PSD

    k |w| sqrt(2 tau),  k |a| sqrt(2 tau)

with the mean rate w and the mean acceleration a of an epoch. What gravity makes of it is a bias.
"""

import jax
import jax.numpy as jnp

ESTIMATES = ("gyro_scale", "accel_scale", "gyro_misalignment", "accel_misalignment")
"""States of a filter to which none of it is noise."""
SENSITIVITY_S = 5.0  # s, tau: how long a turn or a braking lasts


def sensitivity_noise(scale: jax.Array, rate: jax.Array, acceleration: jax.Array) -> jax.Array:
    """Return the root PSD (2,) of gyro and accelerometer noise, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).

    Args:
        scale: (), sd of scale errors and misalignment.
        rate: (3,) rad/s, mean of an epoch.
        acceleration: (3,) m/s^2, change of velocity in an epoch over its length, any axes.
    """
    square = 2 * SENSITIVITY_S * scale**2 * jnp.stack([rate @ rate, acceleration @ acceleration])
    some = square > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
