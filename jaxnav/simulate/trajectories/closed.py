"""Closed forms: at rest, straight on, a circle, an s-shape, and the move that starts an alignment test."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import units
from jaxnav.simulate.kinds import hashed_by_type
from jaxnav.simulate.trajectories.motion import Motion, Shape, level_motion


@hashed_by_type
class Static(NamedTuple):
    """At rest."""

    rph_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # roll, pitch, heading


@hashed_by_type
class Straight(NamedTuple):
    """Straight on at constant speed and heading (on the globe: along a rhumb line)."""

    speed_mps: float = 10.0
    heading_deg: float = 0.0
    climb_deg: float = 0.0


@hashed_by_type
class Circle(NamedTuple):
    """Round and round on the level, nose along the track; clockwise, or with a negative period anticlockwise."""

    speed_mps: float = 10.0
    period_s: float = 126.0
    heading_deg: float = 0.0  # at the start
    banked: bool = False  # lean into the turn, so that the specific force has no lateral part


@hashed_by_type
class SShape(NamedTuple):
    """A snake on the level, nose along the track: the heading swings as a sine, at constant speed."""

    speed_mps: float = 10.0
    period_s: float = 60.0
    swing_deg: float = 60.0  # amplitude of the heading
    heading_deg: float = 0.0  # mean
    banked: bool = False


@hashed_by_type
class LaunchMove(NamedTuple):
    """At rest, then the FWEKF paper's eq. 33, level and nose ahead: 3 sin^2(tau / 2c) m/s^2 with c = 20 s / pi.

    The paper ends at tau = 20 s (30 m/s, 178.4 m); this goes on until the acceleration is zero again, at tau = 40 s
    and 60 m/s, and then at constant speed.
    """

    standstill_s: float = 20.0
    heading_deg: float = 0.0


def static(motion: Static) -> Shape:
    """Return `Static` as a shape."""
    rph = np.array(motion.rph_deg) * units.DEG
    return lambda t: Motion(0 * t * jnp.ones(3), 0 * t + rph)


def straight(motion: Straight) -> Shape:
    """`Straight` as a shape."""
    heading, climb = motion.heading_deg * units.DEG, motion.climb_deg * units.DEG
    flat = np.cos(climb)
    vel = motion.speed_mps * np.array([flat * np.sin(heading), flat * np.cos(heading), np.sin(climb)])
    return lambda t: Motion(0 * t + vel, 0 * t + np.array([0.0, climb, heading]))


def _bank(speed: float, rate: jax.Array | float, banked: bool) -> jax.Array | float:
    """Roll, rad, of a turn with ``rate`` rad/s: right wing down in a turn to the right."""
    return jnp.arctan(speed * rate / units.G0) if banked else 0.0


def circle(motion: Circle) -> Shape:
    """`Circle` as a shape.

    Raises:
        ValueError: a period of zero.
    """
    if motion.period_s == 0:
        raise ValueError("motion.period_s must not be 0")
    rate = 2 * np.pi / motion.period_s
    roll = _bank(motion.speed_mps, rate, motion.banked)
    return lambda t: level_motion(motion.speed_mps, motion.heading_deg * units.DEG + rate * t, 0 * t + roll)


def s_shape(motion: SShape) -> Shape:
    """`SShape` as a shape.

    Raises:
        ValueError: a period that is not positive.
    """
    if not motion.period_s > 0:
        raise ValueError(f"motion.period_s must be positive, got {motion.period_s:g}")
    w, swing = 2 * np.pi / motion.period_s, motion.swing_deg * units.DEG

    def shape(t: jax.Array) -> Motion:
        roll = _bank(motion.speed_mps, swing * w * jnp.cos(w * t), motion.banked)
        return level_motion(motion.speed_mps, motion.heading_deg * units.DEG + swing * jnp.sin(w * t), 0 * t + roll)

    return shape


def launch_move(motion: LaunchMove) -> Shape:
    """`LaunchMove` as a shape: v = 1.5 (tau - c sin(tau / c))."""
    c = 20 / np.pi

    def shape(t: jax.Array) -> Motion:
        tau = jnp.clip(t - motion.standstill_s, 0, 2 * np.pi * c)
        return level_motion(1.5 * (tau - c * jnp.sin(tau / c)), 0 * t + motion.heading_deg * units.DEG)

    return shape
