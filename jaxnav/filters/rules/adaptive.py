"""Rules that learn how good the fixes are, or forget old ones, each made of another rule: Sage-Husa, IAE, fading.

R is learnt as a factor per channel on the R that comes with the fix, so that the receiver's sd still counts. A
channel that is missing, or that the inner rule rejects, teaches nothing: its memory stands still.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.filters.rule import Correction, Extrapolate, Innovation, Rule
from jaxnav.filters.rules.robust import inflated, require_plain
from jaxnav.types import Tree


class ScaleMemory(NamedTuple):
    """Learnt factors, and the inner rule's memory."""

    learnt: jax.Array  # (m,) or (window, m) variance over the R of the fix
    rule: Tree


def _passed_on(rule: Rule) -> Extrapolate:
    """Extrapolation is the inner rule's."""

    def extrapolate(theta: Tree, memory: ScaleMemory, x0: jax.Array, x: jax.Array) -> tuple[jax.Array, ScaleMemory]:
        x, inner = rule.extrapolate(theta.rule, memory.rule, x0, x)
        return x, memory._replace(rule=inner)

    return extrapolate


class SageHusa(NamedTuple):
    """Parameters of `sage_husa`."""

    forget: jax.Array  # () share of the old estimate that is kept at every fix
    floor: jax.Array  # () least factor on R
    rule: Tree = ()  # parameters of the inner rule


def sage_husa_params(forget: float = 0.97, floor: float = 0.25, rule: Tree = ()) -> SageHusa:
    """Parameters from plain numbers."""
    return SageHusa(jnp.asarray(forget, float), jnp.asarray(floor, float), rule)


@cache
def sage_husa(rule: Rule) -> Rule:
    """R by exponential forgetting: R <- forget R + (1 - forget) diag(r r' + H P+ H') after the correction.

    r r' + H P+ H' is the mean of v v' given the fix, the E-step of maximum likelihood: positive by construction, where
    the original nu nu' - H P H' is not (Sage & Husa 1969). Used from the next fix on.
    """
    require_plain(rule)

    def correct(theta: SageHusa, memory: ScaleMemory, z: Innovation) -> Correction:
        factor = jnp.maximum(memory.learnt, theta.floor)
        c = rule.correct(theta.rule, memory.rule, z._replace(R=inflated(z.R, factor)))
        r = z.nu - z.H @ c.delta
        now = (r**2 + jnp.diag(z.H @ c.P @ z.H.T)) / jnp.diag(z.R)
        learnt = theta.forget * memory.learnt + (1 - theta.forget) * now
        return c._replace(memory=ScaleMemory(jnp.where(c.used, learnt, memory.learnt), c.memory))

    return Rule(
        lambda n, m: ScaleMemory(jnp.ones(m), rule.init(n, m)),
        correct,
        _passed_on(rule),
        rule.estimates,
        rule.supports_smoothing,
    )


class Iae(NamedTuple):
    """Parameters of `iae`."""

    floor: jax.Array  # () least factor on R
    rule: Tree = ()  # parameters of the inner rule


def iae_params(floor: float = 0.25, rule: Tree = ()) -> Iae:
    """Parameters from plain numbers."""
    return Iae(jnp.asarray(floor, float), rule)


@cache
def iae(rule: Rule, window: int = 20) -> Rule:
    """Innovation-based adaptive estimation: R is the mean of nu nu' - H P H' over the last ``window`` fixes.

    This one included, and never below the floor (Mehra 1970; Mohamed & Schwarz 1999). The window starts out full of the
    stated R.
    """
    require_plain(rule)

    def correct(theta: Iae, memory: ScaleMemory, z: Innovation) -> Correction:
        now = (z.nu**2 - jnp.diag(z.H @ z.P @ z.H.T)) / jnp.diag(z.R)
        learnt = jnp.where(z.valid, jnp.concatenate([memory.learnt[1:], now[None]]), memory.learnt)
        factor = jnp.where(z.valid, jnp.maximum(learnt.mean(0), theta.floor), 1.0)
        c = rule.correct(theta.rule, memory.rule, z._replace(R=inflated(z.R, factor)))
        return c._replace(memory=ScaleMemory(jnp.where(c.used, learnt, memory.learnt), c.memory))

    return Rule(
        lambda n, m: ScaleMemory(jnp.ones((window, m)), rule.init(n, m)),
        correct,
        _passed_on(rule),
        rule.estimates,
        rule.supports_smoothing,
    )


class Fading(NamedTuple):
    """Parameters of `fading`."""

    tau: jax.Array  # () s, age at which a fix has lost 63 % of its weight; inf forgets nothing
    rule: Tree = ()  # parameters of the inner rule


def fading_params(tau: float = 300.0, rule: Tree = ()) -> Fading:
    """Parameters from plain numbers."""
    return Fading(jnp.asarray(tau, float), rule)


@cache
def fading(rule: Rule) -> Rule:
    """P carried on from a fix is P exp(T / tau), which ages old fixes at a fixed rate (Sorenson & Sacks 1971).

    Unobserved states lose their memory too: heading, at rest.
    """
    require_plain(rule)

    def correct(theta: Fading, memory: Tree, z: Innovation) -> Correction:
        c = rule.correct(theta.rule, memory, z)
        return c._replace(fade=c.fade * jnp.exp(0.5 * z.T / theta.tau))

    return rule._replace(
        correct=correct, extrapolate=lambda theta, memory, x0, x: rule.extrapolate(theta.rule, memory, x0, x)
    )
