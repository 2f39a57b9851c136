"""Runs of recordings or simulations for gradients, and the objectives over them, by name."""

import importlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxnav.analysis import metrics
from jaxnav.filters.core import Filter
from jaxnav.filters.run import first_failure, run, run_jit
from jaxnav.measurements import clock_offset
from jaxnav.types import ConfigError, DataError, Epoch, FilterError, Info, Nav, Params, Tree, nearest
from tuning.fit import objectives
from tuning.fit.optimizers import Method
from tuning.fit.train import Fit, fit
from tuning.fit.transforms import Spec, leaves, merged

DIVERGED_M = 1e5  # m: a run that is so far from a fix has diverged


class Truth(NamedTuple):
    """True positions at the epochs' GNSS time, by the clocks that tuning starts from."""

    lla: jax.Array  # (E, 3) rad, rad, m
    rate: jax.Array  # (E, 3) of it, per s
    known: jax.Array  # (E,) bool; where not, lla is that of the nearest epoch


class Run(NamedTuple):
    """One run of E epochs with up to W hidden windows, or many with a leading axis."""

    params: Params  # of its source, where they are not free
    nav: Nav  # start
    epochs: Epoch  # (E, ...), prepared for the filter
    ends: jax.Array  # (W,) int, last epoch of each window
    scored: jax.Array  # (W,) bool, windows that count here
    keep: jax.Array  # (E,) bool, epochs with innovations that count
    part: jax.Array  # (E,) bool, epochs of this part of the data, hidden or not
    truth: Truth | None = None


# ---------------------------------------------------------------------------- objectives by name


def _error(info: Info, r: Run) -> tuple[jax.Array, jax.Array]:
    """Return the position's error (E, 3) m and the epochs with a truth (E,)."""
    assert r.truth is not None  # `check_objective` saw to it
    return jax.vmap(metrics.position_error)(info.nav, r.truth.lla), r.truth.known


def _rmse(info: Info, r: Run) -> jax.Array:
    error, known = _error(info, r)
    return jnp.mean(objectives.rmse(error, r.part & known))


def _nees(info: Info, r: Run) -> jax.Array:
    error, known = _error(info, r)
    return objectives.error_consistency(error, info.P[:, :3, :3], r.keep & known)


Score = Callable[[Info, Run], jax.Array]
OBJECTIVES: dict[str, Score] = {
    "drift": lambda info, r: objectives.drift(info, r.ends, r.scored),
    "log_drift": lambda info, r: objectives.log_mean_drift(info, r.ends, r.scored),
    "nll": lambda info, r: objectives.innovation_nll(info, r.keep),
    "consistency": lambda info, r: objectives.consistency(info, r.keep),
    "whiteness": lambda info, r: objectives.whiteness(info, r.keep),
    "rmse": _rmse,
    "nees": _nees,
}
"""Of one run: log RMS and mean log of the error at the ends of hidden windows; innovation likelihood, normalised
innovations against their law, their autocorrelation; with truth the position's RMSE in m and its normalised error."""
NEED_TRUTH = ("rmse", "nees")


def check_objective(weights: Mapping[str, float], truth: bool = True, windows: bool = True) -> None:
    """Raise ConfigError for an unknown objective, for none, or for one that needs a truth or windows."""
    for name in weights:
        score_of(name)
    asked = [name for name, weight in weights.items() if weight]
    if not asked:
        raise ConfigError("tune.objective: every weight is zero")
    for name in asked:
        if name in NEED_TRUTH and not truth:
            raise ConfigError(f"tune.objective: {name} needs a truth, and the recording has none")
        if name in ("drift", "log_drift") and not windows:
            raise ConfigError(f"tune.objective: {name} needs outages, see data.options.outages_s; or take rmse or nll")


@cache
def score_of(name: str) -> Score:
    """Return an objective by name, or a user's ``module:function`` of (info, epochs, truth) -> ().

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
        users = getattr(importlib.import_module(module), function)
    except Exception as error:  # any error of a user's module at import
        raise ConfigError(f"tune.objective: {name!r} cannot be imported: {type(error).__name__}: {error}") from error
    if not callable(users):
        raise ConfigError(f"tune.objective: {name!r} is no function: {users!r}")

    def score(info: Info, r: Run) -> jax.Array:
        value = users(info, r.epochs, None if r.truth is None else r.truth.lla)
        if jnp.shape(value) != ():
            raise ConfigError(f"tune.objective: {name!r} must give one number, got shape {jnp.shape(value)}")
        return value

    return score


@cache
def loss_of(
    filt: Filter, weights: tuple[tuple[str, float], ...], free: tuple[str, ...]
) -> Callable[[Params, Run], jax.Array]:
    """Return the weighted sum of objectives of one run; inf where it stopped being finite or got lost.

    Of the parameters only the leaves in ``free`` count; the rest is the run's. One function per setting.
    """
    return partial(_loss, filt, tuple((score_of(name), w) for name, w in weights if w), free)


def _loss(
    filt: Filter, scores: tuple[tuple[Score, float], ...], free: tuple[str, ...], params: Params, r: Run
) -> jax.Array:
    params = merged(params, r.params, free)
    info = run(filt, params, r.nav, r.epochs)
    if r.truth is not None:  # navigation's time at the truth's, if the clocks have drifted since the start
        later = clock_offset(params.mounting, info.nav) - clock_offset(r.params.mounting, info.nav)
        r = r._replace(truth=r.truth._replace(lla=r.truth.lla + later[:, None] * r.truth.rate))
    total = sum((w * score(info, r) for score, w in scores), jnp.zeros(()))
    near = jnp.all(jnp.where(info.valid, jnp.abs(info.residual), 0.0) < DIVERGED_M)
    return jnp.where(info.ok.all() & near, total, jnp.inf)


# ---------------------------------------------------------------------------- the search


class Descent(NamedTuple):
    """A gradient search: its objective, method and checkpoints."""

    objective: Mapping[str, float]  # weight by name
    method: str = "adam"  # a row of `tuning.fit.optimizers.OPTIMIZERS`
    steps: int = 40
    rate: float = 0.1
    keep: Path | None = None  # folder of checkpoints
    resume: bool = False
    identity: str = ""  # of the job, so that another job's checkpoint is refused
    mesh: Mesh | None = None  # devices that share the runs
    progress: bool = False


def descend(
    filt: Filter,
    spec: Spec,
    params: Params,
    train: Sequence[Run],
    validation: Sequence[Run],
    names: Sequence[str],
    how: Descent,
    prior_weight: float,
) -> Fit:
    """Minimise an objective over runs by gradient; the best by the validation runs is taken.

    Args:
        filt: the filter.
        spec: the free parameters.
        params: the start.
        train: groups of runs, each with a leading axis.
        validation: the same.
        names: of the training runs, of all groups.
        how: objective and search.
        prior_weight: weight of the priors next to an objective per epoch.

    Raises:
        FilterError: the objective of the start is not finite.
        CheckpointError: nothing usable to resume from.
    """
    free = leaves(spec)
    loss = loss_of(filt, tuple(sorted(how.objective.items())), free)
    try:
        return fit(
            loss, spec, params, how.steps, Method(how.method, how.steps, how.rate), validation=loss,
            cases=train, validation_cases=validation, names=names, prior_weight=prior_weight, progress=how.progress,
            explain=lambda found, i: why(filt, merged(found, _at(train, i).params, free), _at(train, i)),
            folder=how.keep, resume=how.resume, identity=how.identity, mesh=how.mesh,
        )  # fmt: skip
    except (DataError, ConfigError):
        raise
    except ValueError as error:
        raise FilterError(f"{names[0]} and others: {error}") from error


def _at(groups: Sequence[Run], i: int) -> Run:
    """Return run i, counted over all groups."""
    for group in groups:
        count = group.keep.shape[0]
        if i < count:
            break
        i -= count
    return jax.tree.map(lambda a: a[i], group)


def why(filt: Filter, params: Params, r: Run) -> str:
    """Return why a run fails."""
    info = jax.device_get(run_jit(filt, params, r.nav, r.epochs))
    t = np.asarray(info.nav.t)
    failure = first_failure(info, t)
    if failure:
        return failure
    far = np.flatnonzero((np.abs(np.where(info.valid, info.residual, 0.0)) >= DIVERGED_M).any(-1))
    if far.size:
        return f"further than {DIVERGED_M:g} from a measurement at t = {t[far[0]]:.3f} s"
    return "its gradient is not finite"


def many(tree: Tree, count: int) -> Any:
    """Return a tree with a leading axis, once for every run."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *jnp.shape(a))), tree)
