"""A spline through a recorded track: a real vehicle's motion under a simulated IMU, which is semi-synthetic."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.simulate.trajectories.motion import Motion, Shape
from jaxnav.simulate.trajectories.splines import from_scipy
from jaxnav.types import DataError

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

SLOW = 1.0  # m/s: below, the direction of the velocity is noise, and the heading is bridged


LAM = 0.05  # s^3, of the attitude's smoothing: bends shorter than about 2 s are rounded


class Recorded(NamedTuple):
    """A shape, and the start of a scenario along it with `jaxnav.simulate.simulation.simulate_shape`."""

    shape: Shape
    start_deg_m: tuple[float, float, float]  # latitude, longitude, height at its t = 0
    duration_s: float


def _along(t: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Roll, pitch and heading (N, 3) along a velocity N, E, U (N, 3), bridged where it is slow."""
    horizontal = np.hypot(speed[:, 0], speed[:, 1])
    fast = horizontal > SLOW
    if not fast.any():
        raise DataError(f"track: never faster than {SLOW:g} m/s, so that it shows no heading: give rph")
    heading = np.unwrap(np.arctan2(speed[fast, 1], speed[fast, 0]))
    pitch = np.arctan2(speed[fast, 2], horizontal[fast])
    return np.stack([np.zeros(t.size), np.interp(t, t[fast], pitch), np.interp(t, t[fast], heading)], 1)


def _smooth(t: np.ndarray, rph: np.ndarray) -> "BSpline":
    """Return a C2 smoothing spline through angles (N, 3)."""
    from scipy.interpolate import BSpline, make_smoothing_spline

    fits = [make_smoothing_spline(t, each, lam=LAM) for each in rph.T]
    return BSpline(fits[0].t, np.stack([fit.c for fit in fits], 1), 3)


def recorded(t: np.ndarray, lla: np.ndarray, sd_m: ArrayLike = 0.02, rph: np.ndarray | None = None) -> Recorded:
    """Return a semi-synthetic motion: a quintic smoothing spline (C4) through positions, its velocity and its attitude.

    ``t`` (N,) s, increasing, its first is the shape's 0; ``lla`` (N, 3) lat rad, lon rad, h m; ``sd_m`` the
    track's noise, () or (N,) or (N, 3) ENU m: the spline leaves the points by about that much. ``rph`` (N, 3) rad,
    or None: the nose then is along the track, the heading bridged where the vehicle is slower than 1 m/s, and the roll
    is zero; attitude is a C2 spline.

    Raises:
        DataError: fewer than 10 rows, times that do not increase, values that are not finite, or never faster than
            1 m/s without ``rph``.
    """
    t, lla = np.asarray(t, float), np.asarray(lla, float)
    if t.ndim != 1 or t.size < 10 or lla.shape != (t.size, 3):
        raise DataError(f"track: needs 10 rows or more of t (N,) and lla (N, 3), got {t.shape} and {lla.shape}")
    if not (np.isfinite(t).all() and np.isfinite(lla).all()) or (np.diff(t) <= 0).any():
        raise DataError("track: t must increase, and t and lla must be finite")
    t = t - t[0]
    lla = np.concatenate([lla[:, :1], np.unwrap(lla[:, 1:2], axis=0), lla[:, 2:]], 1)
    scale = np.asarray(earth.metres_per_radian(jnp.asarray(lla[0])))
    sd = np.maximum(np.broadcast_to(np.reshape(sd_m, (-1, 1)) if np.ndim(sd_m) == 1 else sd_m, lla.shape), 1e-6)
    metres = (lla - lla[0]) * scale  # N, E, U
    from scipy.interpolate import BSpline, splrep

    fits = [BSpline(*splrep(t, metres[:, i], w=1 / sd[:, j], k=5, s=t.size)) for i, j in enumerate((1, 0, 2))]
    speed = np.stack([fit.derivative()(t) for fit in fits], 1)
    attitude = from_scipy(_smooth(t, _along(t, speed) if rph is None else np.unwrap(np.asarray(rph, float), axis=0)))
    offsets = [from_scipy(fit) for fit in fits]
    start = lla[0] + np.array([float(fit(0.0)) for fit in fits]) / scale

    def place(t: jax.Array) -> jax.Array:
        return jnp.asarray(lla[0]) + jnp.concatenate([each(t) for each in offsets]) / scale

    def shape(t: jax.Array) -> Motion:
        here, rate = jax.jvp(place, (t,), (jnp.ones_like(t),))
        north, east, up = rate * earth.metres_per_radian(here)
        return Motion(jnp.stack([east, north, up]), attitude(t))

    lat, lon, h = start.tolist()
    return Recorded(shape, (lat / DEG, lon / DEG, h), float(t[-1]))
