"""A shape: velocity and attitude as a function of time that jax can differentiate."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike


class Motion(NamedTuple):
    """A shape at one instant."""

    vel: jax.Array  # (3,) m/s, ENU
    rph: jax.Array  # (3,) rad, roll, pitch, heading of FRD against NED


Shape = Callable[[jax.Array], Motion]


def level_motion(speed: ArrayLike, heading: ArrayLike, roll: ArrayLike = 0.0) -> Motion:
    """Motion on the level with the nose along the track: m/s, rad, rad."""
    speed, heading, roll = (jnp.asarray(a, float) for a in (speed, heading, roll))
    zero = jnp.zeros_like(heading)
    vel = jnp.stack([speed * jnp.sin(heading), speed * jnp.cos(heading), zero])
    return Motion(vel, jnp.stack([roll, zero, heading]))
