"""`jaxnav tune` and `jaxnav demo`: tune on training data by gradient, show the gain on test data."""

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.app import tune_report
from jaxnav.app.batches import Material, from_recording, from_scenario
from jaxnav.app.config import Config, for_source
from jaxnav.app.jobs import tune_recorded
from jaxnav.app.long import Long, identity
from jaxnav.app.objectives import LOST, TuningCase, aggregate, check_objective, objective
from jaxnav.app.prepare import base_params, filter_name, grade_of, measurements_of, tune_spec
from jaxnav.app.results import Outcome, picture, stderr
from jaxnav.app.scores import compare, has_windows, runs_jit, score
from jaxnav.app.sources import scenario_of
from jaxnav.filters.run import first_failure
from jaxnav.types import ConfigError, DataError, FilterError, Params, nearest
from tuning import distributed, likelihood
from tuning.optimizers import OPTIMIZERS
from tuning.train import Fit, fit
from tuning.transforms import LOG, Spec, join, leaves, merged, split

METHODS = ("auto", "tempered", *OPTIMIZERS, "scoring")


def tune(config: Config, folder: Path, progress: bool = False, long: Long | None = None) -> Outcome:
    """Tune, compare before and after on test data, write parameters, history and figures.

    Raises:
        FilterError: the starting filter stops being finite.
        CheckpointError: nothing usable to resume from.
    """
    check(config)
    if tune_recorded.is_for(config):
        if long is not None and long.resume:
            raise ConfigError("--resume: the tempered method keeps no checkpoints, it takes some forty evaluations")
        return tune_recorded.tune_recorded(config, folder, progress)
    long = Long() if long is None else long
    if config.tune.method == "auto":
        config = dataclasses.replace(config, tune=dataclasses.replace(config.tune, method="adam"))
    seconds, begin = {}, time.perf_counter()
    materials = prepare(config)
    config = with_objective(config, materials)
    main = materials[0]
    spec = tune_spec(config.tune, filter_name(config), main.measurements, main.sheet)
    if progress:
        stderr("\n".join([*(m.about for m in materials), f"free: {', '.join(spec)}"]))
    seconds["prepare"], begin = time.perf_counter() - begin, time.perf_counter()
    before = score(materials, main.params, ())
    seconds["before"], begin = time.perf_counter() - begin, time.perf_counter()
    surface = likelihood.surface([m.source for m in materials], spec, main.params)
    found = search(config, materials, spec, surface, progress, long)
    seconds["tune"], begin = time.perf_counter() - begin, time.perf_counter()
    after = score(materials, found.params, leaves(spec))
    gain = compare(before, after, config.seed)
    seconds["after"], begin = time.perf_counter() - begin, time.perf_counter()
    about = likelihood.answers(surface, spec, found.params, main.sheet) if config.tune.intervals else {}
    if config.tune.posterior:
        draws = config.tune.posterior
        about |= likelihood.draw(surface, [m.source for m in materials], spec, found.params, draws, config.seed)
    seconds["intervals"], begin = time.perf_counter() - begin, time.perf_counter()
    result = tune_report.report(materials, found, list(spec), before, after, gain, about)
    tune_report.write(folder, main, found, list(spec), result)
    if config.out.figures:
        with picture("the tuning"):
            tune_report.draw(folder, main, found, before, after)
    seconds["write"] = time.perf_counter() - begin
    stopped = found.stopped if found.stopped.startswith("interrupted") else ""
    return Outcome(result, tune_report.text(result, config), seconds, stopped)


def check(config: Config) -> None:
    """Refuse settings that do not go together, before anything is read.

    Raises:
        ConfigError: names the setting.
    """
    t = config.tune
    check_objective(t.objective)
    aggregate(t)
    if t.method not in METHODS:
        raise ConfigError(f"tune.method: no method {t.method!r}: {nearest(t.method, METHODS)}")
    if t.method == "scoring" and {name for name, w in t.objective.items() if w} != {"nll"}:
        raise ConfigError(f'tune.method: {t.method} is for tune.objective = "nll" alone')
    plain = type(t)()
    unused = [k for k in ("starts", "patience", "redraw", "over_runs", "clip") if getattr(t, k) != getattr(plain, k)]
    if t.method == "scoring" and unused:
        raise ConfigError(
            f"tune.{unused[0]}: {t.method} has no use for it: it climbs the likelihood of all training data"
        )
    sheet = base_params(config, grade_of(config, scenario_of(config)), np.zeros(3), 1.0, 1.0)
    tune_spec(t, filter_name(config), measurements_of(config), sheet)


def prepare(config: Config) -> list[Material]:
    """The material of [data] source and of every source of tune.more.

    Raises:
        DataError: data that cannot be used. ConfigError: see `check_objective`.
    """
    materials = []
    for i, source in enumerate((config.data.source, *config.tune.more)):
        own = dataclasses.replace(for_source(config, source), seed=config.seed + i) if i else config
        scenario = scenario_of(own)
        material = from_scenario(own, scenario) if scenario is not None else from_recording(own)
        check_objective(config.tune.objective, material.train.truth is not None)
        materials.append(material)
    return materials


def with_objective(config: Config, materials: list[Material]) -> Config:
    """The objective as stated; its default, where nothing is hidden that could drift, is the error against the truth.

    Raises:
        ConfigError: a drift is asked for and a scenario has no outages, or one has and another has not.
    """
    if has_windows(materials):
        return config
    if any(m.windows for m in materials):
        raise ConfigError("tune.more: sources with outages and without: their errors are not of one kind")
    if config.tune.objective == type(config.tune)().objective:
        return dataclasses.replace(config, tune=dataclasses.replace(config.tune, objective={"rmse": 1.0}))
    asked = [name for name in ("drift", "log_drift") if config.tune.objective.get(name)]
    if asked:
        raise ConfigError(f"tune.objective: {asked[0]} needs outages, see data.options.outages_s; or take rmse or nll")
    return config


# ---------------------------------------------------------------------------- search


def search(
    config: Config, materials: list[Material], spec: Spec, surface: likelihood.Surface, progress: bool, long: Long
) -> Fit:
    """The best parameters by validation, or by the likelihood of the training data with scoring.

    Raises:
        FilterError: the objective of the start is not finite.
    """
    t, start = config.tune, materials[0].params
    note = (lambda row: stderr(f"  {row['step']:3d}  {row['loss']:.6g}")) if progress else (lambda row: None)
    try:
        if t.method == "scoring" and long.resume:
            raise ConfigError(f"--resume: {t.method} keeps no checkpoints")
        if t.method == "scoring":
            return likelihood.maximise(surface, spec, start, t.steps, note)
        free = leaves(spec)
        weights = tuple(sorted(t.objective.items()))
        losses = [objective(m.filter, weights, free) for m in materials]
        groups = lambda batches: [TuningCase(b, _many(m.params, b)) for m, b in zip(materials, batches, strict=True)]
        train = groups([m.train for m in materials])
        optimizer = OPTIMIZERS[t.method](t.steps, t.rate, 1.0, t.warmup)
        return fit(
            losses, spec, start, t.steps, optimizer, validation=losses, progress=progress,
            cases=(lambda step: groups([m.redraw(step) for m in materials])) if t.redraw else train,
            validation_cases=groups([m.validation for m in materials]),
            names=[name for m in materials for name in m.train_names],
            explain=lambda params, run: why(materials, params, free, run),
            aggregate=aggregate(t), clip=t.clip or None, prior_weight=1 / max(surface.epochs, 1),
            starts=starts(config, spec, start), patience=t.patience or None,
            folder=long.keep, resume=long.resume, identity=identity(config),
            mesh=distributed.mesh(long.devices),
        )  # fmt: skip
    except DataError:
        raise
    except ValueError as error:
        raise FilterError(f"{materials[0].about}: {error}") from error


def _many(params: Params, runs: Any) -> Params:
    """The parameters once for every run."""
    count = runs.keep.shape[0]
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *jnp.shape(a))), params)


def starts(config: Config, spec: Spec, params: Params) -> list[Params]:
    """More starting points, drawn about the first with an sd of the factor tune.spread (a unit's worth elsewhere)."""
    rng, raw = np.random.default_rng(config.seed), split(spec, params)
    found = []
    for _ in range(config.tune.starts - 1):
        moved = {}
        for name, value in raw.items():
            logs = spec[name].forward is LOG.forward or spec[name].axes
            size = np.log(config.tune.spread) if logs else 1.0
            moved[name] = value + size * rng.normal(size=np.shape(value))
        found.append(join(spec, moved, params))
    return found


def why(materials: list[Material], params: Params, free: tuple[str, ...], index: int) -> str:
    """What went wrong with a run of the training, counted over all materials."""
    for m in materials:
        if index < len(m.train_names):
            break
        index -= len(m.train_names)
    one = lambda tree: jax.tree.map(lambda a: a[index : index + 1], tree)
    info = runs_jit(m.filter, merged(params, m.params, free), one(m.train.nav), one(m.train.epochs))
    info = jax.tree.map(lambda a: np.asarray(a[0]), info)
    failure = first_failure(info, m.t_train)
    if failure:
        return failure
    far = np.flatnonzero((np.abs(np.where(info.valid, info.residual, 0.0)) >= LOST).any(-1))
    if far.size:
        return f"further than {LOST:g} from a measurement at t = {m.t_train[far[0]]:.3f} s"
    return "its gradient is not finite"
