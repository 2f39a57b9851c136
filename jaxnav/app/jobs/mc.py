"""`jaxnav mc`."""

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxnav.analysis import montecarlo
from jaxnav.analysis.montecarlo import MonteCarlo
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import montecarlo as plots_mc
from jaxnav.analysis.tables import table
from jaxnav.app import prepare as pre
from jaxnav.app.config import Config, as_dict
from jaxnav.app.long import Long, identity
from jaxnav.app.results import Outcome, draws, picture
from jaxnav.app.sources import scenario_of
from jaxnav.filters.border import override
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.parameters import history_for
from jaxnav.findings import finding
from jaxnav.io.json import write_json
from jaxnav.measurements import GNSS
from jaxnav.simulate.scenarios import SCENARIOS, Scenario
from jaxnav.simulate.simulation import matched_params, sizes
from jaxnav.types import ConfigError, FilterError, Finding, Json, nearest
from tuning.fit import checkpoint, distributed

CHECKPOINT_INTERVAL_S = 30.0  # s between two checkpoints
LEAF: Any = 0
SHAPE = montecarlo.Progress(
    LEAF, LEAF, montecarlo.Scores(*[LEAF] * len(montecarlo.Scores._fields)), montecarlo.Sums(*[LEAF] * 8)
)  # the structure of a checkpoint


def mc(config: Config, folder: Path, progress: bool = False, long: Long | None = None) -> Outcome:
    """Run every filter of [filter] name over the same simulated runs; table, metrics, figures.

    With ``long``, finished runs are checkpointed now and then, and a resumed job continues from there, bit for bit.

    The filters know the scenario's datasheet, prior and installation; parameters of the configuration go first.

    Raises:
        ConfigError: the source is no scenario, or names that are not known.
        FilterError: every run of every filter diverged.
    """
    scenario, long = scenario_to_run(config), Long() if long is None else long
    found, seconds, stopped = {}, {}, ""
    mesh = distributed.mesh(long.devices)
    if mesh is not None and config.mc.chunk % mesh.size:
        raise ConfigError(f"mc.chunk: {config.mc.chunk} runs cannot be shared among {mesh.size} devices")
    for each in _each(config):
        name, begin = pre.filter_name(each), time.perf_counter()
        entry = FILTERS[name]
        params = override(
            matched_params(as_specified(each, scenario), entry.theta(), entry.feedback_theta()), as_dict(config)
        )
        rate, span = scenario.imu_rate_hz, scenario.duration_s
        history = history_for(params, rate, span)
        filt = build(name, GNSS, config.filter.cov_stride, history, adapter=pre.adapter_name(each))
        params = pre.with_weights(each, params._replace(adapter=filt.params().adapter))
        try:
            found[name] = montecarlo.monte_carlo(
                filt, scenario, params, config.mc.runs, config.seed, chunk=config.mc.chunk,
                limit_m=config.mc.limit_m, progress=progress, mesh=mesh, **kept(config, name, long),
            )  # fmt: skip
        except KeyboardInterrupt:
            if not found:
                raise
            stopped = f"before {name} had finished a run"
            break
        seconds[name] = time.perf_counter() - begin
        if found[name].stopped:
            stopped = f"{name} after {found[name].runs.size} of {config.mc.runs} runs"
            break
    about = {name: montecarlo.summary(runs) for name, runs in found.items()}
    if not any("scores" in one for one in about.values()):
        raise FilterError(f"every run of {', '.join(about)} on {scenario.name} diverged")
    write_json(folder / "metrics.json", about)
    np.savez_compressed(folder / "runs.npz", **_per_run(found))  # type: ignore[arg-type]
    if draws(config):
        with picture("the runs"):
            for name, fig in plots_mc.figures(found, scenario.gnss.outages_s).items():
                plots.name(fig, name, scenario.name)
                plots.save(fig, folder / f"{name}.png")
    return Outcome(about, _text(about, scenario), seconds, stopped, findings=findings_of(about))


def kept(config: Config, name: str, long: Long) -> Json:
    """Return the checkpoint of a filter's runs to resume from, and the function that writes it.

    Raises:
        CheckpointError: nothing usable to resume from.
    """
    if long.keep is None:
        return {}
    path, job, written = long.keep / f"mc_{name}.npz", f"{name} {identity(config)}", [time.monotonic()]
    finished = None
    if long.resume and path.exists():
        leaves = checkpoint.load(path, None, job).tree
        finished = jax.tree.unflatten(jax.tree.structure(SHAPE), leaves)
        finished = finished._replace(done=int(finished.done))

    def keep(now: montecarlo.Progress) -> None:
        if time.monotonic() > written[0] + CHECKPOINT_INTERVAL_S or now.done >= config.mc.runs:
            if distributed.writes():
                checkpoint.save(path, now, {}, job)
            written[0] = time.monotonic()

    return {"resume": finished, "keep": keep}


def scenario_to_run(config: Config) -> Scenario:
    """Return the scenario that [data] names, fit to be simulated.

    Raises:
        ConfigError: there is none, or one that does not fit together.
    """
    scenario = scenario_of(config)
    if scenario is None:
        known = nearest(config.data.source, SCENARIOS)
        raise ConfigError(f"data.source: a scenario is needed, got {config.data.source!r}: {known}")
    if pre.measurements_of(config) != GNSS:
        raise ConfigError("filter: simulated runs have a receiver only, switch the constraints off")
    if scenario.sensors or scenario.sensor_states:
        raise ConfigError("data.options.sensors: runs of mc have a receiver only; see jaxnav simulate")
    try:
        sizes(scenario)
    except ValueError as error:
        raise ConfigError(f"data.options: {error}") from error
    return scenario


def as_specified(config: Config, scenario: Scenario) -> Scenario:
    """Return the scenario as the filters know it: with the grade of [filter], if one is named."""
    if not config.filter.grade:
        return scenario
    pre.grade_of(config, scenario)
    return scenario._replace(imu=scenario.imu._replace(grade=config.filter.grade))


def _each(config: Config) -> list[Config]:
    """Return the configuration with each of the filters, which [filter] name separates by commas."""
    names = [name.strip() for name in config.filter.name.split(",")]
    each = [dataclasses.replace(config, filter=dataclasses.replace(config.filter, name=name)) for name in names]
    for one in each:
        pre.filter_name(one)
    return each


def _per_run(found: dict[str, MonteCarlo]) -> dict[str, np.ndarray]:
    """Every score of every run, by ``filter.score``."""
    return {
        f"{name}.{score}": values
        for name, one in found.items()
        for score, values in {"run": one.runs, **jax.tree.map(np.asarray, one.scores)._asdict()}.items()
    }


def _text(about: Json, scenario: Scenario) -> str:
    scored = [(name, one["scores"]) for name, one in about.items() if "scores" in one]
    rows = [[name, score, *s.values()] for name, scores in scored for score, s in scores.items()]
    head = ["filter", "RMS of a run", "mean", "sd", "5 %", "median", "95 %"]
    runs = max(one["runs"] for one in about.values())
    return "\n".join([f"{runs} runs of {scenario.name}", table(head, rows), ""])


def findings_of(about: Json) -> list[Finding]:
    """Return divergences and the consistency of every filter."""
    out = []
    for name, one in about.items():
        bad = one["diverged"]
        if bad:
            first = ", ".join(f"{b['run']} ({b['t_s']:g} s)" for b in bad[:8]) + (", ..." if len(bad) > 8 else "")
            out.append(finding("mc.diverged", name, float(len(bad)), runs=one["runs"], first=first))
        if "scores" not in one:
            continue
        out.append(finding("mc.anees", name, one["anees"]["mean"], share=100 * one["anees"]["share_inside"]))
        if one.get("anis"):
            low, high = one["anis"]["bounds"]
            out.append(finding("mc.anis", name, one["anis"]["mean"], high, low=low))
    return out
