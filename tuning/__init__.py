"""Tuning of filter parameters by gradient: objectives, transforms, training, validation; `tune` on a recording."""

from tuning.recorded import Tuned, tune
from tuning.report import load

__all__ = ["Tuned", "load", "tune"]
