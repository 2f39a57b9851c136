"""Corrections that the check of a recording establishes: the offset of a clock, and its rate."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxnav.checkup import checkup
from jaxnav.checkup.findings import finding
from jaxnav.filters.parameters import put
from jaxnav.maths.units import PPM
from jaxnav.types import Finding, Params, Recording

OFFSET, DRIFT = "data.options.time_shift_s", "mounting.clock_drift_ppm"
CORRECTED = {"time.offset": OFFSET, "time.drift": DRIFT}  # codes of findings, and the settings that take their values


class Corrections(NamedTuple):
    """Settings that a check established, and a recording that is read with them."""

    recording: Recording
    settings: dict[str, float]  # in a user's units
    found: list[Finding]  # by the check of the corrected recording
    applied: list[Finding]  # a finding for each setting

    def clock(self, params: Params) -> Params:
        """Return parameters with the rate of the IMU's clock."""
        drift = self.settings.get(DRIFT)
        return (
            params if drift is None else put(params, "mounting.clock_drift", params.mounting.clock_drift + drift * PPM)
        )


def correct(rec: Recording, kept: Sequence[str] = ()) -> Corrections:
    """Check a recording and apply the offset and the rate of the IMU's clock that IMU and fixes speak for.

    Right-handed axes of both sensors need no correction, since the alignment finds any attitude. A fault of one sensor
    is none that can be corrected with confidence: it stays a finding.

    Args:
        rec: the recording.
        kept: settings that are the user's, and stay as they are.

    Returns:
        The recording with the IMU's times shifted onto the fixes', and what was found.
    """
    found = checkup(rec)
    settings, applied = {}, []
    offset = _value(found, "time.offset", kept)
    if offset is not None:
        offset = round(offset, 2)
        rec = rec._replace(imu=rec.imu._replace(t=rec.imu.t + offset))
        settings[OFFSET] = offset
        applied.append(finding("solve.applied", OFFSET, offset, why=_message(found, "time.offset")))
        found = checkup(rec)
    drift = _value(found, "time.drift", kept)
    if drift is not None:
        settings[DRIFT] = round(drift)
        applied.append(
            finding("solve.applied", DRIFT, round(drift), why=_message(found, "time.drift"), unit_text="ppm")
        )
    done = {code for code, setting in CORRECTED.items() if setting in settings}
    return Corrections(rec, settings, [f for f in found if f.code not in done], applied)


def _value(found: Sequence[Finding], code: str, kept: Sequence[str]) -> float | None:
    """Return the value of a finding, None where there is none or its setting is the user's."""
    values = [f.value for f in found if f.code == code and CORRECTED[code] not in kept]
    return values[0] if values else None


def _message(found: Sequence[Finding], code: str) -> str:
    return next(f.message for f in found if f.code == code)
