"""Tuning of filter parameters by gradient: `tune` on recordings, `tune_simulated` on runs of scenarios,
and `solve`, from a recording to its best trajectory.
"""

from tuning.recordings.recorded import tune
from tuning.recordings.report import Tuned, load
from tuning.simulated import tune_simulated
from tuning.solving.solve import Solved, solve

__all__ = ["Solved", "Tuned", "load", "solve", "tune", "tune_simulated"]
