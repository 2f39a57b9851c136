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

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from jaxnav.filters.core import Correction, Innovation, Rule, Transition
from jaxnav.maths import linalg

OFFSET = 6  # o (3,) m, o' (3,) m/s
SOFTLY = 10.0  # s, over which the belief that navigation is lost comes up, and between two times that it is tried
NONE = 1e-300  # a probability
LONG = 1e9  # s, before the first correction; a memory is finite


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
    walk: jax.Array  # (3,) m/sqrt(s) of o; m/s/sqrt(s) of o', fast and slow
    widened: jax.Array  # (2,) m, m/s, sd of navigation that may be lost


def receiver_params() -> Receiver:
    """Parameters from plain numbers."""
    pairs = (30.0, 4.0), (60.0, 10.0), (3.0, 2.0, 0.3), (200.0, 15.0)
    return Receiver(*(jnp.asarray(a, float) for a in (1e-3, 0.3, 0.01, 65.0, 2.0, *pairs)))


class Hypotheses(NamedTuple):
    """Healthy, noisy, and one a row of `KINDS`: M in all, in deviations from the filter's own estimate."""

    dev: jax.Array  # (M, n + 6)
    P: jax.Array  # (M, n + 6, n + 6)
    weight: jax.Array  # (M,) log probability
    age: jax.Array  # (M,) s since the receiver went wrong
    since: jax.Array  # () s since the last correction
    begun: jax.Array  # (k + 1,) s since a slide of each sort was begun, and since navigation was held to be lost;
    #   `LONG` before the first correction


@cache
def receiver(position: int = 0, velocity: int | None = 3) -> Rule:
    """The rule of a filter whose receiver's channels begin at ``position`` and ``velocity``; it sees all channels."""
    names, rows = list(KINDS), list(KINDS.values())
    count = 2 + len(rows)
    open_now = [i for i, row in enumerate(rows) if not row.every]
    slides = [i for i, row in enumerate(rows) if row.every]
    sorts = list(dict.fromkeys(rows[i] for i in slides))
    sort_of = np.array([sorts.index(rows[i]) for i in slides])

    def init(n: int, m: int) -> Hypotheses:
        size, weight = n + OFFSET, jnp.full(count, jnp.log(NONE)).at[0].set(0.0)
        return Hypotheses(
            jnp.zeros((count, size)), jnp.zeros((count, size, size)), weight, jnp.zeros(count), jnp.zeros(()),
            jnp.full(len(sorts) + 1, LONG),
        )  # fmt: skip

    def transport(theta: Receiver, memory: Hypotheses, moved: Transition, T: jax.Array) -> Hypotheses:
        n = moved.Phi.shape[0]
        still = Kind()
        tied = jnp.array([float(row.tied) for row in (still, still, *rows)])
        density = jnp.concatenate([jnp.zeros(1), theta.walk**2])
        walks = density[np.array([row.walks for row in (still, still, *rows)])]  # (M, 2)

        def one(dev, P, grows, walk):
            A = jnp.eye(n + OFFSET).at[:n, :n].set(moved.Phi).at[n : n + 3, n + 3 :].set(grows * T * jnp.eye(3))
            both = grows * walk[1] * T**2 / 2
            block = jnp.array([[walk[0] * T + grows * walk[1] * T**3 / 3, both], [both, walk[1] * T]])
            Q = jnp.zeros_like(P).at[:n, :n].set(moved.Q).at[n:, n:].set(jnp.kron(block, jnp.eye(3)))
            return A @ dev, linalg.sandwich(A, P) + Q

        dev, P = jax.vmap(one)(memory.dev, memory.P, tied, walks)
        age = memory.age.at[1:].add(T)
        return memory._replace(dev=dev, P=P, age=age, since=memory.since + T, begun=memory.begun + T)

    def correct(theta: Receiver, memory: Hypotheses, z: Innovation) -> Correction:
        n, m = z.P.shape[0], z.nu.size
        size = n + OFFSET
        H, own = _with_offsets(z, position, velocity), _own(m, position, velocity)
        bare = np.arange(size) < n
        known = jnp.zeros((size, size)).at[:n, :n].set(z.P)
        dev, age, dt = memory.dev, memory.age, memory.since
        P = jnp.where(memory.begun[0] >= LONG, known, memory.P)

        def given(dev, P, weight, noise=(0.0, 0.0)):
            """A hypothesis after this fix."""
            R = z.R + jnp.diag(jnp.where(z.valid, noise[0] ** 2 * own[0] + noise[1] ** 2 * own[1], 0.0))
            S = linalg.sandwich(H, P) + R
            nu, inv = z.nu - H @ dev, linalg.inverse(S)
            K = P @ H.T @ inv
            after = linalg.joseph(P, K, H, R)
            return dev + K @ nu, after, weight - 0.5 * (nu @ inv @ nu + linalg.log_determinant(S))

        far = jnp.clip((age - theta.late) / SOFTLY, 0.0, 1.0)
        ends, weight = theta.well * dt * (1 - far), memory.weight
        stays = weight + jnp.log1p(-jnp.clip(ends + theta.lost * dt * far, 0.0, 0.9))
        # what is lost is tried from time to time: at every fix, its wide P would spoil what the last trial has become
        tried = memory.begun[-1] >= SOFTLY
        gives_up = jnp.where(tried, 0.5 * far, 0.0)
        # into the healthy one: itself, faults that end, and navigation that was lost instead
        dev0, P0 = jnp.where(bare, dev, 0.0), jnp.where(bare[:, None] & bare, P, 0.0)
        wide = jnp.diag(jnp.pad(jnp.repeat(theta.widened**2, 3, total_repeat_length=6), (0, size - 6)))
        into = jax.vmap(given)(
            jnp.concatenate([dev0, dev0[1:]]),
            jnp.concatenate([P0, P0[1:] + wide]),
            jnp.concatenate([weight[:1], weight[1:] + _log(ends[1:]), weight[1:] + _log(gives_up[1:])]),
        )
        healthy = _merged(into[0], into[1], into[2], jnp.zeros(2 * count - 1))
        # into the noisy one: itself and the healthy one
        begins = weight[0] + _log(theta.wrong * dt)
        loud = _merged(
            jnp.stack([dev[1], dev0[0]]), jnp.stack([P[1], P0[0]]), jnp.stack([stays[1], begins]),
            jnp.stack([age[1], jnp.zeros(())]),
        )  # fmt: skip
        noisy = (*given(loud[0], loud[1], loud[2], theta.noisy), loud[3])
        # into offsets that open at once: themselves and the healthy one
        now = 2 + np.array(open_now)
        opened = np.array([rows[i].opened for i in open_now]) * theta.jump
        anew = jax.vmap(jnp.diag)(
            jnp.pad(jnp.repeat(opened**2, 3, axis=1, total_repeat_length=OFFSET), ((0, 0), (n, 0)))
        )
        rare = np.array([rows[i].lies for i in open_now])
        kept = jax.vmap(given)(dev[now], P[now], stays[now])
        new = jax.vmap(given, (None, 0, 0))(dev0[0], P0[0] + anew, begins + jnp.where(rare, jnp.log(theta.lies), 0.0))
        both = [jnp.stack([a, b], 1) for a, b in zip(kept, new, strict=True)]
        jumped = jax.vmap(_merged)(both[0], both[1], both[2], jnp.stack([age[now], jnp.zeros(now.size)], 1))
        # slides: of each sort the least likely one is begun anew from time to time
        late = 2 + np.array(slides)
        spacing = np.array([sort.every for sort in sorts])
        renew = memory.begun[:-1] >= spacing
        least = jnp.stack([jnp.argmin(jnp.where(sort_of == i, stays[late], jnp.inf)) for i in range(len(sorts))])
        fresh = (jnp.arange(late.size) == least[sort_of]) & renew[sort_of]
        chance = weight[0] + _log(theta.wrong * spacing[sort_of])
        sliding = jax.vmap(given)(
            jnp.where(fresh[:, None], dev0[0], dev[late]), jnp.where(fresh[:, None, None], P0[0], P[late]),
            jnp.where(fresh, chance, stays[late]),
        )  # fmt: skip
        parts = [[a[None] for a in healthy], [jnp.asarray(a)[None] for a in noisy], jumped,
                 [*sliding, jnp.where(fresh, 0.0, age[late])]]  # fmt: skip
        order = np.argsort([0, 1, *now, *late])
        dev, P, weight, age = (jnp.concatenate(each)[order] for each in zip(*parts, strict=True))
        share = jax.nn.softmax(weight)
        delta = share @ dev
        mixed = _covariance(share, dev - delta, P)[:n, :n]
        # a channel is used where what it says of navigation is believed: by itself, or though the other one lies
        sound = share[0] + share[1] + jnp.stack([share[2 + names.index(n)] for n in ("velocity", "position")])
        after = Hypotheses(
            dev - jnp.where(bare, delta, 0.0), P, weight - logsumexp(weight), age, jnp.zeros(()),
            jnp.where(jnp.append(renew, tried), 0.0, memory.begun),
        )  # fmt: skip
        return Correction(delta[:n], mixed, after, z.valid & ((own.sum(0) == 0) | (sound @ own > 0.5)))

    return Rule(init, correct, transport=transport)


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


def _covariance(share: jax.Array, dev: jax.Array, P: jax.Array) -> jax.Array:
    """Of a mixture, from deviations (M, n) from its mean and the covariances (M, n, n) of its parts."""
    return jnp.einsum("m,mij->ij", share, P) + (share[:, None] * dev).T @ dev


def _merged(dev: jax.Array, P: jax.Array, weight: jax.Array, age: jax.Array) -> tuple[jax.Array, ...]:
    """One Gaussian for several (k, ...) by its moments; probabilities add up, ages are means."""
    total = logsumexp(weight)
    share = jnp.exp(weight - total)
    mean = share @ dev
    return mean, _covariance(share, dev - mean, P), total, share @ age
