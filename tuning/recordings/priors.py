"""Free parameters of a filter and their priors: a datasheet is right within a factor.

Each prior is Gaussian about the datasheet in the unconstrained space (`tuning.fit.transforms`); `PRIORS` says how wide.
"""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax.numpy as jnp

from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import get
from jaxnav.types import ConfigError, Params
from tuning.fit.transforms import LOG, Spec, tied, with_prior
from tuning.recordings.free import leaves_of, step_of, transform_of


class Prior(NamedTuple):
    """How far from the datasheet a parameter may be."""

    sd: float  # one sd: a factor where the parameter is positive, else in SI
    far: str  # likely cause where the data put it far from there


PRIORS: dict[str, Prior] = {
    "noise": Prior(10.0, "vibration, scale errors or a delay pass for noise, or another grade"),
    "driving_noise": Prior(10.0, "an unmodelled error passes for a bias that drifts"),
    "tau": Prior(5.0, "a slow error is a walk, or a fast one is noise"),
    "scale": Prior(3.0, "the receiver's sd are not meant as such, or its errors are not white"),
    "sd": Prior(3.0, "the initial error exceeds its stated sd"),
    "time": Prior(0.1, "logged by another clock, or a receiver that filters for long"),
    "clock_drift": Prior(300e-6, "a clock that was adjusted, or errors that pass for a drift"),
    "length": Prior(0.5, "another antenna, or a delay"),
    "angle": Prior(math.radians(3.0), "the IMU is misaligned with the vehicle"),
}


def kind_of(leaf: str) -> str:
    """Return the row of `PRIORS` for a leaf."""
    last = leaf.rpartition(".")[2]
    if last in ("time_offset", "latency"):
        return "time"
    if last in ("lever_arm", "wheel_arm"):
        return "length"
    return "angle" if last == "vehicle" else last if last in PRIORS else "noise"


def spec_of(
    filt: Filter, params: Params, names: Iterable[str], prior_sd: Mapping[str, float] | None = None, priors: bool = True
) -> Spec:
    """Return how each free leaf is tuned, with its prior about ``params``; one number for all axes, or for level ones.

    Parameters of the filter's rule have no prior.

    Args:
        filt: the filter.
        params: the datasheet.
        names: of free parameters, see `tuning.recordings.free.leaves_of`.
        prior_sd: one sd by leaf, in place of `PRIORS`: a factor where the parameter is positive, else in SI.
        priors: False leaves them out.

    Raises:
        ConfigError: an unknown name, or no parameter at all.
    """
    spec: Spec = {}
    prior_sd, leaves = prior_sd or {}, leaves_of(filt, params, names)
    if not leaves:
        raise ConfigError(f"no free parameter in {', '.join(names)}")
    for leaf in leaves:
        if leaf.startswith("rule."):
            spec[leaf] = step_of(leaf, filt.name)
            continue
        transform = transform_of(leaf)
        centre = jnp.asarray(get(params, leaf), float)
        if kind_of(leaf) in ("noise", "driving_noise", "tau", "scale", "sd") and centre.ndim < 2:
            two = centre.size == 3 and bool(centre[0] == centre[1] != centre[2])  # level and up, as slow errors leave
            transform = tied(transform, (0, 0, 1) if two else ())
            centre = centre if two else jnp.exp(jnp.mean(jnp.log(centre)))
        width = prior_sd.get(leaf, PRIORS[kind_of(leaf)].sd)
        sd = math.log(width) if transform.forward is LOG.forward else float(transform.inverse(jnp.asarray(width)))
        spec[leaf] = with_prior(transform, centre, sd) if priors else transform
    return spec
