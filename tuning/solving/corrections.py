"""Corrections that the check of a recording establishes: axes of both sensors, offset and rate of the IMU's clock."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxnav.checkup import checkup
from jaxnav.checkup.motion import both_point_up, clock_rate_of
from jaxnav.filters.parameters import put
from jaxnav.findings import finding
from jaxnav.maths.axes import rotation
from jaxnav.maths.units import PPM
from jaxnav.types import Finding, Params, Recording

AXES, OFFSET, DRIFT = "data.options.axes", "data.options.time_shift_s", "mounting.clock_drift_ppm"
UP = "flu"  # axes of an IMU whose z axis points up


class Corrections(NamedTuple):
    """Settings that a check established, and a recording that is read with them."""

    recording: Recording
    settings: dict[str, float | str]  # in a user's units
    found: list[Finding]  # by the check of the corrected recording
    applied: list[Finding]  # a finding for each setting
    rate_sd: float = 0.0  # s/s, of the clock's rate among the settings

    def clock(self, params: Params) -> Params:
        """Return parameters with the rate of the IMU's clock."""
        drift = self.settings.get(DRIFT)
        if drift is None:
            return params
        return put(params, "mounting.clock_drift", params.mounting.clock_drift + float(drift) * PPM)


def check_and_correct(rec: Recording, kept: Sequence[str] = ()) -> Corrections:
    """Check a recording and apply what IMU and fixes speak for.

    Axes: z up, where both sensors agree in that. The alignment finds any attitude, so that other
    right-handed axes need no setting. A fault of one sensor cannot be corrected with confidence: it stays a finding.

    Args:
        rec: the recording.
        kept: settings that are the user's, and stay as they are: "data.options.axes", "data.options.time_shift_s",
            "mounting.clock_drift_ppm".

    Returns:
        The recording in body axes, with the IMU's times shifted onto the fixes', and what was found.
    """
    found = checkup(rec)
    settings, applied = dict[str, float | str](), list[Finding]()
    up = [f for f in found if f.code == "axes.gravity" and f.subject == "z" and (f.value or 0.0) > 0.0]
    if up and AXES not in kept and both_point_up(rec):
        rec, settings[AXES] = turned(rec, UP), UP
        applied.append(finding("solve.axes", AXES, axes=UP, why=up[0].message))
        found = checkup(rec)
    offset = _first(found, "time.offset")
    if offset is not None and OFFSET not in kept:
        shift = round(float(offset.value or 0.0), 2)
        rec, settings[OFFSET] = rec._replace(imu=rec.imu._replace(t=rec.imu.t + shift)), shift
        applied.append(finding("solve.applied", OFFSET, shift, why=offset.message))
        found = checkup(rec)
    drift = _first(found, "time.drift")
    rate_sd = 0.0
    if drift is not None and DRIFT not in kept:
        rate_sd = (clock_rate_of(rec) or (0.0, 0.0))[1]
        settings[DRIFT] = float(round(drift.value or 0.0))
        applied.append(finding("solve.applied", DRIFT, float(round(drift.value or 0.0)), why=drift.message))
        found = [f for f in found if f is not drift]
    return Corrections(rec, settings, found, applied, rate_sd)


def turned(rec: Recording, axes: str) -> Recording:
    """Return the recording with the sensors' axes turned to the body's."""
    turn = rotation(axes)
    imu, aiding = rec.imu._replace(gyro=rec.imu.gyro @ turn.T, accel=rec.imu.accel @ turn.T), dict(rec.aiding)
    if "magnetometer" in aiding:
        aiding["magnetometer"] = aiding["magnetometer"]._replace(value=aiding["magnetometer"].value @ turn.T)
    return rec._replace(imu=imu, aiding=aiding)


def _first(found: Sequence[Finding], code: str) -> Finding | None:
    return next((f for f in found if f.code == code), None)
