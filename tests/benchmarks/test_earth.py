"""`benchmarks earth`: drives have the errors that they are said to have, whatever is stated; the bars of made cells."""

import numpy as np
import pytest

from benchmarks.simulated import earth
from jaxnav.maths.earth import enu_path


@pytest.mark.parametrize(("receiver", "white"), [("white", 0.4), ("slow", 0.4), ("rtk", 0.02)])
def test_a_drive_has_the_errors_of_its_receiver(receiver, white):
    """From fix to fix the white part and little of the slow one; the same errors whatever is stated."""
    rec, other = (earth.drive("bus", receiver, total, 3) for total in (1.0, 2.0))
    position, truth = rec.aiding["position"], rec.truth
    true = np.column_stack([np.interp(position.t, truth.t, c) for c in truth.lla.T])
    error = enu_path(position.value, true)
    slow, tau = earth.RECEIVERS[receiver][1:]
    step = np.hypot(white, slow * np.sqrt(1 - np.exp(-1 / tau)))
    assert np.std(np.diff(error[:, :2], axis=0)) / np.sqrt(2) == pytest.approx(step, rel=0.15)
    np.testing.assert_allclose(position.sd, np.hypot(white, slow))
    np.testing.assert_array_equal(other.aiding["position"].value, position.value)
    np.testing.assert_allclose(other.aiding["position"].sd, 2.0 * position.sd)


def test_the_bars_are_of_the_right_totals():
    cell = {"error_over_sd": 1.0, "inside_95": 0.9, "tilt": 1.0, "heading": 2.0, "velocity": 1.0}
    cell |= {"receiver": "fast", "share": 0.98, "tau_s": 70.0}
    cells = {"a": cell | {"total": 1.0}, "b": cell | {"total": 1.0, "error_over_sd": 1.6, "tau_s": 130.0},
             "c": cell | {"total": 0.5}, "e": cell | {"total": 1.0, "receiver": "far"},
             "d": {"total": 1.0, "failed": "no start"}}  # fmt: skip
    found = earth.summary(cells)
    assert found["cells"] == 4 and found["failed"] == 1 and found["within"] == pytest.approx(2 / 3)
    assert found["worst"] == 1.6
    assert found["inside_95"] == pytest.approx(0.9) and found["heading"] == 0.0 and found["tilt"] == 1.0
    assert found["share_and_tau"] == 0.5  # of receivers whose errors change thrice in a drive
