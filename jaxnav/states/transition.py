"""How the error state moves over an epoch: Phi, Q and d from 3x3 blocks of its dynamics; docs/theory.md derives it.

    p' = v,   v' = A(f) phi + B C M_a(f_b) s + u_a,   phi' = G C M_g(w_b) s + u_g,   s' = -s / tau + white noise

and the slow rest (Coriolis, transport, gravity); a state may be the rate of another one. f is specific force in the
axes of the frame, C takes the body to them, s are the optional states (`jaxnav.states.STATES`), M their effect on the
sensors' readings, u an observer's forcing. B and G stand before C in the frame's blocks: -1, but for the inertial
frame's axes.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import linalg
from jaxnav.maths.components import running
from jaxnav.states.motion import MOTION
from jaxnav.states.sensors import OTHER
from jaxnav.states.state import Reading, State
from jaxnav.types import ErrorInputs, Forcing, Noise, Params, StateParams

Blocks = dict[tuple[str, str], jax.Array]
"""3x3 blocks by (row, column); rows and columns are of `MOTION`, a column may also be "gyro" or "accel"."""

FAST = (("velocity", "attitude"), ("velocity", "accel"), ("attitude", "gyro"))
"""Blocks that follow specific force and attitude from sample to sample, and must be linear in ``force`` (the first) or
``C`` (the others); all other blocks change over minutes."""

GAUSS3, GAUSS2 = np.array([-1, 0, 1]) * np.sqrt(3 / 5), np.array([-1, 1]) / np.sqrt(3)
INTEGRALS = {"gyro": (3, 2, 1), "accel": (2, 1, 0), None: (0, 0, 0)}
"""Integrals in time from a state that enters a sensor to position, velocity and attitude."""


def assemble(blocks: Blocks) -> jax.Array:
    """Return a (9, 9) matrix from 3x3 blocks by (row, column) names of `MOTION`; zero elsewhere.

    Raises:
        ValueError: a block of another name.
    """
    unknown = {name for pair in blocks for name in pair} - set(MOTION)
    if unknown:
        raise ValueError(f"no states {sorted(unknown)}; known are {list(MOTION)}")
    zero = jnp.zeros((3, 3))
    return jnp.block([[blocks.get((row, column), zero) for column in MOTION] for row in MOTION])


class Maps(NamedTuple):
    """The fast blocks: A(f) = sum f_i force[i], and B and G, the factors before C."""

    force: jax.Array  # (3, 3, 3)
    accel: jax.Array  # (3, 3)
    gyro: jax.Array  # (3, 3)

    def A(self, f: jax.Array) -> jax.Array:
        """Return the block of velocity by attitude for specific forces (..., 3): (..., 3, 3)."""
        return jnp.tensordot(f, self.force, 1)


class EpochSums(NamedTuple):
    """The points of an epoch, piecewise constants, and their running sums."""

    C: jax.Array  # (b, 3, 3)
    force: jax.Array  # (b, 3) m/s^2
    T: jax.Array  # (b,) s
    end: jax.Array  # (b,) s, of each point since the epoch's start
    weights: jax.Array  # (b, 2), see `_weights`
    done: jax.Array  # (b, 2, 3) m, m/s: effect of the specific force so far on position and velocity at the end


def discretize(
    dynamics: Callable[[ErrorInputs], Blocks],
    params: Params,
    states: Sequence[State],
    points: ErrorInputs,
    T: jax.Array,
    u: Forcing | None,
    lumped: bool = False,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Phi (n, n), Q (n, n), d (n,) of a whole epoch: x -> Phi x + d, with noise of covariance Q.

    ``dynamics`` gives the blocks of F at one point, ``points`` are b of them (constant over ``T`` (b,) s each; 0 marks
    padding). The blocks of `FAST` and p' = v are nilpotent: their part N, and E that takes the optional states into
    motion, are summed over the points in closed form, without error. The slow rest S is taken at the epoch's mean
    point, half of it before and half after (Strang 1968): the error is of third order in the epoch's length. After a
    second it is below 3e-6 of a block's largest entry in a local level case, but for position by attitude: 4e-5. That
    is the reason why the covariance may move once an epoch instead of at every sample.

    White noise is integrated by Gauss' rule with three points, the states' driving noise with two. ``lumped``: it
    enters at the end of each point, Q = G T, as textbook filters have it.

    Navigation holds an estimate constant while a Gauss-Markov state decays, so that the error of an estimate b grows by
    b / tau: that is part of d.
    """
    total = T.sum()
    shares = _shares(T)
    point = jax.tree.map(lambda a: jnp.tensordot(shares, a, 1), points)
    maps, slow_blocks = _blocks(dynamics, point)
    slow = _exponential(assemble(slow_blocks) * (0.5 * total))
    end = running(T)
    weights = _weights(T, total - end)
    sums = EpochSums(points.C, points.force, T, end, weights, running(weights[:, :, None] * points.force[:, None]))
    N, d = _nilpotent(maps, sums, u)
    W = linalg.times(slow, _white(maps, sums, params.noise, lumped))
    Phi, d = linalg.times(linalg.times(slow, N), slow), slow @ d
    if not states:
        return Phi, linalg.square(W), d
    each = [params.states[s.name] for s in states]
    tau = jnp.concatenate([jnp.broadcast_to(p.tau, (s.size,)) for p, s in zip(each, states, strict=True)])
    lost = -jnp.expm1(-0.5 * total / tau)  # in half an epoch
    held = jnp.concatenate([point.nav.errors[s.name] for s in states])
    kept, decayed = 1 - lost, lost * held
    E = _entered(maps, sums, points, states)
    slow_E, kept_W = linalg.times(slow, E), jnp.zeros((kept.size, W.shape[1]))
    moved, driven = _driven(E, kept, each, states, total)
    among, stale, later = jnp.diag(kept * kept), (1 + kept) * decayed, [driven for _ in moved]
    if (rates := _rates(states)).any():
        growth = total * kept[:, None] * rates * kept
        among, stale = among + growth, stale - growth @ held
        later = [driven + total * (0.5 + 0.5 * at) * rates @ driven for at in GAUSS2]
    W = jnp.block([[W, *(linalg.times(slow, root) for root in moved)], [kept_W, *later]])
    Phi = jnp.block([[Phi, slow_E * kept], [jnp.zeros((kept.size, 9)), among]])
    return Phi, linalg.square(W), jnp.concatenate([d + slow_E @ decayed, stale])


def _rates(states: Sequence[State]) -> np.ndarray:
    """Return (k, k): 1 in the row of a state that grows by another one, in the column of that one."""
    stops = np.cumsum([s.size for s in states]).tolist()
    starts = {s.name: stop - s.size for s, stop in zip(states, stops, strict=True)}
    found = np.zeros((stops[-1], stops[-1]))
    for s in states:
        if s.rate_of in starts:
            i = np.arange(s.size)
            found[starts[s.rate_of] + i, starts[s.name] + i] = 1.0
    return found


def _blocks(dynamics: Callable[[ErrorInputs], Blocks], point: ErrorInputs) -> tuple[Maps, Blocks]:
    """Return the fast blocks as maps and the slow ones, at one point; none but A depends on specific force."""
    eye = jnp.eye(3)

    def at(force: jax.Array) -> tuple[jax.Array, Blocks]:
        blocks = dynamics(point._replace(C=eye, force=force))
        return blocks.pop(("velocity", "attitude")), blocks

    pushes, bare = jax.vmap(at, out_axes=(0, None))(eye)
    slow = {k: v for k, v in bare.items() if k not in FAST and k != ("position", "velocity")}
    return Maps(pushes, bare["velocity", "accel"], bare["attitude", "gyro"]), slow


def _exponential(S: jax.Array) -> jax.Array:
    """exp(S) to second order, (9, 9)."""
    return jnp.eye(9) + S + linalg.times(0.5 * S, S)


def _shares(T: jax.Array) -> jax.Array:
    """Return T / sum T along the last axis, alike where all are zero."""
    total = T.sum(-1, keepdims=True)
    return jnp.where(total > 0, T / jnp.where(total > 0, total, 1.0), 1.0 / T.shape[-1])


def _weights(T: jax.Array, left: jax.Array) -> jax.Array:
    """Return the effect (b, 2) of an acceleration over T (b,) s on position and velocity ``left`` (b,) s after that."""
    return jnp.stack([T * (left + 0.5 * T), T], -1)


def _nilpotent(maps: Maps, sums: EpochSums, u: Forcing | None) -> tuple[jax.Array, jax.Array]:
    """Return N (9, 9) and d (9,) of p' = v, v' = A(f) phi + u, phi' = u, exactly for piecewise constants."""
    _, f, T, end, weights, done = sums
    total = end[-1]
    A_w, A_T = maps.A(done[-1])
    d = jnp.zeros(9)
    if u:
        # u.omega turns phi by u.omega t: the integrals of A(f) t; within a point the mean of t s is 1/12 T^2 off
        at = (weights.T * (end - 0.5 * T)).at[0].add(-(T**3) / 12)
        u_w, u_T = maps.A(at @ f) @ u.omega
        d = jnp.concatenate([u_w + 0.5 * total**2 * u.accel, u_T + total * u.accel, total * u.omega])
    eye, zero = jnp.eye(3), jnp.zeros((3, 3))
    return jnp.block([[eye, total * eye, A_w], [zero, eye, A_T], [zero, zero, eye]]), d


def _entered(maps: Maps, sums: EpochSums, points: ErrorInputs, states: Sequence[State]) -> jax.Array:
    """Return E (9, k): effect of constant optional states on motion over the epoch, by their columns C M."""
    parts: dict[str, jax.Array] = {s.name: jnp.zeros((9, s.size)) for s in states}
    readings = {"gyro": points.gyro, "accel": points.accel}
    for sensor, integrals in (("gyro", _turns), ("accel", _pushes)):
        entering = [s for s in states if s.enters == sensor]
        reading = Reading(readings[sensor], readings[OTHER[sensor]], points.nav.auxiliary)
        if entering:
            CM = jnp.concatenate([sums.C if s.effect is None else sums.C @ s.effect(reading) for s in entering], -1)
            columns = jnp.split(integrals(maps, sums, CM), np.cumsum([s.size for s in entering])[:-1], 1)
            parts |= dict(zip((s.name for s in entering), columns, strict=True))
    return jnp.concatenate([parts[s.name] for s in states], 1)


def _turns(maps: Maps, sums: EpochSums, CM: jax.Array) -> jax.Array:
    """Return (9, k): effect of a rate CM (b, 3, k), in the axes of the frame, on position, velocity and attitude."""
    _, f, T, _, weights, _ = sums
    b, _, k = CM.shape
    flat = CM.reshape(b, -1)
    turned = running(T[:, None] * flat)
    middle = turned - 0.5 * T[:, None] * flat
    # A(f) times the turn so far; within a point the mean of t s is 1/12 T^2 off
    by = jnp.concatenate([weights.T[:, :, None] * f, (-(T**3) / 12)[None, :, None] * f])  # (3, b, 3)
    to_position, to_velocity = jnp.einsum("sba,bc->sac", by[:2], middle)
    to_position = to_position + by[2].T @ flat
    AG = lambda M: jnp.einsum("aij,jk,akl->il", maps.force, maps.gyro, M.reshape(3, 3, k))
    return jnp.concatenate([AG(to_position), AG(to_velocity), maps.gyro @ turned[-1].reshape(3, k)])


def _pushes(maps: Maps, sums: EpochSums, CM: jax.Array) -> jax.Array:
    """Return (9, k): effect of an acceleration CM (b, 3, k), axes of the frame, on position, velocity, attitude."""
    b, _, k = CM.shape
    to_position, to_velocity = maps.accel @ (sums.weights.T @ CM.reshape(b, -1)).reshape(2, 3, k)
    return jnp.concatenate([to_position, to_velocity, jnp.zeros((3, k))])


def _white(maps: Maps, sums: EpochSums, noise: Noise, lumped: bool) -> jax.Array:
    """Return (9, 6 moments): effect of the sensors' white noise at some moments at the epoch's end."""
    C, f, T, end, _, done = sums
    total = end[-1]
    if lumped:
        moments, lengths, C_then, to_come = end, T, C, done[-1] - done
    else:  # Gauss' points, which integrate polynomials up to the fifth order
        moments, lengths = total * (0.5 + 0.5 * GAUSS3), total * np.array([5, 8, 5]) / 18
        # the first point that ends after a moment; the last one where rounding or an empty epoch leaves none
        i = jnp.minimum((end <= moments[:, None]).sum(1), end.size - 1)
        rest = jnp.maximum(end[i] - moments, 0.0)  # how much of that point comes after the moment
        part = _weights(rest, total - end[i])[:, :, None] * f[i][:, None]
        C_then, to_come = C[i], done[-1] - done[i] + part
    pi, alpha = maps.A(to_come[:, 0]), maps.A(to_come[:, 1])
    column = lambda a: a[:, None, None]
    root = column(_root(lengths))
    g = linalg.times_root(maps.gyro @ C_then, noise.gyro) * root
    a = linalg.times_root(maps.accel @ C_then, noise.accel) * root
    rows = [[pi @ g, column(total - moments) * a], [alpha @ g, a], [g, jnp.zeros_like(a)]]
    return jnp.moveaxis(jnp.block(rows), 0, 1).reshape(9, -1)


def _driven(
    E: jax.Array, kept: jax.Array, each: Sequence[StateParams], states: Sequence[State], total: jax.Array
) -> tuple[list[jax.Array], jax.Array]:
    """Return the effect of the states' unit driving noise at Gauss' points: on motion, (9, k) each, on them, (k, k).

    Noise with the share s of the epoch to come has s, s^2 or s^3 of the effect of a constant state, by how many
    integrals are between: exact while C and f are constant. The variance from two points is 35/36 of the
    exact one through two integrals and 91/108 through three.
    """
    starts = np.cumsum([0, *(s.size for s in states)])
    part = lambda M, i: M[:, starts[i] : starts[i + 1]]
    root = _root(0.5 * total)
    roots = [p.driving_noise for p in each]
    by_drive = lambda M: jnp.concatenate([linalg.times_root(part(M, i), L) for i, L in enumerate(roots)], 1)
    E_L = by_drive(E) * root
    power = np.concatenate([np.tile(np.repeat(INTEGRALS[s.enters], 3)[:, None], s.size) for s in states], 1)
    return [E_L * share**power for share in 0.5 + 0.5 * GAUSS2], by_drive(jnp.diag(kept)) * root


def _root(length: jax.Array) -> jax.Array:
    """Square root of a time that may be zero."""
    some = length > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, length, 1.0)), 0.0)
