"""A random drive in town."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import units
from jaxnav.simulate.kinds import hashed_by_type
from jaxnav.simulate.trajectories.motion import Motion, Shape
from jaxnav.simulate.trajectories.pieces import BUMP_MEAN, BUMP_PEAK, PEAK, Profile, join_pieces, profile


@hashed_by_type
class Urban(NamedTuple):
    """A random drive in town: streets and crossings, stops, turns of 40 to 110 deg, bends, lane changes, hills."""

    standstill_s: float = 20.0  # at the start
    speed_max_mps: float = 20.0
    traffic: float = 0.0  # share of the streets that end in a queue, which moves in `CREEPS` short spurts


class Waves(NamedTuple):
    """A road's feature as a sum of M sines of the distance travelled: nothing moves while the vehicle stands."""

    amplitude: jax.Array  # (M,)
    number: jax.Array  # (M,) rad/m
    phase: jax.Array  # (M,) rad

    def __call__(self, distance: jax.Array) -> jax.Array:
        """Return the feature at a distance in m."""
        return jnp.sum(self.amplitude * jnp.sin(self.number * distance + self.phase))


def waves(uniform: jax.Array, rms: float, shortest: float, longest: float) -> Waves:
    """M waves of the given root mean square and range of wavelengths (m) from random numbers (2, M) in [0, 1)."""
    length = shortest * (longest / shortest) ** uniform[0]
    amplitude = jnp.full(length.shape, rms * np.sqrt(2 / length.size), float)
    return Waves(amplitude, 2 * np.pi / length, 2 * np.pi * uniform[1])


DRAWS = 18  # random numbers of a leg
CREEPS = 3  # spurts of a queue
SHORTEST_LEG = 11.0  # s: lower limit of `_legs`
PITCH_GAIN = 0.25 * units.DEG  # rad per m/s^2, nose up when the car speeds up
ROLL_GAIN = 0.3 * units.DEG  # rad per m/s^2, the car leans out of a turn


def _legs(uniform: jax.Array, speed_max: float, queue: jax.Array) -> tuple[jax.Array, ...]:
    """Pieces of n streets, each left by a crossing, from random numbers (`DRAWS`, n) in [0, 1).

    ``queue`` (n,) bool: the street ends in one. Gives duration, end speed, dip, turn and bow, (n, 7) each.

    Pieces of a street: pull away, cruise along a bending road, change lane, brake, wait, start again, turn.
    """
    rows = iter(uniform)
    draw = lambda low, high: low + (high - low) * next(rows)
    chance = lambda p: next(rows) < p
    sign = lambda: jnp.where(chance(0.5), 1.0, -1.0)
    zero = jnp.zeros_like(uniform[0])

    cruise = speed_max * draw(0.45, 1.0)
    lateral = draw(2.0, 3.0)  # m/s^2 in the turn
    angle = jnp.where(chance(0.75), draw(40.0, 110.0) * units.DEG, 0.0) * sign()  # or straight over the crossing
    # no tighter than 7 m of radius: the turn's rate stays below sqrt(lateral / radius)
    T_turn = jnp.maximum(draw(4.0, 8.0), PEAK * jnp.abs(angle) / jnp.sqrt(lateral / 7.0))
    rate = jnp.maximum(PEAK * jnp.abs(angle) / T_turn, 0.05)
    corner = jnp.minimum(lateral / rate, draw(0.5, 0.9) * cruise)
    stop = chance(0.45) | queue
    enter = jnp.where(stop, 0.0, corner)

    pull, brake = draw(1.0, 1.8), draw(1.2, 2.5)  # m/s^2, at the peak
    before = jnp.concatenate([jnp.zeros(1), corner[:-1]])
    T_pull = jnp.maximum(PEAK * jnp.abs(cruise - before) / pull, 2.0)
    T_brake = jnp.maximum(PEAK * (cruise - enter) / brake, 1.5)
    T_start = jnp.where(stop, PEAK * corner / pull, 0.0)
    T_wait = jnp.where(stop, draw(2.0, 20.0), 0.0)
    T_cruise, T_lane = draw(4.0, 18.0), jnp.where(chance(0.5), draw(4.0, 6.0), 0.0)

    easy = 1.2 * T_cruise / cruise  # rad: limit of 1.2 m/s^2 across at a rate of one per piece
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


def _creeps(uniform: jax.Array, queue: jax.Array) -> tuple[jax.Array, ...]:
    """Pieces of n queues from random numbers (`3 CREEPS`, n) in [0, 1), (n, 2 CREEPS) each: wait, move up, wait ..."""
    wait, lasts, speed = uniform.reshape(CREEPS, 3, -1).swapaxes(0, 1)
    T_wait, T_move = 2 + 8 * wait, 3 + 5 * lasts
    hump = jnp.minimum(1 + 3 * speed, 1.2 * T_move / BUMP_PEAK)  # m/s, for 1.2 m/s^2 at most
    zero = jnp.zeros_like(hump)
    weave = lambda a, b: jnp.where(queue, jnp.stack([a, b], 1).reshape(2 * CREEPS, -1), 0.0).T
    return weave(T_wait, T_move), weave(zero, zero), weave(zero, -hump), weave(zero, zero), weave(zero, zero)


BRAKED = 4  # pieces of a street up to where a queue stands


def _streets(key: jax.Array, uniform: jax.Array, speed_max: float, traffic: float) -> list[jax.Array]:
    """Return the pieces of all streets, from random numbers (`DRAWS`, n); traffic has a separate one."""
    n = uniform.shape[1]
    if traffic == 0:
        return [a.ravel() for a in _legs(uniform, speed_max, jnp.zeros(n, bool))]
    more = jax.random.uniform(jax.random.fold_in(key, 1), (1 + 3 * CREEPS, n), float)
    queue = more[0] < traffic
    both = zip(_legs(uniform, speed_max, queue), _creeps(more[1:], queue), strict=True)
    return [jnp.concatenate([a[:, :BRAKED], b, a[:, BRAKED:]], 1).ravel() for a, b in both]


def urban(
    key: jax.Array, duration: float, standstill: float = 0.0, speed_max: float = 20.0, traffic: float = 0.0
) -> Shape:
    """`Urban` as a shape, of ``duration`` s.

    Accelerates by at most 1.8 and brakes by at most 2.5 m/s^2, turns with about 3 m/s^2 across at most. Stands for the
    first ``standstill`` s. Pitch and roll follow the road and the springs.
    """
    # all random numbers by one call: each costs compile time
    M, n = 6, int(np.ceil(duration / SHORTEST_LEG))
    uniform = jax.random.uniform(key, (8 * M + 1 + DRAWS * n,), float)
    road, first, streets = uniform[: 8 * M].reshape(4, 2, M), uniform[8 * M], uniform[8 * M + 1 :].reshape(n, DRAWS)
    table = [jnp.pad(a, (1, 0)) for a in _streets(key, streets.T, speed_max, traffic)]
    table[0] = table[0].at[0].set(standstill)
    pieces = join_pieces(2 * np.pi * first, *table)
    hills = waves(road[0], 1.0 * units.DEG, 150.0, 600.0)
    ripple = waves(road[1], 0.3 * units.DEG, 20.0, 80.0)
    camber = waves(road[2], 0.4 * units.DEG, 30.0, 200.0)
    weave = waves(road[3], 0.3 * units.DEG, 60.0, 200.0)  # of the heading: no driver keeps a straight line

    def along_road(t: jax.Array) -> Profile:
        at = profile(pieces, t)
        return at._replace(heading=at.heading + weave(at.distance))

    def shape(t: jax.Array) -> Motion:
        (s, v, heading), rate = jax.jvp(along_road, (t,), (jnp.ones_like(t),))
        grade = hills(s)
        along, up = v * jnp.cos(grade), v * jnp.sin(grade)
        vel = jnp.stack([along * jnp.sin(heading), along * jnp.cos(heading), up])
        pitch = grade + ripple(s) + PITCH_GAIN * rate.speed
        roll = camber(s) - ROLL_GAIN * v * rate.heading
        return Motion(vel, jnp.stack([roll, pitch, heading]))

    return shape
