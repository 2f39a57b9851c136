"""`jaxnav convert`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import MAP, PATH, Job, Verb
from jaxnav.app.verbs.check import unused

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.check`."""
    from jaxnav.app.jobs import check

    return check.convert(job.config, job.folder)


VERB = Verb(
    "convert", "write a recording of any format as CSV files", run, (PATH, MAP), sections=("data",), unused=unused
)
