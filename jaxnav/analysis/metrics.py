"""Errors of a solution and consistency of a filter, per epoch; reduce over time and runs as you need."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtri  # the inverse chi-square law without the second that scipy.stats takes to load

from jaxnav.data.epochs import TICK
from jaxnav.maths import earth, linalg, rotations
from jaxnav.maths.interpolation import columns_at
from jaxnav.types import Info, Nav, Track

HOLE = 2.5  # intervals of a truth, from which on it is one


class Errors(NamedTuple):
    """Estimate minus truth, on the host; NED and degrees only on the border."""

    position: np.ndarray  # (..., 3) m, ENU
    velocity: np.ndarray  # (..., 3) m/s, ENU
    attitude: np.ndarray  # (..., 3) rad, roll, pitch, heading, each in (-pi, pi]; nan where the truth has none


def told_by(t: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Times (E,) at which a truth known at ``times`` (N,) says anything, bool (E,): within it, and not in a hole of it.

    A hole is longer than `HOLE` of its intervals, for a line across it would be scored as an error of the solution.
    """
    after = np.clip(np.searchsorted(times, t - TICK), 1, max(times.size - 1, 1))
    apart = np.diff(times)
    if not apart.size:
        return np.abs(t - times[0]) <= TICK
    on = np.abs(t - times[np.clip(np.searchsorted(times, t - TICK), 0, times.size - 1)]) <= TICK
    whole = apart[after - 1] <= HOLE * np.median(apart)
    return (t >= times[0] - TICK) & (t <= times[-1] + TICK) & (whole | on)


def errors(solution: Track, truth: Track) -> Errors:
    """Errors of a solution at its own times against a truth that is interpolated linearly to them (host arrays)."""
    unwrapped = np.where(np.isfinite(truth.rph), np.unwrap(np.nan_to_num(truth.rph), axis=0), np.nan)
    at = lambda a: columns_at(solution.t, truth.t, a)
    position = earth.enu_path(solution.lla, at(earth.continuous(truth.lla)))
    turn = solution.rph - at(unwrapped)
    return Errors(position, solution.vel - at(truth.vel), np.remainder(turn + np.pi, 2 * np.pi) - np.pi)


def position_error(nav: Nav, lla: jax.Array) -> jax.Array:
    """ENU error in m of local level navigation against a true position, (3,); differentiable."""
    return earth.enu_difference(nav.pos, lla)


def state_error(nav: Nav, truth: Nav, states: Iterable[str] = ()) -> jax.Array:
    """X = estimate - truth, (9 + size of the states,), of local level navigation: ENU, and the states in their order.

    Motion by the error model's own definition, C_est = exp([phi x]) C_true.
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
