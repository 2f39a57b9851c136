"""`jaxnav bakeoff`: filters tuned alike, ranked on runs and scenario types that none has seen."""

import dataclasses
import time
from pathlib import Path

from jaxnav.app.config import Config, as_dict
from jaxnav.app.jobs import mc
from jaxnav.app.results import Outcome, draws, picture
from jaxnav.filters.border import override
from jaxnav.simulate.simulation import matched_params
from jaxnav.types import ConfigError
from tuning import contest_report
from tuning.contest import Kind, Plan, contest, filters
from tuning.fit import distributed


def bakeoff(config: Config, folder: Path, progress: bool = False, devices: int = 1) -> Outcome:
    """Tune and rank the filters of [filter] name, on the scenarios of [data] source and of [bakeoff] unseen.

    Raises:
        ConfigError: a filter or scenario that is not known, or one that does not fit.
        KeyboardInterrupt: before the first filter was finished.
    """
    begin = time.perf_counter()
    names, plan = filters(config.filter.name), plan_of(config)
    found, stopped = contest(names, plan, progress, distributed.mesh(devices))
    result = contest_report.verdict(found, plan)
    contest_report.write(folder, result)
    if draws(config):
        with picture("the ranking"):
            contest_report.draw(result, folder / "bakeoff.png")
    return Outcome(result, contest_report.text(result), {"bakeoff": time.perf_counter() - begin}, stopped)


def plan_of(config: Config) -> Plan:
    """Return the plan that a configuration states.

    Raises:
        ConfigError: see `bakeoff`.
    """
    trained = [name.strip() for name in config.data.source.split(",")]
    twice = [name for name in config.bakeoff.unseen if name in trained]
    if twice:
        raise ConfigError(f"bakeoff.unseen: {twice[0]} is trained on, as data.source says")
    if config.tune.test_runs < 2:
        raise ConfigError("tune.test_runs: an interval needs 2 runs or more")
    first, unseen = (tuple(_kind(config, name) for name in names) for names in (trained, config.bakeoff.unseen))
    t = config.tune
    runs = (t.runs, t.validation_runs, t.test_runs)
    return Plan(first, unseen, t.steps, t.rate, runs, config.seed, config.mc.limit_m, config.filter.cov_stride)


def _kind(config: Config, name: str) -> Kind:
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, source=name))
    scenario = mc.scenario_to_run(config)
    return Kind(scenario, override(matched_params(mc.as_specified(config, scenario)), as_dict(config)))
