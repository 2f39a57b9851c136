"""Rules made of rules."""

from functools import cache

import jax
import jax.numpy as jnp

from jaxnav.filters.core import Correction, Innovation, Rule, only_if
from jaxnav.filters.rules import kalman


@cache
def only(rule: Rule, channels: int) -> Rule:
    """``rule`` sees the first ``channels`` channels, the others get a plain Kalman update after it.

    A rule that works once per fix (an integral, a residual window) would otherwise act at the rate of the constraints,
    and take a wheel's residual for a receiver's. The two groups must have independent noise.
    """

    def correct(theta, memory, z: Innovation) -> Correction:
        own, other = slice(0, channels), slice(channels, None)
        part = z._replace(nu=z.nu[own], H=z.H[own], R=z.R[own, own], valid=z.valid[own], age=z.age[own])
        c = only_if(part.valid.any(), rule.correct(theta, memory, part), part, memory)
        rest = z._replace(nu=z.nu[other] - z.H[other] @ c.delta, H=z.H[other], R=z.R[other, other], P=c.P)
        k = kalman.correct((), (), rest._replace(valid=z.valid[other]))
        return c._replace(delta=c.delta + k.delta, P=k.P, used=jnp.concatenate([c.used, k.used]))

    def init(n: int, m: int):
        if m < channels:
            raise ValueError(f"the rule is to see {channels} channels, the filter has {m}")
        return rule.init(n, channels)

    def extrapolate(theta, memory, x0: jax.Array, x: jax.Array):
        return rule.extrapolate(theta, memory, x0, x)

    return Rule(init, correct, extrapolate, rule.estimates)
