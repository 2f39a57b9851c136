"""Settings that somebody made and that the job at hand does not use: said, not passed over."""

from dataclasses import fields
from operator import attrgetter

from jaxnav.app.config import Config, Start, resolve
from jaxnav.filters.catalogue import FILTERS
from jaxnav.filters.parameters import UNITS
from jaxnav.simulate.scenarios import SCENARIOS

_START = tuple(f"start.{field.name}" for field in fields(Start))


def unused(verb: str, config: Config) -> list[str]:
    """What has no effect, a line each: ``key: why``.

    Only of what a verb reads otherwise: a file may hold the sections of other verbs.
    """
    simulated = config.data.source in SCENARIOS or verb in ("mc", "bakeoff")
    why: dict[str, str] = {}

    def note(text: str, *keys: str) -> None:
        why.update(dict.fromkeys(keys, text))

    if not simulated:
        note("is of simulated data alone", "data.imu_worse_by", "data.gnss_latency_s")
    if verb in ("check", "convert"):
        note("the whole recording is read", "data.start", "data.stop")
    if verb in ("tune", "bakeoff", "mc"):
        note(f"is of jaxnav filter; {verb} hides fixes by itself", "filter.outages")
        note("is of jaxnav filter", "filter.smooth", "filter.lag_s")
    if simulated and verb in ("tune", "demo", "bakeoff", "mc"):
        note("a simulated run is used whole", "data.start", "data.stop")
    if verb in ("filter", "tune") and config.start.heading == "motion":
        found = ("start.course_speed_mps", "start.tilt_sd_deg", "start.heading_sd_deg")
        note('start.heading = "motion" finds it by itself', *(found if not (simulated and verb == "tune") else ()))
    if verb in ("bakeoff", "mc"):
        note("filters start as the scenario says", *_START)
    if verb in ("tune", "demo") and config.tune.method in ("lbfgs", "scoring"):
        note(f"{config.tune.method} finds its own steps", "tune.rate", "tune.warmup")
    if config.filter.smooth:
        note("filter.smooth takes all fixes", "filter.lag_s")
    if config.filter.name in FILTERS:
        held = {"states." + state for state in (*FILTERS[config.filter.name].states, *config.filter.states)}
        for leaf, unit in UNITS.items():
            if leaf.startswith("states.") and leaf.rpartition(".")[0] not in held:
                note(f"{config.filter.name} has no {leaf.split('.')[1]}", f"params.{unit.key}")
    plain = resolve([("", {"data": {"source": config.data.source}})])
    set_here = [key for key in why if attrgetter(key)(config) != attrgetter(key)(plain)]
    return [f"{key}: {why[key]}" for key in set_here]
