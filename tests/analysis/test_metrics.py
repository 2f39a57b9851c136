"""Where a truth says anything, and where a line across its hole would pass for an error of the solution."""

import numpy as np

from jaxnav.analysis.metrics import told_by


def test_a_truth_tells_what_lies_within_it_and_in_no_hole():
    times = np.concatenate([np.arange(0.0, 10.1, 0.5), np.arange(40.0, 50.1, 0.5)])
    t = np.array([-0.1, 0.0, 3.3, 10.0, 10.2, 25.0, 39.9, 40.0, 47.1, 50.0, 50.1])
    assert told_by(t, times).tolist() == [False, True, True, True, False, False, False, True, True, True, False]


def test_a_truth_of_uneven_rate_has_no_holes():
    times = np.cumsum(np.tile([0.4, 0.6, 1.0], 20))
    assert told_by(np.linspace(times[0], times[-1], 500), times).all()
    assert told_by(np.array([1.0, 2.0]), np.array([2.0])).tolist() == [False, True]
