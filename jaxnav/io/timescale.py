"""UTC against GPS time: an IMU with Unix stamps next to a receiver in GPS time is 16 to 18 s off."""

import numpy as np

from jaxnav.checkup.motion import MAX_CHI2_PER_DOF, misfit
from jaxnav.io import mend
from jaxnav.io.parts import Parts, TimeScale
from jaxnav.maths.gps_time import leap_seconds
from jaxnav.types import Recording

FIRST, LAST = 3e8, 4e9  # s since 1970 that are a date, about 1980 to 2096
DECISIVE = 3.0  # ratio of chi^2 of one scale and the other


def recording(parts: Parts) -> Recording:
    """Return the checked recording of parts, IMU and fixes in one time scale, which is the IMU's.

    Stated scales are converted. Where the IMU's stamps are a date of no stated scale and the fixes are in GPS time, the
    scale in which IMU and fixes agree is taken; where none is better, a note says so.

    Raises:
        DataError: see `jaxnav.io.mend.recording`.
    """
    leap = _leap_seconds(parts)
    if not leap or parts.imu is None:
        return mend.recording(parts)
    scale = parts.aiding["position"].scale
    aiding = {
        name: stream._replace(t=np.asarray(stream.t, float) - leap) if stream.scale is scale else stream
        for name, stream in parts.aiding.items()
    }
    moved = mend.recording(parts._replace(aiding=aiding))
    taken = f"imu: UTC is taken as GPS time less {abs(leap):g} s, the leap seconds of its date"
    if parts.imu.scale is not TimeScale.UNKNOWN:
        return _noted(moved, f"{taken}.")
    rec = mend.recording(parts)
    gps, utc = misfit(rec), misfit(moved)
    if utc < min(MAX_CHI2_PER_DOF, gps / DECISIVE):
        return _noted(moved, f"{taken}: IMU and fixes agree to chi^2/dof {utc:.2g} so, to {gps:.2g} else.")
    if gps < min(MAX_CHI2_PER_DOF, utc / DECISIVE):
        return rec
    return _noted(
        rec,
        f"imu: its stamps may be UTC, {leap:g} s behind the fixes' GPS time, which this motion does not decide: "
        'time_scale = "utc" or "gps" states it.',
    )


def _leap_seconds(parts: Parts) -> float:
    """Return the seconds that the fixes' scale is ahead of the IMU's where these differ; 0 where it cannot."""
    imu, position = parts.imu, parts.aiding.get("position")
    if imu is None or position is None or imu.scale is position.scale or not np.isfinite(imu.t).any():
        return 0.0
    at = float(np.nanmedian(imu.t)) + parts.zero
    if not FIRST < at < LAST:
        return 0.0
    if position.scale is TimeScale.GPS:
        return leap_seconds(at)
    return -leap_seconds(at) if (imu.scale, position.scale) == (TimeScale.GPS, TimeScale.UTC) else 0.0


def _noted(rec: Recording, note: str) -> Recording:
    return rec._replace(notes="\n".join(filter(None, [rec.notes, note])))
