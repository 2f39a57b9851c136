"""Constraints and speeds of a vehicle on the ground: wheels without slip, wheel speeds, a constant height."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import rotations
from jaxnav.maths.units import Unit
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav


class NonholonomicParams(NamedTuple):
    """Parameters of the non-holonomic constraint."""

    sd: Leaf  # () or (2,) m/s, of lateral and vertical velocity of the vehicle


class LevelParams(NamedTuple):
    """Parameters of a constant height."""

    sd: Leaf  # () m/s


class SpeedParams(NamedTuple):
    """Parameters of a wheel speed."""

    sd_scale: Leaf  # () factor on the stated sd
    scale: Leaf  # () scale error; 0 is none


class WheelsParams(NamedTuple):
    """Parameters of the wheels of two sides."""

    sd_scale: Leaf  # () factor on the stated sd
    scale: Leaf  # () scale error; 0 is none
    track: Leaf  # () m, between the two


def vehicle_velocity(
    mounting: Mounting, nav: Nav, kin: Kinematics, offset: jax.Array | None = None
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Velocity of the wheel point in vehicle axes (forward, right, down), (3,), and its rows (3, k).

    ``offset`` (3,) m, vehicle axes: of a point that moves along with it.
    """
    angles = mounting.vehicle + nav.errors.get("vehicle_axes", jnp.zeros(2))

    def axes(angles: jax.Array) -> jax.Array:
        turn = jnp.concatenate([jnp.zeros(1), angles])
        return rotations.to_dcm(rotations.exp(turn)).T  # body -> vehicle

    M, offset = axes(angles), jnp.zeros(3) if offset is None else offset
    arm = mounting.wheel_arm + nav.errors.get("wheel_arm_error", jnp.zeros(3))
    v_b = kin.C.T @ kin.vel + jnp.cross(nav.omega, arm)
    seen = lambda M: M @ v_b + jnp.cross(M @ nav.omega, offset)
    # d(C' v) = C' (dv + [v x] phi); d(w x l) = -[l x] dw
    rows = {
        "velocity": M @ kin.C.T,
        "attitude": M @ kin.C.T @ rotations.skew(kin.vel),
        "gyro": -M @ rotations.skew(arm) - rotations.skew(offset) @ M,
        "wheel_arm_error": M @ rotations.skew(nav.omega),
    }
    if "vehicle_axes" in nav.errors:
        rows |= {"vehicle_axes": jax.jacfwd(lambda a: seen(axes(a)))(angles)}
    return seen(M), rows


def observe_nonholonomic(
    theta: NonholonomicParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix
) -> Observation:
    """Return the velocity to the right and down."""
    v, rows = vehicle_velocity(mounting, nav, kin)
    return Observation(v[1:], {name: row[1:] for name, row in rows.items()}, fix.sd, theta.sd)


def observe_speed(theta: SpeedParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return (1 + scale) v_forward - y, where the state ``odometer_scale`` is a part of the scale."""
    return _rolled(theta, [vehicle_velocity(mounting, nav, kin)], nav, fix)


def observe_wheels(theta: WheelsParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return the same for both sides: v_forward + w_z b / 2 on the left, less it on the right; b is the track."""
    sides = [jnp.stack([jnp.zeros(()), side * 0.5 * theta.track, jnp.zeros(())]) for side in (-1.0, 1.0)]
    return _rolled(theta, [vehicle_velocity(mounting, nav, kin, side) for side in sides], nav, fix)


def _rolled(theta: SpeedParams | WheelsParams, points: list[Any], nav: Nav, fix: Fix) -> Observation:
    """Return the forward speed of wheels at points, (velocity, rows) of `vehicle_velocity`."""
    scale = 1 + theta.scale + nav.errors.get("odometer_scale", jnp.zeros(1))[0]
    v = jnp.stack([velocity[0] for velocity, _ in points])
    rows = {name: scale * jnp.stack([rows[name][0] for _, rows in points]) for name in points[0][1]}
    return Observation(v * scale - fix.value, rows | {"odometer_scale": v[:, None]}, fix.sd, theta.sd_scale)


def observe_level(theta: LevelParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return v_up."""
    return Observation(kin.vel[2:], {"velocity": jnp.array([[0.0, 0.0, 1.0]])}, fix.sd, theta.sd)


NONHOLONOMIC = Measurement(
    "nonholonomic",
    ("right", "down"),
    observe_nonholonomic,
    NonholonomicParams((0.1, 0.1)),
    NonholonomicParams(Unit("mps", shape=(2,), text="m/s")),
    states=("vehicle_axes", "wheel_arm_error"),
)
"""Wheels neither slide sideways nor lift: no value; sd = its parameter times the fix's sd (1 by default)."""
SPEED = Measurement(
    "speed",
    ("forward",),
    observe_speed,
    SpeedParams(1.0, 0.0),
    SpeedParams(Unit(), Unit(step=0.02)),
    states=("vehicle_axes", "odometer_scale", "wheel_arm_error"),
    columns=(column("speed_mps", "speed", 0.3, plausible=(-500.0, 500.0)),),
)
"""Wheel speed: value forward m/s, sd."""
WHEELS = Measurement(
    "wheels",
    ("left", "right"),
    observe_wheels,
    WheelsParams(1.0, 0.0, 1.0),
    WheelsParams(Unit(), Unit(step=0.02), Unit("m", text="m", step=0.02)),
    states=("vehicle_axes", "odometer_scale", "wheel_arm_error"),
    columns=tuple(column(f"{side}_mps", "speed", 0.1, f"sd_{side}_mps", (-500.0, 500.0)) for side in ("left", "right")),
)
"""Speed of the wheels of both sides, none of which steers: value (2,) forward m/s, left and right, sd."""
LEVEL = Measurement("level", ("up",), observe_level, LevelParams(0.1), LevelParams(Unit("mps", text="m/s")))
"""A boat, or a robot on a floor, keeps its height: no value; sd = its parameter times the fix's sd."""
