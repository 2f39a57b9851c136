"""Constraints of a vehicle at rest: zero velocity and zero rotation."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG, TICK, Unit
from jaxnav.measurements.gnss import ENU, NED
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.states.sensors import corrected_reading
from jaxnav.states.state import BODY
from jaxnav.types import Fix, ImuLog, Leaf, Mounting, Nav


class Sd(NamedTuple):
    """Noise of a constraint."""

    sd: Leaf  # () m/s or rad/s


def observe_zero_velocity(theta: Sd, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return v."""
    return Observation(kin.vel, {"velocity": jnp.eye(3)}, jnp.broadcast_to(theta.sd, (3,)))


def observe_zero_rate(theta: Sd, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Compare the gyros with the Earth's rate and their errors: value is their mean over the standstill."""
    w_ie = earth.earth_rate(kin.lla[0])
    w = corrected_reading(fix.value, "gyro", nav.errors, nav.force, nav.auxiliary)
    rows = {"gyro": jnp.eye(3), "attitude": -kin.C.T @ rotations.skew(w_ie)}
    return Observation(w - kin.C.T @ w_ie, rows, jnp.broadcast_to(theta.sd, (3,)), reading=w)


def mean_rate(imu: ImuLog, t: np.ndarray, window: float) -> np.ndarray:
    """Mean raw gyro rate over the ``window`` s before each of ``t``, (E, 3) rad/s: the value of a zero-rate update."""
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(imu.gyro, 0)])
    last, first = np.searchsorted(imu.t, t + TICK), np.searchsorted(imu.t, t - window + TICK)
    return (total[last] - total[first]) / np.maximum(last - first, 1)[:, None]


ZERO_VELOCITY = Measurement(
    "zero_velocity", ENU, observe_zero_velocity, Sd(0.02), Sd(Unit("mps", text="m/s")), reported=NED, at_rest=True,
)  # fmt: skip
"""The vehicle stands: no value; sd from its parameters."""
ZERO_RATE = Measurement(
    "zero_rate", BODY, observe_zero_rate, Sd(0.1 * DEG), Sd(Unit("deg_per_s", DEG, text="deg/s")),
    at_rest=True, pseudo=mean_rate,
)  # fmt: skip
"""The vehicle does not turn: value = mean raw gyro rate, rad/s, body; sd from its parameters."""
