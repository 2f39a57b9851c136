"""`jaxnav bakeoff`."""

from typing import TYPE_CHECKING, Any

from jaxnav.app.verb import DATA, DEVICES, FILTER, PARAMS, Argument, Job, Verb
from jaxnav.app.verbs.mc import unused
from jaxnav.filters.border import TABLES

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome

DEFAULTS: dict[str, Any] = {
    "data": {"source": "gipkf_urban"},
    "filter": {"name": "gpid,gpid15,gipkf,fwekf,fwekf15,ekf15_gate,ekf15_huber", "cov_stride": 10},
    "bakeoff": {"unseen": ["gipkf_urban_uncalibrated", "gipkf_urban_stress"]},
    "tune": {"steps": 20, "rate": 0.2, "runs": 6, "validation_runs": 4, "test_runs": 16},
}
"""The papers' filters in outages, if nothing else is said."""


def run(job: Job) -> "Outcome":
    """See `jaxnav.app.jobs.bakeoff`."""
    from jaxnav.app.jobs import bakeoff

    return bakeoff.bakeoff(job.config, job.folder, job.progress, job.devices)


VERB = Verb(
    "bakeoff",
    "filters tuned alike on the same scenarios, ranked on runs and scenarios that none has seen",
    run,
    (
        *DATA,
        FILTER,
        PARAMS,
        Argument(
            "--unseen", "scenarios to test on only; SOURCE, --filter take lists too", "bakeoff.unseen",
            value="A,B", type=lambda text: [name.strip() for name in text.split(",")],
        ),
        *DEVICES,
    ),
    sections=("data", "filter", *TABLES, "tune", "bakeoff", "out"),
    report=True, defaults=lambda args: DEFAULTS, unused=unused, simulates=True,
)  # fmt: skip
