"""The innovations' likelihood of simulated runs, by runs on lanes: method of scoring, intervals, identifiability."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.filters.border import component, user_value
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import CHUNK, lanes, taken
from jaxnav.measurements import MEASUREMENTS
from jaxnav.measurements.measurement import tested_alone
from jaxnav.types import Epoch, Finding, Json, Nav, Params
from tuning import uncertainty
from tuning.fit.train import Fit
from tuning.fit.transforms import Spec, join, labels, leaves, merged, split
from tuning.recordings import scoring
from tuning.recordings.evidence import MAX_LANE_EPOCHS, STEP, innovation_terms
from tuning.recordings.report import Row, rows_of
from tuning.uncertainty import Information


class Runs(NamedTuple):
    """Runs of one source, on the host; every fix counts once."""

    filter: Filter
    params: Params  # where they are not free
    nav: Nav  # (B, ...)
    epochs: Epoch  # (B, E, ...), prepared for the filter, E a multiple of `CHUNK`
    keep: np.ndarray  # (B, E) bool
    block: np.ndarray  # (B, E) int, runs or stretches of time that are drawn together, from 0 on
    blocks: int  # how many there are, of all runs that these may be some of

    @property
    def fixes(self) -> int:
        """Return how many fixes count."""
        return int((self.keep & np.asarray(self.epochs.fix.valid).any(-1)).sum())


def runs_of(filt: Filter, params: Params, nav: Nav, epochs: Epoch, keep: Any, block: Any) -> Runs:
    """Return runs with their epochs padded for lanes.

    Args:
        filt: the filter.
        params: its parameters, where they are not free.
        nav: (B, ...) the starts.
        epochs: (B, E, ...) prepared for the filter.
        keep: (B, E) bool, epochs that count.
        block: (B, E) int, runs or stretches of time that are drawn together, from 0 on.
    """
    size = np.shape(keep)[1]
    more = -size % CHUNK
    longer = lambda a: np.concatenate([a, np.repeat(np.asarray(a)[:, -1:], more, 1)], 1)
    epochs, keep, block = jax.tree.map(longer, jax.device_get((epochs, keep, block)))
    inside = np.arange(size + more) < size
    fix = epochs.fix._replace(valid=epochs.fix.valid & inside[:, None])
    return Runs(filt, params, jax.device_get(nav), epochs._replace(fix=fix), keep & inside, block, int(block.max()) + 1)


def information(runs: Runs, spec: Spec, params: Params, flat: Any) -> Information:
    """Return likelihood, score and information of runs at unconstrained numbers, by central differences on lanes.

    Args:
        runs: the runs.
        spec: the free parameters.
        params: parameters of the shapes of the free ones.
        flat: (P,) unconstrained numbers.
    """
    flat, (_, back) = np.asarray(flat), ravel_pytree(split(spec, params))
    steps = STEP * np.eye(flat.size)
    around = flat + np.concatenate([np.zeros((1, flat.size)), steps, -steps])
    whole = lambda r: merged(join(spec, back(r), params), runs.params, leaves(spec))
    candidates = jax.device_get(jax.vmap(whole)(around))
    B, E, P = *runs.keep.shape, flat.size
    each = max(1, MAX_LANE_EPOCHS // (E * len(around)))
    parts = [_sums(taken_runs(runs, slice(i, i + each)), candidates, P) for i in range(0, B, each)]
    nll, score, fisher = (sum(p[i] for p in parts) for i in range(3))
    blocks = np.zeros((runs.blocks, P))
    np.add.at(blocks, np.concatenate([p[3] for p in parts]), np.concatenate([p[4] for p in parts]))
    return Information(nll, score, fisher, blocks)


def taken_runs(runs: Runs, rows: Any) -> Runs:
    """Return some of the runs."""
    return runs._replace(**{key: taken(getattr(runs, key), rows) for key in ("nav", "epochs", "keep", "block")})


def _sums(runs: Runs, candidates: Params, P: int) -> tuple[Any, ...]:
    """Return value, score and information of some runs, and block (N,) and score (N, P) of each fix."""
    B, count = len(runs.keep), 1 + 2 * P
    params = jax.tree.map(lambda a: np.tile(a, (B, *[1] * (np.ndim(a) - 1))), candidates)
    run = np.repeat(np.arange(B), count)
    record = lanes(runs.filter, params, taken(runs.nav, run), runs.epochs, np.asarray(runs.epochs.fix.valid)[run], run)
    record = jax.tree.map(lambda a: a.reshape(B, count, *a.shape[1:]), record)
    alone = tested_alone(MEASUREMENTS[name] for name in runs.filter.model.measurements)
    terms = innovation_terms(record, alone)
    counts = (runs.keep & record.valid[:, 0].any(-1)).ravel()
    value = np.inf if (runs.keep & ~record.ok[:, 0]).any() else terms.value[counts].sum()
    return (
        value,
        terms.score[counts].sum(0),
        terms.fisher[counts].sum(0),
        runs.block.ravel()[counts],
        terms.score[counts],
    )


class Surface(NamedTuple):
    """The posterior density of a job's parameters, up to a constant."""

    inform: Callable[[jax.Array], Information]  # of the flat unconstrained numbers (P,), sums over all data
    raw: dict[str, jax.Array]  # the start
    epochs: int  # fixes that count


def surface(sources: Sequence[Runs], spec: Spec, params: Params) -> Surface:
    """Return the likelihood of all sources together, with the spec's priors."""
    raw = split(spec, params)
    _, back = ravel_pytree(raw)

    def inform(flat: jax.Array) -> Information:
        parts = [information(runs, spec, params, flat) for runs in sources]
        nll, score, fisher = (np.sum([p[i] for p in parts], 0) for i in range(3))
        whole = Information(nll, score, fisher, np.concatenate([p.blocks for p in parts]))
        return uncertainty.with_prior(whole, spec, back(flat))

    return Surface(inform, raw, sum(runs.fixes for runs in sources))


def maximise(found: Surface, spec: Spec, params: Params, steps: int, note: Callable[[Json], None]) -> Fit:
    """Maximise the likelihood by the method of scoring, one history row an evaluation."""
    flat, back = ravel_pytree(found.raw)
    history: list[Json] = []

    def report(i: int, search: scoring.Search) -> None:
        raw, best = back(search.raw), search.best
        norm = float(np.linalg.norm(best.score) / found.epochs)
        row: Json = {"step": i, "loss": float(best.nll) / found.epochs, "grad_norm": norm}
        row["params"] = {name: np.asarray(t.forward(raw[name])).tolist() for name, t in spec.items()}
        history.append(row)
        note(row)

    search = scoring.maximise(found.inform, flat, steps, report=report)
    loss = float(search.best.nll) / found.epochs
    return Fit(join(spec, back(search.raw), params), loss, history, scoring.status(search))


def rows(
    found: Surface, spec: Spec, params: Params, datasheet: Params, known: Mapping[str, float]
) -> tuple[list[Row], list[Finding]]:
    """Return every free number with its 95 % interval, and the undetermined combinations.

    Args:
        found: the likelihood.
        spec: the free parameters.
        params: where the search ended.
        datasheet: where it began.
        known: true values by leaf, of a simulation.
    """
    raw = split(spec, params)
    info = found.inform(ravel_pytree(raw)[0])
    cov = uncertainty.covariance(np.asarray(info.fisher), np.asarray(info.blocks))
    names, out = labels(spec, raw), []
    for label, row in zip(names, rows_of(spec, raw, cov, split(spec, datasheet)), strict=True):
        leaf = label.partition("[")[0]
        remark = f"simulated with {user_value(leaf, known[leaf]):.4g}" if leaf in known else ""
        out.append(row._replace(remark=remark))
    return out, uncertainty.identifiability([component(n) for n in names], cov.model)
