"""Smooth pieces of a drive: speed and heading."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

RAMP = 0.3  # share of a change that its rate takes to rise, and again to fall: a jerk limit, or the clothoid of a turn
PEAK = 1 / (1 - RAMP)  # largest rate of `step`
BUMP_PEAK = 3.82  # largest rate of `bump`
BUMP_MEAN = 256 / 630  # integral of `bump`


def _rise(x: jax.Array) -> jax.Array:
    """Integral of the quintic smoothstep: 0 for x < 0, then a C3 bend into x - 1/2 for x > 1."""
    y = jnp.clip(x, 0, 1)
    return y**4 * (2.5 - 3 * y + y**2) + jnp.maximum(x - 1, 0)


def _rise_area(x: jax.Array) -> jax.Array:
    """Integral of `_rise` from 0."""
    y, z = jnp.clip(x, 0, 1), jnp.maximum(x - 1, 0)
    return y**5 * (0.5 - 0.5 * y + y**2 / 7) + 0.5 * z * (1 + z)


def step(u: jax.Array) -> jax.Array:
    """From 0 to 1 over u in [0, 1]; its rate is a trapezoid with rounded flanks (C2), at most `PEAK`."""
    return PEAK * RAMP * (_rise(u / RAMP) - _rise((u - 1) / RAMP + 1))


def step_area(u: jax.Array) -> jax.Array:
    """Integral of `step` from 0 to u; 1/2 at u = 1."""
    return PEAK * RAMP**2 * (_rise_area(u / RAMP) - _rise_area((u - 1) / RAMP + 1))


def bump(u: jax.Array) -> jax.Array:
    """From 0 to 1 and back over u in [0, 1], C3 at both ends."""
    return 256 * (u * (1 - u)) ** 4


def bump_area(u: jax.Array) -> jax.Array:
    """Integral of `bump` from 0 to u; `BUMP_MEAN` at u = 1."""
    return 256 * u**5 * (1 / 5 - u * (2 / 3 - u * (6 / 7 - u * (1 / 2 - u / 9))))


class Pieces(NamedTuple):
    """A drive as a table of K pieces in time; speed and heading are C3 from one to the next."""

    t: jax.Array  # (K,) s, start
    T: jax.Array  # (K,) s, duration; 0 is a piece that is left out
    distance: jax.Array  # (K,) m, travelled at the start
    speed: jax.Array  # (K,) m/s, at the start
    gain: jax.Array  # (K,) m/s, change of speed over the piece
    dip: jax.Array  # (K,) m/s, how much slower in the middle
    heading: jax.Array  # (K,) rad, at the start
    turn: jax.Array  # (K,) rad, change of heading over the piece
    bow: jax.Array  # (K,) rad, how far the heading swings out in the middle and comes back


class Profile(NamedTuple):
    """Where a vehicle is on its road at one instant."""

    distance: jax.Array  # () m
    speed: jax.Array  # () m/s
    heading: jax.Array  # () rad


def join_pieces(
    heading: jax.Array,
    T: jax.Array,
    end_speed: jax.Array,
    dip: jax.Array,
    turn: jax.Array,
    bow: jax.Array,
    start_speed: ArrayLike = 0.0,
) -> Pieces:
    """Put pieces (K,) one after the other, from t = 0 with a speed () and a heading (); others as in `Pieces`."""
    first = lambda a, start: jnp.concatenate([jnp.reshape(start, 1), a[:-1]])
    before = lambda a: first(jnp.cumsum(a), jnp.zeros(()))
    speed = first(end_speed, jnp.asarray(start_speed, float))
    gain = end_speed - speed
    length = T * (speed + 0.5 * gain - dip * BUMP_MEAN)
    return Pieces(before(T), T, before(length), speed, gain, dip, heading + before(turn), turn, bow)


def profile(pieces: Pieces, t: jax.Array) -> Profile:
    """Distance, speed and heading at one time; after the last piece the vehicle goes on straight at constant speed."""
    i = jnp.maximum(jnp.sum(pieces.t <= t) - 1, 0)  # the last that has started
    p = Pieces(*(a[i] for a in pieces))
    T = jnp.where(p.T > 0, p.T, 1.0)
    u = jnp.clip((t - p.t) / T, 0, 1)
    speed = p.speed + p.gain * step(u) - p.dip * bump(u)
    length = T * (p.speed * u + p.gain * step_area(u) - p.dip * bump_area(u))
    late = jnp.maximum(t - p.t - p.T, 0)
    heading = p.heading + p.turn * step(u) + p.bow * bump(u)
    return Profile(p.distance + length + late * speed, speed, heading)
