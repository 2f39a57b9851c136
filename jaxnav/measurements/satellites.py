"""Pseudoranges and range rates, one channel a satellite: tight coupling (Groves 2013, sections 9.4 and 14.3.2).

A pseudorange is corrected for the satellite's clock, the atmosphere and the rotation of the Earth during the signal's
flight (`jaxnav.gnss.corrections`): the satellite stands in the ECEF axes of the time of reception. A range rate is
positive where the range grows, and is corrected for the satellite's clock rate.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DELAY, Unit
from jaxnav.measurements.gnss import arm_of
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.states.receiver_clock import SLOTS
from jaxnav.types import Fix, Leaf, Mounting, Nav

SATELLITE = ("satellite", "x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps", "elevation_rad", "cn0_dbhz", "restart")
"""Auxiliary values of a channel: number (`jaxnav.gnss.satellites`), position and velocity in ECEF, elevation, carrier
to noise density, and 1 at the first epoch of another satellite in the slot."""
CONSTELLATION = (
    100  # a satellite's number is that times the index of its constellation in `CONSTELLATIONS`, plus its PRN
)
CONSTELLATIONS = "GJSECRI"
"""GPS, QZSS and SBAS on one clock; Galileo, BeiDou, and GLONASS or NavIC, each with an ``inter_system_bias``."""
REFERENCE_CN0 = 45.0  # dB-Hz, of a strong signal
MIN_ELEVATION = math.radians(3.0)  # below it sd grows no more


class SatelliteParams(NamedTuple):
    """Weights of a satellite: sd = hypot(floor, slant / sin(elevation)) * 10^((45 dB-Hz - C/N0) / cn0_scale)."""

    floor_sd: Leaf  # () m or m/s
    slant_sd: Leaf  # () m or m/s, overhead
    cn0_scale: Leaf  # () dB of C/N0 over which sd grows tenfold
    latency: Leaf  # () s, its age when it is stamped


class Satellites(NamedTuple):
    """Auxiliary values of the channels of a fix, by name."""

    position: jax.Array  # (s, 3) m, ECEF at reception
    velocity: jax.Array  # (s, 3) m/s, derivative of that
    elevation: jax.Array  # (s,) rad
    cn0: jax.Array  # (s,) dB-Hz
    further: jax.Array  # (s, 3) 1 in the column of a further constellation


def satellites(fix: Fix) -> Satellites:
    """Return the satellites of the channels."""
    table = jnp.asarray(fix.auxiliary)
    system = jnp.floor_divide(table[:, 0], CONSTELLATION)
    third = CONSTELLATIONS.index("R")
    further = jnp.stack([system == CONSTELLATIONS.index("E"), system == CONSTELLATIONS.index("C"), system >= third], 1)
    return Satellites(table[:, 1:4], table[:, 4:7], table[:, 7], table[:, 8], further.astype(table.dtype))


def weight(theta: SatelliteParams, elevation: Any, cn0: Any, xp: Any = jnp) -> Any:
    """Return the sd (s,) m or m/s of `SatelliteParams`; ``elevation`` rad, ``cn0`` dB-Hz; ``xp``: np on the host."""
    slant = theta.slant_sd / xp.sin(xp.maximum(elevation, MIN_ELEVATION))
    return xp.sqrt(theta.floor_sd**2 + slant**2) * 10 ** ((REFERENCE_CN0 - cn0) / theta.cn0_scale)


class Sight(NamedTuple):
    """Geometry between antenna and satellites."""

    distance: jax.Array  # (s,) m
    u: jax.Array  # (s, 3) unit vectors to the satellites, ENU
    to_ecef: jax.Array  # (3, 3) ENU -> ECEF
    arm: jax.Array  # (3,) m, IMU -> antenna, ENU
    turn: jax.Array  # (3, 3) rad/m, of the axes ENU by a displacement


def line_of_sight(mounting: Mounting, nav: Nav, kin: Kinematics, position: jax.Array, valid: jax.Array) -> Sight:
    """Return the geometry; channels that are not ``valid`` (s,) have any direction.

    At the antenna, whose ENU axes are those of the IMU: 1e-7 rad at an arm of a metre.
    """
    to_ecef = earth.axes(kin.lla[0], kin.lla[1])
    arm = kin.C @ arm_of(mounting, nav)
    off = position - (earth.lla_to_ecef(kin.lla) + to_ecef @ arm)
    off = jnp.where(valid[:, None], off, jnp.array([2e7, 0.0, 0.0]))
    distance = jnp.sqrt(jnp.sum(off * off, 1))
    turn = earth.axes_turn(kin.lla[0], kin.lla[2])
    return Sight(distance, (off / distance[:, None]) @ to_ecef, to_ecef, arm, turn)


def observe_pseudorange(theta: SatelliteParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return |s - p - C l| + b + i + e - y: receiver's clock b, its bias i to a constellation, slow range error e.

    Groves 2013, eq. 9.128 without the terms that `jaxnav.gnss.corrections` takes out; rows eq. 14.118.
    """
    seen = satellites(fix)
    sight = line_of_sight(mounting, nav, kin, seen.position, fix.valid)
    error = lambda name, size: nav.errors.get(name, jnp.zeros(size))
    n = fix.sd.size
    rows = {
        "position": -sight.u + sight.u @ rotations.skew(sight.arm) @ sight.turn,
        "attitude": sight.u @ rotations.skew(sight.arm),
        "lever_arm_error": -sight.u @ kin.C,
        "receiver_clock_bias": jnp.ones((n, 1)),
        "inter_system_bias": seen.further,
        "range_error": jnp.eye(n),
    }
    clock = error("receiver_clock_bias", 1) + seen.further @ error("inter_system_bias", 3)
    y = sight.distance + clock + error("range_error", n) - fix.value
    return Observation(y, rows, fix.sd, weight(theta, seen.elevation, seen.cn0))


def observe_range_rate(theta: SatelliteParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return u' (v_s - v - C (w x l)) + d - y, with the drift d of the receiver's clock (Groves 2013, eq. 9.141)."""
    seen = satellites(fix)
    sight = line_of_sight(mounting, nav, kin, seen.position, fix.valid)
    arm = arm_of(mounting, nav)
    swing = kin.C @ jnp.cross(nav.omega, arm)
    relative = seen.velocity @ sight.to_ecef - (kin.vel + swing)
    rate = jnp.sum(sight.u * relative, 1)
    turning = -(relative - rate[:, None] * sight.u) / sight.distance[:, None]  # d rate / d position: u turns
    rows = {
        "position": turning
        + (sight.u @ rotations.skew(kin.vel + swing) - turning @ rotations.skew(sight.arm)) @ sight.turn,
        "velocity": -sight.u,
        "attitude": sight.u @ rotations.skew(swing) - turning @ rotations.skew(sight.arm),
        "gyro": sight.u @ kin.C @ rotations.skew(arm),
        "lever_arm_error": -sight.u @ kin.C @ rotations.skew(nav.omega) + turning @ kin.C,
        "receiver_clock_drift": jnp.ones((fix.sd.size, 1)),
    }
    y = rate + nav.errors.get("receiver_clock_drift", jnp.zeros(1)) - fix.value
    return Observation(y, rows, fix.sd, weight(theta, seen.elevation, seen.cn0))


def _units(suffix: str, text: str) -> SatelliteParams:
    return SatelliteParams(Unit(suffix, text=text), Unit(suffix, text=text), Unit("db", text="dB"), DELAY)


_SLOTS = tuple(f"slot_{i + 1}" for i in range(SLOTS))
PSEUDORANGE = Measurement(
    "pseudorange", _SLOTS, observe_pseudorange, SatelliteParams(1.0, 0.5, 20.0, 0.0), _units("m", "m"), receiver=True,
    states=("receiver_clock_bias", "receiver_clock_drift", "inter_system_bias", "range_error", "lever_arm_error",
            "clock_offset"),
    auxiliary=SATELLITE, needs=("receiver_clock_bias", "receiver_clock_drift", "inter_system_bias", "range_error"),
    replaces=("position",), restarts=("range_error",),
)  # fmt: skip
"""Pseudoranges of satellites: value m a slot, sd a factor on `SatelliteParams`."""
RANGE_RATE = Measurement(
    "range_rate", _SLOTS, observe_range_rate, SatelliteParams(0.05, 0.03, 20.0, 0.0), _units("mps", "m/s"),
    receiver=True, states=("receiver_clock_drift", "lever_arm_error", "clock_offset"),
    auxiliary=SATELLITE, needs=("receiver_clock_drift",), replaces=("velocity",),
)  # fmt: skip
"""Range rates of satellites, Doppler or time-differenced carrier phase: value m/s a slot, sd a factor likewise."""
