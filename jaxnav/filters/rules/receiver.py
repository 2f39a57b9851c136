"""`receiver`: an interacting multiple model of faults of a GNSS receiver (Blom & Bar-Shalom 1988).

A receiver's position and velocity come from one solution and fail together: both jump, drift away and return, one of
the two disagrees with the other, or both become noisy. One Kalman filter per hypothesis runs on the same navigation;
the offset (o, o') of position and velocity in ENU is part of its state. `FAULT_MODELS` gives its initial covariance and
its process.

Weights are the posterior probabilities of a jump Markov process: Bayes' rule over innovations, rates of failure and
recovery, and moment matching of all transitions into a hypothesis. A ramp starts before it shows, so that it reaches
back to navigation without its error. The estimate is the mixture's mean. After a timeout the probability of faults goes
to navigation that is lost: its P is widened and the fix is taken, so that no fix is rejected for ever.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from jaxnav.filters.rule import NEVER_USED_AGE, Correction, Innovation, Rule, Transition
from jaxnav.maths import linalg
from jaxnav.types import Array

OFFSET = 6  # o (3,) m, o' (3,) m/s
TIMEOUT_RAMP = 10.0  # s, in which the probability of lost navigation rises, and between two trials of it
MIN_PROBABILITY = 1e-300  # instead of zero, whose logarithm is not finite


class FaultModel(NamedTuple):
    """A row of `FAULT_MODELS`."""

    offset_sd: tuple[float, float] = (0.0, 0.0)  # initial sd of o, o', in `Receiver.jump`: 1 is any offset, 0 is zero
    integrates: bool = False  # o is the integral of o'
    random_walk: tuple[int, int] = (0, 0)  # of o, o': number in `Receiver.walk`, counted from one; 0: constant
    disagreement: bool = False  # position and velocity disagree: rarer, by `Receiver.disagreement`
    restart_interval: float = 0.0  # s between restarts, whatever the fix; 0: restarted at every fix


FAULT_MODELS: dict[str, FaultModel] = {
    "jump": FaultModel((1.0, 1.0), integrates=True),
    "independent jumps": FaultModel((1.0, 1.0), disagreement=True),
    "independent jumps and walks": FaultModel((1.0, 1.0), random_walk=(1, 2), disagreement=True),
    "position": FaultModel((1.0, 0.0), random_walk=(1, 0), disagreement=True),
    "velocity": FaultModel((0.0, 1.0), random_walk=(0, 2), disagreement=True),
    "random walk": FaultModel((0.2, 0.1), random_walk=(1, 3), disagreement=True),
    "ramp": FaultModel(integrates=True, random_walk=(0, 2), restart_interval=4.0),
    "ramp, second": FaultModel(integrates=True, random_walk=(0, 2), restart_interval=4.0),
    "slow ramp": FaultModel(integrates=True, random_walk=(0, 3), restart_interval=10.0),
    "slow ramp, second": FaultModel(integrates=True, random_walk=(0, 3), restart_interval=10.0),
    "drag-off": FaultModel(integrates=True, random_walk=(0, 4), restart_interval=30.0),
    "drag-off, second": FaultModel(integrates=True, random_walk=(0, 4), restart_interval=30.0),
}
"""Faults in addition to healthy and noisy; of ramps with equal parameters the less probable one is restarted."""


class Receiver(NamedTuple):
    """Parameters of `receiver`; rates are 1/s."""

    wrong: jax.Array  # () rate of each kind of fault
    disagreement: jax.Array  # () factor on that rate where position and velocity disagree
    well: jax.Array  # () rate at which a fault ends
    late: jax.Array  # () s, timeout after which navigation is lost rather than the receiver wrong
    lost: jax.Array  # () rate at which the probability of a fault falls, from then on
    noisy: jax.Array  # (2,) m, m/s, sd of the added noise of a noisy fix
    jump: jax.Array  # (2,) m, m/s, sd of an unknown offset
    walk: jax.Array  # (4,) m/sqrt(s) of o; m/s/sqrt(s) of o', fast, slow and very slow
    widened: jax.Array  # (2,) m, m/s, sd of navigation that may be lost


def receiver_params() -> Receiver:
    """Return the default parameters."""
    pairs = (30.0, 4.0), (60.0, 10.0), (3.0, 2.0, 0.3, 0.12), (200.0, 15.0)
    return Receiver(*(jnp.asarray(a, float) for a in (1e-3, 0.3, 0.01, 65.0, 2.0, *pairs)))


class Hypotheses(NamedTuple):
    """Healthy, noisy, and one per row of `FAULT_MODELS`: M in all, as deviations from the filter's estimate."""

    dev: jax.Array  # (M, n + 6)
    P: jax.Array  # (M, n + 6, n + 6)
    weight: jax.Array  # (M,) log probability
    age: jax.Array  # (M,) s since the receiver went wrong
    since: jax.Array  # () s since the last correction
    since_restart: jax.Array  # (k + 1,) s since a ramp of each kind was restarted, and since lost navigation was tried;
    #   `NEVER_USED_AGE` and more before the first correction


@cache
def receiver(position: int = 0, velocity: int | None = 3) -> Rule:
    """Return the rule of a filter with the receiver's first channels at ``position`` and ``velocity``."""
    names, rows = (
        list(FAULT_MODELS),
        [FaultModel(), FaultModel(), *FAULT_MODELS.values()],
    )  # healthy and noisy come first
    now = np.array([i for i, row in enumerate(rows) if i > 1 and not row.restart_interval])  # restarted at every fix
    ramps = np.array([i for i, row in enumerate(rows) if row.restart_interval])
    assert [0, 1, *now, *ramps] == list(range(len(rows))), "ramps are the last rows of FAULT_MODELS"
    kinds = list(dict.fromkeys(rows[i] for i in ramps))
    kind_of = np.array([kinds.index(rows[i]) for i in ramps])
    spacing = np.array([kind.restart_interval for kind in kinds])

    def init(n: int, m: int) -> Hypotheses:
        count, size = len(rows), n + OFFSET
        weight = jnp.full(count, jnp.log(MIN_PROBABILITY)).at[0].set(0.0)
        return Hypotheses(
            jnp.zeros((count, size)),
            jnp.zeros((count, size, size)),
            weight,
            jnp.zeros(count),
            jnp.zeros(()),
            jnp.full(len(kinds) + 1, NEVER_USED_AGE),
        )

    def transport(theta: Receiver, memory: Hypotheses, moved: Transition, T: jax.Array) -> Hypotheses:
        n = moved.Phi.shape[0]
        integrates = jnp.array([float(row.integrates) for row in rows])
        density = jnp.concatenate([jnp.zeros(1), theta.walk**2])
        random_walk = density[np.array([row.random_walk for row in rows])]  # (M, 2)

        def one(dev: jax.Array, P: jax.Array, grows: jax.Array, walk: jax.Array) -> tuple[jax.Array, jax.Array]:
            A = jnp.eye(n + OFFSET).at[:n, :n].set(moved.Phi).at[n : n + 3, n + 3 :].set(grows * T * jnp.eye(3))
            both = grows * walk[1] * T**2 / 2
            block = jnp.array([[walk[0] * T + grows * walk[1] * T**3 / 3, both], [both, walk[1] * T]])
            Q = jnp.zeros_like(P).at[:n, :n].set(moved.Q).at[n:, n:].set(jnp.kron(block, jnp.eye(3)))
            return A @ dev, linalg.sandwich(A, P) + Q

        dev, P = jax.vmap(one)(memory.dev, memory.P, integrates, random_walk)
        age = memory.age.at[1:].add(T)
        return memory._replace(dev=dev, P=P, age=age, since=memory.since + T, since_restart=memory.since_restart + T)

    def correct(theta: Receiver, memory: Hypotheses, z: Innovation) -> Correction:
        n = z.P.shape[0]
        H, channels = _with_offsets(z, position, velocity), _channels(z.nu.size, position, velocity)
        bare = np.arange(n + OFFSET) < n
        known = jnp.pad(z.P, ((0, OFFSET), (0, OFFSET)))
        P = jnp.where(memory.since_restart[0] >= NEVER_USED_AGE, known, memory.P)
        update = partial(kalman_update, z, H)
        timeout_ramp = jnp.clip((memory.age - theta.late) / TIMEOUT_RAMP, 0.0, 1.0)
        ends = theta.well * memory.since * (1 - timeout_ramp)
        fades = jnp.clip(ends + theta.lost * memory.since * timeout_ramp, 0.0, 0.9)
        old = Parts(memory.dev, P, memory.weight + jnp.log1p(-fades), memory.age)
        # without offsets: the healthy hypothesis, and faults that end
        plain = Parts(jnp.where(bare, old.dev, 0.0), jnp.where(bare[:, None] & bare, P, 0.0), memory.weight, memory.age)
        healthy = jax.tree.map(lambda a: a[0], plain)
        starts = healthy.weight + _log(theta.wrong * memory.since)

        def merge_healthy() -> Parts:
            """Merge the healthy hypothesis, faults that end, and lost navigation."""
            # at intervals only: at every fix, the wide P would replace the result of the last trial
            gives_up = jnp.where(memory.since_restart[-1] >= TIMEOUT_RAMP, 0.5 * timeout_ramp, 0.0)
            wide = jnp.diag(jnp.pad(jnp.repeat(theta.widened**2, 3, total_repeat_length=6), (0, n + OFFSET - 6)))
            ended, lost = (plain.weight + _log(chance) for chance in (ends, gives_up))
            dev, P, weight = jax.vmap(update)(
                jnp.concatenate([plain.dev, plain.dev[1:]]),
                jnp.concatenate([plain.P, plain.P[1:] + wide]),
                jnp.concatenate([healthy.weight[None], ended[1:], lost[1:]]),
            )
            return moment_match(Parts(dev, P, weight, jnp.zeros(weight.shape)))

        def merge_noisy() -> Parts:
            """Merge the noisy and the healthy hypothesis, updated with a larger R."""
            restarted = healthy._replace(weight=starts, age=jnp.zeros(()))
            one = moment_match(jax.tree.map(lambda a, b: jnp.stack([a[1], b]), old, restarted))
            more = z.R + jnp.diag(jnp.where(z.valid, theta.noisy**2 @ channels, 0.0))
            dev, P, weight = kalman_update(z._replace(R=more), H, one.dev, one.P, one.weight)
            return Parts(dev, P, weight, one.age)

        def merge_offsets() -> Parts:
            """Merge each fault with an offset, and the healthy hypothesis with a new offset."""
            variance = (np.array([rows[i].offset_sd for i in now]) * theta.jump) ** 2  # (k, 2)
            spread = jnp.pad(jnp.repeat(variance, 3, axis=1, total_repeat_length=OFFSET), ((0, 0), (n, 0)))
            rare = jnp.where(np.array([rows[i].disagreement for i in now]), jnp.log(theta.disagreement), 0.0)
            kept = jax.vmap(update)(old.dev[now], old.P[now], old.weight[now])
            new = jax.vmap(update, (None, 0, 0))(healthy.dev, healthy.P + jax.vmap(jnp.diag)(spread), starts + rare)
            dev, P, weight = (jnp.stack([a, b], 1) for a, b in zip(kept, new, strict=True))
            return jax.vmap(moment_match)(Parts(dev, P, weight, jnp.stack([old.age[now], jnp.zeros(now.size)], 1)))

        renew = memory.since_restart[:-1] >= spacing

        def merge_ramps() -> Parts:
            """Update the ramps; of each kind the least probable one is restarted at its interval."""
            weight = old.weight[ramps]
            least = jnp.stack([jnp.argmin(jnp.where(kind_of == i, weight, jnp.inf)) for i in range(len(kinds))])
            restart = (jnp.arange(ramps.size) == least[kind_of]) & renew[kind_of]
            dev, P, weight = jax.vmap(update)(
                jnp.where(restart[:, None], healthy.dev, old.dev[ramps]),
                jnp.where(restart[:, None, None], healthy.P, old.P[ramps]),
                jnp.where(restart, healthy.weight + _log(theta.wrong * spacing[kind_of]), weight),
            )
            return Parts(dev, P, weight, jnp.where(restart, 0.0, old.age[ramps]))

        single = (jax.tree.map(lambda a: jnp.asarray(a)[None], each) for each in (merge_healthy(), merge_noisy()))
        found = jax.tree.map(lambda *a: jnp.concatenate(a), *single, merge_offsets(), merge_ramps())
        mean = moment_match(found)
        share = jnp.exp(found.weight - mean.weight)
        # a channel is used where it is probably healthy: with both, or with a fault of the other one alone
        accepted = share[0] + share[1] + jnp.stack([share[2 + names.index(each)] for each in ("velocity", "position")])
        after = Hypotheses(
            found.dev - jnp.where(bare, mean.dev, 0.0),
            found.P,
            found.weight - mean.weight,
            found.age,
            jnp.zeros(()),
            jnp.where(jnp.append(renew, memory.since_restart[-1] >= TIMEOUT_RAMP), 0.0, memory.since_restart),
        )
        used = z.valid & ((channels.sum(0) == 0) | (accepted @ channels > 0.5))
        return Correction(mean.dev[:n], mean.P[:n, :n], after, used)

    return Rule(init, correct, transport=transport)


class Parts(NamedTuple):
    """Gaussians with their weights, one or many."""

    dev: jax.Array  # (n + 6,) mean
    P: jax.Array  # (n + 6, n + 6)
    weight: jax.Array  # () log
    age: Array  # () s


def kalman_update(
    z: Innovation, H: jax.Array, dev: jax.Array, P: jax.Array, weight: jax.Array
) -> tuple[jax.Array, ...]:
    """Return mean, covariance and log weight after a fix: Kalman update and Bayes' rule."""
    S = linalg.sandwich(H, P) + z.R
    nu, (inv, log_det) = z.nu - H @ dev, linalg.swept(S)
    K = P @ H.T @ inv
    after = linalg.joseph(P, K, H, z.R)
    return dev + K @ nu, after, weight - 0.5 * (nu @ inv @ nu + log_det)


def _channels(m: int, position: int, velocity: int | None) -> np.ndarray:
    """Return 1 for the receiver's position and velocity among m channels, (2, m)."""
    channels = np.zeros((2, m))
    for row, begin in zip(channels, (position, velocity), strict=True):
        if begin is not None:
            row[begin : begin + 3] = 1.0
    return channels


def _with_offsets(z: Innovation, position: int, velocity: int | None) -> jax.Array:
    """Return H (m, n + 6) with the offsets' columns; zero where a channel is missing."""
    D = np.zeros((z.nu.size, OFFSET))
    D[position : position + 3, :3] = np.eye(3)
    if velocity is not None:
        D[velocity : velocity + 3, 3:] = np.eye(3)
    return jnp.concatenate([z.H, jnp.where(z.valid[:, None], D, 0.0)], 1)


def _log(probability: Any) -> jax.Array:
    return jnp.log(jnp.clip(probability, MIN_PROBABILITY, 0.5))


def moment_match(parts: Parts) -> Parts:
    """Merge Gaussians (k, ...) by moment matching; probabilities add up, ages are means."""
    total = logsumexp(parts.weight)
    share = jnp.exp(parts.weight - total)
    mean = share @ parts.dev
    off = parts.dev - mean
    P = jnp.einsum("m,mij->ij", share, parts.P) + (share[:, None] * off).T @ off
    return Parts(mean, P, total, share @ parts.age)
