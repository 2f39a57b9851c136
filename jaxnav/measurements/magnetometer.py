"""The Earth's magnetic field in body axes: heading, where no motion shows it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import rotations
from jaxnav.maths.units import DEG, DELAY, Unit
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.states.state import BODY
from jaxnav.types import Fix, Leaf, Mounting, Nav


class MagnetometerParams(NamedTuple):
    """Parameters of a magnetometer, and of the field there, which `jaxnav.initialization.magnetic` looks up."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped
    declination: Leaf  # () rad, of the horizontal field from north to east
    inclination: Leaf  # () rad, of the field below the horizon
    strength: Leaf  # () uT


def field(declination: jax.Array, inclination: jax.Array, strength: jax.Array) -> jax.Array:
    """(3,) uT ENU."""
    level = jnp.cos(inclination)
    return strength * jnp.stack([level * jnp.sin(declination), level * jnp.cos(declination), -jnp.sin(inclination)])


def observe_magnetometer(
    theta: MagnetometerParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix
) -> Observation:
    """C' m + b - y, where b is the state ``magnetometer_bias`` and m is turned by ``declination_error``."""
    east = theta.declination + nav.errors.get("declination_error", jnp.zeros(1))[0]
    m = field(east, theta.inclination, theta.strength)
    y = kin.C.T @ m + nav.errors.get("magnetometer_bias", jnp.zeros(3)) - fix.value
    rows = {
        "attitude": kin.C.T @ rotations.skew(m),  # d(C' m) = C' [m x] phi
        "magnetometer_bias": jnp.eye(3),
        "declination_error": kin.C.T @ jnp.stack([m[1], -m[0], jnp.zeros(())])[:, None],
    }
    return Observation(y, rows, fix.sd, theta.sd_scale)


MAGNETOMETER = Measurement(
    "magnetometer", BODY, observe_magnetometer, MagnetometerParams(1.0, 0.0, 0.0, 60 * DEG, 50.0),
    MagnetometerParams(
        Unit(), DELAY,
        Unit("deg", DEG, text="deg", step=3 * DEG), Unit("deg", DEG, text="deg", step=3 * DEG),
        Unit("ut", text="uT", step=1.0),
    ),
    states=("magnetometer_bias", "declination_error"),
    columns=tuple(column(f"{axis}_ut", "field", 3.0, f"sd_{axis}_ut", (-2e3, 2e3)) for axis in "xyz"),
)  # fmt: skip
"""Magnetic field: value (3,) uT, body, sd."""
