"""Where the vehicle points: two antennas, the course over ground, and how fast wheels say that it turns."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import rotations
from jaxnav.maths.units import DEG, DELAY, Unit
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav

TINY = 1e-9  # m/s or m: shorter vectors are taken for zero
SLOWEST = 0.1  # m/s or m: below it a direction means nothing, and its row is bounded


class HeadingParams(NamedTuple):
    """Parameters of a heading by two antennas."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped
    yaw: Leaf  # () rad, of the line from the first antenna to the second in body axes, to the right of forward


class BaselineParams(NamedTuple):
    """Parameters of the line from one antenna to another."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped
    arm: Leaf  # (3,) m, first antenna -> second, body


class AgedParams(NamedTuple):
    """Parameters of a sensor that is only late."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped


def azimuth(d: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Direction () rad from north to east of a vector (3,) ENU, and its derivative (1, 3)."""
    square = d[0] ** 2 + d[1] ** 2
    none = square < TINY**2  # of a vector without a direction the angle is 0, and so is its derivative
    angle = jnp.arctan2(jnp.where(none, 0.0, d[0]), jnp.where(none, 1.0, d[1]))
    return angle, jnp.stack([d[1], -d[0], jnp.zeros(())])[None] / jnp.maximum(square, SLOWEST**2)


def turned(angle: jax.Array) -> jax.Array:
    """Return the angle within +-pi, (1,)."""
    return (jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi)[None]


def observe_heading(theta: HeadingParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Azimuth of C (cos yaw, sin yaw, 0) - y."""
    d = kin.C @ jnp.stack([jnp.cos(theta.yaw), jnp.sin(theta.yaw), jnp.zeros(())])
    angle, slope = azimuth(d)
    return Observation(turned(angle - fix.value[0]), {"attitude": -slope @ rotations.skew(d)}, fix.sd, theta.sd_scale)


def observe_baseline(theta: BaselineParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """C b - y."""
    d = kin.C @ theta.arm
    return Observation(d - fix.value, {"attitude": -rotations.skew(d)}, fix.sd, theta.sd_scale)


def observe_course(theta: AgedParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Azimuth of the velocity - y."""
    angle, slope = azimuth(kin.vel)
    return Observation(turned(angle - fix.value[0]), {"velocity": slope}, fix.sd, theta.sd_scale)


def observe_yaw_rate(theta: AgedParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """w_z - y."""
    return Observation(nav.omega[2:] - fix.value, {"gyro": jnp.eye(3)[2:]}, fix.sd, theta.sd_scale)


_AGED = (Unit(), DELAY)
"""Units of ``sd_scale`` and ``latency``."""
HEADING = Measurement(
    "heading",
    ("heading",),
    observe_heading,
    HeadingParams(1.0, 0.0, 0.0),
    HeadingParams(*_AGED, Unit("deg", DEG, text="deg", step=DEG)),
    columns=(column("heading_rad", "angle", 0.1, plausible=(-13.0, 13.0)),),
)
"""Heading by two antennas: value rad from north, clockwise, of the line from the first to the second, sd."""
BASELINE = Measurement(
    "baseline",
    ("east", "north", "up"),
    observe_baseline,
    BaselineParams(1.0, 0.0, (1.0, 0.0, 0.0)),
    BaselineParams(*_AGED, Unit("m", 1.0, (3,), "m", step=0.1)),
    columns=(
        column("e_m", "length", 0.02, "sd_e_m"),
        column("n_m", "length", 0.02, "sd_n_m"),
        column("u_m", "length", 0.04, "sd_u_m"),
    ),
)
"""Line between two antennas: value (3,) m ENU, first -> second, sd."""
COURSE = Measurement(
    "course",
    ("course",),
    observe_course,
    AgedParams(1.0, 0.0),
    AgedParams(*_AGED),
    columns=(column("course_rad", "angle", 0.1, plausible=(-13.0, 13.0)),),
)
"""Course over ground: value rad from north, clockwise, sd; give none below walking pace."""
YAW_RATE = Measurement(
    "yaw_rate",
    ("down",),
    observe_yaw_rate,
    AgedParams(1.0, 0.0),
    AgedParams(*_AGED),
    columns=(column("rate_radps", "rate", 0.05, plausible=(-35.0, 35.0)),),
)
"""Turn rate by the wheels of both sides: value rad/s about the body's z, sd."""
