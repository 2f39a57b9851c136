"""`jaxnav bakeoff`: filters tuned alike, ranked on runs and scenario types that none has seen."""

import dataclasses
import time
from pathlib import Path

from jaxnav.app import bakeoff_report
from jaxnav.app.config import Config, as_dict
from jaxnav.app.contest import REFERENCES, Kind, Plan, contest
from jaxnav.app.jobs import mc
from jaxnav.app.results import Outcome
from jaxnav.filters.border import override
from jaxnav.filters.catalogue import FILTERS
from jaxnav.simulate.simulation import matched_params
from jaxnav.types import ConfigError, nearest
from tuning import distributed


def bakeoff(config: Config, folder: Path, progress: bool = False, devices: int = 1) -> Outcome:
    """Tune and rank the filters of [filter] name, on the scenarios of [data] source and those of [bakeoff] unseen.

    Raises:
        ConfigError: a filter or scenario that is not known, or one that does not fit.
        KeyboardInterrupt: before the first filter was finished.
    """
    begin = time.perf_counter()
    names, plan = filters(config.filter.name), plan_of(config)
    found, stopped = contest(names, plan, progress, distributed.mesh(devices))
    result = bakeoff_report.verdict(found, plan)
    bakeoff_report.write(folder, result, config.out.figures)
    return Outcome(result, bakeoff_report.text(result), {"bakeoff": time.perf_counter() - begin}, stopped)


def filters(text: str) -> list[str]:
    """The filters that a list A,B,... names, or all of them; the references first.

    Raises:
        ConfigError: there is no such filter.
    """
    given = list(FILTERS) if text.strip() == "all" else [name.strip() for name in text.split(",")]
    for name in given:
        if name not in FILTERS:
            raise ConfigError(f"filter.name: no filter {name!r}: {nearest(name, FILTERS)}")
    return list(dict.fromkeys([*REFERENCES, *given]))


def plan_of(config: Config) -> Plan:
    """The plan that a configuration states.

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
    return Plan(first, unseen, config.tune, config.seed, config.mc.limit_m, config.filter.cov_stride)


def _kind(config: Config, name: str) -> Kind:
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, source=name))
    scenario = mc.scenario_to_run(config)
    return Kind(scenario, override(matched_params(mc.as_specified(config, scenario)), as_dict(config)))
