"""Likelihood of free parameters in recordings' training parts: J of `tuning.recordings.recorded`, its information."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import CHUNK, LaneRecord, lanes, repeated, taken
from jaxnav.filters.run import FREEDOM
from jaxnav.filters.scores import gaussian_scale, position_noise, student
from jaxnav.maths.units import TICK
from jaxnav.measurements import MEASUREMENTS
from jaxnav.measurements.measurement import tested_alone
from jaxnav.types import Epoch, Leaf, Nav, Params
from tuning.fit.transforms import Spec, join, split
from tuning.recordings.parts import Used, ages
from tuning.recordings.priors import kind_of
from tuning.uncertainty import Information


class ScoreSums(NamedTuple):
    """Sums over the training part: value (), score (P,), information (P, P), and number of terms."""

    value: Leaf
    score: Leaf
    fisher: Leaf
    number: Leaf


MAX_LANE_EPOCHS = 200_000  # that are held at a time, some 100 MB; more go one phase of windows after the other
STEP = 1e-4  # of unconstrained numbers, of the differences that derivatives are: right to 1e-5 of the largest


class Terms(NamedTuple):
    """Negative log-likelihood (N,), score (N, P) and information (N, P, P) of N residuals."""

    value: np.ndarray
    score: np.ndarray
    fisher: np.ndarray


def gaussian_terms(
    nu: np.ndarray, S: np.ndarray, valid: np.ndarray, dnu: np.ndarray, dS: np.ndarray, heavy: np.ndarray
) -> Terms:
    """Return the terms of residuals, those of a Gaussian or a Student t of `FREEDOM`, on the host.

    Args:
        nu: (N, m) residuals, 0 on missing channels.
        S: (N, m, m) their covariances, identity rows on missing channels.
        valid: (N, m) bool.
        dnu: (N, P, m) derivatives.
        dS: (N, P, m, m) likewise.
        heavy: (N,) bool, by a Student t.
    """
    inv, m = np.linalg.inv(S), valid.sum(1)
    w = np.einsum("nij,nj->ni", inv, nu)
    square, A = (nu * w).sum(1), inv[:, None] @ dS
    near = 0.5 * (square + m * np.log(2 * np.pi))
    value = np.where(heavy, student(square, m), near) + 0.5 * np.linalg.slogdet(S)[1]
    weight = np.where(heavy, (FREEDOM + m) / (FREEDOM + square), 1.0)[:, None]
    by_S = np.einsum("npij,ni,nj->np", dS, w, w, optimize=True)
    score = 0.5 * (np.trace(A, axis1=2, axis2=3) - weight * by_S) + weight * np.einsum("npi,ni->np", dnu, w)
    wide = (*A.shape[:2], A.shape[-1] ** 2)
    flat = A.reshape(wide), np.swapaxes(A, 2, 3).reshape(wide)
    fisher = 0.5 * flat[0] @ np.swapaxes(flat[1], 1, 2) + weight[:, :, None] * (dnu @ inv @ np.swapaxes(dnu, 1, 2))
    return Terms(value, score, fisher)


def gated_terms(
    nu: np.ndarray, S: np.ndarray, valid: np.ndarray, used: np.ndarray, dnu: np.ndarray, dS: np.ndarray,
    alone: np.ndarray,
) -> Terms:  # fmt: skip
    """Return the terms of innovations where a gate tests the channels ``alone`` (m,) one by one.

    Each of them that is rejected counts by a Student t; an epoch with another rejected channel is one as a whole.
    """
    out = valid & ~used & alone
    keep = valid & ~out
    both = keep[:, :, None] & keep[:, None]
    rest = gaussian_terms(
        np.where(keep, nu, 0.0),
        np.where(both, S, np.eye(keep.shape[1])),
        keep,
        np.where(keep[:, None], dnu, 0.0),
        np.where(both[:, None], dS, 0.0),
        (valid & ~used & ~alone).any(1),
    )
    if not out.any():
        return rest
    n, i = np.nonzero(out)
    one = np.ones((n.size, 1), bool)
    single = gaussian_terms(
        nu[n, i][:, None],
        S[n, i, i][:, None, None],
        one,
        dnu[n, :, i][:, :, None],
        dS[n, :, i, i][:, :, None, None],
        one[:, 0],
    )
    for into, more in zip(rest, single, strict=True):
        np.add.at(into, n, more)
    return rest


def summed(terms: Terms, mask: np.ndarray) -> ScoreSums:
    """Return the sums of the terms where ``mask`` (N,)."""
    value, score, fisher = (a[mask].sum(0) for a in terms)
    return ScoreSums(value, score, fisher, mask.sum())


def evidence_of(
    filt: Filter, candidates: Params, part: "Training", points: int = 1
) -> list[tuple[ScoreSums, ScoreSums]]:
    """Return sums over a training part, of innovations and of hidden fixes, at some points, by runs on lanes.

    Args:
        filt: the filter.
        candidates: (points (1 + 2 P), ...) parameters at each point, and a `STEP` above and below it in each number, of
            which score and information are central differences.
        part: the recording's training part.
        points: how many.
    """
    phases, count = len(part.valid), len(jax.tree.leaves(candidates)[0])
    if phases > 1 and part.valid.shape[1] * phases * count > MAX_LANE_EPOCHS:
        each = [evidence_of(filt, candidates, part.phase(slice(p, p + 1)), points) for p in range(phases)]
        return jax.tree.map(lambda *a: sum(a), *each)
    params = jax.tree.map(lambda a: np.tile(a, (phases, *[1] * (np.ndim(a) - 1))), candidates)
    record = lanes(filt, params, repeated(part.nav, phases * count), part.epochs, np.repeat(part.valid, count, 0))
    record = jax.tree.map(lambda a: a.reshape(phases, points, -1, *a.shape[1:]), record)
    alone = tested_alone(MEASUREMENTS[name] for name in filt.model.measurements)
    noise = [position_noise(taken(candidates, k), part.sd) for k in range(count)]  # (phases, A, 3, 3) each
    noises = np.stack(noise, 1).reshape(phases, points, -1, *part.at.shape[1:], 3, 3)
    return [_sums(taken(record, np.s_[:, k]), noises[:, k], part, alone) for k in range(points)]


def _sums(record: LaneRecord, noise: np.ndarray, part: "Training", alone: np.ndarray) -> tuple[ScoreSums, ScoreSums]:
    """Return the sums at a point, of the record (phases, 1 + 2 P, E) and the noise of hidden fixes (phases, .., A)."""
    phases, count = record.ok.shape[:2]
    same, middle = decided_alike(record), _middle
    innovations = summed(innovation_terms(record, alone), part.keep.reshape(-1) & middle(record.valid).any(1))
    if (part.keep & ~record.ok[:, 0]).any():
        innovations = innovations._replace(value=np.inf)
    rows = np.arange(phases)[:, None, None], np.arange(count)[:, None], part.at[:, None]
    y, C = record.residual[rows], (record.P[rows] + noise) / gaussian_scale(3)  # as `residual_nll`
    three = np.ones((part.at.size, 3), bool)
    dy, dC = differences(y, same[rows]), differences(C, same[rows])
    far = gaussian_terms(middle(y), middle(C), three, dy, dC, three[:, 0])
    return innovations, summed(far, part.there.reshape(-1))


def _middle(a: np.ndarray) -> np.ndarray:
    """Return the values at the point, (B E, ...) of (B, 1 + 2 P, E, ...)."""
    return a[:, 0].reshape(-1, *a.shape[3:])


def decided_alike(record: LaneRecord) -> np.ndarray:
    """(B, 1 + 2 P, E) bool: up to then each step's gate has decided as at the point; else what follows jumps."""
    return np.logical_and.accumulate((record.used == record.used[:, :1]).all(-1) & record.ok, 2)


def innovation_terms(record: LaneRecord, alone: np.ndarray) -> Terms:
    """Return the terms of the innovations of B runs, (B E, ...).

    Args:
        record: (B, 1 + 2 P, E, ...) each run at a point, and a `STEP` above and below it in each number.
        alone: (m,) bool, channels that a gate tests one by one.
    """
    same = decided_alike(record)
    dnu, dS = differences(record.nu, same), differences(record.S, same)
    return gated_terms(
        _middle(record.nu), _middle(record.S), _middle(record.valid), _middle(record.used), dnu, dS, alone
    )


def differences(a: np.ndarray, same: np.ndarray) -> np.ndarray:
    """Return derivatives (phases E, P, ...) by central differences, one-sided where one side is not the same.

    Args:
        a: (phases, 1 + 2 P, E, ...) values at the point, and a `STEP` above and below it in each number.
        same: (phases, 1 + 2 P, E) bool, that decided as the point did; a derivative is 0 where neither side did.
    """
    P = (a.shape[1] - 1) // 2
    wide = same.reshape(*same.shape, *[1] * (a.ndim - 3))
    up, down = wide[:, 1 : P + 1], wide[:, P + 1 :]
    change = np.where(up, a[:, 1 : P + 1] - a[:, :1], 0.0) + np.where(down, a[:, :1] - a[:, P + 1 :], 0.0)
    slopes = change / (STEP * np.maximum(up.astype(int) + down, 1))
    return np.moveaxis(slopes, 1, 2).reshape(len(a) * a.shape[2], P, *a.shape[3:])


class Training(NamedTuple):
    """A recording's training part, as `evidence_of` takes it."""

    nav: Nav
    epochs: Epoch  # (E, ...) prepared
    valid: np.ndarray  # (P, E, m) not hidden
    keep: np.ndarray  # (P, E) counts
    at: np.ndarray  # (P, A) epochs of hidden fixes
    there: np.ndarray  # (P, A) which are any
    sd: np.ndarray  # (P, A, 3) m

    def phase(self, rows: slice) -> "Training":
        """Return some of the phases of windows."""
        return self._replace(
            valid=self.valid[rows], keep=self.keep[rows], at=self.at[rows], there=self.there[rows], sd=self.sd[rows]
        )


def training_of(filt: Filter, used: Used) -> Training:
    """Return the epochs up to the training part's end, a multiple of `CHUNK`; those after it do not count."""
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    size = -(-int(np.searchsorted(used.packed.t, used.layout.train + TICK)) // CHUNK) * CHUNK
    epochs, t = taken(used.epochs, slice(size)), used.t[:size]
    hidden, layout, fix = used.windows.hidden[:, :size], used.layout, used.packed.epochs.fix
    counts = (t >= used.packed.start + layout.settle) & (t <= layout.train + TICK)
    there = np.all(np.asarray(fix.valid)[:, :2], axis=1)
    at, known = ages(used.windows, used.packed.t, there, used.parts["training"], layout.window)
    valid = np.stack([np.asarray(run.fix.valid) for run in used.windows.hide(epochs, chosen)])
    return Training(used.nav, epochs, valid, counts & ~hidden, at, known, np.asarray(fix.sd)[:, :3][at])


class Evidence:
    """The objective of recordings that are tuned on together, for a search.

    ``observations``: as how many the likelihood counts; by default the windows that fit into the training parts.

    Its numbers (G,) are those of the first recording, in the order of `ravel_pytree`, then for each of the others
    its ``per_recording`` ones; all else is shared.
    """

    def __init__(
        self,
        filt: Filter,
        spec: Spec,
        used: Sequence[Used],
        per_recording: Sequence[str] = (),
        observations: float | None = None,
    ):
        self.filt, self.spec, self.used = filt, spec, list(used)
        self.raw = split(spec, used[0].datasheet)
        first, self.back = ravel_pytree(self.raw)
        self.leaves = [name for name in sorted(spec) for _ in range(np.size(self.raw[name]))]  # of each local number
        single = np.flatnonzero(np.isin(self.leaves, per_recording))
        self.places = [np.arange(first.size)]  # of a recording's numbers among all
        for r in range(1, len(used)):
            mine = self.places[0].copy()
            mine[single] = first.size + (r - 1) * single.size + np.arange(single.size)
            self.places.append(mine)
        #: of each number: its recording, and its index in that recording
        self.owner = np.concatenate([np.zeros(first.size, int), np.repeat(np.arange(1, len(used)), single.size)])
        self.origin = np.concatenate([np.arange(first.size), np.tile(single, len(used) - 1)])
        self.parts = [training_of(filt, u) for u in used]
        lengths = [float(u.layout.train - u.packed.start - u.layout.settle) / u.layout.window for u in used]
        self.effective = max(1.0, sum(lengths)) if observations is None else observations
        self.flat = self.centre = self.numbers([u.datasheet for u in used])  # centre of the priors
        self.known: dict[tuple[bytes, bytes], Information] = {}  # by numbers and centre
        self.width = np.array([_width(spec, self.leaves[i]) for i in self.origin])

    def evidence(self, flat: jax.Array) -> tuple[ScoreSums, ScoreSums]:
        """Return the sums of innovations and of hidden fixes over all recordings, on the host, as `inform`."""
        return self._evidence(np.asarray(flat)[None], STEP)[0]

    def _evidence(self, points: np.ndarray, step: float | None = None) -> list[tuple[ScoreSums, ScoreSums]]:
        """Return the evidence at points (T, G), without derivatives where ``step`` is None."""
        found = []
        for r, (at, part) in enumerate(zip(self.places, self.parts, strict=True)):
            steps = np.zeros((0, at.size)) if step is None else step * np.eye(at.size)
            around = np.concatenate([np.zeros((1, at.size)), steps, -steps])
            numbers = (points[:, None, at] + around).reshape(-1, at.size)
            whole = lambda x, r=r: join(self.spec, self.back(x), self.used[r].datasheet)
            candidates = jax.device_get(jax.vmap(whole)(numbers))
            found.append(evidence_of(self.filt, candidates, part, len(points)))
        G = points.shape[1]

        def among_all(e: ScoreSums, at: np.ndarray) -> ScoreSums:
            score, fisher = np.zeros(G), np.zeros((G, G))
            if e.score.size:
                score[at], fisher[np.ix_(at, at)] = e.score, e.fisher
            return e._replace(score=score, fisher=fisher)

        together = [
            [tuple(among_all(e, at) for e in both) for both in each]
            for at, each in zip(self.places, found, strict=True)
        ]
        return jax.tree.map(lambda *each: sum(each), *together)

    def inform(self, flat: jax.Array) -> Information:
        """Return J and its information at numbers (G,), as `tuning.recordings.scoring.maximise` takes it."""
        key = np.asarray(flat).tobytes(), np.asarray(self.centre).tobytes()
        if key not in self.known:
            self.known[key] = self._inform(flat)
        return self.known[key]

    def _inform(self, flat: jax.Array) -> Information:
        mean = [jax.tree.map(lambda a, e=e: a / np.maximum(e.number, 1), e) for e in self.evidence(flat)]
        score = self.effective * sum(e.score for e in mean) + self._off(flat) / self.width
        fisher = self.effective * sum(e.fisher for e in mean) + np.diag(1 / self.width**2)
        return Information(self._value(mean, flat), score, fisher, jnp.zeros((1, flat.size)))

    def values(self, points: jax.Array) -> np.ndarray:
        """Return J (T,) at points (T, G)."""
        found = self._evidence(np.asarray(points))
        mean = [[e._replace(value=e.value / np.maximum(e.number, 1)) for e in both] for both in found]
        return np.array([self._value(*each) for each in zip(mean, points, strict=True)])

    def _value(self, mean: Sequence[ScoreSums], flat: jax.Array) -> Any:
        return self.effective * sum(e.value for e in mean) + 0.5 * np.sum(self._off(flat) ** 2)

    def _off(self, flat: jax.Array) -> np.ndarray:
        """Return the distance (G,) of numbers from the centre of their priors, in sd."""
        return (np.asarray(flat) - np.asarray(self.centre)) / self.width

    def centre_delays(self, flat: jax.Array) -> None:
        """Centre the priors of the delays at numbers (G,)."""
        time = np.array([kind_of(self.leaves[i]) == "time" for i in self.origin])
        self.centre = jnp.where(time, flat, self.centre)

    def numbers(self, params: Sequence[Params]) -> jax.Array:
        """Return the unconstrained numbers (G,) of each recording's parameters; the mean of shared ones.

        States that they lack have the datasheet's.
        """
        total, count = np.zeros(self.owner.size), np.zeros(self.owner.size)
        for at, each, used in zip(self.places, params, self.used, strict=True):
            whole = each._replace(states=used.datasheet.states | each.states)
            total[at] += np.asarray(ravel_pytree(split(self.spec, whole))[0])
            count[at] += 1
        return jnp.asarray(total / count)

    def params(self, flat: jax.Array, recording: int = 0) -> Params:
        """Return the parameters that numbers (G,) stand for in a recording."""
        return join(self.spec, self.back(jnp.asarray(flat)[self.places[recording]]), self.used[recording].datasheet)

    def each(self, flat: jax.Array) -> list[Params]:
        """Return the same in every recording."""
        return [self.params(flat, r) for r in range(len(self.used))]


def _width(spec: Spec, name: str) -> float:
    prior = spec[name].prior
    return 1e3 if prior is None else prior.sd
