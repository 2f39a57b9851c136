"""`receiver`: hypotheses of what a GNSS receiver does, side by side: a fault is believed neither soon nor for ever.

A receiver's position and velocity come of one solution and go wrong together: they jump, slide away and come back, one
of the two lies, or both become noise. One Kalman filter a hypothesis runs on the same navigation; the offset (o, o') of
position and velocity in ENU is part of its state. `KINDS` says how it begins and moves.

Weights are the posterior probabilities of a jump Markov process: Bayes' rule over innovations, hazards of going wrong
and of getting well, and a merge by moments for what comes into a hypothesis from several, as an interacting multiple
model has it (Blom & Bar-Shalom 1988). A slide is begun before it is seen, so that it reaches back to navigation that
is not yet spoilt. The estimate is the mixture's mean. After a while no fault is believed any longer: then navigation
may be lost instead, its P is widened, and the fix is taken, so that nothing locks out for ever.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from jaxnav.filters.rule import NEVER, Correction, Innovation, Rule, Transition
from jaxnav.maths import linalg

OFFSET = 6  # o (3,) m, o' (3,) m/s
SOFTLY = 10.0  # s, over which the belief that navigation is lost comes up, and between two times that it is tried
NONE = 1e-300  # a probability


class Kind(NamedTuple):
    """A row of `KINDS`."""

    opened: tuple[float, float] = (0.0, 0.0)  # sd of o, o' at first, in `Receiver.jump`: 1 is anything, 0 is zero
    tied: bool = False  # o grows by o'
    walks: tuple[int, int] = (0, 0)  # of o, o': number in `Receiver.walk`, counted from one; 0 stays
    lies: bool = False  # rarer than others, by `Receiver.lies`
    every: float = 0.0  # s, between two that are begun whatever the fix is like; 0: begun at every fix


KINDS: dict[str, Kind] = {
    "jumped": Kind((1.0, 1.0), tied=True),
    "apart": Kind((1.0, 1.0), lies=True),
    "loose": Kind((1.0, 1.0), walks=(1, 2), lies=True),
    "position": Kind((1.0, 0.0), walks=(1, 0), lies=True),
    "velocity": Kind((0.0, 1.0), walks=(0, 2), lies=True),
    "wander": Kind((0.2, 0.1), walks=(1, 3), lies=True),
    "slide": Kind(tied=True, walks=(0, 2), every=4.0),
    "slide, another": Kind(tied=True, walks=(0, 2), every=4.0),
    "slow slide": Kind(tied=True, walks=(0, 3), every=10.0),
    "slow slide, another": Kind(tied=True, walks=(0, 3), every=10.0),
    "drag-off": Kind(tied=True, walks=(0, 4), every=30.0),
    "drag-off, another": Kind(tied=True, walks=(0, 4), every=30.0),
}
"""What a receiver does beside being healthy, or noisy; of slides that are alike the less likely one is begun anew."""


class Receiver(NamedTuple):
    """Parameters of `receiver`; rates are 1/s."""

    wrong: jax.Array  # () rate of each kind of fault
    lies: jax.Array  # () of that, the share of position and velocity that disagree
    well: jax.Array  # () rate at which a fault ends
    late: jax.Array  # () s, after which navigation is rather lost than the receiver wrong
    lost: jax.Array  # () rate at which a fault is no longer believed, from then on
    noisy: jax.Array  # (2,) m, m/s, sd of what is added to a noisy fix
    jump: jax.Array  # (2,) m, m/s, sd of an offset that is anything
    walk: jax.Array  # (4,) m/sqrt(s) of o; m/s/sqrt(s) of o', fast, slow and very slow
    widened: jax.Array  # (2,) m, m/s, sd of navigation that may be lost


def receiver_params() -> Receiver:
    """Parameters from plain numbers."""
    pairs = (30.0, 4.0), (60.0, 10.0), (3.0, 2.0, 0.3, 0.12), (200.0, 15.0)
    return Receiver(*(jnp.asarray(a, float) for a in (1e-3, 0.3, 0.01, 65.0, 2.0, *pairs)))


class Hypotheses(NamedTuple):
    """Healthy, noisy, and one a row of `KINDS`: M in all, in deviations from the filter's own estimate."""

    dev: jax.Array  # (M, n + 6)
    P: jax.Array  # (M, n + 6, n + 6)
    weight: jax.Array  # (M,) log probability
    age: jax.Array  # (M,) s since the receiver went wrong
    since: jax.Array  # () s since the last correction
    begun: jax.Array  # (k + 1,) s since a slide of each sort was begun, and since navigation was held to be lost;
    #   `NEVER` and more before the first correction


@cache
def receiver(position: int = 0, velocity: int | None = 3) -> Rule:
    """The rule of a filter whose receiver's channels begin at ``position`` and ``velocity``; it sees all channels."""
    names, rows = list(KINDS), [Kind(), Kind(), *KINDS.values()]  # healthy and noisy come first
    now = np.array([i for i, row in enumerate(rows) if i > 1 and not row.every])  # begun at every fix
    slides = np.array([i for i, row in enumerate(rows) if row.every])
    assert [0, 1, *now, *slides] == list(range(len(rows))), "slides are the last rows of KINDS"
    sorts = list(dict.fromkeys(rows[i] for i in slides))
    sort_of = np.array([sorts.index(rows[i]) for i in slides])
    spacing = np.array([sort.every for sort in sorts])

    def init(n: int, m: int) -> Hypotheses:
        count, size = len(rows), n + OFFSET
        weight = jnp.full(count, jnp.log(NONE)).at[0].set(0.0)
        return Hypotheses(
            jnp.zeros((count, size)), jnp.zeros((count, size, size)), weight, jnp.zeros(count), jnp.zeros(()),
            jnp.full(len(sorts) + 1, NEVER),
        )  # fmt: skip

    def transport(theta: Receiver, memory: Hypotheses, moved: Transition, T: jax.Array) -> Hypotheses:
        n = moved.Phi.shape[0]
        tied = jnp.array([float(row.tied) for row in rows])
        density = jnp.concatenate([jnp.zeros(1), theta.walk**2])
        walks = density[np.array([row.walks for row in rows])]  # (M, 2)

        def one(dev: jax.Array, P: jax.Array, grows: jax.Array, walk: jax.Array) -> tuple[jax.Array, jax.Array]:
            A = jnp.eye(n + OFFSET).at[:n, :n].set(moved.Phi).at[n : n + 3, n + 3 :].set(grows * T * jnp.eye(3))
            both = grows * walk[1] * T**2 / 2
            block = jnp.array([[walk[0] * T + grows * walk[1] * T**3 / 3, both], [both, walk[1] * T]])
            Q = jnp.zeros_like(P).at[:n, :n].set(moved.Q).at[n:, n:].set(jnp.kron(block, jnp.eye(3)))
            return A @ dev, linalg.sandwich(A, P) + Q

        dev, P = jax.vmap(one)(memory.dev, memory.P, tied, walks)
        age = memory.age.at[1:].add(T)
        return memory._replace(dev=dev, P=P, age=age, since=memory.since + T, begun=memory.begun + T)

    def correct(theta: Receiver, memory: Hypotheses, z: Innovation) -> Correction:
        n = z.P.shape[0]
        H, own = _with_offsets(z, position, velocity), _own(z.nu.size, position, velocity)
        bare = np.arange(n + OFFSET) < n
        known = jnp.pad(z.P, ((0, OFFSET), (0, OFFSET)))
        P = jnp.where(memory.begun[0] >= NEVER, known, memory.P)
        given = partial(_given, z, H)
        far = jnp.clip((memory.age - theta.late) / SOFTLY, 0.0, 1.0)
        ends = theta.well * memory.since * (1 - far)
        fades = jnp.clip(ends + theta.lost * memory.since * far, 0.0, 0.9)
        old = Parts(memory.dev, P, memory.weight + jnp.log1p(-fades), memory.age)
        # without offsets, which are those of the healthy one and of what turns into it
        plain = Parts(jnp.where(bare, old.dev, 0.0), jnp.where(bare[:, None] & bare, P, 0.0), memory.weight, memory.age)
        sound = jax.tree.map(lambda a: a[0], plain)
        begins = sound.weight + _log(theta.wrong * memory.since)

        def healthy() -> Parts:
            """Itself, faults that end, and navigation that was lost instead."""
            # from time to time only: at every fix, its wide P would spoil what the last trial has become
            gives_up = jnp.where(memory.begun[-1] >= SOFTLY, 0.5 * far, 0.0)
            wide = jnp.diag(jnp.pad(jnp.repeat(theta.widened**2, 3, total_repeat_length=6), (0, n + OFFSET - 6)))
            ended, lost = (plain.weight + _log(chance) for chance in (ends, gives_up))
            dev, P, weight = jax.vmap(given)(
                jnp.concatenate([plain.dev, plain.dev[1:]]),
                jnp.concatenate([plain.P, plain.P[1:] + wide]),
                jnp.concatenate([sound.weight[None], ended[1:], lost[1:]]),
            )
            return _merged(Parts(dev, P, weight, jnp.zeros(weight.shape)))

        def noisy() -> Parts:
            """Itself and the healthy one, by a fix whose R is larger."""
            anew = sound._replace(weight=begins, age=jnp.zeros(()))
            one = _merged(jax.tree.map(lambda a, b: jnp.stack([a[1], b]), old, anew))
            more = z.R + jnp.diag(jnp.where(z.valid, theta.noisy**2 @ own, 0.0))
            dev, P, weight = _given(z._replace(R=more), H, one.dev, one.P, one.weight)
            return Parts(dev, P, weight, one.age)

        def opened() -> Parts:
            """Themselves, and the healthy one with an offset that is anything."""
            variance = (np.array([rows[i].opened for i in now]) * theta.jump) ** 2  # (k, 2)
            spread = jnp.pad(jnp.repeat(variance, 3, axis=1, total_repeat_length=OFFSET), ((0, 0), (n, 0)))
            rare = jnp.where(np.array([rows[i].lies for i in now]), jnp.log(theta.lies), 0.0)
            kept = jax.vmap(given)(old.dev[now], old.P[now], old.weight[now])
            new = jax.vmap(given, (None, 0, 0))(sound.dev, sound.P + jax.vmap(jnp.diag)(spread), begins + rare)
            dev, P, weight = (jnp.stack([a, b], 1) for a, b in zip(kept, new, strict=True))
            return jax.vmap(_merged)(Parts(dev, P, weight, jnp.stack([old.age[now], jnp.zeros(now.size)], 1)))

        renew = memory.begun[:-1] >= spacing

        def sliding() -> Parts:
            """Themselves; of each sort the least likely one is begun anew when it is time."""
            weight = old.weight[slides]
            least = jnp.stack([jnp.argmin(jnp.where(sort_of == i, weight, jnp.inf)) for i in range(len(sorts))])
            fresh = (jnp.arange(slides.size) == least[sort_of]) & renew[sort_of]
            dev, P, weight = jax.vmap(given)(
                jnp.where(fresh[:, None], sound.dev, old.dev[slides]),
                jnp.where(fresh[:, None, None], sound.P, old.P[slides]),
                jnp.where(fresh, sound.weight + _log(theta.wrong * spacing[sort_of]), weight),
            )
            return Parts(dev, P, weight, jnp.where(fresh, 0.0, old.age[slides]))

        single = (jax.tree.map(lambda a: jnp.asarray(a)[None], each) for each in (healthy(), noisy()))
        found = jax.tree.map(lambda *a: jnp.concatenate(a), *single, opened(), sliding())
        mean = _merged(found)
        share = jnp.exp(found.weight - mean.weight)
        # a channel is used where what it says of navigation is believed: by itself, or though the other one lies
        believed = share[0] + share[1] + jnp.stack([share[2 + names.index(each)] for each in ("velocity", "position")])
        after = Hypotheses(
            found.dev - jnp.where(bare, mean.dev, 0.0), found.P, found.weight - mean.weight, found.age, jnp.zeros(()),
            jnp.where(jnp.append(renew, memory.begun[-1] >= SOFTLY), 0.0, memory.begun),
        )  # fmt: skip
        used = z.valid & ((own.sum(0) == 0) | (believed @ own > 0.5))
        return Correction(mean.dev[:n], mean.P[:n, :n], after, used)

    return Rule(init, correct, transport=transport)


class Parts(NamedTuple):
    """Gaussians with their weights, one or many."""

    dev: jax.Array  # (n + 6,) mean
    P: jax.Array  # (n + 6, n + 6)
    weight: jax.Array  # () log
    age: Any  # () s


def _given(z: Innovation, H: jax.Array, dev: jax.Array, P: jax.Array, weight: jax.Array) -> tuple[jax.Array, ...]:
    """Mean, covariance and log weight after a fix: a Kalman correction, and Bayes' rule."""
    S = linalg.sandwich(H, P) + z.R
    nu, inv = z.nu - H @ dev, linalg.inverse(S)
    K = P @ H.T @ inv
    after = linalg.joseph(P, K, H, z.R)
    return dev + K @ nu, after, weight - 0.5 * (nu @ inv @ nu + linalg.log_determinant(S))


def _own(m: int, position: int, velocity: int | None) -> np.ndarray:
    """Which of m channels are a receiver's positions, and which its velocities, (2, m)."""
    own = np.zeros((2, m))
    for row, begin in zip(own, (position, velocity), strict=True):
        if begin is not None:
            row[begin : begin + 3] = 1.0
    return own


def _with_offsets(z: Innovation, position: int, velocity: int | None) -> jax.Array:
    """H (m, n + 6): what a receiver's channels see of the offsets too; nothing where a channel is missing."""
    D = np.zeros((z.nu.size, OFFSET))
    D[position : position + 3, :3] = np.eye(3)
    if velocity is not None:
        D[velocity : velocity + 3, 3:] = np.eye(3)
    return jnp.concatenate([z.H, jnp.where(z.valid[:, None], D, 0.0)], 1)


def _log(probability: Any) -> jax.Array:
    return jnp.log(jnp.clip(probability, NONE, 0.5))


def _merged(parts: Parts) -> Parts:
    """One Gaussian for several (k, ...) by its moments; probabilities add up, ages are means."""
    total = logsumexp(parts.weight)
    share = jnp.exp(parts.weight - total)
    mean = share @ parts.dev
    off = parts.dev - mean
    P = jnp.einsum("m,mij->ij", share, parts.P) + (share[:, None] * off).T @ off
    return Parts(mean, P, total, share @ parts.age)
