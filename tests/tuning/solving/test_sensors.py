"""Options of a solution: an antenna that is elsewhere than stated is a state that is tried."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.simulated import earth, verdict
from benchmarks.simulated.vehicles import simulated
from jaxnav.checkup.findings import finding
from jaxnav.measurements import GNSS
from tuning.solving import solve
from tuning.solving.sensors import Option, choose, options
from tuning.solving.settled import settled


def test_an_antenna_that_is_elsewhere_is_estimated_or_said():
    found = finding("lever_arm", vector="+1.5 (0.1), -2.5 (0.1), +0.0 (0.9)")
    rec, _ = simulated("car", "consumer", True, np.random.default_rng(3), span=20.0, late=0.0)
    assert [o.names for o in options(rec, [found])] == [("lever_arm_error",)] and options(rec, []) == []
    straight = finding("mounting.yaw", value=-2.4, count=9, scatter=0.5)
    assert [(o.names, o.states) for o in options(rec, [straight])] == [(("nonholonomic",), ("vehicle_axes",))]
    word, why = solve.judge(1.0, None, [found])
    assert word == solve.CARE and "the antenna is +1.5" in why
    params = solve.build("ekf15").params("consumer")
    assert settled([found], params, False) == [found]
    estimated = params._replace(states=params.states | {"lever_arm_error": params.states["gyro_bias"]})
    assert settled([found], estimated, False) == []


@pytest.mark.slow
def test_solve_estimates_it():
    """Positions are those of the IMU, and not of an antenna 3 m off: 11.8 stated sd without the state."""
    row = verdict.score(verdict.arm(earth.drive("car", "white", 1.0, 10), np.random.default_rng([0, 10])), fast=True)
    assert row["error_m"] < 1.0 and row["error_over_sd"] < 2.5 and "lever_arm" not in row["findings"]


@pytest.mark.slow
def test_constraints_of_an_imu_that_is_turned_by_3_degrees_are_taken():
    """Their axes are estimated; with those of the body the drift grows by half."""
    turn = Rotation.from_euler("zyx", [3.0, 1.5, 0.0], degrees=True).as_matrix()
    rec = verdict.sensors(turn, turn)(earth.drive("car", "white", 1.0, 3), np.random.default_rng())
    filt = solve.build("ekf15", [m.name for m in GNSS], 5)
    sheet = lambda f: f.params("consumer")
    bench, tested = solve._bench(filt, sheet(filt), solve.initialize, solve.Standing(), None, rec)
    assert tested
    plain = bench.score(filt, sheet(filt))
    fixed, free = (
        choose(bench, plain, sheet, [Option(("nonholonomic",), states)]).tried[0] for states in ((), ("vehicle_axes",))
    )
    assert free.taken and free.drift_ratio < 0.8 < fixed.drift_ratio and not fixed.taken
