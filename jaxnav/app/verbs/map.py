"""`jaxnav map`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import Argument, Job, Verb

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.check`."""
    from jaxnav.app.jobs import check

    return check.drafted(job.args.files)


VERB = Verb(
    "map", "draft a column map of tables from names and numbers of their columns", run,
    (Argument("files", "tables with names in a header, or their folder", value="FILE", reads=True,
              more={"nargs": "+"}),),
    writes=lambda args: False,
)  # fmt: skip
