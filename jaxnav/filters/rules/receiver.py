"""`receiver`: hypotheses of what a GNSS receiver does, side by side: a fault is believed neither soon nor for ever.

A receiver's position and velocity come of one solution and go wrong together: they jump, slide away and come back, one
of the two lies, or both become noise. One Kalman filter a hypothesis runs on the same navigation; the offset (o, o') of
position and velocity in ENU is part of its state:

    healthy    o = o' = 0
    noisy      white noise of metres and metres per second is added
    jumped     o and o' are anything at first, then o grows by o'
    position   o is anything at first, then walks; o' = 0
    velocity   o' is anything at first; o = 0
    sliding    o = o' = 0 at first, then o' walks and o grows by it: begun every few seconds, some at a time

Weights are the posterior probabilities of a jump Markov process: Bayes' rule over innovations, hazards of going wrong
and of getting well, and for what comes into a hypothesis a merge by moments, as an interacting multiple model has it
(Blom & Bar-Shalom 1988). A slide is begun before it is seen, so that it reaches back to navigation that is not yet
spoilt. The estimate is the mixture's mean. After a while no fault is believed any longer: then the navigation may be
lost instead, its P is widened, and the fix is taken (no lock-out).
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from jaxnav.filters.core import Correction, Innovation, Rule, Transition
from jaxnav.maths import linalg

OFFSET = 6  # o (3,) m, o' (3,) m/s
HEALTHY, NOISY, JUMPED, POSITION, VELOCITY, SLIDES = range(6)
NEVER = -60.0  # log weight that stands for none


class Receiver(NamedTuple):
    """Parameters of `receiver`; rates are 1/s."""

    wrong: jax.Array  # () rate of each kind of fault
    lies: jax.Array  # () of that, the share of position or velocity alone
    well: jax.Array  # () rate at which a fault ends
    late: jax.Array  # () s, after which navigation is rather lost than the receiver wrong
    lost: jax.Array  # () rate of that, from then on
    noisy: jax.Array  # (2,) m, m/s, sd of what is added to a noisy fix
    jump: jax.Array  # (2,) m, m/s, sd of an offset that is anything
    walk: jax.Array  # (2,) m/sqrt(s) of a position that lies; m/s/sqrt(s) of a velocity that slides
    widened: jax.Array  # (2,) m, m/s, sd of navigation that may be lost


def receiver_params() -> Receiver:
    """Parameters from plain numbers."""
    pairs = (30.0, 4.0), (60.0, 10.0), (3.0, 2.0), (200.0, 15.0)
    return Receiver(*(jnp.asarray(a, float) for a in (1e-3, 0.3, 0.01, 65.0, 0.2, *pairs)))


class Hypotheses(NamedTuple):
    """M of them, in deviations from the filter's own estimate."""

    dev: jax.Array  # (M, n + 6)
    P: jax.Array  # (M, n + 6, n + 6)
    weight: jax.Array  # (M,) log probability
    age: jax.Array  # (M,) s since the receiver went wrong
    since: jax.Array  # () s since the last correction
    begun: jax.Array  # () s since a slide was begun; inf before the first correction


@cache
def receiver(position: int, velocity: int | None, slides: int = 2, every: float = 4.0) -> Rule:
    """The rule of a filter whose receiver's channels begin at ``position`` and ``velocity``; it sees all channels.

    ``slides`` are held at a time and begun every so many s.
    """
    count = SLIDES + slides
    kinds = np.array([HEALTHY, NOISY, JUMPED, POSITION, VELOCITY, *[SLIDES] * slides])
    tied = np.isin(kinds, (JUMPED, SLIDES)).astype(float)  # o grows by o'
    jumps = np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])  # of what is anything in JUMPED, POSITION, VELOCITY

    def init(n: int, m: int) -> Hypotheses:
        size, weight = n + OFFSET, jnp.full(count, NEVER).at[HEALTHY].set(0.0)
        return Hypotheses(
            jnp.zeros((count, size)), jnp.zeros((count, size, size)), weight, jnp.zeros(count), jnp.zeros(()),
            jnp.array(jnp.inf),
        )  # fmt: skip

    def transport(theta: Receiver, memory: Hypotheses, moved: Transition, T: jax.Array) -> Hypotheses:
        n = moved.Phi.shape[0]

        def one(dev, P, kind, grows):
            A = jnp.eye(n + OFFSET).at[:n, :n].set(moved.Phi)
            A = A.at[n : n + 3, n + 3 :].set(grows * T * jnp.eye(3))
            white = jnp.where(kind == POSITION, theta.walk[0] ** 2, 0.0) * T
            pushed = jnp.where((kind == SLIDES), theta.walk[1] ** 2, jnp.where(kind == JUMPED, 0.25, 0.0))
            block = jnp.kron(jnp.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]), jnp.eye(3)) * pushed
            Q = jnp.zeros_like(P).at[:n, :n].set(moved.Q).at[n:, n:].set(block)
            Q = Q.at[n : n + 3, n : n + 3].add(white * jnp.eye(3))
            return A @ dev, linalg.sandwich(A, P) + Q

        dev, P = jax.vmap(one)(memory.dev, memory.P, jnp.asarray(kinds), jnp.asarray(tied))
        return memory._replace(
            dev=dev, P=P, age=memory.age.at[NOISY:].add(T), since=memory.since + T, begun=memory.begun + T
        )

    def correct(theta: Receiver, memory: Hypotheses, z: Innovation) -> Correction:
        n, m = z.P.shape[0], z.nu.size
        H = _with_offsets(z, position, velocity)
        own = np.zeros((2, m))  # the receiver's channels: positions, velocities
        for i, begin in enumerate((position, velocity)):
            if begin is not None:
                own[i, begin : begin + 3] = 1.0
        first = jnp.isinf(memory.begun)
        start = jnp.zeros((n + OFFSET, n + OFFSET)).at[:n, :n].set(z.P)
        P, weight, age, dt = jnp.where(first, start, memory.P), memory.weight, memory.age, memory.since

        def known(dev, P, weight, noise=(0.0, 0.0)):
            """A hypothesis after this fix."""
            R = z.R + jnp.diag(jnp.where(z.valid, noise[0] ** 2 * own[0] + noise[1] ** 2 * own[1], 0.0))
            S = linalg.sandwich(H, P) + R
            nu, inv = z.nu - H @ dev, linalg.inverse(S)
            K = P @ H.T @ inv
            P = linalg.joseph(P, K, H, R)
            return dev + K @ nu, P, weight - 0.5 * (nu @ inv @ nu + linalg.log_determinant(S))

        far = jax.nn.sigmoid((age - theta.late) / 3.0)
        ends, gives_up = theta.well * dt, theta.lost * dt * far
        stays = weight + jnp.log1p(-jnp.clip(ends + gives_up, 0.0, 0.9))
        begins = jnp.log(jnp.clip(theta.wrong * dt, 1e-300, 0.5))
        # into the healthy one: itself, faults that end, and navigation that was lost instead
        bare = jnp.arange(n + OFFSET) < n
        dev0, P0 = jnp.where(bare, memory.dev, 0.0), jnp.where(bare[:, None] & bare, P, 0.0)
        wide = jnp.zeros(n + OFFSET).at[:3].set(theta.widened[0] ** 2).at[3:6].set(theta.widened[1] ** 2)
        into = (
            jnp.concatenate([dev0, dev0[1:]]),
            jnp.concatenate([P0, P0[1:] + jnp.diag(wide)]),
            jnp.concatenate([weight[:1], weight[1:] + jnp.log(jnp.maximum(ends, 1e-300)),
                             weight[1:] + jnp.log(jnp.maximum(gives_up[1:], 1e-300))]),
        )  # fmt: skip
        dev, P_in, weights = jax.vmap(known)(*into)
        healthy = _merged(dev, P_in, weights, jnp.zeros(2 * count - 1))
        # into the others: themselves, and the healthy one
        loud = _merged(
            jnp.stack([memory.dev[NOISY], dev0[0]]), jnp.stack([P[NOISY], P0[0]]),
            jnp.stack([stays[NOISY], weight[0] + begins]), jnp.stack([age[NOISY], 0.0]),
        )  # fmt: skip
        noisy = (*known(loud[0], loud[1], loud[2], theta.noisy), loud[3])
        opened = jnp.repeat((jumps * theta.jump) ** 2, 3, axis=1, total_repeat_length=OFFSET)  # (3, 6)
        anew = P0[0] + jax.vmap(jnp.diag)(jnp.pad(opened, ((0, 0), (n, 0))))
        share = jnp.log(jnp.stack([jnp.ones(()), theta.lies, theta.lies]))
        old = slice(JUMPED, SLIDES)
        kept = jax.vmap(known)(memory.dev[old], P[old], stays[old])
        new = jax.vmap(known)(jnp.broadcast_to(dev0[0], (3, n + OFFSET)), anew, weight[0] + begins + share)
        both = [jnp.stack([a, b], 1) for a, b in zip(kept, new, strict=True)]
        jumped = jax.vmap(_merged)(both[0], both[1], both[2], jnp.stack([age[old], jnp.zeros(3)], 1))
        # the least likely slide is begun anew
        renew = memory.begun >= every
        least = (jnp.arange(slides) == jnp.argmin(stays[SLIDES:])) & renew
        fresh = weight[0] + jnp.log(jnp.clip(theta.wrong * every, 1e-300, 0.5))
        sliding = jax.vmap(known)(
            jnp.where(least[:, None], dev0[0], memory.dev[SLIDES:]),
            jnp.where(least[:, None, None], P0[0], P[SLIDES:]),
            jnp.where(least, fresh, stays[SLIDES:]),
        )
        old_age = jnp.where(least, 0.0, age[SLIDES:])
        one = lambda a: jnp.asarray(a)[None]  # noqa: E731
        dev, P, weight, age = (
            jnp.concatenate([one(a), one(b), c, d])
            for a, b, c, d in zip(healthy, noisy, jumped, (*sliding, old_age), strict=True)
        )
        weight = jnp.maximum(weight - logsumexp(weight), NEVER)
        share = jax.nn.softmax(weight)
        delta = share @ dev
        P_mean, dev = _covariance(share, dev - delta, P), dev - jnp.where(bare, delta, 0.0)
        used = z.valid & ((own.sum(0) == 0) | (share[HEALTHY] + share[NOISY] > 0.5))
        begun = jnp.where(first | renew, 0.0, memory.begun)
        after = Hypotheses(dev, P, weight, age, jnp.zeros(()), begun)
        return Correction(delta[:n], P_mean[:n, :n], after, used)

    return Rule(init, correct, transport=transport)


def _with_offsets(z: Innovation, position: int, velocity: int | None) -> jax.Array:
    """H (m, n + 6): what a receiver's channels see of the offsets too; nothing where a channel is missing."""
    D = np.zeros((z.nu.size, OFFSET))
    D[position : position + 3, :3] = np.eye(3)
    if velocity is not None:
        D[velocity : velocity + 3, 3:] = np.eye(3)
    return jnp.concatenate([z.H, jnp.where(z.valid[:, None], D, 0.0)], 1)


def _covariance(share: jax.Array, dev: jax.Array, P: jax.Array) -> jax.Array:
    """Covariance of a mixture, from deviations (M, n) from its mean and the covariances (M, n, n) of its parts."""
    return jnp.einsum("m,mij->ij", share, P) + (share[:, None] * dev).T @ dev


def _merged(dev: jax.Array, P: jax.Array, weight: jax.Array, age: jax.Array) -> tuple[jax.Array, ...]:
    """One Gaussian for several (k, ...) by its moments; log weights add up, ages are means."""
    total = logsumexp(weight)
    share = jnp.exp(weight - total)
    mean = share @ dev
    return mean, _covariance(share, dev - mean, P), total, share @ age
