"""Clocks of IMU and fixes that count from other instants: UTC and GPS time, zones, and seconds since 1970 and 1980.

An IMU with Unix stamps next to a receiver in GPS time is 16 to 18 s off; a logger that stamps by local time is off by
whole quarter hours. The motion says which it is: the one with which IMU and fixes agree.
"""

import numpy as np

from jaxnav.checkup.motion import misfit
from jaxnav.findings import finding
from jaxnav.initialization.initialize import MAX_CHI2_PER_DOF
from jaxnav.io import mend
from jaxnav.io.parts import Parts, TimeScale
from jaxnav.maths.gps_time import GPS_EPOCH, leap_seconds
from jaxnav.types import Finding, Recording

FIRST, LAST = 3e8, 4e9  # s since 1970 that are a date, about 1980 to 2096
DECISIVE = 3.0  # ratio of chi^2 of one scale and the other
QUARTER, MAX_ZONE = 900.0, 14 * 3600.0  # s; of zones
MOST = 0.5  # share of the fixes that are within the IMU's time


def in_one_scale(parts: Parts) -> Recording:
    """Return the checked recording of parts, IMU and fixes in one time scale, which is the IMU's.

    Stated scales are converted. Where the IMU's stamps are a date of no stated scale and the fixes are in GPS time, the
    scale in which IMU and fixes agree is taken; where none is better, a note says so.

    Raises:
        DataError: see `jaxnav.io.mend.mended`.
    """
    leap = _leap_seconds(parts)
    stated = parts.imu is not None and parts.imu.scale is not TimeScale.UNKNOWN
    if not leap or parts.imu is None or (_shifts(parts) and not stated):
        return _in_one_zone(parts)
    scale = parts.aiding["position"].scale
    aiding = {
        name: stream._replace(t=np.asarray(stream.t, float) - leap) if stream.scale is scale else stream
        for name, stream in parts.aiding.items()
    }
    if stated:
        return _noted(_in_one_zone(parts._replace(aiding=aiding)), finding("time.utc", "imu", abs(leap), words=""))
    moved = mend.mended(parts._replace(aiding=aiding))
    rec = mend.mended(parts)
    gps, utc = misfit(rec), misfit(moved)
    if utc < min(MAX_CHI2_PER_DOF, gps / DECISIVE):
        words = f": chi^2/dof of IMU against fixes: {utc:.2g} if UTC, {gps:.2g} if GPS time"
        return _noted(moved, finding("time.utc", "imu", abs(leap), words=words))
    if gps < min(MAX_CHI2_PER_DOF, utc / DECISIVE):
        return rec
    return _noted(rec, finding("time.undecided", "imu", leap))


def _in_one_zone(parts: Parts) -> Recording:
    """Return the recording with its fixes moved by a zone, or from 1980 to 1970, where they miss the IMU's time.

    So are other streams that miss it.
    """
    rec = mend.mended(parts)
    shifts = _shifts(parts)
    if not shifts or parts.imu is None:
        return rec
    astray = {name for name, stream in parts.aiding.items() if _inside(parts.imu.t, stream.t) < MOST}
    later = lambda name, s, shift: s._replace(t=np.asarray(s.t, float) + shift) if name in astray else s
    moved = {
        shift: mend.mended(parts._replace(aiding={n: later(n, s, shift) for n, s in parts.aiding.items()}))
        for shift in shifts
    }
    fits = {0.0: misfit(rec)} | {shift: misfit(each) for shift, each in moved.items()}
    best, second = sorted(fits, key=lambda shift: fits[shift])[:2]
    if not best or fits[best] >= min(MAX_CHI2_PER_DOF, fits[second] / DECISIVE):
        return rec
    return _noted(moved[best], finding("time.zone", "fixes", best, words=_span(best), fit=fits[best]))


def _shifts(parts: Parts) -> list[float]:
    """Return times (s) that may have to be added to the fixes' for most of them to be within the IMU's time."""
    if parts.imu is None or "position" not in parts.aiding:
        return []
    t, imu = (np.asarray(a, float) for a in (parts.aiding["position"].t, parts.imu.t))
    t, imu = t[np.isfinite(t)], imu[np.isfinite(imu)]
    if not (t.size and imu.size) or _inside(imu, t) >= MOST:
        return []
    gap = float(np.median(imu) - np.median(t))
    leap = leap_seconds(max(float(np.median(t)), float(np.median(imu))) + parts.zero)
    zones = QUARTER * (round(gap / QUARTER) + np.arange(-1, 2)) if abs(gap) <= MAX_ZONE + QUARTER else np.zeros(0)
    found = [float(zone + k * leap) for zone in zones for k in ((-1, 0, 1) if leap else (0,))]
    found += [sign * (GPS_EPOCH + k * leap) for sign in (-1, 1) for k in ((-1, 0) if leap else (0,))]
    return [shift for shift in found if shift and _inside(imu, t + shift) >= MOST]


def _inside(imu: np.ndarray, t: np.ndarray) -> float:
    """Return the share of times (K,) s that are within those of the IMU (N,)."""
    return float(np.mean((np.asarray(t) >= np.nanmin(imu)) & (np.asarray(t) <= np.nanmax(imu)))) if len(t) else 1.0


def _span(shift: float) -> str:
    """Return a shift in words."""
    return (
        f"{round(shift / QUARTER) / 4:+g} h"
        if abs(shift) <= MAX_ZONE + QUARTER
        else "seconds since 1980 for those since 1970"
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


def _noted(rec: Recording, found: Finding) -> Recording:
    return rec._replace(findings=(*rec.findings, found))
