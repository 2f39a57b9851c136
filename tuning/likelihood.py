"""The innovations' likelihood of all data of a job: the method of scoring, intervals, identifiability in words."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.filters.border import component, unit_of
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import get
from jaxnav.filters.run import negative_log_likelihood, run
from jaxnav.types import Epoch, Info, Nav, Params
from tuning import objectives, scoring, uncertainty
from tuning.posterior import sample
from tuning.train import Fit
from tuning.transforms import Spec, join, labels, leaves, merged, penalty, reported, split, values
from tuning.uncertainty import Information


class Likelihood(NamedTuple):
    """What the innovations say of the parameters is read off here: the training data, every fix of it once."""

    nav: Nav  # (B, ...)
    epochs: Epoch  # (B, E, ...), prepared for the filter
    keep: jax.Array  # (B, E) bool
    block: jax.Array  # (B, E) int, runs or stretches of time that are drawn together
    blocks: int  # that there are


class Source(NamedTuple):
    """The data of one source, and the filter and parameters that it is run with."""

    filter: Filter
    params: Params  # its own, where they are not free
    whole: Likelihood


class Surface(NamedTuple):
    """The posterior density of a job's parameters, up to a constant."""

    inform: Callable[[jax.Array], Information]  # of the flat unconstrained numbers (P,), sums over all data
    raw: dict[str, jax.Array]  # the start
    epochs: int  # fixes that count


@partial(jax.jit, static_argnums=(0, 1, 2))
def _inform(
    filt: Filter, items: Any, count: int, flat: jax.Array, like: Any, params: Params, own: Any, whole: Likelihood
) -> Information:
    spec, (_, back) = dict(items), ravel_pytree(like)
    free = leaves(spec)

    def one(nav: Nav, epochs: Epoch, keep: jax.Array, block: jax.Array) -> Information:
        def solve(r: jax.Array) -> Info:
            return run(filt, merged(join(spec, back(r), params), own, free), nav, epochs)

        return uncertainty.information(solve, flat, keep, block, count)

    parts = jax.vmap(one)(whole.nav, whole.epochs, whole.keep, whole.block)
    return Information(*(a.sum(0) for a in parts))


def surface(sources: Sequence[Source], spec: Spec, params: Params) -> Surface:
    """The likelihood of all sources together, with the spec's beliefs."""
    raw = split(spec, params)
    _, back = ravel_pytree(raw)
    items = tuple(spec.items())

    def inform(flat: jax.Array) -> Information:
        parts = [
            _inform(m.filter, items, m.whole.blocks, flat, raw, params, m.params, m.whole._replace(blocks=0))
            for m in sources
        ]
        nll, score, fisher = (sum(p[i] for p in parts) for i in range(3))
        whole = Information(nll, score, fisher, jnp.concatenate([p.blocks for p in parts]))
        return uncertainty.with_belief(whole, spec, back(flat))

    count = sum(int(np.sum(m.whole.keep & np.asarray(m.whole.epochs.fix.valid).any(-1))) for m in sources)
    return Surface(inform, raw, count)


def maximise(found: Surface, spec: Spec, params: Params, steps: int, note: Callable[[dict[str, Any]], None]) -> Fit:
    """The most likely parameters by the method of scoring, one history row an evaluation."""
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
    stopped = "done" if scoring.converged(search) else f"not converged in {steps} evaluations: raise tune.steps"
    if search.interrupted:
        stopped = f"interrupted at evaluation {len(history)}"
    return Fit(join(spec, back(search.raw), params), float(search.best.nll) / found.epochs, history, stopped)


@partial(jax.jit, static_argnums=(0, 1))
def _density(
    filt: Filter, items: Any, flat: jax.Array, like: Any, params: Params, own: Any, whole: Likelihood
) -> jax.Array:
    """Log-likelihood of one source."""
    spec, (_, back) = dict(items), ravel_pytree(like)

    def one(nav: Nav, epochs: Epoch, keep: jax.Array) -> jax.Array:
        info = run(filt, merged(join(spec, back(flat), params), own, leaves(spec)), nav, epochs)
        each = jax.vmap(negative_log_likelihood)(info)
        return objectives.sound(info, keep, jnp.sum(jnp.where(keep & info.valid.any(-1), each, 0.0)))

    return -jnp.sum(jax.vmap(one)(whole.nav, whole.epochs, whole.keep))


def draw(
    found: Surface, sources: Sequence[Source], spec: Spec, params: Params, draws: int, seed: int
) -> dict[str, Any]:
    """Median and 95 % of every free number under the posterior, by NUTS.

    Raises:
        ConfigError: the extra bayes is not installed.
    """
    raw = split(spec, params)
    flat, back = ravel_pytree(raw)
    items = tuple(spec.items())

    def log_density(r: jax.Array) -> jax.Array:
        parts = [
            _density(m.filter, items, r, raw, params, m.params, m.whole._replace(blocks=0)) for m in sources
        ]  # fmt: skip
        return sum(parts, jnp.zeros(())) - penalty(spec, back(r))

    info = found.inform(flat)
    cov = uncertainty.covariance(np.asarray(info.fisher), np.asarray(info.blocks)).model
    got = sample(log_density, np.asarray(flat), cov, draws, jax.random.key(seed))
    drawn = jax.vmap(lambda r: ravel_pytree(reported(spec, back(r)))[0])(jnp.asarray(got.raw))
    quantiles = jnp.quantile(drawn, jnp.array([0.025, 0.5, 0.975]), axis=0)
    found_at = [np.asarray(ravel_pytree(values(spec, back(q)))[0]).tolist() for q in quantiles]
    rows = {}
    for label, *three in zip(labels(spec, raw), *found_at, strict=True):
        low, middle, high = (v / _unit(label)[0] for v in three)
        rows[component(label)] = {"low": low, "median": middle, "high": high}
    return {"posterior": {"parameters": rows, "draws": draws, "divergent": got.divergent,
                          "acceptance": got.acceptance}}  # fmt: skip


def answers(found: Surface, spec: Spec, params: Params, sheet: Params) -> dict[str, Any]:
    """Every free number with its 95 % interval and ratio to the datasheet, and what cannot be told apart, in words."""
    raw = split(spec, params)
    info = found.inform(ravel_pytree(raw)[0])
    cov = uncertainty.covariance(np.asarray(info.fisher), np.asarray(info.blocks))
    names = labels(spec, raw)
    rows = {}
    for label, interval in zip(names, uncertainty.intervals(spec, raw, cov), strict=True):
        factor, text = _unit(label)
        datasheet = _stated(label, sheet)
        value, low, high = (v / factor for v in (interval.value, interval.low, interval.high))
        rows[component(label)] = {
            "value": value, "low": low, "high": high, "datasheet": datasheet / factor,
            "ratio": interval.value / datasheet if datasheet else None, "unit": text,
            "identified": interval.identified,
        }  # fmt: skip
    words = uncertainty.identifiability([component(n) for n in names], cov.model)
    return {"parameters": rows, "identifiability": words, "blocks": cov.blocks, "epochs": found.epochs}


def _unit(label: str) -> tuple[float, str]:
    """The user's unit of a free number in SI, and in words."""
    leaf, _, index = label.partition("[")
    unit = unit_of(leaf)
    return (1.0, "correlation") if "," in index else (unit.factor, unit.text)


def _stated(label: str, sheet: Params) -> float:
    """What the datasheet says of a free number; it knows no correlations."""
    leaf, _, index = label.partition("[")
    if "," in index:
        return 0.0
    value = np.ravel(get(sheet, leaf))
    return float(value[min(int(index.rstrip("]") or 0), value.size - 1)])
