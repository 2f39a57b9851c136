"""`jaxnav info`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import Argument, Job, Verb

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.info`."""
    from jaxnav.app.jobs import info

    return info.info(job.args.clear_cache)


VERB = Verb(
    "info", "versions, devices, filters, data sets, compiled programs", run,
    (Argument("--clear-cache", "remove the compiled programs that are kept"),),
    writes=lambda args: False,
)  # fmt: skip
