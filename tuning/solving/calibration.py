"""Stated standard deviations against the errors of hidden fixes, by age, and a factor for them."""

from typing import NamedTuple

import numpy as np
from scipy.stats import binom

from tuning.recordings.experiment import Scored
from tuning.recordings.parts import AGES

CHI2_95 = 5.991  # of 2 degrees of freedom
MIN_ERROR_OVER_SD = 0.7  # of sd that are not too large
MIN_FACTOR = 1.1  # of sd that are too small on the test part, below which they stay as they are


class Consistency(NamedTuple):
    """Horizontal errors of hidden positions or velocities against their stated sd."""

    error_over_sd: float  # rms; 1 where the sd are right
    inside_95: float  # share inside the stated 95 %
    fixes: int  # hidden

    @property
    def interval(self) -> tuple[float, float]:
        """Share inside that right sd show with a probability of 95 %: fixes of one window are one observation."""
        windows = max(1, self.fixes // len(AGES))
        low, high = binom.ppf([0.025, 0.975], windows, 0.95) / windows
        return float(low), float(high)

    @property
    def too_small(self) -> bool:
        """Are the sd too small?"""
        return self.inside_95 < self.interval[0]

    @property
    def too_large(self) -> bool:
        """Are the sd too large, by the share inside and by the errors?"""
        return self.inside_95 > self.interval[1] and self.error_over_sd < MIN_ERROR_OVER_SD


class Age(NamedTuple):
    """The same at one age of the windows."""

    age_s: float  # mean
    error_m: float  # rms, horizontal
    stated_m: float  # rms, horizontal, with the fix's noise
    inside_95: float
    fixes: int


class Calibration(NamedTuple):
    """Stated sd on data that are kept aside."""

    factor: float  # that the stated sd are multiplied by
    before: Consistency  # on the test part, as the filter states them
    after: Consistency  # and with the factor
    ages: list[Age]  # of the test part, with the factor
    velocity: Consistency | None = None  # of hidden velocities of the test part, with their factor
    velocity_factor: float = 1.0  # that the stated sd of velocities are multiplied by


def calibrate(final: Scored) -> Calibration:
    """Compare hidden fixes of the test part with their stated sd, and find the factor that the sd need.

    The factor is of the training and validation windows; it applies where the test windows say as well that the sd are
    too small. Sd that are too large stay.

    Args:
        final: the filter, over the windows.
    """
    known, test = final.hidden("training", "validation"), final.hidden("test")
    before, factor = consistency(test.nees()), needed(known.nees(), test.nees())
    nees = test.nees() / factor**2
    step = final.used.layout.window / (len(AGES) - 1)
    place = np.rint(test.age / step).astype(int)
    square = lambda a: float(np.sqrt(np.mean(a)))
    rows = []
    for i in np.unique(place):
        at = place == i
        stated = factor**2 * np.trace(test.covariance[at][:, :2, :2], axis1=1, axis2=2)
        error = (test.residual[at, :2] ** 2).sum(1)
        rows.append(
            Age(
                float(test.age[at].mean()),
                square(error),
                square(stated),
                consistency(nees[at]).inside_95,
                int(at.sum()),
            )
        )
    velocities = final.velocities("training", "validation"), final.velocities("test")
    earlier, later = (np.zeros(0) if each is None else each.nees() for each in velocities)
    velocity_factor = needed(earlier, later)
    velocity = consistency(later / velocity_factor**2) if later.size else None
    return Calibration(factor, before, consistency(nees), rows, velocity, velocity_factor)


def needed(known: np.ndarray, test: np.ndarray) -> float:
    """Return the factor that sd need by normalised squares of known data (K,); 1 if those of the test need none."""
    factor, later = (float(np.sqrt(np.mean(nees) / 2)) if nees.size else 1.0 for nees in (known, test))
    return factor if min(factor, later) > MIN_FACTOR else 1.0


def consistency(nees: np.ndarray) -> Consistency:
    """Return the consistency of errors squared over their covariance (K,), of 2 degrees of freedom."""
    if not nees.size:
        return Consistency(float("nan"), float("nan"), 0)
    return Consistency(float(np.sqrt(np.mean(nees) / 2)), float(np.mean(nees <= CHI2_95)), int(nees.size))
