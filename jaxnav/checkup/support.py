"""Which measurements a recording supports, by its check: what `check` configures and `solve` tries."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxnav.measurements import MEASUREMENTS
from jaxnav.states.installation import LEVER_ARM_ERROR, ODOMETER_SCALE, VEHICLE_AXES, WHEEL_ARM_ERROR
from jaxnav.types import Finding, Recording

MAX_YAW_DEG = 10.0  # of an IMU whose x axis is the vehicle's
ARM_SD = ((f"states.{LEVER_ARM_ERROR.name}.sd", 10.0),)  # 3 m, where a check finds another arm than is stated


class Option(NamedTuple):
    """Measurements and states that are tried together."""

    measurements: tuple[str, ...]
    states: tuple[str, ...] = ()
    factors: tuple[tuple[str, float], ...] = ()  # on leaves of the parameters

    @property
    def names(self) -> tuple[str, ...]:
        """What it is called by: its measurements, or its states where it has none."""
        return self.measurements or self.states


REASONS = {
    "speed": "there are wheel speeds",
    "wheels": "there are speeds of both wheels",
    "body_velocity": "there are velocities in body axes",
    "barometer": "the barometer goes with the receiver's height",
    "magnetometer": "the magnetometer turns with the gyros, as strong as the Earth's field is here",
}
"""Why an option is one, by its first measurement."""


def options(rec: Recording, found: Sequence[Finding]) -> list[Option]:
    """Return the measurements that a recording supports, in the order in which they are tried.

    Args:
        rec: the recording.
        found: findings of its check.
    """
    by, good = {f.code: f for f in found}, {f.code for f in found if not f.warns}
    tried = [Option((), (LEVER_ARM_ERROR.name,), ARM_SD)] if "lever_arm" in by else []
    tried += [Option((name,), (ODOMETER_SCALE.name,)) for name in ("speed", "wheels") if name in rec.aiding]
    tried += [Option(("body_velocity",))] if "body_velocity" in rec.aiding else []
    yaw = by.get("mounting.yaw")
    if yaw is not None and abs(yaw.value or 0.0) < MAX_YAW_DEG:
        tried.append(Option(("nonholonomic",), (VEHICLE_AXES.name, WHEEL_ARM_ERROR.name)))
    if "standstill.accel" in good:
        tried.append(Option(("zero_velocity", "zero_rate")))
    if "barometer" in good:
        tried.append(Option(("barometer",), ("barometer_bias",)))
    if "magnetometer" in rec.aiding and good >= {"compass", "compass.turns"}:
        tried.append(Option(("magnetometer",), ("magnetometer_bias",)))
    return tried


def untried(tried: Sequence[Option], found: Sequence[Finding]) -> list[Option]:
    """Return the options that may be taken without a trial: of data that no finding warns of, no constraints."""
    doubted = {f.code.partition(".")[0] for f in found if f.warns}
    of_data = lambda each: each.measurements and all(MEASUREMENTS[name].has_data for name in each.measurements)
    return [each for each in tried if of_data(each) and not doubted & set(each.measurements)]
