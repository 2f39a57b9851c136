"""`jaxnav filter`."""

import argparse
from typing import TYPE_CHECKING, Any

from jaxnav.app.config import Config
from jaxnav.app.verb import DATA, FILTER, MAP, PARAMS, Argument, Job, Verb, no_effect
from jaxnav.filters.border import TABLES

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome

# ten minutes at usual rates: recordings of similar ones share its programs (`jaxnav.filters.epochs.pad_to_bucket`)
WARM: dict[str, Any] = {"data": {"source": "urban", "options": {"duration_s": 600.0, "imu_rate_hz": 100.0}}}


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.filtering`."""
    from jaxnav.app.jobs import filtering, info

    outcome = filtering.filter(job.config, job.folder)
    return outcome._replace(text=info.programs()) if job.args.warm else outcome


def defaults(args: argparse.Namespace) -> dict[str, Any]:
    """Return the recording to compile for where none is named."""
    return WARM if args.warm and not (args.source or args.data or args.config) else {}


def unused(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where the motion shows the start."""
    if config.initialization.heading != "motion":
        return {}
    found = ("initialization.course_speed_mps", "initialization.tilt_sd_deg", "initialization.heading_sd_deg")
    return no_effect('initialization.heading = "motion" finds it by itself', *found)


VERB = Verb(
    "filter",
    "run a filter over a recording: solution, metrics, figures",
    run,
    (
        *DATA,
        MAP,
        FILTER,
        PARAMS,
        Argument("--smooth", "by all fixes, those after it too ([filter] smooth)", "filter.smooth"),
        Argument("--lag", "by the fixes of the next S seconds ([filter] lag_s)", "filter.lag_s", value="S", type=float),
        Argument("--warm", "compile for recordings like this one and write nothing: before a demo"),
    ),
    sections=("data", "filter", "initialization", *TABLES, "time", "out"), writes=lambda args: not args.warm,
    report=True, defaults=defaults, unused=unused,
)  # fmt: skip
