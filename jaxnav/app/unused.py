"""Settings that are stated and not used by the job at hand: reported, not ignored."""

from operator import attrgetter

from jaxnav.app.config import Config, resolve
from jaxnav.app.verb import Verb
from jaxnav.filters.border import NAMES
from jaxnav.filters.catalogue import FILTERS
from jaxnav.simulate.scenarios import SCENARIOS


def unused(verb: Verb, config: Config) -> list[str]:
    """Return the settings without effect, a line each: ``key: why``.

    Only of sections that the verb reads: a file may hold the sections of other verbs.
    """
    simulated = config.data.source in SCENARIOS or verb.simulates
    why = verb.unused(config, simulated)

    def note(text: str, *keys: str) -> None:
        why.update(dict.fromkeys(keys, text))

    if not simulated:
        note("applies to simulated data only", "data.imu_worse_by", "data.gnss_latency_s")
    if config.filter.smooth:
        note("filter.smooth takes all fixes", "filter.lag_s")
    if config.filter.name in FILTERS:
        held = {"states." + state for state in (*FILTERS[config.filter.name].states, *config.filter.states)}
        for leaf in NAMES:
            if leaf.startswith("states.") and leaf.rpartition(".")[0] not in held:
                note(f"{config.filter.name} has no {leaf.split('.')[1]}", NAMES[leaf])
    plain = resolve([("", {"data": {"source": config.data.source}})])
    set_here = [key for key in why if attrgetter(key)(config) != attrgetter(key)(plain)]
    return [f"{key}: {why[key]}" for key in set_here]
