"""Tuning of filter parameters by gradient: `tune` on recordings, `tune_simulated` on runs of scenarios."""

from tuning.recordings.recorded import tune
from tuning.recordings.report import Tuned, load
from tuning.simulated import tune_simulated

__all__ = ["Tuned", "load", "tune", "tune_simulated"]
