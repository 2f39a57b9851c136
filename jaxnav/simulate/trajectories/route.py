"""A route through points on a local map, with a speed at each."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.simulate.kinds import hashed_by_type
from jaxnav.simulate.trajectories.motion import Motion, Shape
from jaxnav.simulate.trajectories.pieces import join_pieces, profile
from jaxnav.simulate.trajectories.splines import from_scipy


@hashed_by_type
class Waypoints(NamedTuple):
    """A smooth path through points, nose along the track; goes straight on after the last unless it stops there."""

    points_m: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0), (0.0, 200.0, 0.0), (200.0, 300.0, 0.0))  # ENU
    speeds_mps: tuple[float, ...] = (0.0, 10.0, 0.0)  # at the points; 0 is a stop
    waits_s: tuple[float, ...] = ()  # at the points, where it stops; empty: none


def _check(motion: Waypoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    points, speeds = np.array(motion.points_m, float), np.array(motion.speeds_mps, float)
    waits = np.array(motion.waits_s or np.zeros(len(points)), float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3:
        raise ValueError(f"motion.points_m must be three points (E, N, U) or more, got shape {points.shape}")
    if speeds.shape != (len(points),) or waits.shape != (len(points),):
        raise ValueError(f"motion.speeds_mps and waits_s must have {len(points)} values, one a point")
    if (speeds < 0).any() or ((speeds[1:] + speeds[:-1]) == 0).any():
        raise ValueError("motion.speeds_mps must not be negative, nor zero at two points in a row")
    if (waits < 0).any() or (waits[speeds > 0] > 0).any():
        raise ValueError("motion.waits_s must not be negative, and zero where the vehicle does not stop")
    if (np.linalg.norm(np.diff(points, axis=0), axis=1) == 0).any():
        raise ValueError("motion.points_m: two points in a row are the same")
    return points, speeds, waits


def waypoints(motion: Waypoints) -> Shape:
    """`Waypoints` as a shape.

    The path is a quintic spline in ENU metres about the start, its direction C3 in the distance travelled; the speed
    goes from point to point by `pieces.step`. Lengths are the ellipsoid's, so that a long route keeps its shape only
    as a map does.

    Raises:
        ValueError: points, speeds or waits that do not fit together.
    """
    points, speeds, waits = _check(motion)
    from scipy.interpolate import make_interp_spline

    chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    free = [(3, np.zeros(3)), (4, np.zeros(3))]  # third and fourth derivative at an end: natural, least jerk
    path = make_interp_spline(chords, points, k=5, bc_type=(free, free))
    # chord parameter as a function of the distance along the path
    fine = np.unique(np.concatenate([np.linspace(a, b, 65) for a, b in zip(chords[:-1], chords[1:], strict=True)]))
    rate = lambda u: np.linalg.norm(path.derivative()(u), axis=-1)
    nodes, weights = np.polynomial.legendre.leggauss(5)
    half = np.diff(fine) / 2
    length = np.concatenate([[0.0], np.cumsum(half * (rate(fine[:-1, None] + half[:, None] * (1 + nodes)) @ weights))])
    parameter = from_scipy(make_interp_spline(length, fine, k=5))
    direction = from_scipy(path.derivative())

    legs = np.diff(np.interp(chords, fine, length))
    # a wait at each point, then the leg from it
    T = np.stack([waits[:-1], 2 * legs / (speeds[1:] + speeds[:-1])], 1).ravel()
    end = np.concatenate([[speeds[0]], np.repeat(speeds[1:], 2)])[: T.size]
    zero = jnp.zeros(T.size)
    table = join_pieces(jnp.zeros(()), jnp.asarray(T), jnp.asarray(end), zero, zero, zero, start_speed=speeds[0])

    def shape(t: jax.Array) -> Motion:
        at = profile(table, t)
        d = direction(parameter(at.distance)[0])
        d = d / jnp.sqrt(d @ d)
        pitch = jnp.arctan2(d[2], jnp.hypot(d[0], d[1]))
        return Motion(at.speed * d, jnp.stack([jnp.zeros_like(pitch), pitch, jnp.arctan2(d[0], d[1])]))

    return shape
