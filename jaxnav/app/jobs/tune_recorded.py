"""`jaxnav tune` on recordings, by `tuning.tune`: tempered likelihood, priors, and a verdict."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

from jaxnav.analysis.navigate import navigate
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import stats as plots_stats
from jaxnav.app import prepare as pre
from jaxnav.app.config import Config, Tune, for_source
from jaxnav.app.results import Outcome, picture, stderr
from jaxnav.app.sources import load, scenario_of
from jaxnav.filters.border import unit_of
from jaxnav.filters.catalogue import build
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.types import ConfigError, Recording, nearest
from tuning.free import constant, groups, leaves_of, of_rule, transform_of
from tuning.recorded import Tuned, tune
from tuning.report import shown
from tuning.targets import TARGETS, Target
from tuning.transforms import LOG

FREE = ("noise", "fixes", "timing")  # where [tune] free is not set: a rule's own numbers stay as they are


def is_for(config: Config) -> bool:
    """Recordings, and nothing asked for that only the gradient methods do."""
    t, plain = config.tune, Tune()
    own = ("objective", "redraw", "starts", "patience", "over_runs", "clip", "correlated", "tied", "posterior")
    asked = any(getattr(t, name) != getattr(plain, name) for name in own)
    simulated = any(source in SCENARIOS for source in (config.data.source, *t.more))
    return bool(t.target) or t.method == "tempered" or (t.method == "auto" and not simulated and not asked)


def for_target(config: Config, target: Target) -> Config:
    """The configuration with a target's filter and states, and none of the constraints.

    Raises:
        ConfigError: settings that are the target's to say.
    """
    plain, own = Config(), config.filter
    for key, value in (("name", target.filter), ("states", target.states)):
        if getattr(own, key) not in (getattr(plain.filter, key), value):
            raise ConfigError(f"filter.{key}: tune.target says what filter it is: {target.about}")
    if config.tune.method not in ("auto", "tempered"):
        raise ConfigError(f"tune.target goes with the tempered method, not {config.tune.method}")
    return dataclasses.replace(config, filter=dataclasses.replace(own, name=target.filter, states=target.states))


def tune_recorded(config: Config, folder: Path, progress: bool) -> Outcome:
    """Tune on the recordings, write the winner, the report and the figures.

    Raises:
        DataError: a recording that cannot be used, or is too short. ConfigError: names that are not known.
    """
    if config.tune.priors not in ("datasheet", "none"):
        raise ConfigError(f'tune.priors must be "datasheet" or "none", got {config.tune.priors!r}')
    begin, target = time.perf_counter(), None
    if config.tune.target:
        if config.tune.target not in TARGETS:
            raise ConfigError(f"tune.target: no target {config.tune.target!r}: {nearest(config.tune.target, TARGETS)}")
        target = TARGETS[config.tune.target]
        config = for_target(config, target)
    name, measurements = pre.filter_name(config), pre.measurements_of(config)
    configs = [config, *(for_source(config, source) for source in config.tune.more)]
    recs = [load(own) for own in configs]
    sheets = [
        pre.base_params(own, pre.grade_of(own, scenario_of(own)), rec.lever_arm)
        for own, rec in zip(configs, recs, strict=True)
    ]
    if target:
        sheets = [target.shaped(sheet) for sheet in sheets]
        measurements = tuple(m for m in measurements if m.name in target.measurements)
    params, everywhere = sheets[0], set.intersection(*(set(rec.aiding) for rec in recs))
    chosen = tuple(m for m in measurements if not m.columns or m.name in everywhere or m.name == "velocity")
    filt = build(name, chosen, config.filter.cov_stride, states=config.filter.states)
    plain = Tune()
    named = (target.free if target else FREE) if config.tune.free == plain.free else config.tune.free
    short = groups(chosen, params.states, of_rule(name))
    which = lambda key, names: leaves_of(names, short, params, f"tune.{key}")
    frozen = set(which("frozen", config.tune.frozen))
    free = [leaf for leaf in which("free", named) if leaf not in frozen]
    if not free:
        raise ConfigError("tune.frozen: nothing is left free")
    free = [leaf for leaf in free if not constant(leaf, params)]
    seconds = {"prepare": time.perf_counter() - begin}
    begin = time.perf_counter()
    found = tune(
        recs, filt, sheets, free=free, own=which("own", config.tune.own), widths=widths(config, free, which),
        begin=[pre.start_of(*each) for each in zip(configs, recs, sheets, strict=True)], stop=config.data.stop,
        window=None if config.tune.outage_s == plain.outage_s else config.tune.outage_s,
        priors=config.tune.priors != "none", extend=target is None, standing=pre.standing_of(config),
        say=stderr if progress else lambda line: None,
    )  # fmt: skip
    seconds["tune"] = time.perf_counter() - begin
    begin = time.perf_counter()
    found.write(folder, config.filter.states, exports=target is None)
    if target:
        target.write(folder, recs[0], found.params, found.start)
    if config.out.figures:
        draw(folder, recs[0], found)
    seconds["write"] = time.perf_counter() - begin
    lines = [str(found)]
    if target:
        lines.append(f"for {config.tune.target} ({target.about}): {target.file}")
    for rec, used in zip(recs, found.used, strict=True):
        own = [used.begin.how, *rec.notes.splitlines()]
        lines += own if len(recs) == 1 else [f"{rec.name}: {line}" for line in own]
    return Outcome(found.metrics(), "\n".join(lines), seconds, "interrupted" if found.stopped else "")


def widths(config: Config, free: list[str], which: Callable[..., list[str]]) -> dict[str, float]:
    """Priors of [tune] prior in SI, by leaf; ``which`` says what a name stands for."""
    out = {}
    for key, sd in config.tune.prior.items():
        for leaf in which("prior", (key,)):
            if leaf in free:
                out[leaf] = sd if transform_of(leaf).forward is LOG.forward else sd * unit_of(leaf).factor
    return out


def draw(folder: Path, rec: Recording, found: Tuned) -> None:
    """Drift of the candidates over the test windows, and the winner's run over the first recording."""
    test = found.parts["test"]
    with picture("outage_drift"):
        drift = {name: found.trials[name].drift[test] for name in ("datasheet", shown(found.chosen, found.trials))}
        plots.save(plots_stats.outage_drift(drift), folder / "outage_drift.png")
    with picture("the run"):
        sol = navigate(rec, found.filter, found.params, begin=found.start)
        for name, fig in sol.plot().items():
            plots.save(fig, folder / f"{name}.png")
