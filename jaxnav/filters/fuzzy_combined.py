"""Fuzzy filter that decides between fading and a new R, made from `jaxnav.filters.fwekf` and innovation-based R.

Residuals larger than expected can mean two things. If the model is wrong (a biased IMU, a start off by more than P),
old information must fade; if the receiver is worse than it says, R must grow, and fading would make it follow every
fault. Each cure does harm in the other's place. What tells them apart is who sees it, over the last n fixes:

    m = least over blocks of the share of their mean square that is their mean squared     biased in all blocks
    e_b = log10(1 + mean square over expected)                                             size, for each block

with a block being a receiver's position or velocity. A mean that all blocks see is the model's; one that only one block
has is the receiver's. Two Takagi-Sugeno systems answer: from m and the largest e_b, the fading a (as in `fwekf`); from
m and e_b, how far R of that block goes this time towards what the window says it is, in logarithms.

What is expected is judged by R as it now is, so that a = 1 again once R is right. It counts for `Combined.doubt` fixes
in every mean: while the window fills, the filter is held to be right.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.filters import fuzzy
from jaxnav.filters.core import Correction, Innovation, Rule
from jaxnav.filters.fwekf import Window, fading, limits, push, weighted, window
from jaxnav.filters.robust import BLOCK, by_block, inflated, require_blocks
from jaxnav.types import Prior

TABLE = ((0, 1, 2), (3, 4, 5), (6, 7, 8))
"""Each rule has a consequent of its own; rows by the mean, columns by the size; zero, small, large."""


class Combined(NamedTuple):
    """Parameters of the rule."""

    fade: fuzzy.System  # inputs m, max e_b; answer a
    adapt: fuzzy.System  # inputs m, e_b; answer the share of the way to R's estimate
    limit: Prior  # standard deviations at which fading ends
    doubt: jax.Array  # () fixes that the expectation counts for
    bounds: jax.Array  # (2,) least and largest factor on the fix's own R
    floor: jax.Array  # () least share of the residuals' mean square that R has


class Memory(NamedTuple):
    """Residuals, and what R has been multiplied by."""

    past: Window
    log_factor: jax.Array  # (m / 3,)


def combined_params(low: float = 0.98, high: float = 1.2, limit: Prior | None = None) -> Combined:
    """Hand-set parameters: fade if all blocks have a mean, adapt R if they have none."""
    centres, widths = ((0.1, 0.4, 0.8), (0.1, 0.3, 1.2)), ((0.12, 0.12, 0.2), (0.08, 0.1, 0.4))
    fades = (1.0, 1.0, 1.02, 1.0, 1.005, 1.05, 1.01, 1.03, 1.08)
    shares = (0.1, 0.05, 0.5, 0.02, 0.02, 0.2, 0.01, 0.01, 0.02)
    fade = fuzzy.system(centres, widths, fades, (low, high))
    adapt = fuzzy.system(centres, widths, shares, (0.0, 1.0))
    numbers = (jnp.asarray(v, float) for v in (5.0, (1e-3, 1e6), 0.1))
    return Combined(fade, adapt, limits() if limit is None else limit, *numbers)


def inputs(doubt: jax.Array, past: Window, z: Innovation, R: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The mean m (), the sizes e (m / 3,), and the mean square of the residuals over R, (m / 3,).

    Blocks that the fix does not have are left out of m, and their other two mean nothing.
    """
    here = by_block(z.valid)
    count = past.valid.sum(0)
    residual = jnp.where(past.valid, past.residual, 0.0)
    total, power = residual.sum(0), (residual**2).sum(0)
    expected = jnp.diag(z.H @ z.P @ z.H.T + R)
    average = lambda a: jnp.where(here, by_block(a), 0.0).sum(1) / jnp.maximum(here.sum(1), 1)  # noqa: E731
    # of white residuals the squared mean is a share 1 / count of the mean square: no news
    share = total**2 / jnp.maximum(power * count, 1e-12)
    news = (average(share) - average(1 / jnp.maximum(count, 1))) * average(count / (count + doubt))
    m = jnp.min(jnp.where(here.any(1), news, 1.0))
    square = (power + doubt * expected) / (count + doubt)
    e = jnp.clip(jnp.log10(1 + average(square / expected)), 0.0, 6.0)
    return jnp.sqrt(jnp.maximum(m, 0.0) + 1e-6), e, average(square)


@cache
def fuzzy_combined(n: int = 50, table=TABLE, conjunction: fuzzy.Conjunction = fuzzy.product) -> Rule:
    """The rule with a window of ``n`` fixes; its channels come in blocks of three."""

    def correct(theta: Combined, memory: Memory, z: Innovation) -> Correction:
        past = push(memory.past, z)
        before = inflated(z.R, jnp.exp(jnp.repeat(memory.log_factor, BLOCK)))
        m, e, square = inputs(theta.doubt, past, z, before)
        a = fuzzy.infer(theta.fade, table, jnp.stack([m, jnp.max(jnp.where(by_block(z.valid).any(1), e, 0.0))]),
                        conjunction)  # fmt: skip
        answer = lambda e: fuzzy.infer(theta.adapt, table, jnp.stack([m, e]), conjunction)  # noqa: E731
        share = jnp.where(by_block(z.valid).any(1), jax.vmap(answer)(e), 0.0)
        spread = jnp.diag(z.H @ z.P @ z.H.T)
        here = by_block(z.valid)
        average = lambda v: jnp.where(here, by_block(v), 0.0).sum(1) / jnp.maximum(here.sum(1), 1)  # noqa: E731
        left = jnp.maximum(square - average(spread), theta.floor * square)
        goal = jnp.log(jnp.where(here.any(1), left / jnp.maximum(average(jnp.diag(z.R)), 1e-300), 1.0))
        goal = jnp.clip(goal, *jnp.log(theta.bounds))
        log_factor = memory.log_factor + share * (goal - memory.log_factor)
        R = inflated(z.R, jnp.exp(jnp.repeat(log_factor, BLOCK)))
        delta, P = weighted(z, R / a**2)
        return Correction(delta, P, Memory(past, log_factor), z.valid, fading(theta.limit, a, P))

    def init(_: int, m: int) -> Memory:
        require_blocks(m)
        return Memory(window(n, m), jnp.zeros(m // BLOCK))

    return Rule(init, correct)
