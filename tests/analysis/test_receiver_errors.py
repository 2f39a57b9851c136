"""Errors of a receiver: the split keeps what is stated, other filters get all of it, accuracy from second to second."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxnav import build
from jaxnav.analysis.receiver_errors import ReceiverErrors, alike, on_top, receiver, usual, whole, without_slow_errors
from jaxnav.filters.lanes import RECEIVER_ERROR, slow_errors
from jaxnav.navigation import Solution
from tuning.fit.transforms import split
from tuning.recordings.priors import spec_of

WIDE = build("ekf15", states=(RECEIVER_ERROR,))
SD = np.array([2.0, 2.0, 4.0])


def test_white_and_slow_variance_add_up_to_the_stated_one():
    errors = receiver(np.array([0.1, np.log10(4.0), 2.0, 0.0, 1.5, np.log10(1.5)]), SD)
    np.testing.assert_allclose(errors.share, [0.8, 0.5])
    np.testing.assert_allclose(errors.tau, [100.0, 10**1.5])
    params = errors.applied(WIDE.params("consumer"))
    state, scale = params.states[RECEIVER_ERROR], params.measurements["position"].scale
    np.testing.assert_allclose(np.square(scale * SD) + np.square(state.sd), np.square(1.5 * SD))
    np.testing.assert_allclose(state.driving_noise**2 * state.tau / 2, np.square(state.sd))  # stationary
    np.testing.assert_allclose(params.measurements["velocity"].scale, 10**0.1)
    np.testing.assert_allclose(whole(params, SD).measurements["position"].scale, 1.5)
    plain = errors.applied(build("ekf15").params("consumer"))
    np.testing.assert_allclose(plain.measurements["position"].scale, 1.5)  # a filter without the state: all of it white
    assert whole(plain, SD) is plain


@pytest.mark.parametrize("sd", [SD, np.full(3, 0.02)])
def test_slow_errors_on_top_leave_the_white_ones_as_stated(sd):
    params = receiver(on_top(sd), sd).applied(WIDE.params("consumer"))
    np.testing.assert_allclose(params.measurements["position"].scale, 1.0)
    share = 10.0 ** usual(sd)[0] / (1 + 10.0 ** usual(sd)[0])
    np.testing.assert_allclose(np.square(params.states[RECEIVER_ERROR].sd), share * sd**2)
    np.testing.assert_allclose(params.states[RECEIVER_ERROR].tau, 150.0)


def test_without_slow_errors_the_state_is_none():
    """Off it has no sd and no driving noise; a receiver without slow errors leaves a state that is known otherwise."""
    params = WIDE.params("consumer")
    off = without_slow_errors(params).states[RECEIVER_ERROR]
    assert not np.any(off.sd) and not np.any(off.driving_noise) and np.isfinite(off.tau).all()
    assert ReceiverErrors().applied(params).states[RECEIVER_ERROR].sd == params.states[RECEIVER_ERROR].sd


def test_recordings_that_are_tuned_together_share_a_split():
    one = ReceiverErrors(np.array([0.8, 0.4]), np.array([50.0, 100.0]), sd=SD)
    other = ReceiverErrors(np.array([0.4, 0.2]), np.array([200.0, 100.0]), 1.5, 4.0, 2 * SD)
    found = alike([one, other])
    for mine, was in zip(found, (one, other), strict=True):
        np.testing.assert_allclose(mine.share, [0.6, 0.3])
        np.testing.assert_allclose(mine.tau, [100.0, 100.0])
        assert mine.position == pytest.approx(2.0) and mine.velocity == was.velocity
        np.testing.assert_array_equal(mine.sd, was.sd)
    np.testing.assert_allclose(alike([one])[0].share, one.share)


@pytest.mark.parametrize(("sd", "share"), [(2.0, 0.8), (0.02, 0.09)])
def test_a_receiver_of_centimetres_is_usually_white(sd, share):
    odds = 10 ** usual(np.full(3, sd))[0]
    assert odds / (1 + odds) == pytest.approx(share, abs=0.01)


def test_relative_accuracy_is_that_of_a_known_slow_error():
    """p = r - s with var r = 0.04 and var s = 1 m^2, independent: 1.02 m on the Earth, 0.2 m where s is known."""
    slow = slow_errors(WIDE)
    P = np.zeros((2, 18, 18))
    P[:, :3, :3], P[:, slow, slow] = 1.04 * np.eye(3), np.eye(3)
    P[:, :3, slow] = P[:, slow, :3] = -np.eye(3)
    P[1, :3, slow] = P[1, slow, :3] = P[1, slow, slow] = 0.0  # a state that is off
    trace = SimpleNamespace(info=SimpleNamespace(P=P))
    sol = SimpleNamespace(trace=trace, filter=WIDE, sd_factor=2.0, sd=np.ones((2, 9)))
    of = Solution.sd_relative.fget
    np.testing.assert_allclose(of(sol), 2.0 * np.array([[0.2] * 3, [np.sqrt(1.04)] * 3]), rtol=1e-6)
    sol.filter = build("ekf15")
    np.testing.assert_allclose(of(sol), 2.0 * np.sqrt([[1.04] * 3] * 2))


def test_level_and_vertical_scales_stay_apart():
    """Where the split differs upwards, a search has a number for each; else one for all axes."""
    leaf = "measurements.position.scale"
    differ = ReceiverErrors(np.array([0.9, 0.5]), np.full(2, 100.0), sd=SD).applied(WIDE.params("consumer"))
    spec = spec_of(WIDE, differ, [leaf])
    np.testing.assert_allclose(np.exp(split(spec, differ)[leaf]), np.sqrt([0.1, 0.5]))
    params = WIDE.params("consumer")
    assert np.shape(split(spec_of(WIDE, params, [leaf]), params)[leaf]) == ()
    np.testing.assert_allclose(spec[leaf].prior.centre, np.sqrt([0.1, 0.1, 0.5]))
