"""Where a truth says anything, and where a line across its hole would pass for an error of the solution."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxnav.analysis.metrics import chi2_bounds, normalized_innovations, told_by
from jaxnav.types import Info


def test_a_truth_tells_what_lies_within_it_and_in_no_hole():
    times = np.concatenate([np.arange(0.0, 10.1, 0.5), np.arange(40.0, 50.1, 0.5)])
    t = np.array([-0.1, 0.0, 3.3, 10.0, 10.2, 25.0, 39.9, 40.0, 47.1, 50.0, 50.1])
    assert told_by(t, times).tolist() == [False, True, True, True, False, False, False, True, True, True, False]


def test_a_truth_of_uneven_rate_has_no_holes():
    times = np.cumsum(np.tile([0.4, 0.6, 1.0], 20))
    assert told_by(np.linspace(times[0], times[-1], 500), times).all()
    assert told_by(np.array([1.0, 2.0]), np.array([2.0])).tolist() == [False, True]


def test_what_was_rejected_is_no_innovation_of_the_filter():
    nothing = dict.fromkeys(Info._fields)
    info = Info(**nothing | {
        "nu": jnp.array([[2.0, 6.0]]), "S": jnp.diag(jnp.array([4.0, 9.0]))[None], "valid": jnp.array([[True, True]]),
        "used": jnp.array([[True, False]]),
    })  # fmt: skip
    np.testing.assert_array_equal(normalized_innovations(info), [[1.0, np.nan]])


def test_bounds_of_a_mean_close_with_the_number_of_runs():
    """Against scipy; both of them, and narrower by the root of a hundred."""
    low, high = chi2_bounds(6.0, 100)
    assert low == pytest.approx(stats.chi2.ppf(0.025, 600) / 100) and high == pytest.approx(
        stats.chi2.ppf(0.975, 600) / 100
    )
    one = chi2_bounds(6.0)
    assert 5 < (one[1] - one[0]) / (high - low) < 15
