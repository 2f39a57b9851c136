"""Errors of a solution and consistency of a filter, per epoch; reduce over time and runs as you need."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtri  # the inverse chi-square law without the second that scipy.stats takes to load

from jaxnav.maths import earth, linalg, rotations
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import TICK
from jaxnav.types import Info, Nav, Track

HOLE = 2.5  # intervals of a truth, from which on it is one


class Errors(NamedTuple):
    """Estimate minus truth, on the host; NED and degrees only on the border."""

    position: np.ndarray  # (..., 3) m, ENU
    velocity: np.ndarray  # (..., 3) m/s, ENU
    attitude: np.ndarray  # (..., 3) rad, roll, pitch, heading, each in (-pi, pi]; nan where the truth has none


def covered_by(t: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return at which times (E,) a truth known at ``times`` (N,) has a value, bool (E,): within it and not in a gap.

    A hole is longer than `HOLE` of its intervals, for a line across it would be scored as an error of the solution.
    """
    after = np.clip(np.searchsorted(times, t - TICK), 1, max(times.size - 1, 1))
    steps = np.diff(times)
    if not steps.size:
        return np.abs(t - times[0]) <= TICK
    on = np.abs(t - times[np.clip(np.searchsorted(times, t - TICK), 0, times.size - 1)]) <= TICK
    whole = steps[after - 1] <= HOLE * np.median(steps)
    return (t >= times[0] - TICK) & (t <= times[-1] + TICK) & (whole | on)


def errors(solution: Track, truth: Track) -> Errors:
    """Errors of a solution at its times against a truth that is interpolated linearly to them (host arrays)."""
    unwrapped = np.where(np.isfinite(truth.rph), np.unwrap(np.nan_to_num(truth.rph), axis=0), np.nan)
    at = lambda a: columns_at(solution.t, truth.t, a)
    position = earth.enu_path(solution.lla, at(earth.continuous(truth.lla)))
    turn = solution.rph - at(unwrapped)
    return Errors(position, solution.vel - at(truth.vel), np.remainder(turn + np.pi, 2 * np.pi) - np.pi)


def attitude_errors(solution: Track, truth: Track) -> np.ndarray:
    """Return the rotation from the true attitude to a solution's, (E, 3) rad; nan where the truth has none.

    Its components are about the horizontal axis forward, the horizontal axis to the right, and down: to first order
    these are errors of roll, pitch and heading while the vehicle is level, and still defined where it points up.
    """
    from scipy.spatial.transform import Rotation  # here, for it takes a while to load

    after = np.clip(np.searchsorted(truth.t, solution.t), 1, max(truth.t.size - 1, 1))
    before = after - 1
    after = np.minimum(after, truth.t.size - 1)
    known = np.isfinite(truth.rph[before]).all(1) & np.isfinite(truth.rph[after]).all(1)
    known &= np.isfinite(solution.rph).all(1)
    out = np.full(solution.rph.shape, np.nan)
    if not known.any():
        return out
    before, after = before[known], after[known]
    turn = lambda rph: Rotation.from_euler("ZYX", rph[:, ::-1])
    first, step = turn(truth.rph[before]), truth.t[after] - truth.t[before]
    share = np.where(step > 0, (solution.t[known] - truth.t[before]) / np.where(step > 0, step, 1.0), 0.0)
    true = first * Rotation.from_rotvec(
        np.clip(share, 0.0, 1.0)[:, None] * (first.inv() * turn(truth.rph[after])).as_rotvec()
    )
    north, east, down = (turn(solution.rph[known]) * true.inv()).as_rotvec().T
    heading = solution.rph[known, 2]
    s, c = np.sin(heading), np.cos(heading)
    out[known] = np.stack([c * north + s * east, -s * north + c * east, down], axis=1)
    return out


def position_error(nav: Nav, lla: jax.Array) -> jax.Array:
    """ENU error in m of local level navigation against a true position, (3,); differentiable."""
    return earth.enu_difference(nav.pos, lla)


def state_error(nav: Nav, truth: Nav, states: Iterable[str] = ()) -> jax.Array:
    """X = estimate - truth, (9 + size of the states,), of local level navigation: ENU, and the states in their order.

    Motion as the error model defines it, C_est = exp([phi x]) C_true.
    """
    phi = rotations.log(rotations.multiply(nav.q, rotations.conjugate(truth.q)))
    optional = [nav.errors[name] - truth.errors[name] for name in states]
    return jnp.concatenate([position_error(nav, truth.pos), nav.vel - truth.vel, phi, *optional])


def normalized_innovations(info: Info) -> np.ndarray:
    """Innovations over the roots of diag S, (E, m), nan on unused channels; of unit variance if all is consistent."""
    sd = np.sqrt(np.asarray(jnp.diagonal(info.S, axis1=-2, axis2=-1)))
    return np.where(np.asarray(info.used), np.asarray(info.nu) / sd, np.nan)


def nees(x: jax.Array, P: jax.Array) -> jax.Array:
    """Normalised error squared, x' P^-1 x, of one error (n,): chi-square of n degrees if the filter is consistent."""
    return linalg.normalized(x, P)


def chi2_bounds(dof: float, runs: int = 1, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds for the mean of ``runs`` independent chi-square values of ``dof`` degrees of freedom."""
    tail = (1 - probability) / 2
    return chdtri(dof * runs, 1 - tail) / runs, chdtri(dof * runs, tail) / runs


def rms(a: np.ndarray, axis: int | None = 0) -> np.ndarray:
    """Root mean square over an axis, nan left out."""
    return np.sqrt(np.nanmean(np.asarray(a) ** 2, axis=axis))
