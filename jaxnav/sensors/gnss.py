"""A GNSS receiver on a trajectory: position and velocity of the antenna with noise, and when there is none."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav import earth, rotations
from jaxnav.epochs import TICK
from jaxnav.types import Fix, Nav


def antenna(nav: Nav, lever_arm: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position (lat, lon, h) and velocity (ENU m/s) of the antenna of local level navigation, (3,) each.

    ``lever_arm``: (3,) m, body FRD. The Earth's own rate does not move the antenna.
    """
    C = rotations.to_dcm(nav.q)
    turning = C @ nav.omega - earth.earth_rate(nav.pos[0])
    arm = C @ lever_arm
    return earth.move(nav.pos, arm), nav.vel + jnp.cross(turning, arm)


def fixes(
    key: jax.Array, truth: Nav, lever_arm: jax.Array, position_sd: jax.Array, velocity_sd: jax.Array, hidden: jax.Array
) -> Fix:
    """Fixes (E, 6) for `jaxnav.measurements.GNSS` at the times of ``truth`` (E, ...), with white noise.

    ``position_sd`` (3,) m and ``velocity_sd`` (3,) m/s, ENU; ``hidden`` (E,) bool: there the fix is not valid, but its
    value is that of a receiver that works, so that the end of an outage can be scored.
    """
    lla, vel = jax.vmap(antenna, (0, None))(truth, lever_arm)
    e = jax.random.normal(key, (*vel.shape[:-1], 6), float)
    value = jnp.concatenate([jax.vmap(earth.move)(lla, position_sd * e[:, :3]), vel + velocity_sd * e[:, 3:]], 1)
    sd = jnp.broadcast_to(jnp.concatenate([position_sd, velocity_sd]), value.shape)
    return Fix(value, sd, jnp.zeros_like(value), jnp.broadcast_to(~hidden[:, None], value.shape))


def inside(t: jax.Array, windows: jax.Array) -> jax.Array:
    """Is each of t (E,) in a window (W, 2) s, start < t <= end? (E,) bool."""
    t = t[:, None]
    return jnp.any((t > windows[:, 0] + TICK) & (t <= windows[:, 1] + TICK), axis=1)


def random_outages(key: jax.Array, count: int, start: float, stop: float, length: tuple[float, float]) -> jax.Array:
    """``count`` windows (count, 2) s between start and stop, one at a random place of each of as many equal parts.

    Raises:
        ValueError: the longest one does not fit into its part.
    """
    part = (stop - start) / max(count, 1)
    if length[1] > part:
        raise ValueError(f"{count} outages of up to {length[1]:g} s do not fit between {start:g} and {stop:g} s")
    how_long, where = jax.random.uniform(key, (2, count), float)
    lasts = length[0] + (length[1] - length[0]) * how_long
    begin = start + part * np.arange(count) + (part - lasts) * where
    return jnp.stack([begin, begin + lasts], 1)
