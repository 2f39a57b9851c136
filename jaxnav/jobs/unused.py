"""Settings that somebody made and that the job at hand does not use: said, not passed over."""

import dataclasses
from operator import attrgetter

from jaxnav.config import Config, Start, resolve
from jaxnav.scenarios import SCENARIOS

_START = tuple(f"start.{field.name}" for field in dataclasses.fields(Start))


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
    if verb in ("tune", "bakeoff", "mc"):
        note(f"is of jaxnav filter; {verb} hides fixes by itself", "filter.outages")
    if simulated and verb in ("tune", "demo", "bakeoff", "mc"):
        note("a simulated run is used whole", "data.start", "data.stop")
    if verb in ("bakeoff", "mc"):
        note("filters start as the scenario says", *_START)
    if verb in ("tune", "demo") and config.tune.method in ("lbfgs", "scoring"):
        note(f"{config.tune.method} finds its own steps", "tune.rate", "tune.warmup")
    plain = resolve([("", {"data": {"source": config.data.source}})])
    set_here = [key for key in why if attrgetter(key)(config) != attrgetter(key)(plain)]
    return [f"{key}: {why[key]}" for key in set_here]
