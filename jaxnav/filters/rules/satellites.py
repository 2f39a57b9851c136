"""A gate for satellites: each is tested by itself, and the filter is held to be wrong where most are rejected."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.core import masked
from jaxnav.filters.rule import Correction, Innovation, Rule, only_if
from jaxnav.filters.rules.robust import healthy_bound
from jaxnav.types import Tree

THRESHOLD = healthy_bound(0.999, 1)  # of a squared innovation over its variance, which 99.9 % of healthy channels pass
TIMEOUT_S = 1.0  # s of most channels rejected after which the filter is wrong
MIN_CHANNELS = 3  # of fewer, none outvotes the others
MEDIAN = 0.455  # of the square of a normal deviate
SEEN_ROW = 1e-3  # least entry of H of a state that a channel sees


class Memory(NamedTuple):
    """Memory of `gate_satellites`."""

    rejected: jax.Array  # () s that most satellites have been rejected without a break
    rule: Tree


@cache
def gate_satellites(rule: Rule, channels: tuple[int, ...]) -> Rule:
    """``rule`` sees only those of the satellites' ``channels`` whose innovation is likely, and all others.

    A rejected channel is a fault of its satellite, however long it lasts. Recovery: after `TIMEOUT_S` with more than
    half of three or more channels rejected, P is widened in the states that channels see, correlations kept, until the
    median of the squared innovations is a normal deviate's.
    """
    place = np.array(channels, int)

    def init(n: int, m: int) -> Memory:
        return Memory(jnp.zeros(()), rule.init(n, m))

    def correct(theta: Tree, memory: Memory, z: Innovation) -> Correction:
        H, valid = z.H[place], z.valid[place]
        d2 = z.nu[place] ** 2 / (jnp.sum((H @ z.P) * H, 1) + jnp.diag(z.R)[place])
        far, count = valid & (d2 > THRESHOLD), valid.sum()
        most = (count >= MIN_CHANNELS) & (2 * far.sum() > count)
        rejected = jnp.where(most, memory.rejected + z.T, jnp.where(count >= MIN_CHANNELS, 0.0, memory.rejected))
        wrong = most & (rejected >= TIMEOUT_S)
        middle = jnp.sort(jnp.where(valid, d2, jnp.inf))[jnp.maximum((count - 1) // 2, 0)]
        factor = jnp.where(wrong, jnp.maximum(jnp.where(wrong, middle, 1.0) / MEDIAN, 1.0), 1.0)
        root = jnp.where((jnp.abs(H) > SEEN_ROW).any(0), jnp.sqrt(factor), 1.0)
        keep = z.valid.at[place].set(valid & (~far | wrong))
        nu, H, R = masked(z.nu, z.H, z.R, keep)
        seen = z._replace(nu=nu, H=H, R=R, P=root[:, None] * z.P * root, valid=keep)
        c = only_if(keep.any(), rule.correct(theta, memory.rule, seen), seen, memory.rule)
        return c._replace(memory=Memory(jnp.where(wrong, 0.0, rejected), c.memory))

    def extrapolate(theta: Tree, memory: Memory, x0: jax.Array, x: jax.Array) -> tuple[jax.Array, Memory]:
        x, inner = rule.extrapolate(theta, memory.rule, x0, x)
        return x, memory._replace(rule=inner)

    transport = rule.transport
    moved = transport and (lambda theta, memory, *of: memory._replace(rule=transport(theta, memory.rule, *of)))
    return rule._replace(init=init, correct=correct, extrapolate=extrapolate, transport=moved)
