"""Rules that bear faulty fixes, each made of another rule: gate, Huber and Student-t weights.

They change the inner rule's fix (which channels, which R), so that each goes with any paper's rule. A block
is three consecutive channels: a receiver's position, its velocity.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtri

from jaxnav.filters.core import masked
from jaxnav.filters.rule import NEVER_USED_AGE, Correction, Innovation, Rule, only_if, select
from jaxnav.maths import linalg
from jaxnav.types import Tree

OUTAGE_RATIO = 1.5  # of the interval between fixes: a longer one is an outage
BLOCK = 3  # channels of a receiver's measurement


def by_block(a: jax.Array) -> jax.Array:
    """Values per channel (m,) as (m / 3, 3)."""
    return a.reshape(-1, BLOCK)


def own_blocks(S: jax.Array) -> jax.Array:
    """Return the blocks on the diagonal of S (m, m), as (m / 3, 3, 3)."""
    i = jnp.arange(S.shape[0] // BLOCK)
    return S.reshape(i.size, BLOCK, i.size, BLOCK)[i, :, i, :]


def squared_by_block(v: jax.Array, S: jax.Array) -> jax.Array:
    """Return v' S^-1 v of every block, (m / 3,), from v (m,) and S (m, m)."""
    return jax.vmap(linalg.normalized)(by_block(v), own_blocks(S))


def inflated(R: jax.Array, factor: jax.Array) -> jax.Array:
    """R with variances times ``factor`` (m,) > 0, correlations kept."""
    root = jnp.sqrt(factor)
    return root[:, None] * R * root


def require_plain(rule: Rule) -> None:
    """Raise ValueError for a rule with error states, which no other rule can contain."""
    if rule.transport is not None:
        raise ValueError("a rule with error states, as `receiver`, cannot be inside of another")


def require_blocks(m: int) -> None:
    """Raise ValueError where the channels are not blocks of three."""
    if m % BLOCK:
        raise ValueError(f"a rule on blocks of {BLOCK} channels needs a multiple of them, the filter has {m}")


# ---------------------------------------------------------------------------- chi-square gate


class Gate(NamedTuple):
    """Parameters of `gate`."""

    threshold: jax.Array  # () largest nu' S^-1 nu of a block
    timeout: jax.Array  # () s of rejected fixes after which a block is accepted again; inf is never
    rule: Tree = ()  # parameters of the inner rule


class GateMemory(NamedTuple):
    """How long each block has been rejected without a break, outages not counted."""

    rejected: jax.Array  # (blocks,) s
    seen: jax.Array  # (blocks,) s, its age at its last fix if that was rejected, else 0
    interval: jax.Array  # (blocks,) s, the shortest time between two of its fixes so far
    rule: Tree


def gate_params(threshold: float = 16.27, timeout: float = 30.0, rule: Tree = ()) -> Gate:
    """Parameters from plain numbers; the default threshold is passed by 99.9 % of sound fixes of three channels."""
    return Gate(jnp.asarray(threshold, float), jnp.asarray(timeout, float), rule)


def inflate_block(z: Innovation, S: jax.Array, factor: jax.Array, blocks: Sequence[slice]) -> jax.Array:
    """P (n, n) after each block's measured quantity has jumped, S (m, m) of that block becoming S times its factor.

    ``factor`` (blocks,) >= 1. The jump is independent of all that P knows, and is in the states that would be
    responsible were their errors independent: for a position, in position.
    """
    P = z.P
    D = jnp.diag(P)[:, None]  # so that a lever arm's attitude counts in metres
    for i, b in enumerate(blocks):
        H, missing = z.H[b], jnp.diag(1.0 - z.valid[b])
        G = D * H.T @ linalg.inverse(H @ (D * H.T) + missing)
        P = P + (factor[i] - 1) * G @ S[b, b] @ G.T
    return P


def healthy_bound(share: float, channels: int) -> float:
    """Return the bound of nu' S^-1 nu of so many channels, for that share of healthy fixes."""
    return float(chdtri(channels, 1 - share))


@cache
def gate(rule: Rule, sizes: tuple[int, ...] | None = None) -> Rule:
    """``rule`` sees only the blocks whose innovation is likely; the others are missing for it.

    ``sizes``: channels of each block, which is a measurement; None is blocks of three. The threshold is that of three
    channels; a block of another size has that which as many sound fixes pass.

    Recovery: receivers' faults end, while a filter that has drifted off by more than its P never comes back by itself.
    So after ``timeout`` the filter is held to be wrong, and the block is accepted with P widened by a jump
    (see `inflate_block`) that makes the innovation likely again: nu' S^-1 nu is then its number of channels. A plain
    acceptance moves a filter that is too sure of itself by little, and the next fix is rejected again; R in place of P
    would move it even less. Inflating all of P lets a lasting fault turn the attitude through its correlations. The
    inner rule restarts, too: an integral of the filter that was wrong would be applied again at every recovery.

    The time counts only fixes that were rejected, not outages: an interval between two fixes counts as `OUTAGE_RATIO`
    of their shortest interval at most, and a fix after a tunnel is tested like any other.
    """
    require_plain(rule)

    def blocks(m: int) -> tuple[int, ...]:
        if sizes is None:
            require_blocks(m)
        elif sum(sizes) != m:
            raise ValueError(f"blocks of {sizes} channels are not the {m} of the filter")
        return sizes or (BLOCK,) * (m // BLOCK)

    def init(n: int, m: int) -> GateMemory:
        count = len(blocks(m))
        return GateMemory(jnp.zeros(count), jnp.zeros(count), jnp.full(count, NEVER_USED_AGE), rule.init(n, m))

    def correct(theta: Gate, memory: GateMemory, z: Innovation) -> Correction:
        widths = blocks(z.nu.size)
        stops = np.cumsum(widths)
        places = [slice(stop - size, stop) for stop, size in zip(stops, widths, strict=True)]
        share = np.array([healthy_bound(0.999, size) / healthy_bound(0.999, BLOCK) for size in widths])
        S = z.H @ z.P @ z.H.T + z.R
        count = jnp.stack([z.valid[b].sum() for b in places])
        d2 = jnp.stack([linalg.normalized(z.nu[b], S[b, b]) for b in places])
        far = (count > 0) & (d2 > theta.threshold * share)
        late = far & (memory.rejected >= theta.timeout)
        out = far & ~late
        P = inflate_block(z, S, jnp.where(late, jnp.maximum(d2 / jnp.maximum(count, 1), 1.0), 1.0), places)
        keep = z.valid & ~jnp.repeat(out, np.array(widths), total_repeat_length=z.nu.size)
        nu, H, R = masked(z.nu, z.H, z.R, keep)
        seen = z._replace(nu=nu, H=H, R=R, P=P, valid=keep)
        inner = select(late.any(), rule.init(z.P.shape[0], z.nu.size), memory.rule)
        c = only_if(keep.any(), rule.correct(theta.rule, inner, seen), seen, inner)
        # the time since the block's last fix, and not that since the last epoch, which may have been empty
        there, age = count > 0, jnp.stack([z.age[b].max() for b in places])
        since = age - memory.seen
        rejected = memory.rejected + jnp.minimum(since, OUTAGE_RATIO * memory.interval)
        last = (rejected, age), (memory.rejected, memory.seen)
        rejected, old = (jnp.where(out, a, jnp.where(there, 0.0, b)) for a, b in zip(*last, strict=True))
        interval = jnp.where(there & (since > 0), jnp.minimum(memory.interval, since), memory.interval)
        return c._replace(memory=GateMemory(rejected, old, interval, c.memory))

    def extrapolate(theta: Gate, memory: GateMemory, x0: jax.Array, x: jax.Array) -> tuple[jax.Array, GateMemory]:
        x, inner = rule.extrapolate(theta.rule, memory.rule, x0, x)
        return x, memory._replace(rule=inner)

    return Rule(init, correct, extrapolate, rule.estimates, rule.supports_smoothing)


# ---------------------------------------------------------------------------- weights


class Huber(NamedTuple):
    """Parameters of `huber`."""

    knee: jax.Array  # () sd of the innovation beyond which a channel loses weight
    rule: Tree = ()  # parameters of the inner rule


def huber_params(knee: float = 1.5, rule: Tree = ()) -> Huber:
    """Parameters from plain numbers."""
    return Huber(jnp.asarray(knee, float), rule)


@cache
def huber(rule: Rule) -> Rule:
    """Huber's M-estimator in one step: R of a channel over its weight min(1, knee / |innovation in sd|).

    The correction by a channel is then bounded however far off it is (Huber 1964; Karlgaard & Schaub 2007 iterate it).
    """
    require_plain(rule)

    def correct(theta: Huber, memory: Tree, z: Innovation) -> Correction:
        sd = jnp.sqrt(jnp.diag(z.H @ z.P @ z.H.T + z.R))
        excess = jnp.maximum(jnp.abs(z.nu) / (theta.knee * sd), 1.0)
        return rule.correct(theta.rule, memory, z._replace(R=inflated(z.R, excess)))

    return rule._replace(
        correct=correct, extrapolate=lambda theta, memory, x0, x: rule.extrapolate(theta.rule, memory, x0, x)
    )


class StudentT(NamedTuple):
    """Parameters of `student_t`."""

    dof: jax.Array  # () degrees of freedom: few are heavy tails, many a Gaussian
    rule: Tree = ()  # parameters of the inner rule


def student_t_params(dof: float = 4.0, rule: Tree = ()) -> StudentT:
    """Parameters from plain numbers."""
    return StudentT(jnp.asarray(dof, float), rule)


@cache
def student_t(rule: Rule, iterations: int = 4) -> Rule:
    """Measurement noise of a block is Student-t: R over a weight found by variational Bayes.

    With d channels of a block there, each iteration takes the weight w = (dof + d) / (dof + E[r' R^-1 r]) with
    E = r' R^-1 r + tr(H P+ H' R^-1), r and P+ after the correction with R / w (Agamennoni et al. 2012, eqs. 12-15).
    Sound fixes have w near 1.
    """
    require_plain(rule)

    def correct(theta: StudentT, memory: Tree, z: Innovation) -> Correction:
        d = by_block(z.valid).sum(1)
        inverse = linalg.inverse(z.R)
        w = jnp.ones(d.shape)
        for _ in range(iterations):
            R = inflated(z.R, jnp.repeat(1 / w, BLOCK))
            K, P = linalg.update(z.P, z.H, R)
            r, spread = z.nu - z.H @ (K @ z.nu), z.H @ P @ z.H.T
            expected = squared_by_block(r, z.R) + by_block(jnp.sum(spread * inverse, axis=1)).sum(1)
            w = (theta.dof + d) / (theta.dof + expected)
        return rule.correct(theta.rule, memory, z._replace(R=inflated(z.R, jnp.repeat(1 / w, BLOCK))))

    def init(n: int, m: int) -> Any:
        require_blocks(m)
        return rule.init(n, m)

    return rule._replace(
        init=init, correct=correct, extrapolate=lambda theta, memory, x0, x: rule.extrapolate(theta.rule, memory, x0, x)
    )
