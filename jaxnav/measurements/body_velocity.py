"""Velocity along the sensor's axes: a Doppler velocity log, optical flow, visual odometry."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxnav.maths import rotations
from jaxnav.maths.units import DEG, DELAY, Unit
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav


class BodyVelocityParams(NamedTuple):
    """Parameters of a sensor that measures its velocity over ground."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped
    scale: Leaf  # () scale error; 0 is none
    yaw: Leaf  # () rad, of the sensor's forward axis, to the right of the body's
    arm: Leaf  # (3,) m, IMU -> sensor, body FRD


def observe_body_velocity(
    theta: BodyVelocityParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix
) -> Observation:
    """Return (1 + scale) M (C' v + w x arm) - y, where M turns the body's axes to the sensor's."""
    M = (1 + theta.scale) * rotations.to_dcm(rotations.exp(theta.yaw * jnp.array([0.0, 0.0, 1.0]))).T
    v_b = kin.C.T @ kin.vel + jnp.cross(nav.omega, theta.arm)
    # d(C' v) = C' (dv + [v x] phi); d(w x l) = -[l x] dw
    rows = {
        "velocity": M @ kin.C.T,
        "attitude": M @ kin.C.T @ rotations.skew(kin.vel),
        "gyro": -M @ rotations.skew(theta.arm),
    }
    return Observation(M @ v_b - fix.value, rows, fix.sd, theta.sd_scale)


BODY_VELOCITY = Measurement(
    "body_velocity", ("forward", "right", "down"), observe_body_velocity,
    BodyVelocityParams(1.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0)),
    BodyVelocityParams(
        Unit(), DELAY, Unit(step=0.02), Unit("deg", DEG, text="deg", step=1.0 * DEG),
        Unit("m", 1.0, (3,), "m", step=0.2),
    ),
    columns=tuple(
        column(f"{axis}_mps", "speed", 0.1, f"sd_{axis}_mps", (-500.0, 500.0)) for axis in ("forward", "right", "down")
    ),
)  # fmt: skip
"""Velocity over ground along the sensor's axes: value (3,) m/s forward, right, down, sd."""
