"""Position, velocity and clock of a receiver at each epoch by itself: robust weighted least squares."""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from jaxnav.gnss.ranges import LIGHT, Ranges, epochs
from jaxnav.maths.axes import enu_to_ecef, geodetic
from jaxnav.measurements.satellites import CONSTELLATION, CONSTELLATIONS, PSEUDORANGE, RANGE_RATE, weight
from jaxnav.states.receiver_clock import RANGE_ERROR
from jaxnav.types import Samples

STEPS = 27  # Gauss-Newton steps
HUBER_FROM, CAUCHY_FROM = 9, 18  # steps from which on large residuals lose weight, and all but all of it
KNEE, CAUCHY = 1.5, 2.4  # sd of a residual (Huber 1964; Holland and Welsch 1977)
MAX_SD = 100.0  # m, horizontal: a worse geometry is no solution
MIN_EPOCHS, UNLIKELY = 20, 1e-3  # of residuals that say how large they are; share of epochs with larger ones by chance
NEAR_CLOCKS = 3  # constellations on the receiver's clock, the first of `CONSTELLATIONS`
FAR_ABOVE, FAR_BELOW = 1e6, -1e5  # m of height beyond which a solution is none


class SinglePoint(NamedTuple):
    """Solutions of E epochs, by the satellites of each alone."""

    t: np.ndarray  # (E,) s
    position: np.ndarray  # (E, 3) m, ECEF
    cov: np.ndarray  # (E, 3, 3) m^2, ECEF
    clock: np.ndarray  # (E,) m
    velocity: np.ndarray  # (E, 3) m/s, ECEF; nan where there is none
    velocity_cov: np.ndarray  # (E, 3, 3) m^2/s^2
    satellites: np.ndarray  # (E,) int

    def samples(self) -> tuple[Samples, Samples]:
        """Return position and velocity as streams of a recording, ENU, with times less the receiver's clock error."""
        lla = geodetic(self.position)
        t = self.t - self.clock / LIGHT
        to_enu = np.swapaxes(enu_to_ecef(lla), 1, 2)
        moved = np.isfinite(self.velocity).all(1)
        return _samples(t, lla, self.cov, to_enu), _samples(
            t[moved], np.einsum("eij,ej->ei", to_enu, self.velocity)[moved], self.velocity_cov[moved], to_enu[moved]
        )


def _samples(t: np.ndarray, value: np.ndarray, cov: np.ndarray, to_enu: np.ndarray) -> Samples:
    P = to_enu @ cov @ np.swapaxes(to_enu, 1, 2)
    sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    i, j = np.arange(3), np.array([1, 2, 0])
    return Samples(t, value, sd, 0.999 * P[:, i, j] / (sd[:, i] * sd[:, j]))


def single_point(ranges: Ranges) -> SinglePoint:
    """Return the epochs with satellites enough for a solution, each by itself.

    The sd of a pseudorange is that of its weight and of its slow error together, that of a range rate that of its
    weight, by their defaults; both covariances times what the residuals of all epochs say, see `variance_factor`.

    Args:
        ranges: corrected rows, in order of their times.
    """
    times, of = epochs(ranges.t)
    order = np.arange(of.size) - np.searchsorted(of, of)  # of a row within its epoch
    width = int(order.max(initial=0)) + 1
    wide = lambda a, empty: _padded(a, of, order, (times.size, width), empty)
    valid = wide(np.isfinite(ranges.pseudorange), False)
    s, z = wide(ranges.position, 2e7), wide(np.nan_to_num(ranges.pseudorange), 0.0)
    sd = np.hypot(weight(PSEUDORANGE.defaults, ranges.elevation, ranges.cn0, np), RANGE_ERROR.defaults.sd)
    system = wide(ranges.satellite // CONSTELLATION, 0)
    clocks = np.stack([np.isin(system, group) for group in _clock_groups()], -1).astype(float)
    known = valid / wide(sd, 1.0) ** 2
    there = (clocks * valid[..., None]).any(1)
    x, clock = np.zeros((times.size, 3)), np.zeros((times.size, clocks.shape[-1]))
    robust = np.ones_like(known)
    for step in range(STEPS):
        off = s - x[:, None]
        distance = np.linalg.norm(off, axis=-1)
        H = np.concatenate([-off / distance[..., None], clocks], -1)
        r = z - distance - np.einsum("esc,ec->es", clocks, clock)
        delta, N = _solved(H, r, known * robust, there)
        x, clock = x + delta[:, :3], clock + delta[:, 3:]
        left = (r - np.einsum("esk,ek->es", H, delta)) * np.sqrt(known)
        robust = robust_weight(left, step)
    count = valid.sum(1)
    factor = variance_factor(left, robust, count - 3 - there.sum(1))
    cov = factor[:, None, None] * np.linalg.inv(N)[:, :3, :3]
    lla = geodetic(x)
    good = (count >= 3 + there.sum(1)) & (np.trace(cov, axis1=1, axis2=2) < 2 * MAX_SD**2)
    good &= (lla[:, 2] < FAR_ABOVE) & (lla[:, 2] > FAR_BELOW)
    first = there.argmax(1)
    velocity, velocity_cov = _velocity(ranges, s, x, wide)
    return SinglePoint(times[good], x[good], cov[good], clock[np.arange(times.size), first][good], velocity[good],
                       velocity_cov[good], count[good])  # fmt: skip


def variance_factor(residual: np.ndarray, robust: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """Return the factor on the stated variance of each epoch, (E,): that of all, or the epoch's own where it is larger.

    The median of chi-square over k degrees of freedom is k (1 - 2 / (9 k))^3 (Wilson and Hilferty 1931).

    Args:
        residual: (E, S) in units of its sd.
        robust: (E, S) factors on its weight.
        dof: (E,) degrees of freedom; epochs without any say nothing.
    """
    known, k = dof > 0, np.maximum(dof, 1)
    if known.sum() < MIN_EPOCHS:
        return np.ones(dof.shape)
    usual = np.median(((residual**2).sum(1) / (k * (1 - 2 / (9 * k)) ** 3))[known])
    chi2 = (robust * residual**2).sum(1)
    return np.maximum(usual, np.where(known & (chi2 > usual * chdtri(k, UNLIKELY)), chi2 / k, 0.0))


def robust_weight(residual: np.ndarray, step: int) -> np.ndarray:
    """Return the factor on the weight of a residual in units of its sd: 1, then Huber's, then Cauchy's."""
    if step < HUBER_FROM:
        return np.ones_like(residual)
    if step < CAUCHY_FROM:
        return np.asarray(1 / np.maximum(np.abs(residual) / KNEE, 1.0))
    return np.asarray(1 / (1 + (residual / CAUCHY) ** 2))


def _velocity(ranges: Ranges, s: np.ndarray, x: np.ndarray, wide) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Return velocities (E, 3) m/s at positions ``x`` (E, 3) by the range rates, and their covariances."""
    valid, v = wide(np.isfinite(ranges.range_rate), False), wide(ranges.velocity, 0.0)
    known = valid / wide(weight(RANGE_RATE.defaults, ranges.elevation, ranges.cn0, np), 1.0) ** 2
    u = (s - x[:, None]) / np.linalg.norm(s - x[:, None], axis=-1)[..., None]
    z = wide(np.nan_to_num(ranges.range_rate), 0.0) - np.einsum("esi,esi->es", u, v)
    H, robust = np.concatenate([-u, np.ones_like(z)[..., None]], -1), np.ones_like(z)
    for step in range(HUBER_FROM, STEPS):
        found, N = _solved(H, z, known * robust, np.ones((z.shape[0], 1), bool))
        left = (z - np.einsum("esk,ek->es", H, found)) * np.sqrt(known)
        robust = robust_weight(left, step)
    enough, factor = valid.sum(1) >= 4, variance_factor(left, robust, valid.sum(1) - 4)
    return np.where(enough[:, None], found[:, :3], np.nan), factor[:, None, None] * np.linalg.inv(N)[:, :3, :3]


def _solved(H: np.ndarray, r: np.ndarray, weight: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least squares solution (E, k) and its normal matrix; clocks that are not ``there`` stay at zero."""
    N = np.einsum("esi,es,esj->eij", H, weight, H)
    absent = np.concatenate([np.zeros((there.shape[0], 3), bool), ~there], 1)
    N = N + np.eye(N.shape[-1]) * np.where(absent, 1.0, 1e-9)[:, None]
    return np.linalg.solve(N, np.einsum("esi,es->ei", H, weight * r)[..., None])[..., 0], N


def _clock_groups() -> tuple[tuple[int, ...], ...]:
    """Return the constellations, by index, that share a clock."""
    last = len(CONSTELLATIONS)
    return (tuple(range(NEAR_CLOCKS)), (NEAR_CLOCKS,), (NEAR_CLOCKS + 1,), tuple(range(NEAR_CLOCKS + 2, last)))


def _padded(a: np.ndarray, of: np.ndarray, order: np.ndarray, shape: tuple[int, int], empty: float) -> np.ndarray:
    """Return rows (N, ...) as (E, width, ...)."""
    out = np.full((*shape, *a.shape[1:]), empty, a.dtype if a.dtype == bool else float)
    out[of, order] = a
    return out
