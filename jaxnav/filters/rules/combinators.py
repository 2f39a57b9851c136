"""Rules made of rules."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.rule import Correction, Innovation, Rule, only_if
from jaxnav.filters.rules import kalman
from jaxnav.types import Tree


def channels_of(z: Innovation, channels: np.ndarray) -> Innovation:
    """Return some channels (k,) of an innovation."""
    R = z.R[np.ix_(channels, channels)]
    return z._replace(nu=z.nu[channels], H=z.H[channels], R=R, valid=z.valid[channels], age=z.age[channels])


@cache
def only(rule: Rule, channels: tuple[int, ...]) -> Rule:
    """``rule`` sees these channels, the others get a plain Kalman update after it.

    A rule that works once per fix (an integral, a residual window) would otherwise act at the rate of the constraints,
    and take a wheel's residual for a receiver's. The two groups must have independent noise.
    """
    seen = np.array(channels, int)

    def correct(theta: Tree, memory: Tree, z: Innovation) -> Correction:
        other = np.setdiff1d(np.arange(z.nu.size), seen)
        part, rest = channels_of(z, seen), channels_of(z, other)
        c = only_if(part.valid.any(), rule.correct(theta, memory, part), part, memory)
        k = kalman.correct((), (), rest._replace(nu=rest.nu - rest.H @ c.delta, P=c.P))
        used = jnp.zeros_like(z.valid).at[seen].set(c.used).at[other].set(k.used)
        return c._replace(delta=c.delta + k.delta, P=k.P, used=used)

    def init(n: int, m: int) -> Any:
        if seen.max(initial=-1) >= m:
            raise ValueError(f"the rule is to see {seen.size} channels, the filter has {m}")
        return rule.init(n, seen.size)

    def extrapolate(theta: Tree, memory: Tree, x0: jax.Array, x: jax.Array) -> tuple[jax.Array, Any]:
        return rule.extrapolate(theta, memory, x0, x)

    return Rule(init, correct, extrapolate, rule.estimates, rule.supports_smoothing, rule.transport)
