"""Standstills by the receiver: statistics of the IMU there, and the limits that separate them from motion."""

import numpy as np

from jaxnav.checkup.shared import level_velocity
from jaxnav.filters.standstill import Standing, is_driving, spreads
from jaxnav.findings import finding
from jaxnav.maths.units import DEG
from jaxnav.types import Finding, Json, Recording

MIN_COUNT = 20  # windows at rest and in motion; with fewer there is no result
RIM_S = 1.0  # s before and after, in which the receiver must say the same: fixes are late
MIN_CAUGHT = 0.5  # of the windows at rest, at least, that must be seen
MAX_FALSE = 0.01  # of the windows in motion, at most, that may pass for a standstill
LEVELS = np.linspace(0.05, 1.0, 20)  # quantiles of the windows at rest that are tried


def standstill(rec: Recording) -> list[Finding]:
    """Thresholds of `jaxnav.filters.standstill.Standing` that part rest from motion, by the receiver's velocity."""
    v = level_velocity(rec.aiding)
    if v is None or v.t.size < 2 * MIN_COUNT:
        return []
    t = np.arange(max(rec.imu.t[0], v.t[0]) + 2, min(rec.imu.t[-1], v.t[-1]) - 2, 1.0)
    if t.size < 2 * MIN_COUNT:
        return []
    window = Standing().window
    covered, accel, gyro = spreads(rec.imu, t, window)
    speed = np.hypot(*v.value[:, :2].T)
    slow = lambda at: np.interp(at, v.t, speed) < 0.3 + 2 * np.median(v.sd[:, :2])
    around = [t - window - RIM_S, t - window, t - window / 2, t, t + RIM_S]
    rest = covered & np.all([slow(at) & ~is_driving(v, at) for at in around], 0)
    moving = covered & ~np.any([slow(at) for at in around], 0) | covered & is_driving(v, t)
    if min(rest.sum(), moving.sum()) < MIN_COUNT:
        return []
    best = (-np.inf, 0.0, 0.0, 0.0, 0.0)
    for a in np.quantile(accel[rest], LEVELS):
        for g in np.quantile(gyro[rest], LEVELS):
            still = (accel <= a) & (gyro <= g)
            caught, false = float(still[rest].mean()), float(still[moving].mean())
            best = max(best, (caught - false / MAX_FALSE, -a, -g, caught, false))  # of equals the tightest
    _, a, g, caught, false = best
    a, g = (_between(-x, y[moving]) for x, y in ((a, accel), (g, gyro)))
    shares: Json = {"caught": 100 * caught, "false": 100 * false, "moving": int(moving.sum())}
    count = int(rest.sum())
    if caught < MIN_CAUGHT or false > MAX_FALSE:
        return [finding("standstill", count=count, **shares)]
    force, rate = "filter.standing_accel_sd_mps2", "filter.standing_gyro_sd_deg_per_s"
    return [
        finding("standstill.accel", value=a, setting=force, count=count, window=window),
        finding("standstill.gyro", value=g / DEG, setting=rate, **shares),
    ]


def _between(level: float, moving: np.ndarray) -> float:
    """Room for rest that was not seen: halfway, as a ratio, to the quiet end of motion, and twice at most."""
    quiet = float(np.quantile(moving, MAX_FALSE))
    return float(np.clip(np.sqrt(level * max(quiet, level)), level, 2 * level))
