"""`jaxnav compare`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import Argument, Job, Verb

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.compare`; a single run is printed once more."""
    from jaxnav.app.jobs import compare

    if len(job.args.paths) == 1:
        return compare.show(job.args.paths[0])
    return compare.compare(job.args.paths, job.folder, job.config.out.figures != "none")


VERB = Verb(
    "compare",
    "finished runs side by side: figures and settings that differ, tracks over one another; one alone is printed again",
    run,
    (Argument("paths", "of finished runs of one verb", reads=True, value="FOLDER", more={"nargs": "+"}),),
    sections=("out",),
    writes=lambda args: len(args.paths) > 1,
)
