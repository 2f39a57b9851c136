"""`jaxnav tune` and `jaxnav demo`: tune on training data, show the gain on test data."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import stats as plots_stats
from jaxnav.app.config import Config, Tune, for_source
from jaxnav.app.long import Long, identity
from jaxnav.app.prepare import base_params, filter_of, grade_of, initialization_of, measurements_of, standing_of
from jaxnav.app.results import Outcome, draws, picture, stderr
from jaxnav.app.sources import load, scenario_of
from jaxnav.filters.border import name_of, unit_of, user_value
from jaxnav.filters.core import Filter
from jaxnav.initialization.initialize import Initialization
from jaxnav.measurements import GNSS
from jaxnav.navigation import navigate
from jaxnav.simulate.scenarios import SCENARIOS, Scenario
from jaxnav.types import ConfigError, Params, Recording, nearest
from tuning import tune as tune_recordings
from tuning import tune_simulated
from tuning.fit import distributed
from tuning.fit.optimizers import OPTIMIZERS
from tuning.fit.status import Status
from tuning.fit.transforms import LOG
from tuning.recordings.free import leaves_of, transform_of
from tuning.recordings.report import Tuned, reported_candidate, user_history
from tuning.recordings.runs import Descent, check_objective
from tuning.recordings.search import Checkpoints
from tuning.recordings.targets import TARGETS, Target

METHODS = ("auto", "tempered", "scoring", *OPTIMIZERS)
RUNS = ("runs", "Horizontal error of a run, RMS (m)")  # labels of a figure of errors where no window is hidden
FREE_RECORDED = ("noise", "fixes", "timing")
FREE_SIMULATED = ("noise", "timing", "rule")


class Result(NamedTuple):
    """Result of tuning, and its context."""

    found: Tuned
    lines: list[str]  # after the table
    recording: Recording | None = None  # the first one
    initialization: Initialization | None = None  # of it
    target: Target | None = None


def tune(config: Config, folder: Path, progress: bool = False, long: Long | None = None) -> Outcome:
    """Tune, judge on test data, write parameters, history, metrics and figures.

    Raises:
        ConfigError: settings that do not go together.
        DataError: a recording that cannot be used, or is too short.
        FilterError: the starting filter stops being finite.
        CheckpointError: nothing usable to resume from.
    """
    long = Long() if long is None else long
    simulated = by_runs(config)
    check(config, simulated)
    begin = time.perf_counter()
    log = stderr if progress else lambda line: None
    result = (on_scenarios if simulated else on_recordings)(config, long, progress, log)
    found, seconds = result.found, {"tune": time.perf_counter() - begin}
    begin = time.perf_counter()
    found.write(folder, config.filter.states, exports=result.target is None)
    if result.target and result.recording and result.initialization:
        result.target.write(folder, result.recording, found.params, result.initialization)
    pictures, layout = draw(folder, result, config) if config.out.figures != "none" else ([], None)
    seconds["write"] = time.perf_counter() - begin
    stopped = "interrupted" if found.status is Status.INTERRUPTED else ""
    text = "\n".join([str(found), *result.lines])
    return Outcome(found.metrics(), text, seconds, stopped, layout, findings=found.findings, pictures=pictures)


def by_runs(config: Config) -> bool:
    """Are many simulated runs tuned on? Else each source is one recording, a scenario's with its truth."""
    sources = (config.data.source, *config.tune.more)
    return all(s in SCENARIOS for s in sources) and not config.tune.target and config.tune.method != "tempered"


def check(config: Config, simulated: bool) -> None:
    """Refuse settings that do not go together, before anything is read.

    Raises:
        ConfigError: names the setting.
    """
    t = config.tune
    check_objective(t.objective)
    if t.method not in METHODS:
        raise ConfigError(f"tune.method: no method {t.method!r}: {nearest(t.method, METHODS)}")
    if t.priors not in ("datasheet", "none"):
        raise ConfigError(f'tune.priors must be "datasheet" or "none", got {t.priors!r}')
    if t.target and t.target not in TARGETS:
        raise ConfigError(f"tune.target: no target {t.target!r}: {nearest(t.target, TARGETS)}")
    if t.target and t.method not in ("auto", "tempered"):
        raise ConfigError(f"tune.target goes with the tempered method, not {t.method}")
    if t.method == "scoring" and not simulated:
        raise ConfigError('tune.method: scoring is for simulated runs; for recordings "tempered" with tune.priors')
    if t.method == "scoring" and {name for name, w in t.objective.items() if w} != {"nll"}:
        raise ConfigError('tune.method: scoring is for tune.objective = "nll" alone')


def descent_of(config: Config, long: Long, progress: bool) -> Descent:
    """Return the gradient search that [tune] states."""
    t = config.tune
    method = "adam" if t.method == "auto" else t.method
    if method == "scoring" and long.resume:
        raise ConfigError("--resume: scoring keeps no checkpoints")
    return Descent(
        t.objective, method, t.steps, t.rate, long.keep, long.resume, identity(config),
        distributed.mesh(long.devices), progress,
    )  # fmt: skip


class Free(NamedTuple):
    """The leaves that [tune] frees."""

    leaves: list[str]
    per_recording: list[str]  # leaves with one value for each recording
    prior_sd: dict[str, float]  # priors in SI, by leaf


def free_of(config: Config, filt: Filter, params: Params, usual: tuple[str, ...]) -> Free:
    """Return the free leaves of [tune]: leaves of names, less the frozen ones.

    Raises:
        ConfigError: a name that is not known, nothing left, or a prior that is none.
    """
    t = config.tune
    which = lambda key, names: leaves_of(filt, params, names, f"tune.{key}")
    frozen = set(which("frozen", t.frozen))
    leaves = [leaf for leaf in which("free", t.free or usual) if leaf not in frozen]
    if not leaves:
        raise ConfigError("tune.frozen: nothing is left free")
    prior_sd = {}
    for key, sd in t.prior.items():
        found = which("prior", (key,))
        if not set(found) & set(leaves):
            raise ConfigError(f"tune.prior: {key} is not in tune.free, where it would have to be")
        for leaf in found:
            positive = transform_of(leaf).forward is LOG.forward
            if not sd > (1.0 if positive else 0.0):
                limit = "a factor above 1" if positive else "above 0"
                raise ConfigError(f"tune.prior.{key}: one sd must be {limit}, got {sd:g}")
            prior_sd[leaf] = sd if positive else sd * unit_of(leaf).factor
    return Free(leaves, which("per_recording", t.per_recording), prior_sd)


# ---------------------------------------------------------------------------- recordings


def on_recordings(config: Config, long: Long, progress: bool, log: Callable[[str], None]) -> Result:
    """Tune on recordings: by tempered likelihood, or an objective by gradient where one is stated."""
    t = config.tune
    gradient = t.method in OPTIMIZERS or (t.method == "auto" and t.objective != Tune().objective)
    checkpoints = None if gradient or long.keep is None else Checkpoints(long.keep, long.resume, identity(config))
    target = TARGETS[t.target] if t.target else None
    if target:
        config = for_target(config, target)
    measurements = measurements_of(config)
    configs = [config, *(for_source(config, source) for source in t.more)]
    recs = [load(each) for each in configs]
    datasheets = [
        base_params(each, grade_of(each, scenario_of(each)), rec.lever_arm)
        for each, rec in zip(configs, recs, strict=True)
    ]
    if target:
        datasheets = [target.shaped(datasheet) for datasheet in datasheets]
        measurements = tuple(m for m in measurements if m.name in target.measurements)
    everywhere = set.intersection(*(set(rec.aiding) for rec in recs))
    chosen = tuple(m for m in measurements if not m.columns or m.name in everywhere or m.name == "velocity")
    filt = filter_of(config, chosen)
    free = free_of(config, filt, datasheets[0], target.free if target else FREE_RECORDED)
    begins = [initialization_of(*each) for each in zip(configs, recs, datasheets, strict=True)]
    found = tune_recordings(
        recs, filt, datasheets, free=free.leaves, per_recording=free.per_recording, prior_sd=free.prior_sd,
        initialization=begins, stop=config.data.stop, window=t.outage_s or None, hidden_satellites=t.hidden_satellites,
        priors=t.priors != "none",
        extend=target is None, standing=standing_of(config),
        how=descent_of(config, long, progress) if gradient else None, checkpoints=checkpoints, log=log,
    )  # fmt: skip
    lines = [f"for {t.target} ({target.about}): {target.file}"] if target else []
    lines += notes_on(recs, [used.facts["initialization"] for used in found.used])
    return Result(found, lines, recs[0], begins[0], target)


def notes_on(recs: Sequence[Recording], starts: Sequence[str]) -> list[str]:
    """Return how each recording starts and what its reader notes, with its name where there are several."""
    named = "" if len(recs) == 1 else "{name}: "
    return [
        named.format(name=rec.name) + line
        for rec, start in zip(recs, starts, strict=True)
        for line in (start, *rec.notes.splitlines())
    ]


def for_target(config: Config, target: Target) -> Config:
    """Return the configuration with a target's filter and states, and none of the constraints.

    Raises:
        ConfigError: settings that are the target's to say.
    """
    plain, chosen = Config(), config.filter
    for key, value in (("name", target.filter), ("states", target.states)):
        if getattr(chosen, key) not in (getattr(plain.filter, key), value):
            raise ConfigError(f"filter.{key}: tune.target sets it: {target.about}")
    return dataclasses.replace(config, filter=dataclasses.replace(chosen, name=target.filter, states=target.states))


# ---------------------------------------------------------------------------- simulated


def on_scenarios(config: Config, long: Long, progress: bool, log: Callable[[str], None]) -> Result:
    """Tune over simulated runs of scenarios by gradient; where nothing is hidden, by default for the RMS error."""
    t = config.tune
    configs = [config, *(for_source(config, source) for source in t.more)]
    scenarios = [scenario for each in configs if (scenario := scenario_of(each)) is not None]
    for each, scenario in zip(configs, scenarios, strict=True):
        require_plain(each, scenario)
    if t.objective == Tune().objective and not any(s.gnss.outages_s or s.gnss.random_outages for s in scenarios):
        config = dataclasses.replace(config, tune=dataclasses.replace(t, objective={"rmse": 1.0}))
    params = [simulated_params(each, scenario) for each, scenario in zip(configs, scenarios, strict=True)]
    filt = filter_of(config, GNSS)
    free = free_of(config, filt, params[0], FREE_SIMULATED)
    found = tune_simulated(
        scenarios, filt, params, descent_of(config, long, progress), free=free.leaves, prior_sd=free.prior_sd,
        priors=t.priors != "none", counts=(t.runs, t.validation_runs, t.test_runs), seed=config.seed, log=log,
    )  # fmt: skip
    return Result(found, [])


def require_plain(config: Config, scenario: Scenario) -> None:
    """Raise ConfigError for settings that need a recording."""
    if measurements_of(config) != GNSS:
        raise ConfigError("filter: constraints are tuned on recordings: simulate one, and tune with FOLDER")
    if config.initialization.heading == "unknown":
        raise ConfigError('initialization.heading = "unknown" cannot be tuned: give degrees, "course" or "truth"')
    if scenario.sensors or scenario.sensor_states:
        raise ConfigError("data.options.sensors: tuned on recordings: simulate one, and tune with FOLDER")
    start, simulated = config.initialization, scenario.start
    if simulated.prior_tilt_sd_deg > start.tilt_sd_deg or simulated.prior_heading_sd_deg > start.heading_sd_deg:
        raise ConfigError("initialization: tilt_sd_deg and heading_sd_deg must not be below the scenario's")


def simulated_params(config: Config, scenario: Scenario) -> Params:
    """Return the parameters that a scenario's filter starts from."""
    start, simulated = config.initialization, scenario.start
    sd = start.position_sd_m or simulated.prior_position_sd_m, start.velocity_sd_mps or simulated.prior_velocity_sd_mps
    return base_params(config, grade_of(config, scenario), np.array(scenario.gnss.lever_arm_m), *sd)


# ---------------------------------------------------------------------------- figures


def draw(folder: Path, result: Result, config: Config) -> tuple[list[str], Callable[[], Any] | None]:
    """Draw the candidates' drift over the test windows and the search, and run the winner over the first recording.

    Returns:
        Names of the files, and what makes the interactive figures of that run.
    """
    found, test, files = result.found, result.found.parts["test"], []

    def save(fig: Any, name: str) -> None:
        plots.save(fig, folder / name)
        files.append(name)

    names = ("datasheet", reported_candidate(found.chosen))
    with picture("the drift"):
        drift = {name: found.trials[name].drift[test] for name in names}
        if found.used[0].windows_hidden:
            save(plots_stats.outage_drift(drift), "outage_drift.png")
        else:
            save(plots_stats.outage_drift(drift, labelled=RUNS), "run_error.png")
    history = [row for row in user_history(found.history) if "params" in row]
    if history:
        with picture("the search"):
            true = {name_of(leaf): user_value(leaf, value) for leaf, value in found.used[0].known.items()}
            save(plots_stats.tuning(history, true), "tuning.png")
    if result.recording is None or result.initialization is None:
        return files, None
    sol = None
    with picture("the run"):
        sol = navigate(result.recording, found.filter, found.params, initialization=result.initialization)
        for name, fig in sol.plot().items() if draws(config, interactive=True) else ():
            plots.name(fig, name, f"{found.filter.name}, tuned")
            plots.save(fig, folder / f"{name}.png")
    return files, None if sol is None else sol.layout
