"""Rules that bear faulty fixes, each made of another rule: gate, Huber and Student-t weights.

They change what the inner rule sees of a fix (which channels, what R), so that each goes with any paper's rule. A block
is three consecutive channels: a receiver's position, its velocity.
"""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav import linalg
from jaxnav.filters.core import Correction, Innovation, Rule, idle, masked, select

BLOCK = 3  # channels of a receiver's measurement


def by_block(a: jax.Array) -> jax.Array:
    """Values per channel (m,) as (m / 3, 3)."""
    return a.reshape(-1, BLOCK)


def squared_by_block(v: jax.Array, S: jax.Array) -> jax.Array:
    """v' S^-1 v of every block alone, (m / 3,), from v (m,) and S (m, m)."""
    i = jnp.arange(v.size // BLOCK)
    own = S.reshape(i.size, BLOCK, i.size, BLOCK)[i, :, i, :]
    return jnp.sum(by_block(v) * jnp.linalg.solve(own, by_block(v)[:, :, None])[:, :, 0], axis=1)


def inflated(R: jax.Array, factor: jax.Array) -> jax.Array:
    """R with variances times ``factor`` (m,) > 0, correlations kept."""
    root = jnp.sqrt(factor)
    return root[:, None] * R * root


def require_blocks(m: int) -> None:
    """Raise ValueError where the channels are not blocks of three."""
    if m % BLOCK:
        raise ValueError(f"a rule on blocks of {BLOCK} channels needs a multiple of them, the filter has {m}")


# ---------------------------------------------------------------------------- chi-square gate


class Gate(NamedTuple):
    """Parameters of `gate`."""

    threshold: jax.Array  # () largest nu' S^-1 nu of a block
    timeout: jax.Array  # () s of rejected fixes after which a block is accepted again; inf is never
    rule: Any = ()  # parameters of the inner rule


class GateMemory(NamedTuple):
    """How long each block has been rejected without a break."""

    rejected: jax.Array  # (m / 3,) s, epochs without a fix not counted
    rule: Any


def gate_params(threshold: float = 16.27, timeout: float = 30.0, rule: Any = ()) -> Gate:
    """Parameters from plain numbers; the default threshold is passed by 99.9 % of sound fixes of three channels."""
    return Gate(jnp.asarray(threshold, float), jnp.asarray(timeout, float), rule)


@cache
def gate(rule: Rule) -> Rule:
    """``rule`` sees only the blocks whose innovation is likely; the others are missing for it.

    Recovery: receivers' faults end, while a filter that has drifted off by more than its P never comes back by itself.
    So after ``timeout`` the filter is held to be wrong: the block is accepted, with P times nu' S^-1 nu over its
    channels, which makes the innovation likely again and lets the filter converge anew from what it is told. A larger
    R in place of P would move it by a fraction once every ``timeout``, and be no recovery.

    The time counts only fixes that were rejected, not outages: a fix after a tunnel is tested like any other.
    """

    def init(n: int, m: int) -> GateMemory:
        require_blocks(m)
        return GateMemory(jnp.zeros(m // BLOCK), rule.init(n, m))

    def correct(theta: Gate, memory: GateMemory, z: Innovation) -> Correction:
        here = by_block(z.valid).any(1)
        d2 = squared_by_block(z.nu, z.H @ z.P @ z.H.T + z.R)
        far = here & (d2 > theta.threshold)
        late = far & (memory.rejected >= theta.timeout)
        out = far & ~late
        scale = jnp.max(jnp.where(late, d2 / jnp.maximum(by_block(z.valid).sum(1), 1), 1.0), initial=1.0)
        keep = z.valid & ~jnp.repeat(out, BLOCK)
        nu, H, R = masked(z.nu, z.H, z.R, keep)
        seen = z._replace(nu=nu, H=H, R=R, P=z.P * scale, valid=keep)
        c = select(keep.any(), rule.correct(theta.rule, memory.rule, seen), idle(seen, memory.rule))
        rejected = jnp.where(out, memory.rejected + z.T, jnp.where(here, 0.0, memory.rejected))
        return c._replace(memory=GateMemory(rejected, c.memory))

    def extrapolate(theta: Gate, memory: GateMemory, x0: jax.Array, x: jax.Array):
        x, inner = rule.extrapolate(theta.rule, memory.rule, x0, x)
        return x, memory._replace(rule=inner)

    return Rule(init, correct, extrapolate)


# ---------------------------------------------------------------------------- weights


class Huber(NamedTuple):
    """Parameters of `huber`."""

    knee: jax.Array  # () sd of the innovation beyond which a channel loses weight
    rule: Any = ()  # parameters of the inner rule


def huber_params(knee: float = 1.5, rule: Any = ()) -> Huber:
    """Parameters from plain numbers."""
    return Huber(jnp.asarray(knee, float), rule)


@cache
def huber(rule: Rule) -> Rule:
    """Huber's M-estimator in one step: R of a channel over its weight min(1, knee / |innovation in sd|).

    The correction by a channel is then bounded however far off it is (Huber 1964; Karlgaard & Schaub 2007 iterate it).
    """

    def correct(theta: Huber, memory: Any, z: Innovation) -> Correction:
        sd = jnp.sqrt(jnp.diag(z.H @ z.P @ z.H.T + z.R))
        excess = jnp.maximum(jnp.abs(z.nu) / (theta.knee * sd), 1.0)
        return rule.correct(theta.rule, memory, z._replace(R=inflated(z.R, excess)))

    return Rule(rule.init, correct, lambda theta, memory, x0, x: rule.extrapolate(theta.rule, memory, x0, x))


class StudentT(NamedTuple):
    """Parameters of `student_t`."""

    dof: jax.Array  # () degrees of freedom: few are heavy tails, many a Gaussian
    rule: Any = ()  # parameters of the inner rule


def student_t_params(dof: float = 4.0, rule: Any = ()) -> StudentT:
    """Parameters from plain numbers."""
    return StudentT(jnp.asarray(dof, float), rule)


@cache
def student_t(rule: Rule, iterations: int = 4) -> Rule:
    """Measurement noise of a block is Student-t: R over a weight found by variational Bayes.

    With d channels of a block there, each iteration takes the weight w = (dof + d) / (dof + E[r' R^-1 r]) with
    E = r' R^-1 r + tr(H P+ H' R^-1), r and P+ after the correction with R / w (Agamennoni et al. 2012, eqs. 12-15).
    Sound fixes have w near 1.
    """

    def correct(theta: StudentT, memory: Any, z: Innovation) -> Correction:
        d = by_block(z.valid).sum(1)
        inverse = jnp.linalg.inv(z.R)
        w = jnp.ones(d.shape)
        for _ in range(iterations):
            R = inflated(z.R, jnp.repeat(1 / w, BLOCK))
            K = linalg.gain(z.P, z.H, z.H @ z.P @ z.H.T + R)
            r, spread = z.nu - z.H @ (K @ z.nu), z.H @ linalg.joseph(z.P, K, z.H, R) @ z.H.T
            expected = squared_by_block(r, z.R) + by_block(jnp.sum(spread * inverse, axis=1)).sum(1)
            w = (theta.dof + d) / (theta.dof + expected)
        return rule.correct(theta.rule, memory, z._replace(R=inflated(z.R, jnp.repeat(1 / w, BLOCK))))

    def init(n: int, m: int):
        require_blocks(m)
        return rule.init(n, m)

    return Rule(init, correct, lambda theta, memory, x0, x: rule.extrapolate(theta.rule, memory, x0, x))
