"""What wheels know: they neither slide nor lift, and how fast they roll."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import rotations
from jaxnav.maths.units import Unit
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav


class NonholonomicParams(NamedTuple):
    """Of the constraint."""

    sd: Leaf  # () or (2,) m/s, of lateral and vertical velocity of the vehicle


class SpeedParams(NamedTuple):
    """Of a wheel speed."""

    sd_scale: Leaf  # () factor on its own sd
    scale: Leaf  # () scale error; 0 is none


def vehicle_velocity(mounting: Mounting, nav: Nav, kin: Kinematics) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Velocity of the wheel point in vehicle axes (forward, right, down), (3,), and its rows (3, k)."""
    pitch, yaw = mounting.vehicle
    zero = jnp.zeros_like(pitch)
    M = rotations.to_dcm(rotations.exp(jnp.stack([zero, pitch, yaw]))).T  # body -> vehicle
    v_b = kin.C.T @ kin.vel + jnp.cross(nav.omega, mounting.wheel_arm)
    # d(C' v) = C' (dv + [v x] phi); d(w x l) = -[l x] dw
    rows = {
        "velocity": M @ kin.C.T,
        "attitude": M @ kin.C.T @ rotations.skew(kin.vel),
        "gyro": -M @ rotations.skew(mounting.wheel_arm),
    }
    return M @ v_b, rows


def observe_nonholonomic(
    theta: NonholonomicParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix
) -> Observation:
    """No velocity to the right and down."""
    v, rows = vehicle_velocity(mounting, nav, kin)
    return Observation(v[1:], {name: row[1:] for name, row in rows.items()}, fix.sd, theta.sd)


def observe_speed(theta: SpeedParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """(1 + scale) v_forward - y."""
    v, rows = vehicle_velocity(mounting, nav, kin)
    scale = 1 + theta.scale
    rows = {name: row[:1] * scale for name, row in rows.items()}
    return Observation(v[:1] * scale - fix.value, rows, fix.sd, theta.sd_scale)


NONHOLONOMIC = Measurement(
    "nonholonomic", ("right", "down"), observe_nonholonomic, NonholonomicParams((0.1, 0.1)),
    NonholonomicParams(Unit("nonholonomic_mps", shape=(2,), text="m/s")),
)  # fmt: skip
"""Wheels neither slide sideways nor lift: no value; sd = its parameter times the fix's own sd (1 by default)."""
SPEED = Measurement(
    "speed", ("forward",), observe_speed, SpeedParams(1.0, 0.0),
    SpeedParams(Unit("speed_sd_scale"), Unit("speed_scale", step=0.02)), columns=("speed_mps",),
)  # fmt: skip
"""Wheel speed: value forward m/s, its own sd."""
