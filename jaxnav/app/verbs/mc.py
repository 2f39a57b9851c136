"""`jaxnav mc`."""

from dataclasses import fields
from typing import TYPE_CHECKING

from jaxnav.app.config import Config, Initialization
from jaxnav.app.verb import DATA, DEVICES, FILTER, PARAMS, RESUME, Argument, Job, Verb, no_effect
from jaxnav.filters.border import TABLES

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.mc`."""
    from jaxnav.app.jobs import mc

    return mc.mc(job.config, job.folder, job.progress, job.long)


def unused(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where scenarios are run whole and hide fixes by themselves."""
    return {
        **no_effect("scenarios hide fixes by themselves", "filter.outages"),
        **no_effect("is of jaxnav filter", "filter.smooth", "filter.lag_s"),
        **no_effect("a simulated run is used whole", "data.start", "data.stop"),
        **no_effect(
            "filters start as the scenario says", *(f"initialization.{f.name}" for f in fields(Initialization))
        ),
    }


VERB = Verb(
    "mc",
    "Monte Carlo: filters over many simulated runs, errors, consistency, divergence",
    run,
    (
        *DATA,
        FILTER,
        PARAMS,
        Argument("--runs", "how many ([mc] runs); --filter takes A,B,...", "mc.runs", value="N", type=int),
        RESUME,
        *DEVICES,
    ),
    sections=("data", "filter", *TABLES, "mc", "out"), report=True, unused=unused, simulates=True,
)  # fmt: skip
