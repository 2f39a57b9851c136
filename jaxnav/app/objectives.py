"""What `jaxnav tune` minimises: scores of one run by name, put together by weights, and over runs."""

import importlib
import os
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.analysis import metrics
from jaxnav.app import config as configuration
from jaxnav.app.batches import Batch, ready
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run
from jaxnav.measurements import clock_offset
from jaxnav.types import ConfigError, Info, Params, nearest
from tuning import batch, objectives
from tuning.transforms import merged

LOST = 1e5  # m: a run that is so far from a fix has diverged


class TuningCase(NamedTuple):
    """One run, or many with a leading axis."""

    batch: Batch
    own: Params  # parameters of its source: start, mounting and what else is not tuned


def _drift(info: Info, run: Batch) -> jax.Array:
    return objectives.drift(info, run.ends, run.scored)


def _log_drift(info: Info, run: Batch) -> jax.Array:
    return objectives.log_mean_drift(info, run.ends, run.scored)


def _nll(info: Info, run: Batch) -> jax.Array:
    return objectives.innovation_nll(info, run.keep)


def _rmse(info: Info, run: Batch) -> jax.Array:
    assert run.truth is not None  # `check_objective` saw to it
    error = jax.vmap(metrics.position_error)(info.nav, run.truth.lla)
    return jnp.mean(objectives.rmse(error, run.part & run.truth.known))


def _consistency(info: Info, run: Batch) -> jax.Array:
    return objectives.consistency(info, run.keep)


def _whiteness(info: Info, run: Batch) -> jax.Array:
    return objectives.whiteness(info, run.keep)


def _nees(info: Info, run: Batch) -> jax.Array:
    assert run.truth is not None
    error = jax.vmap(metrics.position_error)(info.nav, run.truth.lla)
    return objectives.error_consistency(error, info.P[:, :3, :3], run.keep & run.truth.known)


Score = Callable[[Info, Batch], jax.Array]
OBJECTIVES: dict[str, Score] = {
    "drift": _drift, "log_drift": _log_drift, "nll": _nll, "consistency": _consistency, "whiteness": _whiteness,
    "rmse": _rmse, "nees": _nees,
}  # fmt: skip
"""Of one run: log RMS and mean log of the error at the ends of hidden windows; innovation likelihood, normalised
innovations against their law, their autocorrelation; with truth the position's RMSE in m and its normalised error."""
NEED_TRUTH = ("rmse", "nees")
SIGNED = ("nll", "drift", "log_drift")  # logarithms, so never averaged as one


def check_objective(weights: dict[str, float], truth: bool = True) -> None:
    """Raise ConfigError for an unknown objective, one that needs a truth that is not there, or none at all."""
    for name in weights:
        score_of(name)
    if not any(weights.values()):
        raise ConfigError("tune.objective: every weight is zero")
    for name in NEED_TRUTH:
        if weights.get(name) and not truth:
            raise ConfigError(f"tune.objective: {name} needs a truth, and the recording has none")


@cache
def score_of(name: str) -> Score:
    """An objective by name, or a user's own ``module:function`` of (info, epochs, truth) -> ().

    ``truth``: (E, 3) lat rad, lon rad, h m, or None; its nearest position at epochs that it does not cover.

    Raises:
        ConfigError: there is none.
    """
    if name in OBJECTIVES:
        return OBJECTIVES[name]
    module, colon, function = name.partition(":")
    if not colon:
        known = [*OBJECTIVES, "module:function"]
        raise ConfigError(f"tune.objective: no objective {name!r}: {nearest(name, known)}")
    if (here := os.getcwd()) not in sys.path:  # the console script's path has not the current folder
        sys.path.append(here)
    try:
        own = getattr(importlib.import_module(module), function)
    except Exception as error:  # whatever a user's module does when it is imported
        raise ConfigError(f"tune.objective: {name!r} cannot be imported: {type(error).__name__}: {error}") from error
    if not callable(own):
        raise ConfigError(f"tune.objective: {name!r} is no function: {own!r}")

    def score(info: Info, run: Batch) -> jax.Array:
        value = own(info, run.epochs, None if run.truth is None else run.truth.lla)
        if jnp.shape(value) != ():
            raise ConfigError(f"tune.objective: {name!r} must give one number, got shape {jnp.shape(value)}")
        return value

    return score


@cache
def objective(
    filt: Filter, weights: tuple[tuple[str, float], ...], free: tuple[str, ...]
) -> Callable[[Params, TuningCase], jax.Array]:
    """The weighted sum of objectives of one run; inf where it stopped being finite or got lost.

    Of the parameters only the leaves in ``free`` are looked at; the rest is the case's own. One function per setting.
    """

    def loss(params: Params, case: TuningCase) -> jax.Array:
        params, batch = merged(params, case.own, free), case.batch
        info = run(filt, params, batch.nav, ready(batch))
        if batch.truth is not None:  # where navigation was by then, if the clocks are further apart than at the start
            later = clock_offset(params.mounting, info.nav) - clock_offset(case.own.mounting, info.nav)
            lla = batch.truth.lla + later[:, None] * batch.truth.rate
            batch = batch._replace(truth=batch.truth._replace(lla=lla))
        total = sum((w * score_of(name)(info, batch) for name, w in weights if w), jnp.zeros(()))
        found = jnp.all(jnp.where(info.valid, jnp.abs(info.residual), 0.0) < LOST)
        return jnp.where(info.ok.all() & found, total, jnp.inf)

    return loss


def aggregate(tune: configuration.Tune) -> batch.Aggregate:
    """How [tune] puts runs together.

    Raises:
        ConfigError: no such way.
    """
    ways: dict[str, Any] = {"mean": batch.mean, "tail": objectives.tail(tune.tail), "log_mean": objectives.log_mean}
    if tune.over_runs not in ways:
        raise ConfigError(f"tune.over_runs: no way {tune.over_runs!r}: {nearest(tune.over_runs, ways)}")
    signed = [name for name, w in tune.objective.items() if w and name in SIGNED]
    if tune.over_runs == "log_mean" and signed:
        raise ConfigError(f'tune.over_runs: "log_mean" is for positive objectives, {signed[0]} is a logarithm already')
    return ways[tune.over_runs]
