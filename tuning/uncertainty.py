"""Uncertainty of each free parameter: intervals, and indistinguishable combinations.

A filter's innovations are independent and Gaussian where its model holds, so their likelihood has the expected
information of a Gaussian with mean and covariance both depending on the parameters (Kay 1993, eq. 3.31):

    F_jk = sum_t  tr(S^-1 dS_j S^-1 dS_k) / 2 + dnu_j' S^-1 dnu_k

It needs first derivatives only (`tuning.likelihood.information`) and is never negative. The scores of blocks of
time or of runs give the sandwich F^-1 (sum_b g_b g_b') F^-1, which holds where the model does not (White 1982).
Everything is in the unconstrained numbers of `tuning.fit.transforms`, where a Gaussian is a fair approximation.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.special import ndtri, stdtrit

from jaxnav.findings import finding
from jaxnav.types import Array, Finding
from tuning.fit.transforms import Spec, labels, penalty, reported, values

MAX_SD = 1.0  # sd of an unconstrained number beyond which it is not determined: a factor e where it is a logarithm


class Information(NamedTuple):
    """Likelihood of innovations about one point, sums over the epochs that count; P free numbers."""

    nll: Array  # () negative log-likelihood; inf where an epoch that counts is frozen
    score: Array  # (P,) its gradient
    fisher: Array  # (P, P) expected information
    blocks: Array  # (K, P) the score by blocks


def with_prior(info: Information, spec: Spec, raw: dict[str, jax.Array]) -> Information:
    """With the beliefs of the spec: the likelihood becomes a posterior density."""
    flat, back = ravel_pytree(raw)
    value, slope = jax.value_and_grad(lambda r: penalty(spec, back(r)))(flat)
    stiff = [0.0 if (prior := spec[name].prior) is None else prior.sd**-2 for name in sorted(spec)]
    curve = jnp.concatenate([jnp.full(jnp.size(raw[name]), k) for name, k in zip(sorted(spec), stiff, strict=True)])
    return Information(info.nll + value, info.score + slope, info.fisher + jnp.diag(curve), info.blocks)


# ---------------------------------------------------------------------------- intervals


class Covariance(NamedTuple):
    """Covariance of the unconstrained estimates, numpy."""

    model: np.ndarray  # (P, P) inverse information: if the model holds
    sandwich: np.ndarray  # (P, P) from the spread of the blocks' scores
    blocks: int  # that it came from


def covariance(bread: np.ndarray, blocks: np.ndarray) -> Covariance:
    """From information or Hessian (P, P) and the blocks' scores (K, P), both of the same sum.

    A direction without information gets an sd of 1e6, so that it is seen.
    """
    bread, blocks = np.asarray(bread, float), np.asarray(blocks, float)
    value, vector = np.linalg.eigh(0.5 * (bread + bread.T))
    inverse = (vector / np.maximum(value, 1e-12)) @ vector.T
    used = blocks[np.any(blocks != 0, axis=1)]
    centred = used - used.mean(0) if len(used) else used
    meat = centred.T @ centred * (len(used) / max(len(used) - 1, 1))
    return Covariance(inverse, inverse @ meat @ inverse, len(used))


class Interval(NamedTuple):
    """One free number with its 95 % interval, in SI."""

    name: str  # of the leaf, with its index where it has several free numbers; of a correlation its axes
    value: float
    low: float
    high: float
    sd: float  # of the unconstrained number: 0.1 is 10 % for a logarithm
    identified: bool  # sd below `MAX_SD`


def intervals(spec: Spec, raw: dict[str, jax.Array], cov: Covariance, level: float = 0.95) -> list[Interval]:
    """Intervals of every free number, by the larger of the two sd: the model's, or the sandwich's.

    Of a matrix they are of the axes' sd and the correlations, by the derivative of `reported`.

    The sandwich of K blocks takes Student's quantile of K - 1 degrees of freedom; with fewer than P + 10 blocks it is
    left out, since it is then too small more often than not.
    """
    flat, back = ravel_pytree(raw)
    numbers = lambda r: ravel_pytree(reported(spec, back(r)))[0]
    show = lambda t: np.asarray(ravel_pytree(values(spec, back(t)))[0])
    J = np.asarray(jax.jacfwd(numbers)(flat))
    sd = lambda C: np.sqrt(np.diag(J @ C @ J.T))
    quantile = float(ndtri(0.5 + level / 2))
    half = quantile * sd(cov.model)
    if cov.blocks >= flat.size + 10:
        wide = float(stdtrit(cov.blocks - 1, 0.5 + level / 2)) * sd(cov.sandwich)
        half = np.maximum(half, wide)
    # beyond e^200 nothing is known anyway, and an exponential would overflow
    low, value, high = (show(jnp.clip(numbers(flat) + h, -200, 200)).tolist() for h in (-half, 0.0, half))
    size = (half / quantile).tolist()
    rows = zip(labels(spec, raw), value, low, high, size, strict=True)
    return [Interval(name, v, a, b, s, s < MAX_SD) for name, v, a, b, s in rows]


MAX_NAMED = 6  # parameters of one combination


def identifiability(names: Sequence[str], cov: np.ndarray, vague: float = MAX_SD) -> list[Finding]:
    """Return which parameters or combinations of them the data do not determine; empty where they do all.

    Args:
        names: of the P numbers.
        cov: (P, P) their covariance; each principal axis with an sd above ``vague`` is a finding.
        vague: sd of an unconstrained number.
    """
    value, vector = np.linalg.eigh(np.asarray(cov, float))
    out = []
    for variance, axis in sorted(zip(value, vector.T, strict=True), key=lambda pair: -pair[0]):
        sd = float(np.sqrt(max(variance, 0.0)))
        if sd < vague:
            break
        part = [i for i in np.argsort(-np.abs(axis)) if abs(axis[i]) > 0.3 * np.abs(axis).max()][:MAX_NAMED]
        size = f"a factor {np.exp(sd):.3g}" if sd < np.log(1e3) else "any amount"
        if len(part) == 1:
            out.append(finding("tune.undetermined", names[part[0]], size=size))
            continue
        up = [names[i] for i in part if axis[i] * axis[part[0]] > 0]
        down = [names[i] for i in part if axis[i] * axis[part[0]] < 0]
        direction = f"{_and(up)} against {_and(down)}" if down else f"{_and(up)} together"
        out.append(finding("tune.indistinguishable", _and([names[i] for i in part]), direction=direction, size=size))
    return out


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
