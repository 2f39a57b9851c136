"""Likelihood of free parameters in recordings' training parts: J of `tuning.recordings.recorded`, its information."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.analysis.windows import RECEIVER_ERROR, position_noise
from jaxnav.filters import epochs as ep
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.gaps import TICK
from jaxnav.filters.programs import stored
from jaxnav.filters.run import run
from jaxnav.measurements import MEASUREMENTS
from jaxnav.measurements.measurement import tested_alone
from jaxnav.states import table
from jaxnav.types import Epoch, Info, Leaf, Nav, Params
from tuning.fit.transforms import Spec, join, split
from tuning.recordings.parts import Used, ages
from tuning.recordings.priors import kind_of
from tuning.uncertainty import Information, gated, gaussian, pushed

SLOW = RECEIVER_ERROR


class ScoreSums(NamedTuple):
    """Sums over the training part: value (), score (P,), information (P, P), and number of terms."""

    value: Leaf
    score: Leaf
    fisher: Leaf
    number: Leaf


class EpochRecord(NamedTuple):
    """Record of an epoch."""

    nu: jax.Array
    S: jax.Array
    valid: jax.Array
    used: jax.Array
    ok: jax.Array
    residual: jax.Array  # (3,) of the position
    P: jax.Array  # (3, 3) of a predicted fix, without its noise


def _keep(slow: slice | None, step: Step, along: Any) -> EpochRecord:
    info = step.info
    P = seen_by_position(info.P, slow)
    return EpochRecord(info.nu, info.S, info.valid, info.used, info.ok, info.residual[:3], P)


@partial(stored, static_argnums=(0, 1))
def _evidence(
    filt: Filter, items: tuple[Any, ...], flat: jax.Array, like: Any, params: Params, nav: Nav, epochs: Epoch,
    valid: jax.Array, keep: jax.Array, at: jax.Array, there: jax.Array, sd: jax.Array,
) -> tuple[ScoreSums, ScoreSums]:  # fmt: skip
    """Of innovations and of hidden fixes; valid (P, E, m), keep (P, E), at and there (P, A), sd (P, A, 3)."""
    spec, (_, back) = dict(items), ravel_pytree(like)
    keep_seen = partial(_keep, slow_errors(filt))
    alone = tested_alone(MEASUREMENTS[name] for name in filt.model.measurements)

    def phase(valid: jax.Array, keep: jax.Array, at: jax.Array, there: jax.Array, sd: jax.Array) -> Any:
        def outputs(r: jax.Array) -> Any:
            moved = join(spec, back(r), params)
            seen = run(filt, moved, nav, epochs._replace(fix=epochs.fix._replace(valid=valid)), keep_seen)
            C = seen.P[at] + position_noise(moved, sd)
            return (seen.nu, seen.S, seen.residual[at], C), (seen.valid, seen.used, seen.ok)

        ((nu, S, y, C), (seen, used, ok)), (dnu, dS, dy, dC) = pushed(outputs, flat)
        if alone.any():
            terms = jax.vmap(partial(gated, alone=alone), (0, 0, 0, 1, 1, 0))(nu, S, seen, dnu, dS, used)
        else:
            terms = jax.vmap(gaussian, (0, 0, 0, 1, 1, 0))(nu, S, seen, dnu, dS, (seen & ~used).any(-1))
        three = jnp.ones((at.size, 3), bool)
        far = jax.vmap(partial(gaussian, heavy=True), (0, 0, 0, 1, 1))(y, C, three, dy, dC)
        lost = jnp.where((keep & ~ok).any(), jnp.inf, 0.0)
        counts = keep & seen.any(-1)

        def total(parts: Any, mask: jax.Array) -> Any:
            value, score, fisher = (jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0).sum(0) for a in parts)
            return ScoreSums(value, score, fisher, mask.sum())

        innovations = total(terms, counts)
        return innovations._replace(value=innovations.value + lost), total(far, there)

    both = jax.vmap(phase)(valid, keep, at, there, sd)
    return jax.tree.map(lambda a: a.sum(0), both)


@stored
def _nll(nu: jax.Array, S: jax.Array, valid: jax.Array, heavy: jax.Array) -> jax.Array:
    """Of residuals (A, m), each alone."""
    m = nu.shape[-1]
    one = lambda nu, S, valid, heavy: gaussian(nu, S, valid, jnp.zeros((0, m)), jnp.zeros((0, m, m)), heavy)[0]
    return jax.vmap(one)(nu, S, valid, heavy)


def predicted(filt: Filter, params: Sequence[Params], used: Sequence[Used], infos: Sequence[Info]) -> float:
    """Return how badly a candidate predicts the validation parts of recordings.

    Mean negative log-likelihood of an innovation, plus that of a hidden fix, both by a Student t, so that no fix counts
    without bound.

    Args:
        filt: the candidate's filter.
        params: its parameters in each recording.
        used: the recordings.
        infos: (P, E, ...) of its runs with hidden windows.
    """
    shown: list[list[np.ndarray]] = [[], []]
    for fitted, u, info in zip(params, used, infos, strict=True):
        part = (u.t > u.layout.train + TICK) & (u.t <= u.layout.validation + TICK)
        counts = part & ~u.windows.hidden & np.asarray(info.valid).any(-1)
        lost = not np.asarray(info.ok)[:, part].all()
        pick = lambda a, counts=counts: jnp.asarray(np.asarray(a)[counts])
        innovations = _nll(*map(pick, (info.nu, info.S, info.valid, np.ones(np.shape(info.ok), bool))))
        hidden = hidden_fixes(filt, fitted, u, info, u.parts["validation"]).nll()
        for into, values in zip(shown, (innovations, hidden), strict=True):
            into.append(np.where(lost, np.inf, np.asarray(values)))
    return float(sum(np.mean(np.concatenate(values)) for values in shown))


class HiddenFixes(NamedTuple):
    """K hidden fixes of a run, at `tuning.recordings.parts.AGES` of its windows, and their predictions."""

    residual: np.ndarray  # (K, 3) m, ENU, predicted minus measured
    covariance: np.ndarray  # (K, 3, 3) m^2, of the residual
    age: np.ndarray  # (K,) s since the window's start

    def nll(self) -> np.ndarray:
        """Negative log-likelihood (K,) of each, by a Student t."""
        every = jnp.ones(self.residual.shape, bool)
        return np.asarray(_nll(jnp.asarray(self.residual), jnp.asarray(self.covariance), every, every[:, 0]))

    def nees(self) -> np.ndarray:
        """Horizontal error squared over its covariance, (K,): chi-square of 2 degrees of freedom."""
        y = self.residual[:, :2]
        return np.asarray(np.einsum("ki,kij,kj->k", y, np.linalg.inv(self.covariance[:, :2, :2]), y))


def hidden_fixes(filt: Filter, params: Params, used: Used, info: Info, mask: np.ndarray) -> HiddenFixes:
    """Return the hidden fixes of some windows.

    Args:
        filt: the filter.
        params: its parameters.
        used: the recording.
        info: (P, E, ...) runs with hidden windows.
        mask: (W,) the windows.
    """
    fix, windows = used.packed.epochs.fix, used.windows
    there = np.all(np.asarray(fix.valid)[:, :2], axis=1)
    at, known = ages(windows, used.packed.t, there, mask, used.layout.window)
    phase, column = np.nonzero(known)
    epoch = at[phase, column]
    sd = jnp.asarray(np.asarray(fix.sd)[epoch, :3])
    P = seen_by_position(jnp.asarray(np.asarray(info.P)[phase, epoch]), slow_errors(filt))
    begins = [windows.start[(windows.phase == p) & mask] for p in range(len(windows.hidden))]
    age = [t - begins[p][begins[p] < t].max() for p, t in zip(phase, used.packed.t[epoch], strict=True)]
    covariance = np.asarray(P + position_noise(params, sd))
    return HiddenFixes(np.asarray(info.residual)[phase, epoch, :3], covariance, np.array(age))


def slow_errors(filt: Filter) -> slice | None:
    """Return where a filter's covariance has the slow errors of a receiver, None where it has none."""
    return table.layout(table.chosen(filt.model.states)).get(SLOW)


def seen_by_position(P: jax.Array, slow: slice | None) -> jax.Array:
    """Covariance (..., 3, 3) m^2, ENU, of a predicted fix without its noise: position and the receiver's slow error."""
    if slow is None:
        return P[..., :3, :3]
    cross = P[..., :3, slow]
    return P[..., :3, :3] + cross + jnp.swapaxes(cross, -1, -2) + P[..., slow, slow]


class Training(NamedTuple):
    """A recording's training part, as `_evidence` takes it."""

    datasheet: Params
    nav: Nav
    epochs: Epoch  # (E, ...)
    valid: jax.Array  # (P, E, m) not hidden
    keep: jax.Array  # (P, E) counts
    at: np.ndarray  # (P, A) epochs of hidden fixes
    there: np.ndarray  # (P, A) which are any
    sd: np.ndarray  # (P, A, 3) m


def training_of(filt: Filter, used: Used, size: int) -> Training:
    """Return the first ``size`` epochs; epochs after the training part in them do not count."""
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    epochs, t = jax.tree.map(lambda a: a[:size], used.epochs), used.t[:size]
    hidden, layout, fix = used.windows.hidden[:, :size], used.layout, used.packed.epochs.fix
    counts = (t >= used.packed.start + layout.settle) & (t <= layout.train + TICK)
    there = np.all(np.asarray(fix.valid)[:, :2], axis=1)
    at, known = ages(used.windows, used.packed.t, there, used.parts["training"], layout.window)
    valid = jnp.stack([ep.hide(epochs, h, chosen, layout.satellites).fix.valid for h in hidden])
    return Training(
        used.datasheet, used.nav, epochs, valid,
        jnp.asarray(counts & ~hidden), at, known, np.asarray(fix.sd)[:, :3][at],
    )  # fmt: skip


class Job:
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
        self.items = tuple(
            (name, t._replace(prior=None)) for name, t in spec.items()
        )  # priors are no part of a program
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
        size = max(int(np.searchsorted(u.packed.t, u.layout.train + TICK)) for u in used)
        parts = [training_of(filt, u, size) for u in used]
        most = max(p.at.shape[1] for p in parts)
        wide = lambda a: np.pad(a, [(0, 0), (0, most - a.shape[1])] + [(0, 0)] * (a.ndim - 2))
        self.parts = [p._replace(at=wide(p.at), there=wide(p.there), sd=wide(p.sd)) for p in parts]
        lengths = [float(u.layout.train - u.packed.start - u.layout.settle) / u.layout.window for u in used]
        self.effective = max(1.0, sum(lengths)) if observations is None else observations
        self.flat = self.centre = self.numbers([u.datasheet for u in used])  # centre of the priors
        self.width = np.array([_width(spec, self.leaves[i]) for i in self.origin])

    def evidence(self, flat: jax.Array) -> tuple[ScoreSums, ScoreSums]:
        """Of innovations, of hidden fixes, of all recordings; on the host, as `objective`."""
        numbers = np.asarray(flat)
        found = [
            _evidence(self.filt, self.items, numbers[at], self.raw, *part)
            for at, part in zip(self.places, self.parts, strict=True)
        ]
        G = flat.size

        def among_all(e: ScoreSums, at: np.ndarray) -> ScoreSums:
            score, fisher = np.zeros(G), np.zeros((G, G))
            score[at], fisher[np.ix_(at, at)] = e.score, e.fisher
            return e._replace(score=score, fisher=fisher)

        found = jax.device_get(found)
        together = [tuple(among_all(e, at) for e in both) for at, both in zip(self.places, found, strict=True)]
        return jax.tree.map(lambda *each: sum(each), *together)

    def objective(self) -> Callable[[jax.Array], Information]:
        """J and its information, as `tuning.recordings.scoring.maximise` takes it."""

        def inform(flat: jax.Array) -> Information:
            mean = [jax.tree.map(lambda a, e=e: a / np.maximum(e.number, 1), e) for e in self.evidence(flat)]
            off = (np.asarray(flat) - np.asarray(self.centre)) / self.width
            value = self.effective * sum(e.value for e in mean) + 0.5 * np.sum(off**2)
            score = self.effective * sum(e.score for e in mean) + off / self.width
            fisher = self.effective * sum(e.fisher for e in mean) + np.diag(1 / self.width**2)
            return Information(value, score, fisher, jnp.zeros((1, flat.size)))

        return inform

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
