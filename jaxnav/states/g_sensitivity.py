"""Effect of specific force on the gyros of small sensors: G_g of Groves 2013, eq. 4.17, row by row."""

import jax
import jax.numpy as jnp

from jaxnav.maths import units
from jaxnav.states.state import Reading, UserUnit, constant

PER_G = units.DEG_PER_HOUR / units.G0  # rad/s per m/s^2


def forces(reading: Reading) -> jax.Array:
    """Return M (..., 3, 9) of the force o: rate axis i reads s_3i o_x + s_3i+1 o_y + s_3i+2 o_z."""
    o = reading.other[..., None, :]
    zero = jnp.zeros_like(o)
    rows = [jnp.concatenate([o if i == axis else zero for i in range(3)], -1) for axis in range(3)]
    return jnp.concatenate(rows, -2)


GYRO_G_SENSITIVITY = constant(
    "gyro_g_sensitivity",
    tuple(f"{axis} by f{force}" for axis in "xyz" for force in "xyz"),
    30.0,
    UserUnit("deg_per_hour_per_g", PER_G, "deg/h/g"),
    "gyro",
    forces,
)
"""(rad/s)/(m/s^2), row by row: a constant unless it is driven."""
