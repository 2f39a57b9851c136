"""`jaxnav config`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import Argument, Job, Verb

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.settings`."""
    from jaxnav.app import settings
    from jaxnav.app.results import Outcome

    return Outcome({}, (settings.page() if job.args.markdown else settings.commented()).rstrip("\n"), {})


VERB = Verb(
    "config", "print every setting with its default and description, as a configuration to fill in", run,
    (Argument("--markdown", "as a page of the docs"),),
    writes=lambda args: False, needs_jax=False,
)  # fmt: skip
