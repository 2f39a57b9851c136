"""Stated sd against hidden fixes: chi-square of two degrees of freedom, by closed form."""

from typing import NamedTuple

import numpy as np
import pytest

from tuning.recordings.experiment import HiddenFixes
from tuning.recordings.parts import Layout
from tuning.solving.calibration import CHI2_95, Consistency, calibrate, consistency


class Windows(NamedTuple):
    layout: Layout


class Run:
    """Hidden fixes of both halves with errors of ``scale`` times the stated sd."""

    used = Windows(Layout(15.0, 45.0, 30.0, 100.0, 130.0))

    def __init__(self, known, test):
        self.scales = {"training": known, "test": test}

    def hidden(self, part, *others):
        rng = np.random.default_rng(len(part))
        age = np.tile([0.0, 5.0, 10.0, 15.0], 2000)
        sd = 0.5 + 0.1 * age
        error = self.scales[part] * sd[:, None] * rng.normal(size=(age.size, 3))
        return HiddenFixes(error, sd[:, None, None] ** 2 * np.eye(3), age)

    def velocities(self, part, *others):
        return self.hidden(part)


def test_errors_as_stated_are_inside_95_of_100():
    rng = np.random.default_rng(0)
    found = consistency((rng.normal(size=(50_000, 2)) ** 2).sum(1))
    assert found.error_over_sd == pytest.approx(1.0, abs=0.01)
    assert found.inside_95 == pytest.approx(0.95, abs=0.005)
    assert np.exp(-CHI2_95 / 2) == pytest.approx(0.05, abs=1e-4)  # survival function of two degrees of freedom


def test_a_share_inside_is_judged_by_its_windows():
    """Of 10 windows two may be outside, of 1,000 some 64; all of 10 windows inside are no surprise."""
    few, many = (lambda share, over=1.0, fixes=fixes: Consistency(over, share, fixes) for fixes in (40, 4000))
    assert few(0.95).interval == (0.8, 1.0) and many(0.95).interval == pytest.approx((0.936, 0.963), abs=0.001)
    assert few(0.79).too_small and not few(0.85).too_small and many(0.93).too_small
    assert not few(1.0, 0.3).too_large and many(0.99, 0.5).too_large and not many(0.99, 0.9).too_large


def test_sd_that_are_too_small_grow_by_the_factor_of_the_earlier_parts():
    found = calibrate(Run(2.0, 1.8))
    assert found.factor == pytest.approx(2.0, rel=0.03)
    assert (found.velocity, found.velocity_factor) == (found.after, found.factor)
    assert found.before.inside_95 < 0.65 and found.after.inside_95 > 0.95
    assert found.after.error_over_sd == pytest.approx(0.9, rel=0.05)


def test_sd_stay_where_one_part_alone_asks_for_more():
    assert calibrate(Run(2.0, 1.0)).factor == 1.0  # the test says that they are right
    assert calibrate(Run(1.0, 2.0)).factor == 1.0  # the test never chooses a factor
    assert calibrate(Run(0.4, 0.4)).factor == 1.0  # too large: they stay


def test_ages_grow_with_their_stated_sd():
    ages = calibrate(Run(1.0, 1.0)).ages
    assert [a.age_s for a in ages] == [0.0, 5.0, 10.0, 15.0] and {a.fixes for a in ages} == {2000}
    assert [a.stated_m for a in ages] == pytest.approx([np.sqrt(2) * sd for sd in (0.5, 1.0, 1.5, 2.0)])
    assert [a.error_m for a in ages] == pytest.approx([a.stated_m for a in ages], rel=0.05)
