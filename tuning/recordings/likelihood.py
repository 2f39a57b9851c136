"""The innovations' likelihood of all data of a job: the method of scoring, intervals, identifiability in words."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.checkup.findings import finding
from jaxnav.filters.border import component, user_value
from jaxnav.filters.core import Filter
from jaxnav.filters.programs import stored
from jaxnav.filters.run import run
from jaxnav.types import Epoch, Finding, Info, Nav, Params
from tuning import uncertainty
from tuning.fit.train import Fit
from tuning.fit.transforms import Spec, join, labels, leaves, merged, split
from tuning.recordings import scoring
from tuning.recordings.report import Row, rows_of
from tuning.uncertainty import Information


class Likelihood(NamedTuple):
    """The training data for the likelihood of the parameters, every fix of it once."""

    nav: Nav  # (B, ...)
    epochs: Epoch  # (B, E, ...), prepared for the filter
    keep: jax.Array  # (B, E) bool
    block: jax.Array  # (B, E) int, runs or stretches of time that are drawn together
    blocks: int  # that there are


class Source(NamedTuple):
    """The data of one source, and the filter and parameters that it is run with."""

    filter: Filter
    params: Params  # of this recording, where they are not free
    whole: Likelihood


class Surface(NamedTuple):
    """The posterior density of a job's parameters, up to a constant."""

    inform: Callable[[jax.Array], Information]  # of the flat unconstrained numbers (P,), sums over all data
    raw: dict[str, jax.Array]  # the start
    epochs: int  # fixes that count


@partial(stored, static_argnums=(0, 1, 2))
def _inform(
    filt: Filter, items: Any, count: int, flat: jax.Array, like: Any, params: Params, fixed: Any, whole: Likelihood
) -> Information:
    spec, (_, back) = dict(items), ravel_pytree(like)
    free = leaves(spec)

    def one(nav: Nav, epochs: Epoch, keep: jax.Array, block: jax.Array) -> Information:
        def solve(r: jax.Array) -> Info:
            return run(filt, merged(join(spec, back(r), params), fixed, free), nav, epochs)

        return uncertainty.information(solve, flat, keep, block, count)

    parts = jax.vmap(one)(whole.nav, whole.epochs, whole.keep, whole.block)
    return Information(*(a.sum(0) for a in parts))


def surface(sources: Sequence[Source], spec: Spec, params: Params) -> Surface:
    """Return the likelihood of all sources together, with the spec's priors."""
    raw = split(spec, params)
    _, back = ravel_pytree(raw)
    items = tuple((name, t._replace(prior=None)) for name, t in spec.items())

    def inform(flat: jax.Array) -> Information:
        parts = [
            _inform(m.filter, items, m.whole.blocks, flat, raw, params, m.params, m.whole._replace(blocks=0))
            for m in sources
        ]
        nll, score, fisher = (sum(p[i] for p in parts) for i in range(3))
        whole = Information(nll, score, fisher, jnp.concatenate([p.blocks for p in parts]))
        return uncertainty.with_prior(whole, spec, back(flat))

    count = sum(int(np.sum(m.whole.keep & np.asarray(m.whole.epochs.fix.valid).any(-1))) for m in sources)
    return Surface(inform, raw, count)


def maximise(found: Surface, spec: Spec, params: Params, steps: int, note: Callable[[dict[str, Any]], None]) -> Fit:
    """Maximise the likelihood by the method of scoring, one history row an evaluation."""
    flat, back = ravel_pytree(found.raw)
    history: list[dict[str, Any]] = []

    def report(i: int, search: scoring.Search) -> None:
        raw, best = back(search.raw), search.best
        norm = float(np.linalg.norm(best.score) / found.epochs)
        row: dict[str, Any] = {"step": i, "loss": float(best.nll) / found.epochs, "grad_norm": norm}
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
    said = uncertainty.identifiability([component(n) for n in names], cov.model)
    return out, [finding("tune.undetermined", message=text) for text in said]
