"""Draws from the posterior of the free parameters by NUTS: what intervals look like where no Gaussian fits.

Needs the package ``blackjax`` (extra ``bayes``). The space is whitened by the covariance at the estimate, so that the
sampler has little left to adapt.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.types import ConfigError


class Draws(NamedTuple):
    """A chain after its warm-up."""

    raw: np.ndarray  # (draws, P) unconstrained numbers
    acceptance: float  # mean, about 0.8 if all is well
    divergent: int  # draws at which the integrator failed: any is a warning


def sample(
    log_density: Callable[[jax.Array], jax.Array],
    centre: np.ndarray,
    covariance: np.ndarray,
    draws: int,
    key: jax.Array,
    warmup: int = 100,
    widest: float = 3.0,
) -> Draws:
    """Draw from exp(log_density(raw (P,))), starting at the estimate ``centre`` with its ``covariance`` (P, P).

    ``widest``: sd beyond which a direction is not stretched; one that the data do not determine has no posterior
    without a belief (see `tuning.transforms.believed`).

    Raises:
        ConfigError: blackjax is not installed.
    """
    try:
        import blackjax
    except ImportError as error:
        raise ConfigError("draws from the posterior need the extra bayes: pip install 'jaxnav[bayes]'") from error
    value, vector = np.linalg.eigh(np.asarray(covariance))
    scale = jnp.asarray(vector * np.sqrt(np.clip(value, 1e-12, widest**2)))
    density = lambda z: log_density(jnp.asarray(centre) + scale @ z)
    warm, go = jax.random.split(key)
    adapt = blackjax.window_adaptation(blackjax.nuts, density)
    (state, parameters), _ = adapt.run(warm, jnp.zeros(len(centre)), warmup)
    kernel = blackjax.nuts(density, **parameters)

    @jax.jit
    def chain(state: Any, keys: jax.Array) -> Any:
        def step(state: Any, key: jax.Array) -> Any:
            state, info = kernel.step(key, state)
            return state, (state.position, info.acceptance_rate, info.is_divergent)

        return jax.lax.scan(step, state, keys)[1]

    z, accepted, divergent = chain(state, jax.random.split(go, draws))
    raw = centre + np.asarray(z @ scale.T)
    return Draws(raw, float(accepted.mean()), int(divergent.sum()))
