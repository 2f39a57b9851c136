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
    angles = mounting.vehicle + nav.errors.get("vehicle_axes", jnp.zeros(2))

    def axes(angles: jax.Array) -> jax.Array:
        turn = jnp.concatenate([jnp.zeros(1), angles])
        return rotations.to_dcm(rotations.exp(turn)).T  # body -> vehicle

    M = axes(angles)
    v_b = kin.C.T @ kin.vel + jnp.cross(nav.omega, mounting.wheel_arm)
    # d(C' v) = C' (dv + [v x] phi); d(w x l) = -[l x] dw
    rows = {
        "velocity": M @ kin.C.T,
        "attitude": M @ kin.C.T @ rotations.skew(kin.vel),
        "gyro": -M @ rotations.skew(mounting.wheel_arm),
    }
    if "vehicle_axes" in nav.errors:
        rows |= {"vehicle_axes": jax.jacfwd(lambda a: axes(a) @ v_b)(angles)}
    return M @ v_b, rows


def observe_nonholonomic(
    theta: NonholonomicParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix
) -> Observation:
    """No velocity to the right and down."""
    v, rows = vehicle_velocity(mounting, nav, kin)
    return Observation(v[1:], {name: row[1:] for name, row in rows.items()}, fix.sd, theta.sd)


def observe_speed(theta: SpeedParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """(1 + scale) v_forward - y, where the state ``odometer_scale`` is a part of the scale."""
    v, rows = vehicle_velocity(mounting, nav, kin)
    scale = 1 + theta.scale + nav.errors.get("odometer_scale", jnp.zeros(1))[0]
    rows = {name: row[:1] * scale for name, row in rows.items()} | {"odometer_scale": v[:1, None]}
    return Observation(v[:1] * scale - fix.value, rows, fix.sd, theta.sd_scale)


NONHOLONOMIC = Measurement(
    "nonholonomic", ("right", "down"), observe_nonholonomic, NonholonomicParams((0.1, 0.1)),
    NonholonomicParams(Unit("nonholonomic_mps", shape=(2,), text="m/s")),
    states=("vehicle_axes",),
)  # fmt: skip
"""Wheels neither slide sideways nor lift: no value; sd = its parameter times the fix's own sd (1 by default)."""
SPEED = Measurement(
    "speed", ("forward",), observe_speed, SpeedParams(1.0, 0.0),
    SpeedParams(Unit("speed_sd_scale"), Unit("speed_scale", step=0.02)), states=("vehicle_axes", "odometer_scale"),
    columns=("speed_mps",),
)  # fmt: skip
"""Wheel speed: value forward m/s, its own sd."""
