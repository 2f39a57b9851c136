"""`jaxnav demo`."""

from typing import Any

from jaxnav.app.verb import FILTER, PARAMS, Verb
from jaxnav.app.verbs.tune import SECTIONS, run, unused

DEFAULTS: dict[str, Any] = {
    "data": {"source": "urban", "imu_worse_by": 3.0, "gnss_latency_s": 0.1},
    "filter": {"cov_stride": 10},
    "tune": {"steps": 24, "rate": 0.25, "runs": 6, "validation_runs": 8, "test_runs": 12, "free": ["noise", "latency"]},
}
"""An IMU three times noisier than its datasheet, and fixes 0.1 s late; the parameters state neither."""

VERB = Verb(
    "demo", "simulate, tune by gradient and draw the figures: no data, no network, two minutes the first time", run,
    (FILTER, PARAMS), sections=SECTIONS, report=True, defaults=lambda args: DEFAULTS, unused=unused,
)  # fmt: skip
