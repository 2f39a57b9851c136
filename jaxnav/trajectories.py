"""Trajectories as smooth functions of time, and their position, on a regular grid, to the precision of float64.

A shape is a function ``t -> Motion(vel, rph)`` that jax can differentiate: `urban` makes one from a key. `travel`
integrates it to position by Gauss-Legendre quadrature (order 6) and gives all that an IMU or a receiver measures.
Nothing here knows a mechanization; the earth enters by its radii only.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav import earth, units


class Motion(NamedTuple):
    """What a shape says of one instant."""

    vel: jax.Array  # (3,) m/s, ENU
    rph: jax.Array  # (3,) rad, roll, pitch, heading of FRD against NED


Shape = Callable[[jax.Array], Motion]


class Point(NamedTuple):
    """A motion at one instant, with its position and the rates of everything."""

    t: jax.Array  # () s
    lla: jax.Array  # (3,) rad, rad, m
    vel: jax.Array  # (3,) m/s, ENU
    rph: jax.Array  # (3,) rad
    lla_rate: jax.Array  # (3,) rad/s, rad/s, m/s
    vel_rate: jax.Array  # (3,) m/s^2, derivative of the ENU components
    rph_rate: jax.Array  # (3,) rad/s


class Travel(NamedTuple):
    """A trajectory of E epochs, each with k samples of an IMU of three quadrature points each."""

    points: Point  # (E + 1, 1 + 3 k, ...) start of an epoch and its quadrature points; of the last row the start only
    dt: float  # s, of a sample

    @property
    def ends(self) -> Point:
        """Start of the first and end of every epoch, (E + 1, ...)."""
        return jax.tree.map(lambda a: a[:, 0], self.points)


# Gauss-Legendre on [0, 1] with three points, and the integrals from 0 to each point (the 3-stage Gauss collocation)
_R = np.sqrt(15.0)
NODES = np.array([0.5 - _R / 10, 0.5, 0.5 + _R / 10])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18
_PARTIAL = np.array(
    [
        [5 / 36, 2 / 9 - _R / 15, 5 / 36 - _R / 30],
        [5 / 36 + _R / 24, 2 / 9, 5 / 36 - _R / 24],
        [5 / 36 + _R / 30, 2 / 9 + _R / 15, 5 / 36],
    ]
)


def _integrate(rate: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Integral from the start of a rate at the nodes (n, 3): at the nodes (n, 3) and at the edges (n + 1,)."""
    edges = jnp.concatenate([jnp.zeros(1), jnp.cumsum(dt * rate @ WEIGHTS)])
    return edges[:-1, None] + dt * rate @ _PARTIAL.T, edges


def _positions(vel: jax.Array, start: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Position from velocity at the nodes (n, 3, 3): at the nodes (n, 3, 3) and at the edges (n + 1, 3)."""
    h, h_edges = (start[2] + a for a in _integrate(vel[..., 2], dt))
    lat, lat_edges = start[0], start[0]
    # lat' = v_N / (R_M(lat) + h) by Picard's iteration: R_M hardly depends on lat, and each round gains a factor of
    # 1e-2 times the radians travelled. No recursion over time is needed.
    for _ in range(4):
        lat, lat_edges = (start[0] + a for a in _integrate(vel[..., 1] / (earth.radii(lat)[0] + h), dt))
    lon, lon_edges = _integrate(vel[..., 0] / ((earth.radii(lat)[1] + h) * jnp.cos(lat)), dt)
    return jnp.stack([lat, start[1] + lon, h], -1), jnp.stack([lat_edges, start[1] + lon_edges, h_edges], -1)


def _point(t: jax.Array, lla: jax.Array, motion: Motion, rate: Motion) -> Point:
    """Put together one instant; the position's rate follows from the velocity."""
    east, north, up = motion.vel
    lla_rate = jnp.stack([north, east, up]) / earth.metres_per_radian(lla)
    return Point(t, lla, motion.vel, motion.rph, lla_rate, rate.vel, rate.rph)


def travel(shape: Shape, start: jax.Array, dt: float, k: int, epochs: int) -> Travel:
    """Follow a shape from ``start`` (lat rad, lon rad, h m) at t = 0 through epochs of k samples of ``dt`` s.

    Exact to nanometres where the shape is smooth over a sample. Epoch after epoch: memory holds the result only.
    """
    offsets = dt * np.concatenate([[0.0], np.add.outer(np.arange(k), NODES).ravel()])
    t = dt * k * jnp.arange(epochs + 1, dtype=float)[:, None] + offsets
    motion, rate = lax.map(jax.vmap(lambda t: jax.jvp(shape, (t,), (jnp.ones_like(t),))), t)
    inner, edges = _positions(motion.vel[:-1, 1:].reshape(-1, 3, 3), start, dt)
    edges = edges[::k, None]
    beyond = jnp.broadcast_to(edges[-1:], (1, 3 * k, 3))  # nothing is sampled there
    lla = jnp.concatenate([edges, jnp.concatenate([inner.reshape(epochs, 3 * k, 3), beyond])], 1)
    return Travel(jax.vmap(jax.vmap(_point))(t, lla, motion, rate), dt)


# ---------------------------------------------------------------------------- smooth pieces of a drive

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
    heading: jax.Array, T: jax.Array, end_speed: jax.Array, dip: jax.Array, turn: jax.Array, bow: jax.Array
) -> Pieces:
    """Put pieces (K,) one after the other, from t = 0 at rest and with a heading (); others as in `Pieces`."""
    first = lambda a, start: jnp.concatenate([jnp.reshape(start, 1), a[:-1]])  # noqa: E731
    before = lambda a: first(jnp.cumsum(a), jnp.zeros(()))  # noqa: E731
    speed = first(end_speed, jnp.zeros(()))
    gain = end_speed - speed
    length = T * (speed + 0.5 * gain - dip * BUMP_MEAN)
    return Pieces(before(T), T, before(length), speed, gain, dip, heading + before(turn), turn, bow)


def profile(pieces: Pieces, t: jax.Array) -> Profile:
    """Distance, speed and heading at one time; after the last piece the vehicle goes on straight at constant speed."""
    i = jnp.maximum(jnp.sum(pieces.t <= t) - 1, 0)  # the last that has begun
    p = Pieces(*(a[i] for a in pieces))
    T = jnp.where(p.T > 0, p.T, 1.0)
    u = jnp.clip((t - p.t) / T, 0, 1)
    speed = p.speed + p.gain * step(u) - p.dip * bump(u)
    length = T * (p.speed * u + p.gain * step_area(u) - p.dip * bump_area(u))
    late = jnp.maximum(t - p.t - p.T, 0)
    heading = p.heading + p.turn * step(u) + p.bow * bump(u)
    return Profile(p.distance + length + late * speed, speed, heading)


# ---------------------------------------------------------------------------- random urban drive


class Waves(NamedTuple):
    """A road's feature as a sum of M sines of the distance travelled: nothing moves while the vehicle stands."""

    amplitude: jax.Array  # (M,)
    number: jax.Array  # (M,) rad/m
    phase: jax.Array  # (M,) rad

    def __call__(self, distance: jax.Array) -> jax.Array:
        """The feature at a distance in m."""
        return jnp.sum(self.amplitude * jnp.sin(self.number * distance + self.phase))


def waves(uniform: jax.Array, rms: float, shortest: float, longest: float) -> Waves:
    """M waves of the given root mean square and range of wavelengths (m) from random numbers (2, M) in [0, 1)."""
    length = shortest * (longest / shortest) ** uniform[0]
    amplitude = jnp.full(length.shape, rms * np.sqrt(2 / length.size), float)
    return Waves(amplitude, 2 * np.pi / length, 2 * np.pi * uniform[1])


DRAWS = 18  # random numbers of a leg
SHORTEST_LEG = 11.0  # s: what `_legs` cannot undercut
PITCH_GAIN = 0.25 * units.DEG  # rad per m/s^2, nose up when the car speeds up
ROLL_GAIN = 0.3 * units.DEG  # rad per m/s^2, the car leans out of a turn


def _legs(uniform: jax.Array, speed_max: float) -> tuple[jax.Array, ...]:
    """Pieces of n streets, each left by a crossing, from random numbers (`DRAWS`, n) in [0, 1).

    Gives duration, end speed, dip, turn and bow, (n, 7) each.

    Pieces of a street: pull away, cruise along a bending road, change lane, brake, wait, start again, turn.
    """
    rows = iter(uniform)
    draw = lambda low, high: low + (high - low) * next(rows)  # noqa: E731
    chance = lambda p: next(rows) < p  # noqa: E731
    sign = lambda: jnp.where(chance(0.5), 1.0, -1.0)  # noqa: E731
    zero = jnp.zeros_like(uniform[0])

    cruise = speed_max * draw(0.45, 1.0)
    lateral = draw(2.0, 3.0)  # m/s^2 in the turn
    angle = jnp.where(chance(0.75), draw(40.0, 110.0) * units.DEG, 0.0) * sign()  # or straight over the crossing
    # no tighter than 7 m of radius: the turn's rate stays below sqrt(lateral / radius)
    T_turn = jnp.maximum(draw(4.0, 8.0), PEAK * jnp.abs(angle) / jnp.sqrt(lateral / 7.0))
    rate = jnp.maximum(PEAK * jnp.abs(angle) / T_turn, 0.05)
    corner = jnp.minimum(lateral / rate, draw(0.5, 0.9) * cruise)
    stop = chance(0.45)
    enter = jnp.where(stop, 0.0, corner)

    pull, brake = draw(1.0, 1.8), draw(1.2, 2.5)  # m/s^2, at the peak
    before = jnp.concatenate([jnp.zeros(1), corner[:-1]])
    T_pull = jnp.maximum(PEAK * jnp.abs(cruise - before) / pull, 2.0)
    T_brake = jnp.maximum(PEAK * (cruise - enter) / brake, 1.5)
    T_start = jnp.where(stop, PEAK * corner / pull, 0.0)
    T_wait = jnp.where(stop, draw(2.0, 20.0), 0.0)
    T_cruise, T_lane = draw(4.0, 18.0), jnp.where(chance(0.5), draw(4.0, 6.0), 0.0)

    easy = 1.2 * T_cruise / cruise  # rad: what 1.2 m/s^2 across allows at a rate of one per piece
    bend = draw(-1.0, 1.0) * jnp.minimum(30 * units.DEG, easy / PEAK)
    swing = draw(-1.0, 1.0) * jnp.minimum(10 * units.DEG, easy / BUMP_PEAK)
    lane = sign() * 3.3 / (cruise * jnp.maximum(T_lane, 1.0) * BUMP_MEAN)  # rad, for 3.3 m to the side
    dip = draw(0.0, 1.0) * jnp.minimum(0.3 * cruise, 1.2 * T_cruise / BUMP_PEAK)
    pieces = (
        (T_pull, T_cruise, T_lane, T_brake, T_wait, T_start, T_turn),
        (cruise, cruise, cruise, enter, enter, corner, corner),
        (zero, dip, zero, zero, zero, zero, zero),
        (zero, bend, zero, zero, zero, zero, angle),
        (zero, swing, lane, zero, zero, zero, zero),
    )
    return tuple(jnp.stack(piece, 1) for piece in pieces)


def urban(key: jax.Array, duration: float, standstill: float = 0.0, speed_max: float = 20.0) -> Shape:
    """A random drive in town: streets and crossings, stops, turns of 40 to 110 deg, bends, lane changes, hills.

    Accelerates by at most 1.8 and brakes by at most 2.5 m/s^2, turns with about 3 m/s^2 across at most. Stands for the
    first ``standstill`` s. Pitch and roll follow the road and the springs.
    """
    # all random numbers by one call: each costs compile time
    M, n = 6, int(np.ceil(duration / SHORTEST_LEG))
    uniform = jax.random.uniform(key, (8 * M + 1 + DRAWS * n,), float)
    road, first, streets = uniform[: 8 * M].reshape(4, 2, M), uniform[8 * M], uniform[8 * M + 1 :].reshape(n, DRAWS)
    table = [jnp.pad(a.ravel(), (1, 0)) for a in _legs(streets.T, speed_max)]
    table[0] = table[0].at[0].set(standstill)
    pieces = join_pieces(2 * np.pi * first, *table)
    hills = waves(road[0], 1.0 * units.DEG, 150.0, 600.0)
    ripple = waves(road[1], 0.3 * units.DEG, 20.0, 80.0)
    camber = waves(road[2], 0.4 * units.DEG, 30.0, 200.0)
    wander = waves(road[3], 0.3 * units.DEG, 60.0, 200.0)  # of the heading: nobody drives a ruler's line

    def along_road(t: jax.Array) -> Profile:
        at = profile(pieces, t)
        return at._replace(heading=at.heading + wander(at.distance))

    def shape(t: jax.Array) -> Motion:
        (s, v, heading), rate = jax.jvp(along_road, (t,), (jnp.ones_like(t),))
        grade = hills(s)
        along, up = v * jnp.cos(grade), v * jnp.sin(grade)
        vel = jnp.stack([along * jnp.sin(heading), along * jnp.cos(heading), up])
        pitch = grade + ripple(s) + PITCH_GAIN * rate.speed
        roll = camber(s) - ROLL_GAIN * v * rate.heading
        return Motion(vel, jnp.stack([roll, pitch, heading]))

    return shape
