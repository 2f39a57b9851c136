"""Fuzzy weighted extended Kalman filter: a fuzzy system sets how fast old information fades (FWEKF paper, section 3-4).

    S = H P- H' + R / a^2,    K = P- H' S^-1,    P+ = (I - K H) P- (I - K H)' + K R K' / a^2     (24, 27)
    P-(k+1) = a^2 Phi P+ Phi' + Q                                                               (26)

with a from the residuals of the last n fixes: x1 is large if their mean is (a bias), x2 if their size is:

    x1^2 = mean over channels of rbar_i^2 / Phat_ii,    x2 = log10(1 + mean over channels of Phat_ii / Pr_ii)

rbar and Phat are the means of r and r r' over the same window (31, 32), of at most n fixes and of the fixes there are
while it fills; Pr = H P- H' + R (28). The paper prints n + 1 terms in eq. 31, and takes mean and covariance as they
are, in metres: divided by the sample covariance, x1 is between 0 and 1 and is 1 / sqrt(n) for white residuals.
A filter with the true noise has x2 = log10(2).

The printed weights R a^(-2(k+1)), Q a^(-2(k+1)) (eqs. 21, 22) are the same filter as long as a is constant, see
`fwekf_literal`.

Fading lets the covariance of an unobserved state grow by a^2 each time, without end: heading at rest. It ends where a
standard deviation reaches `Fwekf.limit`: 1 + (a^2 - 1) (1 - P_ii / limit_i^2)^2 multiplies state i instead of a^2, and
1 beyond, so that with a <= 2 fading by itself takes no standard deviation past its limit. It is the same for a < 1: a
filter's answer then has no kink where its weight crosses 1.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.filters.rule import Correction, Innovation, Rule
from jaxnav.filters.rules import fuzzy
from jaxnav.maths import linalg, units

Z, S, L, NS = range(4)
TABLE = ((Z, S, S), (S, L, S), (Z, NS, NS))
"""Table 1 of the paper: rows by the mean, columns by the covariance of the residuals; zero, small, large."""


class Fwekf(NamedTuple):
    """Parameters of the rule."""

    system: fuzzy.System  # inputs x1, x2; answer a
    limit: "Limits"  # where fading ends


class Limits(NamedTuple):
    """Standard deviations at which fading ends; each leaf broadcasts to its axes."""

    position: jax.Array  # m
    velocity: jax.Array  # m/s
    attitude: jax.Array  # rad
    gyro_bias: jax.Array  # rad/s
    accel_bias: jax.Array  # m/s^2


class Window(NamedTuple):
    """The residuals of the last n fixes, newest last."""

    residual: jax.Array  # (n, m)
    valid: jax.Array  # (n, m) bool


def limits(
    position: float = 1e3,
    velocity: float = 100.0,
    attitude: float = 10 * units.DEG,
    gyro_bias: float = 1 * units.DEG,
    accel_bias: float = 1.0,
) -> Limits:
    """Where fading ends: m, m/s, rad, rad/s, m/s^2."""
    return Limits(*(jnp.asarray(v, float) for v in (position, velocity, attitude, gyro_bias, accel_bias)))


def fwekf_params(low: float = 1.0, high: float = 1.2, limit: Limits | None = None) -> Fwekf:
    """Hand-set parameters: a between ``low`` and ``high``; the sets are zero, small, large for x1, then x2.

    The consequents are a = 1, 1.02, 1.05 and 0.98 for Z, S, L and NS, or as near to them as the bounds allow: NS is
    1.0002 by default, so that old information never counts for more than new; ``low`` = 0.9 has all four. A memory of
    1 / (2 log a) fixes goes with a: 25 and 10 of them for S and L.
    """
    inside = 1e-3 * (high - low)
    answers = [min(max(a, low + inside), high - inside) for a in (1.0, 1.02, 1.05, 0.98)]
    centres, widths = ((0.25, 0.5, 0.9), (0.3, 1.0, 3.0)), ((0.12, 0.12, 0.2), (0.3, 0.4, 1.0))
    return Fwekf(fuzzy.system(centres, widths, answers, (low, high)), limits() if limit is None else limit)


def window(n: int, m: int) -> Window:
    """Return an empty window of n fixes."""
    return Window(jnp.zeros((n, m)), jnp.zeros((n, m), bool))


def push(past: Window, z: Innovation) -> Window:
    """Return the window with a fix at its end; the oldest leaves it."""
    return Window(*(jnp.concatenate([a[1:], b[None]]) for a, b in zip(past, (z.nu, z.valid), strict=True)))


def moments(past: Window) -> tuple[jax.Array, jax.Array]:
    """Mean and mean square of each channel's residuals, (m,) both; eqs. 31 and 32, the diagonal."""
    count = jnp.maximum(past.valid.sum(0), 1)
    residual = jnp.where(past.valid, past.residual, 0.0)
    return residual.sum(0) / count, (residual**2).sum(0) / count


def inputs(past: Window, z: Innovation) -> jax.Array:
    """x1 and x2, (2,), over the channels that the fix has."""
    mean, power = moments(past)
    expected = jnp.diag(z.H @ z.P @ z.H.T + z.R)
    average = lambda a: jnp.where(z.valid, a, 0.0).sum() / jnp.maximum(z.valid.sum(), 1)
    x1 = jnp.sqrt(average(mean**2 / (power + 1e-12)) + 1e-10)
    x2 = jnp.log10(1 + average(power / expected))
    return jnp.stack([x1, jnp.clip(x2, 0.0, 6.0)])


def printed_inputs(past: Window, z: Innovation) -> jax.Array:
    """Eqs. 31 and 32 as printed, (2,): root mean square over the channels of the mean, and mean of the mean squares.

    In metres and metres per second as they come; ``past`` has n + 1 residuals: eq. 31 adds up all of them and divides
    by n.
    """
    residual = jnp.where(past.valid, past.residual, 0.0)
    count = jnp.clip(past.valid.sum(0), 1, past.residual.shape[0] - 1)
    average = lambda a: jnp.where(z.valid, a, 0.0).sum() / jnp.maximum(z.valid.sum(), 1)
    mean, power = residual.sum(0) / count, (residual[1:] ** 2).sum(0) / count
    return jnp.stack([jnp.sqrt(average(mean**2) + 1e-10), average(power)])


def fading(limit: Limits, a: jax.Array, P: jax.Array) -> jax.Array:
    """Factor on each state, (n,), that carries ``P`` on: ``a``, and less where a state is near its limit."""
    full = (
        jnp.maximum(
            1 - jnp.diag(P) / jnp.concatenate([jnp.broadcast_to(sd, (3,)) for sd in limit])[: P.shape[0]] ** 2, 0.0
        )
        ** 2
    )
    return jnp.sqrt(1 + (a**2 - 1) * full)


def weighted(z: Innovation, R: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Kalman update with ``R`` (m, m) in place of the fix's R: delta (n,), P (n, n)."""
    K, P = linalg.update(z.P, z.H, R)
    return K @ z.nu, P


@cache
def fwekf(
    n: int = 50,
    table: Any = TABLE,
    conjunction: fuzzy.Conjunction = fuzzy.product,
    seen: Callable[[Window, Innovation], jax.Array] = inputs,
) -> Rule:
    """Return the rule with a window of ``n`` fixes and any table of two inputs, which ``seen`` computes.

    The paper's Figure 9 rises for 5 s: 50 fixes at 10 Hz. Its text has "max/min used for or/and", its eq. 30 a product.
    """
    rows = n + 1 if seen is printed_inputs else n

    def correct(theta: Fwekf, memory: Window, z: Innovation) -> Correction:
        memory = push(memory, z)
        a = fuzzy.infer(theta.system, table, seen(memory, z), conjunction)
        delta, P = weighted(z, z.R / a**2)
        return Correction(delta, P, memory, z.valid, fading(theta.limit, a, P))

    return Rule(lambda _, m: window(rows, m), correct, supports_smoothing=True)


class Literal(NamedTuple):
    """Memory of the printed form."""

    past: Window
    k: jax.Array  # () fixes so far
    scale: jax.Array  # () product of the factors on the carried covariance


@cache
def fwekf_literal(n: int = 50, table: Any = TABLE, conjunction: fuzzy.Conjunction = fuzzy.product) -> Rule:
    """Return the weights as printed, R a^(-2(k+1)) and Q a^(-2(k+1)), for comparison with `fwekf`.

    Its covariance shrinks by a^-2 a fix, and is reported so; the carried one is multiplied back, so that the model's
    Q may be added to it. With a constant a, and no limit in force, the gains are those of `fwekf`. With one that varies
    the form is wrong: all of R and Q jumps by (a_k / a_(k-1))^(-2(k+1)) against a covariance that does not. And it is
    out of numbers when a^(2(k+1)) reaches 1e308, after 1945 fixes at a = 1.2: the run then stops being finite.
    `Fwekf.limit` has no effect here.
    """

    def correct(theta: Fwekf, memory: Literal, z: Innovation) -> Correction:
        past = push(memory.past, z)
        a = fuzzy.infer(theta.system, table, inputs(past, z), conjunction)
        weight = a ** (2 * (memory.k + 1))
        delta, P = weighted(z._replace(P=z.P / memory.scale), z.R / weight)
        return Correction(delta, P, Literal(past, memory.k + 1, weight), z.valid, jnp.sqrt(weight))

    return Rule(lambda _, m: Literal(window(n, m), jnp.zeros(()), jnp.ones(())), correct)
