"""`jaxnav simulate`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import DATA, Job, Verb

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.filtering`."""
    from jaxnav.app.jobs import filtering

    return filtering.simulate(job.config, job.folder)


VERB = Verb("simulate", "write a simulated recording and its truth", run, DATA, sections=("data", "out"))
