"""Scores of runs on lanes (`jaxnav.filters.lanes`) on the host: likelihoods and normalised squares, each once."""

from typing import Any

import numpy as np
from scipy.special import gammaln

from jaxnav.filters.lanes import LaneRecord
from jaxnav.filters.run import FREEDOM
from jaxnav.types import Params


def student(square: np.ndarray, m: np.ndarray | int) -> np.ndarray:
    """Return minus the log of a Student t of ``m`` channels and unit scale at a normalised square, elementwise."""
    half = 0.5 * (FREEDOM + np.asarray(m))
    constant = gammaln(0.5 * FREEDOM) - gammaln(half) + 0.5 * np.asarray(m) * np.log(FREEDOM * np.pi)
    return half * np.log1p(square / FREEDOM) + constant


def innovation_nll(record: LaneRecord, heavy: bool = True) -> np.ndarray:
    """Return minus the log-likelihood (L, E) of each epoch's innovations, inf where a run is not finite.

    Args:
        record: the runs.
        heavy: by a Student t everywhere; False: only where a channel was rejected, else by a Gaussian.
    """
    m = record.valid.sum(-1)
    far = student(record.nis, m)
    if not heavy:
        rejected = (record.valid & ~record.used).any(-1)
        far = np.where(rejected, far, 0.5 * (record.nis + m * np.log(2 * np.pi)))
    return np.where(record.ok, far + 0.5 * record.log_det, np.inf)


def position_noise(params: Params, sd: Any, xp: Any = np) -> Any:
    """Return covariances (..., 3, 3) m^2, ENU, of the white noise of positions with stated ``sd`` (..., 3) m.

    ``xp``: jnp within a traced function.
    """
    scale = xp.asarray(params.measurements["position"].scale)
    size = xp.linalg.norm(scale, axis=-1) if scale.ndim == 2 else xp.broadcast_to(scale, 3)
    return np.eye(3) * ((size * sd) ** 2)[..., None]


def residual_nll(residual: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return minus the log-likelihood (...,) of residuals (..., k) of covariance C (..., k, k), by a Student t."""
    return student(normalized(residual, C), residual.shape[-1]) + 0.5 * np.linalg.slogdet(C)[1]


def normalized(residual: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the squares (...,) of residuals (..., k) in units of their covariance C (..., k, k)."""
    return np.einsum("...i,...i->...", residual, np.linalg.solve(C, residual[..., None])[..., 0])


def masked_mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the means (L,) of values (L, E) where ``mask`` (L, E); 0 of none."""
    return np.where(mask, values, 0.0).sum(1) / np.maximum(mask.sum(1), 1)
