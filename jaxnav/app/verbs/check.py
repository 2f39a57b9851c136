"""`jaxnav check`."""

from typing import TYPE_CHECKING

from jaxnav.app.config import Config
from jaxnav.app.verb import MAP, PATH, Job, Verb, no_effect

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.check`."""
    from jaxnav.app.jobs import check

    return check.check(job.config, job.folder)


def unused(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where a recording is read whole."""
    return no_effect("the whole recording is read", "data.start", "data.stop")


VERB = Verb(
    "check", "find faults of data, units, axes and clocks; write a configuration that runs the recording", run,
    (PATH, MAP), sections=("data", "out"), unused=unused,
)  # fmt: skip
