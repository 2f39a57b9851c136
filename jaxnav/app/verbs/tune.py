"""`jaxnav tune`."""

from typing import TYPE_CHECKING

from jaxnav.app.config import Config
from jaxnav.app.verb import DATA, DEVICES, FILTER, MAP, PARAMS, RESUME, Argument, Job, Verb, no_effect
from jaxnav.app.verbs import filter
from jaxnav.filters.border import TABLES

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome

SECTIONS = ("data", "filter", "initialization", *TABLES, "tune", "out")


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.tune`."""
    from jaxnav.app.jobs import tune

    return tune.tune(job.config, job.folder, job.progress, job.long)


def unused(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where fixes are hidden by the tuner, and by the method."""
    found = no_effect("tuning hides fixes by itself", "filter.outages")
    found |= no_effect("is of jaxnav filter", "filter.smooth", "filter.lag_s")
    if simulated:
        found |= no_effect("a simulated run is used whole", "data.start", "data.stop")
        found |= no_effect("simulated runs have the scenario's outages", "tune.outage_s")
    else:
        found |= filter.unused(config, simulated)
        found |= no_effect("is of simulated runs", "tune.runs", "tune.validation_runs", "tune.test_runs")
    if config.tune.method in ("lbfgs", "scoring"):
        found |= no_effect(f"{config.tune.method} chooses its steps", "tune.rate")
    return found


VERB = Verb(
    "tune",
    "tune a filter's parameters and show the gain on test data",
    run,
    (
        *DATA,
        MAP,
        FILTER,
        PARAMS,
        Argument("--for", "another filter, such as kfgins, px4", "tune.target", value="TARGET"),
        RESUME,
        *DEVICES,
    ),
    sections=SECTIONS, report=True, unused=unused,
)  # fmt: skip
