"""Tuning of filter parameters by gradient: objectives, transforms, training, validation; `tune` on a recording."""

from tuning.recorded import Tuned, tune

__all__ = ["Tuned", "tune"]
