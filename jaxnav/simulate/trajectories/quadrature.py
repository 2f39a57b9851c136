"""The position along a shape, and means over samples, by Gauss-Legendre quadrature to the precision of float64.

Nothing here knows a mechanization; the earth enters by its radii only.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.maths import earth
from jaxnav.simulate.trajectories.motion import Motion, Shape
from jaxnav.types import Array


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
    """A trajectory of E epochs of k samples, and a sensor's readings on it."""

    start: tuple[Point, Any]  # at t = 0, and the reading there
    ends: tuple[Point, Any]  # (E, ...) at the end of every epoch
    late: tuple[Point, Any]  # (E, ...) ``lag`` s before these
    means: Array  # (E, k, ...) means of the reading over every sample


# Gauss-Legendre on [0, 1] with three points: the 3-stage Gauss collocation
NODES = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18
_POWERS = np.linalg.inv(np.vander(NODES, 3, increasing=True)).T  # (3 nodes, 3) coefficients of Lagrange's polynomials


def partial_weights(u: float | np.ndarray) -> np.ndarray:
    """Weights (..., 3) that integrate values at the nodes from 0 to ``u``; `WEIGHTS` at u = 1."""
    n = np.arange(1, 4)
    return np.power.outer(u, n) / n @ _POWERS.T


_PARTIAL = partial_weights(NODES)


def _integrate(rate: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Integral from the start of a rate at the nodes (n, 3): at the nodes (n, 3) and at the edges (n + 1,)."""
    edges = jnp.concatenate([jnp.zeros(1), jnp.cumsum(dt * rate @ WEIGHTS)])
    return edges[:-1, None] + dt * rate @ _PARTIAL.T, edges


def _positions(vel: jax.Array, start: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Position from velocity at the nodes (n, 3, 3): at the nodes (n, 3, 3) and at the edges (n + 1, 3)."""
    h, h_edges = (start[2] + a for a in _integrate(vel[..., 2], dt))
    lat, lat_edges = start[0], start[0]
    # lat' = v_N / (R_M(lat) + h) by Picard's iteration: R_M hardly depends on lat, and each round gains a factor of
    # 1e-2 times the radians travelled
    for _ in range(4):
        lat, lat_edges = (start[0] + a for a in _integrate(vel[..., 1] / (earth.radii(lat)[0] + h), dt))
    lon, lon_edges = _integrate(vel[..., 0] / ((earth.radii(lat)[1] + h) * jnp.cos(lat)), dt)
    return jnp.stack([lat, start[1] + lon, h], -1), jnp.stack([lat_edges, start[1] + lon_edges, h_edges], -1)


def _lla_rate(lla: jax.Array, vel: jax.Array) -> jax.Array:
    return vel[jnp.array([1, 0, 2])] / earth.metres_per_radian(lla)


def travel(
    shape: Shape, start: jax.Array, dt: float, k: int, epochs: int, feel: Callable[[Point], Any], lag: float = 0.0
) -> Travel:
    """Follow a shape from ``start`` (lat rad, lon rad, h m) at t = 0 through epochs of k samples of ``dt`` s.

    ``feel`` returns a sensor's reading at a point, ``lag`` (s, less than an epoch) how long before the end of an epoch
    it is looked at once more. Exact to nanometres where the shape is smooth over a sample. Epoch after epoch: memory
    holds the result only.

    Raises:
        ValueError: a lag that is no part of an epoch.
    """
    if not 0 <= lag < k * dt:
        raise ValueError(f"lag must be at least 0 and less than an epoch of {k * dt:g} s, got {lag:g}")
    back = k - lag / dt  # samples from an epoch's start
    j = min(int(back), k - 1)
    late = partial_weights(back - j)
    inner = np.add.outer(np.arange(k), NODES).ravel() * dt
    offsets = np.concatenate([inner, [0.0, k * dt, k * dt - lag]])

    def epoch(lla: jax.Array, e: Any) -> Any:
        t = dt * k * e + offsets
        motion, rate = jax.vmap(lambda t: jax.jvp(shape, (t,), (jnp.ones_like(t),)))(t)
        inside, edges = _positions(motion.vel[:-3].reshape(k, 3, 3), lla, dt)
        speeds = jax.vmap(_lla_rate)(inside[j], motion.vel[3 * j : 3 * j + 3])
        where = jnp.concatenate([inside.reshape(-1, 3), lla[None], edges[-1:], (edges[j] + dt * late @ speeds)[None]])
        points = jax.vmap(_point)(t, where, motion, rate)
        felt = jax.vmap(feel)(points)
        means = jax.tree.map(lambda a: jnp.einsum("g,ng...->n...", WEIGHTS, a[:-3].reshape(k, 3, *a.shape[1:])), felt)
        return edges[-1], (*(jax.tree.map(lambda a, i=i: a[i], (points, felt)) for i in (-3, -2, -1)), means)

    _, (starts, ends, lates, means) = lax.scan(epoch, start, jnp.arange(epochs, dtype=float))
    return Travel(jax.tree.map(lambda a: a[0], starts), ends, lates, means)


def _point(t: jax.Array, lla: jax.Array, motion: Motion, rate: Motion) -> Point:
    """Put together one instant; the position's rate follows from the velocity."""
    return Point(t, lla, motion.vel, motion.rph, _lla_rate(lla, motion.vel), rate.vel, rate.rph)
