"""Fuzzy filter that decides between fading and a new R, made from `jaxnav.filters.papers.fwekf` and innovation-based R.

Residuals larger than expected can mean two things. If the model is wrong (a biased IMU, a start off by more than P),
old information must fade; if the receiver is worse than it says, R must grow, and fading would make it follow every
fault. Each cure does harm in the other's place. Over the last n fixes, these separate the two:

    m^2 = the share of the mean square of the witness's residuals that is their mean squared
    e_b = log10(1 + mean square over expected), for each block

where a block is a receiver's position or velocity, and the witness is the one that a wrong model moves first: velocity,
if the receiver gives it. A mean in velocity is the model's; one in position alone is the receiver's. Two Takagi-Sugeno
systems answer: from m and the largest e_b, the weight a (as in `fwekf`); from m and e_b, how far R of that block goes
this time towards the R of the window, in logarithms.

The expectation uses R as it now is, so that a = 1 again once R is right. It counts for `Combined.doubt` fixes
in every mean: while the window fills, the filter is held to be right.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.papers.fwekf import Limits, Window, fading, limits, push, weighted, window
from jaxnav.filters.rule import Correction, Innovation, Rule
from jaxnav.filters.rules import fuzzy
from jaxnav.filters.rules.robust import BLOCK, by_block, inflated, require_blocks
from jaxnav.types import Tree

TABLE = ((0, 1, 2), (3, 4, 5), (6, 7, 8))
"""Each rule has one consequent; rows by the mean, columns by the size; zero, small, large."""


class Combined(NamedTuple):
    """Parameters of the rule."""

    fade: fuzzy.System  # inputs m, the largest e_b; answer a
    adapt: fuzzy.System  # inputs m, e_b; answer the share of the way to R's estimate
    limit: Limits  # standard deviations at which fading ends
    doubt: jax.Array  # () fixes that the expectation counts for
    bounds: jax.Array  # (2,) least and largest factor on the fix's R
    floor: jax.Array  # () least share of the residuals' mean square that R has


class CombinedMemory(NamedTuple):
    """Residuals, and the factor on R so far."""

    past: Window
    log_factor: jax.Array  # (m / 3,)


def combined_params(low: float = 1.0, high: float = 1.2, limit: Limits | None = None) -> Combined:
    """Hand-set parameters: fade if the witness has a mean, adapt R if it has none."""
    centres, widths = ((0.1, 0.4, 0.8), (0.1, 0.3, 1.0)), ((0.12, 0.12, 0.2), (0.08, 0.1, 0.4))
    fades = np.clip((1.0, 1.0, 1.01, 1.0, 1.005, 1.03, 1.02, 1.03, 1.06), low + 3e-4, high - 3e-4)
    shares = (0.2, 0.1, 0.8, 0.02, 0.02, 0.2, 1e-3, 1e-3, 1e-3)
    fade = fuzzy.system(centres, widths, fades, (low, high))
    # residuals a thousand times too large show a collapsed P, at any R: fade, until R is right
    fade = fade._replace(consequents=fade.consequents.at[2].set(jnp.array([-6.0, 0.0, 2.0])))
    adapt = fuzzy.system(centres, widths, shares, (0.0, 1.0))
    numbers = (jnp.asarray(v, float) for v in (5.0, (1e-3, 1e6), 0.1))
    return Combined(fade, adapt, limits() if limit is None else limit, *numbers)


def over_blocks(valid: jax.Array, a: jax.Array) -> jax.Array:
    """Mean of ``a`` (m,) over the valid channels of each block, (m / 3,); 0 where there is none."""
    here = by_block(valid)
    return jnp.where(here, by_block(a), 0.0).sum(1) / jnp.maximum(here.sum(1), 1)


def inputs(doubt: jax.Array, past: Window, z: Innovation, R: jax.Array, witness: int) -> tuple[jax.Array, ...]:
    """Return the mean m (), the sizes e (m / 3,), and the residuals' mean square in units of the channel, (m / 3,)."""
    count = past.valid.sum(0)
    residual = jnp.where(past.valid, past.residual, 0.0)
    total, power = residual.sum(0), (residual**2).sum(0)
    expected = jnp.diag(z.H @ z.P @ z.H.T + R)
    # of white residuals the mean's square is 1 / count of the mean square: that is no news, and few fixes are little
    share = total**2 / jnp.maximum(power * count, 1e-12) - 1 / jnp.maximum(count, 1)
    news = over_blocks(count > 0, share * count / (count + doubt))[witness]
    square = (power + doubt * expected) / (count + doubt)
    e = jnp.clip(jnp.log10(1 + over_blocks(z.valid, square / expected)), 0.0, 6.0)
    return jnp.sqrt(jnp.maximum(news, 0.0) + 1e-6), e, over_blocks(z.valid, square)


@cache
def fuzzy_combined(
    n: int = 20, table: Any = TABLE, conjunction: fuzzy.Conjunction = fuzzy.product, witness: int = -1
) -> Rule:
    """Return the rule with a window of ``n`` fixes; its channels are in blocks of three, ``witness`` is one of them."""

    def decide(theta: Combined, m: jax.Array, e: jax.Array) -> tuple[jax.Array, jax.Array]:
        answer = lambda system, e: fuzzy.infer(system, table, jnp.stack([m, e]), conjunction)
        return answer(theta.fade, jnp.max(e)), jax.vmap(answer, (None, 0))(theta.adapt, e)

    return deciding(decide, n, witness)


def deciding(decide: Callable[[Any, jax.Array, jax.Array], tuple[jax.Array, jax.Array]], n: int, witness: int) -> Rule:
    """Return the rule by a function: (theta, mean (), sizes (m / 3,)) -> a (), shares of the step to a new R (m / 3,).

    ``theta`` has the limit, doubt, bounds and floor of `Combined`.
    """

    def correct(theta: Tree, memory: CombinedMemory, z: Innovation) -> Correction:
        past, here = push(memory.past, z), by_block(z.valid).any(1)
        before = inflated(z.R, jnp.exp(jnp.repeat(memory.log_factor, BLOCK)))
        m, e, square = inputs(theta.doubt, past, z, before, witness)
        a, share = decide(theta, m, e)
        share = jnp.where(here, share, 0.0)
        left = square - over_blocks(z.valid, jnp.diag(z.H @ z.P @ z.H.T))  # beyond P
        R = over_blocks(z.valid, jnp.diag(z.R))
        factor = jnp.where(here, jnp.maximum(left, theta.floor * square) / jnp.where(here, R, 1.0), 1.0)
        log_factor = memory.log_factor + share * (jnp.log(jnp.clip(factor, *theta.bounds)) - memory.log_factor)
        delta, P = weighted(z, inflated(z.R, jnp.exp(jnp.repeat(log_factor, BLOCK))) / a**2)
        return Correction(delta, P, CombinedMemory(past, log_factor), z.valid, fading(theta.limit, a, P))

    def init(_: int, m: int) -> CombinedMemory:
        require_blocks(m)
        return CombinedMemory(window(n, m), jnp.zeros(m // BLOCK))

    return Rule(init, correct, supports_smoothing=True)
