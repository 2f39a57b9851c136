"""Differences of fixes with their covariances: what an alignment compares with the integral of the samples."""

from typing import NamedTuple

import jax
import numpy as np
from scipy.linalg.lapack import dtbtrs
from scipy.spatial.transform import Rotation

from jaxnav.filters.programs import stored
from jaxnav.maths import earth
from jaxnav.maths.interpolation import running
from jaxnav.types import Samples

DRIVING_NOISE = 0.01  # m/s/sqrt(s): effect of vibration and rounding on S
VERTICAL_SD = 1.0  # m/s, of a vertical velocity that is not measured: taken for steady, else gravity is lost


class DifferencedFixes(NamedTuple):
    """Differences D z of K fixes z, without gravity and Coriolis."""

    t: np.ndarray  # (K,) s
    positions: bool  # else velocities
    gravity_free: np.ndarray  # (K, 3) m or m/s: the fixes without gravity and Coriolis
    gravity_dv: np.ndarray  # (3,) m/s, effect of gravity and Coriolis on velocity up to the last fix
    D: np.ndarray  # (M, K)
    target: np.ndarray  # (M, 3) m/s, the differences, in ENU as it stood at the window's begin
    covariances: list[np.ndarray]  # (B, M) for each axis, from the fixes' stated sd: diagonals 0 to B - 1
    driving: float  # m/s/sqrt(s), noise of the samples' integral
    drift: np.ndarray  # (B, M), its covariance, likewise
    spin: np.ndarray  # (3,) rad/s, rotation of ENU


@stored
def _surroundings(lla: jax.Array, vel: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rate of the Earth, rate of ENU over it at this velocity, rad/s, and gravity, m/s^2."""
    lat, _, h = lla
    return earth.earth_rate(lat), earth.transport_rate(lat, h, vel), earth.gravity(lat, h)


def differences(
    fixes: Samples, positions: bool, lla: np.ndarray, begin: float, driving: float = DRIVING_NOISE
) -> DifferencedFixes:
    """Return the differences of the fixes in a window, without gravity and Coriolis.

    Args:
        fixes: K positions (rad, rad, m) or velocities (ENU, m/s).
        positions: they are positions.
        lla: (3,) rad, rad, m, about where.
        begin: s, of the window.
        driving: m/s/sqrt(s), noise of the samples' integral.
    """
    t = fixes.t
    z = earth.enu_path(fixes.value, fixes.value[0]) if positions else fixes.value
    vel = np.gradient(z, t, axis=0) if positions else z
    rate, over, g = (np.asarray(a) for a in _surroundings(lla, vel.mean(0)))
    push = np.array([0.0, 0.0, -float(g)]) - np.cross(2 * rate + over, vel)
    gravity_dv = running(t, push)
    rest = z - (running(t, gravity_dv) if positions else gravity_dv)
    D = _differences(t, positions)
    middle = (np.abs(D) @ t) / np.abs(D).sum(1)
    back = Rotation.from_rotvec((rate + over) * (middle - begin)[:, None]).as_matrix()  # ENU has turned since
    target = np.einsum("kij,kj->ki", back, D @ rest)
    sd = fixes.sd.copy()
    if not positions:
        sd[:, 2] = np.minimum(sd[:, 2], VERTICAL_SD)
    drift = driving**2 * _drift(t, positions)
    drift[0] += 1e-12
    covariances = [_diagonals(D, s**2, len(drift)) for s in sd.T]
    return DifferencedFixes(t, positions, rest, gravity_dv[-1], D, target, covariances, driving, drift, rate + over)


def _differences(t: np.ndarray, positions: bool) -> np.ndarray:
    """D (M, K): neighbouring differences of velocities, or of the mean velocities between neighbouring positions."""
    first = np.diff(np.eye(t.size), axis=0)
    return np.diff(first / np.diff(t)[:, None], axis=0) if positions else first


def _drift(t: np.ndarray, positions: bool) -> np.ndarray:
    """Covariance of the differences for white noise of unit density in the acceleration, as diagonals (B, M)."""
    dt = np.diff(t)
    if not positions:
        return np.stack([dt, 0 * dt])
    # a second difference weighs the acceleration with a triangle over its two intervals
    a, b = dt[:-1], dt[1:]
    return np.stack([(a + b) / 3, np.append(b[:-1] / 6, 0.0), 0 * a])


def _diagonals(D: np.ndarray, variance: np.ndarray, count: int) -> np.ndarray:
    """Return the first diagonals (B, M) of D diag(variance) D', which has no others: differences of neighbours."""
    found = np.zeros((count, len(D)))
    for k in range(count):
        found[k, : len(D) - k] = np.sum(D[k:] * variance * D[: len(D) - k], axis=1)
    return found


def whitened(root: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return L^-1 of values (M, ...) by the diagonals (B, M) of L, as `scipy.linalg.cholesky_banded` gives them."""
    solution, _ = dtbtrs(root, values.reshape(len(values), -1), uplo="L")
    return np.asarray(solution).reshape(values.shape)
