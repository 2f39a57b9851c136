"""`jaxnav solve`."""

from typing import TYPE_CHECKING

from jaxnav.app.config import Config
from jaxnav.app.verb import MAP, PATH, Argument, Job, Verb, no_effect
from jaxnav.filters.border import TABLES

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.solve`."""
    from jaxnav.app.jobs import solve

    return solve.run(job, job.args.fast, job.args.time)


def unused(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings that are found from the recording."""
    chosen = (
        "name", "grade", "states", "measurements", "cov_stride", "interval_s", "smooth", "lag_s", "sd_factor",
        "velocity_sd_factor", "delay_sd_s", "clock_rate_sd_ppm", "outages", "standing_window_s",
        "standing_accel_sd_mps2", "standing_gyro_sd_deg_per_s",
    )  # fmt: skip
    return no_effect("is found from the recording", *(f"filter.{key}" for key in chosen))


VERB = Verb(
    "solve", "the best trajectory of a recording, without settings: check, tune, smooth, and a verdict", run,
    (
        PATH,
        MAP,
        Argument("--fast", "do not tune"),
        Argument("--time", "end within S seconds, with the best that they allow", value="S", type=float),
    ),
    sections=("data", "filter", "initialization", *TABLES, "time", "out"), report=True, unused=unused,
)  # fmt: skip
