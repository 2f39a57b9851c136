"""`jaxnav allan`."""

from typing import TYPE_CHECKING

from jaxnav.app.verb import DATA, MAP, Argument, Job, Verb

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.allan`."""
    from jaxnav.app.jobs import allan

    return allan.allan(job.config, job.folder)


VERB = Verb(
    "allan",
    "Allan deviation of a resting IMU: white noise, bias instability, random walk, Gauss-Markov",
    run,
    (
        *DATA,
        MAP,
        Argument(
            "--start",
            "s, use the recording from here ([data] start)",
            "data.start",
            value="S",
            type=float,
        ),
        Argument("--stop", "s, to here ([data] stop)", "data.stop", value="S", type=float),
    ),
    sections=("data", "out"),
)
