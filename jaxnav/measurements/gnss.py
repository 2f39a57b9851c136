"""GNSS position and velocity of the antenna."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG, DELAY, Unit
from jaxnav.measurements.columns import Column, column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav


class FixParams(NamedTuple):
    """Parameters of a receiver's position or velocity; as a root L the covariance of a fix is L D C D L' (`Fix`)."""

    scale: Leaf  # (), (3,) or a lower triangular root (3, 3): factor on the fix's sd, ENU
    latency: Leaf  # () s, its age when it is stamped


def arm_of(mounting: Mounting, nav: Nav) -> jax.Array:
    """IMU -> antenna, (3,) m, body, with the state ``lever_arm_error``."""
    return mounting.lever_arm + nav.errors.get("lever_arm_error", jnp.zeros(3))


def observe_position(theta: FixParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return p + C l + e - y, where e is the state ``gnss_position_error`` and ``lever_arm_error`` is a part of l."""
    arm = kin.C @ arm_of(mounting, nav)
    y = earth.enu_difference(kin.lla, fix.value) + arm + nav.errors.get("gnss_position_error", jnp.zeros(3))
    rows = {
        "position": jnp.eye(3),
        "attitude": -rotations.skew(arm),
        "gnss_position_error": jnp.eye(3),
        "lever_arm_error": kin.C,
    }
    return Observation(y, rows, fix.sd, theta.scale)


def observe_velocity(theta: FixParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return v + C (w x l) - y; the Earth's rate times an arm is below 1e-4 m/s."""
    arm = arm_of(mounting, nav)
    swing = kin.C @ jnp.cross(nav.omega, arm)
    rows = {
        "velocity": jnp.eye(3),
        "attitude": -rotations.skew(swing),
        "gyro": -kin.C @ rotations.skew(arm),
        "lever_arm_error": kin.C @ rotations.skew(nav.omega),
    }
    return Observation(kin.vel + swing - fix.value, rows, fix.sd, theta.scale)


def _units(name: str) -> FixParams:
    scale, latency = Unit(shape=(3,), root=True), DELAY
    return FixParams(scale, latency)


SPEEDS = (-20e3, 20e3)  # m/s; beyond it a vehicle leaves the Earth
ENU, NED = ("east", "north", "up"), ("north", "east", "down")
POSITION = Measurement(
    "position", ENU, observe_position, FixParams((1.0, 1.0, 1.0), 0.0), _units("position"), receiver=True,
    states=("gnss_position_error", "lever_arm_error", "clock_offset"),
    columns=(
        column("lat_rad", "length", 3.0, "sd_e_m", (-math.pi / 2, math.pi / 2), (91 * DEG, -91 * DEG)),
        column("lon_rad", "length", 3.0, "sd_n_m", (-2 * math.pi, 2 * math.pi), (181 * DEG, -181 * DEG)),
        column("h_m", "length", 6.0, "sd_u_m", (-12e3, 1e6), (-999.0, -9999.0, -99999.0, -32768.0)),
    ),
    correlated=True, reported=NED, shows=(1, 0, 2),
)  # fmt: skip
"""GNSS position: value (lat rad, lon rad, h m) of the antenna, sd and correlations in ENU m."""
VELOCITY = Measurement(
    "velocity", ENU, observe_velocity, FixParams((1.0, 1.0, 1.0), 0.0), _units("velocity"), receiver=True,
    states=("lever_arm_error", "clock_offset"),
    columns=(
        column("ve_mps", "speed", 0.3, "sd_e_mps", SPEEDS), column("vn_mps", "speed", 0.3, "sd_n_mps", SPEEDS),
        Column((("vu_mps", 1.0), ("vd_mps", -1.0)), (("sd_u_mps", 1.0),), "speed", 0.6, SPEEDS),
    ),
    correlated=True, reported=NED,
)  # fmt: skip
"""GNSS velocity of the antenna: value, sd in ENU m/s."""
