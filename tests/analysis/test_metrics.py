"""Where a truth says anything, and where a line across its hole would pass for an error of the solution."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from jaxnav.analysis.metrics import attitude_errors, chi2_bounds, covered_by, errors, normalized_innovations
from jaxnav.types import Info, Track


def test_a_truth_tells_what_lies_within_it_and_in_no_hole():
    times = np.concatenate([np.arange(0.0, 10.1, 0.5), np.arange(40.0, 50.1, 0.5)])
    t = np.array([-0.1, 0.0, 3.3, 10.0, 10.2, 25.0, 39.9, 40.0, 47.1, 50.0, 50.1])
    assert covered_by(t, times).tolist() == [False, True, True, True, False, False, False, True, True, True, False]


def test_a_truth_of_uneven_rate_has_no_holes():
    times = np.cumsum(np.tile([0.4, 0.6, 1.0], 20))
    assert covered_by(np.linspace(times[0], times[-1], 500), times).all()
    assert covered_by(np.array([1.0, 2.0]), np.array([2.0])).tolist() == [False, True]


def tracks(pitch: float, turned: np.ndarray, n: int = 50) -> tuple[Track, Track]:
    """Return a solution turned by a rotation vector in NED (deg) from a truth that turns on, at ten times its rate."""
    t, motion = np.arange(n) * 1.0, np.zeros((n, 3))
    rph = np.stack([0.2 * np.sin(t), np.full(n, pitch), 0.03 * t - 1.0], axis=1)
    true = Rotation.from_euler("ZYX", rph[:, ::-1])
    euler = lambda r: r.as_euler("ZYX")[:, ::-1]
    solution = Track(t, motion, motion, euler(Rotation.from_rotvec(turned, degrees=True) * true))
    between = true[:-1] * Rotation.from_rotvec(0.5 * (true[:-1].inv() * true[1:]).as_rotvec())
    order = np.argsort(np.r_[t, t[:-1] + 0.5])
    dense = np.concatenate([rph, euler(between)])[order]
    return solution, Track(np.sort(np.r_[t, t[:-1] + 0.5]), np.zeros((2 * n - 1, 3)), np.zeros((2 * n - 1, 3)), dense)


def test_attitude_errors_are_those_of_euler_angles_while_level_and_rotations_when_nose_up():
    """Half a degree about north, east, down: at 89.9 deg of pitch roll and heading of Euler angles run off."""
    turned = np.array([0.5, -0.3, 0.4])
    level = np.degrees(attitude_errors(*tracks(0.0, turned)))
    np.testing.assert_allclose(level, np.degrees(errors(*tracks(0.0, turned)).attitude), atol=0.12)  # roll of 0.2 rad
    np.testing.assert_allclose(np.linalg.norm(level, axis=1), np.linalg.norm(turned), rtol=1e-9)
    solution, truth = tracks(np.radians(89.9), turned)
    steep = np.degrees(attitude_errors(solution, truth))
    np.testing.assert_allclose(np.linalg.norm(steep, axis=1), np.linalg.norm(turned), rtol=1e-6)
    np.testing.assert_allclose(steep[:, 2], turned[2], rtol=1e-6)
    assert np.abs(np.degrees(errors(solution, truth).attitude)).max() > 20.0
    at_half = solution._replace(t=solution.t + 0.25)  # between two rows of the truth: these are turned between
    assert np.isfinite(attitude_errors(at_half, truth)).all()
    holed = truth._replace(rph=np.where(np.arange(99)[:, None] == 40, np.nan, truth.rph))
    missing = np.isnan(attitude_errors(solution, holed)).any(axis=1)
    assert missing[20] and missing.sum() <= 2


def test_a_rejected_fix_is_no_innovation():
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
