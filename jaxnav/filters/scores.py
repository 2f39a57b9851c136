"""Scores of runs on lanes (`jaxnav.filters.lanes`) on the host: likelihoods and normalised squares, each once."""

import math
from functools import cache
from typing import Any

import numpy as np
from scipy.special import gammaincinv, gammaln

from jaxnav.filters.lanes import LaneRecord
from jaxnav.filters.run import FREEDOM
from jaxnav.types import Params, Tree


def student(square: np.ndarray, m: np.ndarray | int) -> np.ndarray:
    """Return minus the log of a Student t of ``m`` channels and unit scale at a normalised square, elementwise."""
    half = 0.5 * (FREEDOM + np.asarray(m))
    constant = gammaln(0.5 * FREEDOM) - gammaln(half) + 0.5 * np.asarray(m) * np.log(FREEDOM * np.pi)
    return half * np.log1p(square / FREEDOM) + constant


def innovation_nll(record: LaneRecord, heavy: bool = True) -> np.ndarray:
    """Return minus the log-likelihood (L, E) of each epoch's innovations, inf where a run is not finite.

    Args:
        record: the runs.
        heavy: by the Student t of `residual_nll` everywhere; False: by a Gaussian, and where a channel was rejected
            by a Student t of the same S.
    """
    m = record.valid.sum(-1)
    if heavy:
        near = _fair(record.nis, record.log_det, m)
    else:
        rejected = (record.valid & ~record.used).any(-1)
        near = np.where(rejected, student(record.nis, m), 0.5 * (record.nis + m * np.log(2 * np.pi)))
        near = near + 0.5 * record.log_det
    return np.where(record.ok, near, np.inf)


def marginal_nll(record: LaneRecord, at: Any) -> np.ndarray:
    """Return `residual_nll` (L, E) of the innovations of some channels alone, inf where a run is not finite."""
    nu, S = record.nu[..., at], record.S[..., at, :][..., at]
    return np.where(record.ok, residual_nll(nu, S, record.valid[..., at].sum(-1)), np.inf)


def residual_nll(residual: np.ndarray, C: np.ndarray, m: np.ndarray | int | None = None) -> np.ndarray:
    """Return minus the log-likelihood (...,) of residuals, by a Student t that finds the sd of Gaussian ones.

    A Student t of covariance C is most likely where C is too small for residuals without outliers; here C is divided by
    `gaussian_scale`.

    Args:
        residual: (..., k), 0 where not measured.
        C: (..., k, k), with identity rows there.
        m: (...,) how many are measured; None: all.
    """
    count = residual.shape[-1] if m is None else m
    return _fair(normalized(residual, C), np.linalg.slogdet(C)[1], np.broadcast_to(count, residual.shape[:-1]))


def _fair(square: np.ndarray, log_det: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Return minus the log-likelihood of normalised squares of ``m`` channels (...,)."""
    scale = np.array([gaussian_scale(count) for count in range(int(np.max(m, initial=0)) + 1)])[m]
    return student(square * scale, m) + 0.5 * (log_det - m * np.log(scale))


@cache
def gaussian_scale(m: int) -> float:
    """Return c with E[(FREEDOM + m) c z / (FREEDOM + c z)] = m for z of a chi-square of ``m`` degrees of freedom.

    With it the slope of a Student t's likelihood in the scale of C is zero at the scale of Gaussian residuals.
    """
    if m == 0:
        return 1.0
    z, c = 2.0 * gammaincinv(0.5 * m, (np.arange(2000) + 0.5) / 2000), 1.0
    for _ in range(100):
        c *= m / float(np.mean((FREEDOM + m) * c * z / (FREEDOM + c * z)))
    return c


def position_noise(params: Params, sd: Any, xp: Any = np, name: str = "position") -> Any:
    """Return covariances (..., 3, 3) m^2, ENU, of the white noise of positions with stated ``sd`` (..., 3) m.

    ``xp``: jnp within a traced function; ``name``: of the measurement, the position or the velocity.
    """
    scale = xp.asarray(params.measurements[name].scale)
    size = xp.linalg.norm(scale, axis=-1) if scale.ndim == 2 else xp.broadcast_to(scale, 3)
    return np.eye(3) * ((size * sd) ** 2)[..., None]


def normalized(residual: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the squares (...,) of residuals (..., k) in units of their covariance C (..., k, k)."""
    return np.einsum("...i,...i->...", residual, np.linalg.solve(C, residual[..., None])[..., 0])


def squares(info: Tree) -> np.ndarray:
    """Return innovations squared over their variances (..., m), nan where nothing was measured.

    Args:
        info: runs (..., E, ...), a report or a record of lanes.
    """
    variance = np.diagonal(np.asarray(info.S), axis1=-2, axis2=-1)
    return np.where(np.asarray(info.valid), np.asarray(info.nu) ** 2 / variance, np.nan)


def nis_by_epoch(info: Tree) -> np.ndarray:
    """Return NIS over degrees of freedom (..., E) of each epoch, inf where nothing was measured."""
    dof = np.asarray(info.valid).sum(-1)
    return np.where(dof > 0, np.asarray(info.nis) / np.maximum(dof, 1), np.inf)


def mean_nis(info: Tree, epochs: np.ndarray, channels: np.ndarray | None = None) -> float:
    """Return NIS over degrees of freedom of some epochs together; nan where nothing was measured in them.

    Args:
        info: of a run (E, ...).
        epochs: (E,) bool.
        channels: those that count, by index; None: all.
    """
    valid = np.asarray(info.valid)[epochs]
    if channels is None:
        nis = np.asarray(info.nis)[epochs]
    else:
        nu, S, valid = np.asarray(info.nu)[epochs], np.asarray(info.S)[epochs], valid[:, channels]
        nis = normalized(nu[:, channels], S[:, channels[:, None], channels])
    return float(nis.sum() / valid.sum()) if valid.any() else math.nan


def masked_mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the means (L,) of values (L, E) where ``mask`` (L, E); 0 of none."""
    return np.where(mask, values, 0.0).sum(1) / np.maximum(mask.sum(1), 1)
