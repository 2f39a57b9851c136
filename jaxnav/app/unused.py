"""Settings that somebody made and that the job at hand does not use: said, not passed over."""

from collections.abc import Sequence
from dataclasses import fields, replace
from operator import attrgetter

from jaxnav.app.config import Config, Start, resolve
from jaxnav.app.sources import scenario_of
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import stride_within

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
    if verb in ("tune", "bakeoff", "mc"):
        note(f"is of jaxnav filter; {verb} hides fixes by itself", "filter.outages")
    if simulated and verb in ("tune", "demo", "bakeoff", "mc"):
        note("a simulated run is used whole", "data.start", "data.stop")
        used = _stride(config, config.bakeoff.unseen if verb == "bakeoff" else ())
        if used != config.filter.cov_stride:
            note(f"{used} is, which divides the samples of a simulated epoch", "filter.cov_stride")
    if verb in ("bakeoff", "mc"):
        note("filters start as the scenario says", *_START)
    if verb in ("tune", "demo") and config.tune.method in ("lbfgs", "scoring"):
        note(f"{config.tune.method} finds its own steps", "tune.rate", "tune.warmup")
    plain = resolve([("", {"data": {"source": config.data.source}})])
    set_here = [key for key in why if attrgetter(key)(config) != attrgetter(key)(plain)]
    return [f"{key}: {why[key]}" for key in set_here]


def _stride(config: Config, unseen: Sequence[str]) -> int:
    """The stride that simulated runs are filtered with; the configured one of scenarios that the job will refuse."""
    names = [name.strip() for name in config.data.source.split(",")] + list(unseen)
    try:
        each = [scenario_of(replace(config, data=replace(config.data, source=name))) for name in names]
        return stride_within(config.filter.cov_stride, *(one for one in each if one is not None))
    except ValueError:
        return config.filter.cov_stride
