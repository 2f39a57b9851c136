"""Options of a solution: an antenna that is elsewhere than stated is a state that is tried."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from benchmarks.simulated import earth, verdict
from benchmarks.simulated.vehicles import simulated
from jaxnav.checkup.support import Option, options
from jaxnav.filters.parameters import installed
from jaxnav.findings import finding
from jaxnav.measurements import GNSS
from jaxnav.types import Samples
from tuning.recordings.experiment import experiments_of
from tuning.solving import solve
from tuning.solving.sensors import choose_measurements
from tuning.solving.settled import settled


def test_an_antenna_that_is_elsewhere_is_estimated_or_said():
    found = finding("lever_arm", vector="+1.5 (0.1), -2.5 (0.1), +0.0 (0.9)")
    rec, _ = simulated("car", "consumer", True, np.random.default_rng(3), span=20.0, late=0.0)
    assert [o.names for o in options(rec, [found])] == [("lever_arm_error",)] and options(rec, []) == []
    straight = finding("mounting.yaw", value=-2.4, count=9, scatter=0.5)
    assert [(o.names, o.states) for o in options(rec, [straight])] == [
        (("nonholonomic",), ("vehicle_axes", "wheel_arm_error"))
    ]
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


def compared(rec, *tried):
    """What options do to a drive by the consumer's datasheet, each by itself."""
    filt = solve.build("ekf15", [m.name for m in GNSS], 5)
    sheet = lambda f: installed(f.params("consumer"), rec.lever_arm)
    (experiment,) = experiments_of([rec], filt, [solve.initialize(rec, sheet(filt))], solve.Standing())
    assert experiment.tested
    plain = experiment.score(filt, sheet(filt))
    return [choose_measurements(experiment, plain, sheet, [option]) for option in tried]


@pytest.mark.slow
def test_constraints_of_an_imu_that_is_turned_by_3_degrees_are_taken():
    """Their axes are estimated; with those of the body the drift grows by half."""
    turn = Rotation.from_euler("zyx", [3.0, 1.5, 0.0], degrees=True).as_matrix()
    rec = verdict.sensors(turn, turn)(earth.drive("car", "white", 1.0, 3), np.random.default_rng())
    each = compared(rec, *(Option(("nonholonomic",), states) for states in ((), ("vehicle_axes",))))
    fixed, free = (found.tried[0] for found in each)
    assert free.taken and free.drift_ratio < 0.8 < fixed.drift_ratio and not fixed.taken


@pytest.mark.slow
def test_the_arm_to_the_rear_axle_is_estimated():
    """An IMU 1.8 m ahead of it slides sideways in every turn."""
    rec, arm = earth.drive("car", "white", 1.0, 3), np.array([1.8, 0.3, -0.8])
    rate = uniform_filter1d(rec.imu.gyro, 25, axis=0)
    swing = np.cross(np.gradient(rate, rec.imu.t, axis=0), arm) + np.cross(rate, np.cross(rate, arm))
    imu = rec.imu._replace(accel=rec.imu.accel + swing)
    rec = rec._replace(imu=imu, lever_arm=rec.lever_arm - arm, truth=None)
    axes = ("vehicle_axes",)
    each = compared(rec, *(Option(("nonholonomic",), states) for states in (axes, (*axes, "wheel_arm_error"))))
    fixed, free = (found.tried[0] for found in each)
    assert free.taken and free.drift_ratio < 0.75 and free.drift_ratio < fixed.drift_ratio - 0.1


@pytest.mark.slow
def test_wheels_whose_errors_last_are_taken_with_larger_sd():
    """A speed that is off by 0.05 m/s for 10 s at a time, stated to 0.02 m/s."""
    rec, rng = earth.drive("car", "white", 1.0, 4), np.random.default_rng(4)
    t = np.arange(1.0, rec.imu.t[-1], 0.2)
    slip = np.repeat(rng.normal(0.0, 0.05, t.size // 50 + 1), 50)[: t.size]
    forward = np.interp(t, rec.truth.t, np.linalg.norm(rec.truth.vel, axis=1)) + slip
    speed = Samples(t, forward[:, None], np.full((t.size, 1), 0.02), np.zeros((t.size, 1)))
    rec = rec._replace(aiding=rec.aiding | {"speed": speed}, truth=None)
    (found,) = compared(rec, Option(("speed",), ("odometer_scale",)))
    assert found.tried[0].taken and found.factors["measurements.speed.sd_scale"] >= 3.0
