"""`jaxnav data`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import Argument, Job, Verb
from jaxnav.types import ConfigError

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.info`."""
    from jaxnav.app.jobs import info

    if job.args.action != "list" and not job.args.name:
        raise ConfigError(f"data {job.args.action} needs the name of a data set")
    return info.data(job.args.action, job.args.name)


VERB = Verb(
    "data", "list, fetch or check public data sets", run,
    (
        Argument("action", "list, fetch or check", more={"choices": ("list", "fetch", "check")}),
        Argument("name", "of the data set; check also takes a path", more={"nargs": "?"}),
    ),
    writes=lambda args: False,
)  # fmt: skip
