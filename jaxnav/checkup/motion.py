"""The IMU against the fixes: turns, and the attitude that makes both go together."""

from typing import Any, NamedTuple

import numpy as np

from jaxnav.checkup.findings import finding
from jaxnav.checkup.shared import level_velocity
from jaxnav.initialization.alignment import Alignment, AlignmentPrior, align
from jaxnav.maths import units
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import DEG
from jaxnav.states.grades import GRADES
from jaxnav.types import Finding, ImuLog, Recording, Samples, Severity

STEP = 0.1  # s, of the series that are correlated
FARTHEST = 40.0  # s: leap seconds, and a logger that was started early
SURE = 0.6  # correlation of turns that belong together
CLEAR = 0.8  # correlation from which on a wrong scale shows; slip and its delay may explain 0.6 to 1.6
LIKELY = 0.3  # correlation from which on the size of the turns tells the unit, whatever noise hides
SERIES, SIGMAS = 2.0, 3.5  # s, between independent turn rates; of the largest chance correlation over all lags
TURN_SD = 2 * DEG  # rad/s, by which gyros and course differ besides noise: slip, tilt, the smoothing
WINDOW = 20.0  # s, of an alignment
BAD_FIT = 8.0  # chi^2 per degree of freedom
MOST_WINDOWS = 6


class Turns(NamedTuple):
    """Rate of the course and of the gyros on one grid of time."""

    t: np.ndarray  # (N,) s
    course: np.ndarray  # (N,) rad/s, clockwise
    weight: np.ndarray  # (N,) of the course's rate, 0 to 1; 0 where the vehicle hardly moves or fixes are missing
    gyro: np.ndarray  # (N, 3) rad/s


def smooth(a: np.ndarray, n: int) -> np.ndarray:
    """Running mean (N, c) over n."""
    kernel = np.ones(n) / n
    return np.column_stack([np.convolve(c, kernel, "same") for c in a.T])


def turns_of(rec: Recording) -> Turns | None:
    """None where there are no velocities, or where it never moves."""
    v = level_velocity(rec.aiding)
    if v is None or v.t[-1] - v.t[0] < 10.0:
        return None
    t = np.arange(v.t[0], v.t[-1], STEP)
    n = max(3, round(max(1.0, float(np.median(np.diff(v.t)))) / STEP))
    vel = smooth(columns_at(t, v.t, v.value[:, :2]), n)
    acc = np.gradient(vel, STEP, axis=0)
    square = (vel**2).sum(1)
    sd = float(np.median(v.sd[:, :2]))
    least = max(0.5, 3 * sd)
    # a rate from two velocities over the interval T has the variance 2 sd^2 / (speed T)^2
    weight = np.where(
        square > least**2, 1 / (1 + 2 * (sd / (n * STEP * TURN_SD)) ** 2 / np.maximum(square, least**2)), 0
    )
    course = np.where(weight > 0, (vel[:, 1] * acc[:, 0] - vel[:, 0] * acc[:, 1]) / np.maximum(square, least**2), 0.0)
    steps = np.diff(v.t)
    for i in np.flatnonzero(steps > max(2.5 * float(np.median(steps)), 2 * n * STEP)):
        weight[(t > v.t[i] - n * STEP) & (t < v.t[i + 1] + n * STEP)] = 0.0
    total = np.vstack([np.zeros(3), np.cumsum(rec.imu.gyro * rec.imu.dt[:, None], 0)])
    when = np.concatenate([[rec.imu.t[0] - rec.imu.dt[0]], rec.imu.t])
    gyro = smooth(np.gradient(columns_at(t, when, total), STEP, axis=0), n)
    weight[:n], weight[-n:] = 0.0, 0.0  # a running mean ends there
    if (weight > 0).sum() * STEP < 5.0 or np.sqrt((weight * course**2).sum() / weight.sum()) < 0.5 * DEG:
        return None
    return Turns(t, course, weight, gyro)


def correlation(x: Turns, axis: int, lag: int) -> float:
    """Of the course's rate with a gyro that is read ``lag`` steps earlier than the fix."""
    a = slice(max(lag, 0), len(x.t) + min(lag, 0))
    b = slice(max(-lag, 0), len(x.t) + min(-lag, 0))
    w = x.weight[a]
    if (w > 0).sum() < 50:
        return 0.0
    c, g = x.course[a], x.gyro[b, axis]
    c, g = c - (w * c).sum() / w.sum(), g - (w * g).sum() / w.sum()
    size = float(np.sqrt((w * c**2).sum() * (w * g**2).sum()))
    return float((w * c * g).sum() / size) if size > 0 else 0.0


def turns_with_course(rec: Recording) -> bool:
    """Whether gyro z turns as the course does, read within a second of it: it points down then."""
    x = turns_of(rec)
    most = 0 if x is None else min(round(1.0 / STEP), x.t.size // 2)
    return x is not None and max(correlation(x, 2, lag) for lag in range(-most, most + 1)) > SURE


def turns(rec: Recording) -> list[Finding]:
    """Which gyro shows the turns of the course, with which sign, size and lag."""
    x = turns_of(rec)
    if x is None:
        return []
    most = min(round(FARTHEST / STEP), x.t.size // 2)
    lags = np.arange(-most, most + 1)
    table = np.array([[correlation(x, axis, int(lag)) for lag in lags] for axis in range(3)])
    zero = np.abs(lags) <= round(1.0 / STEP)
    near = np.array([row[zero][np.abs(row[zero]).argmax()] for row in table])
    axis, j = np.unravel_index(np.abs(table).argmax(), table.shape)
    best, lag = float(table[axis, j]), float(lags[j] * STEP)
    vector = ", ".join(f"{name} {c:+.2f}" for name, c in zip("xyz", near, strict=True))
    seconds = STEP * float((x.weight > 0).sum()) - abs(lag)  # that overlap, about; few turns are alike by chance
    chance = np.tanh(SIGMAS / np.sqrt(max(seconds / SERIES - 3.0, 1.0)))  # Fisher's z
    if abs(best) > max(SURE, chance) and abs(lag) > 1.0 and abs(best) > 1.5 * np.abs(near).max():
        return [finding("time.offset", "xyz"[axis], lag, best=best, setting="data.options.time_shift_s")]
    w = x.weight
    slope = float((w * x.course * x.gyro[:, 2]).sum() / (w * x.course**2).sum())
    size = abs(slope) / max(near[2] ** 2, 1e-6)  # noise of the course makes the slope that much smaller
    unlike = not 0.1 < size < 10.0 if abs(near[2]) < CLEAR else not 0.6 < size < 1.6
    if abs(near[2]) > max(LIKELY, chance) and unlike:
        message = f"gyro z is about {size:.2g} times the course's rate (correlations {vector})"
        far = not 0.05 < size < 20.0
        cause = "degrees read as radians, or the reverse" if far else "a wrong scale of the gyro"
        return [finding("gyro.units", "gyro z", size, message=message, cause=cause)]
    if abs(near[2]) > max(SURE, chance) and abs(near[2]) >= 0.8 * np.abs(near).max():
        if near[2] < 0:
            message = f"gyro z is {slope:+.2f} times the course's rate (correlations {vector})"
            cause = 'z points up instead of down: axes = "flu"'
            return [finding("gyro.sign", "gyro z", slope, message=message, cause=cause)]
        return [finding("gyro", value=slope, vector=vector)]
    if np.abs(near).max() > max(SURE, chance) and abs(near[2]) < 0.4:
        return [finding("gyro.axes", "xyz"[int(np.abs(near).argmax())], vector=vector)]
    return [finding("gyro", vector=vector)]


# ---------------------------------------------------------------------------- by alignment


def windows_of(rec: Recording, v: Samples) -> list[tuple[float, float]]:
    """Windows of `WINDOW` s all along the recording, in each part of it the one with the most change of velocity."""
    first, last = max(rec.imu.t[0], v.t[0]), min(rec.imu.t[-1], v.t[-1])
    count = int(np.clip((last - first) // (1.5 * WINDOW), 1, MOST_WINDOWS))
    if last - first < 0.5 * WINDOW:
        return []
    length, found = min(WINDOW, last - first), []
    for k in range(count):
        lo, hi = first + k * (last - first) / count, first + (k + 1) * (last - first) / count
        begins = np.arange(lo, max(hi - length, lo) + 1e-6, 5.0)
        power = [np.square(np.diff(v.value[(v.t > b) & (v.t <= b + length), :2], axis=0)).sum() for b in begins]
        b = float(begins[int(np.argmax(power))])
        found.append((b, min(b + length, last)))
    return found


def aligned(imu: ImuLog, rec: Recording, window: tuple[float, float], arm: float = 0.0) -> Alignment | None:
    """By the velocities, else the positions."""
    name = "velocity" if "velocity" in rec.aiding and rec.aiding["velocity"].t.size > 10 else "position"
    grade = GRADES["consumer"]
    believed = AlignmentPrior(2 * grade.gyro_turn_on, 2 * grade.accel_turn_on, 0.3, arm)
    lla = rec.aiding["position"].value[0]
    return align(imu, rec.aiding[name], name == "position", lla, *window, believed, rec.lever_arm)


def alignments(rec: Recording, v: Samples) -> list[tuple[tuple[float, float], Alignment]]:
    """Return the alignments in windows all along a recording; ``v``: its velocities (`level_velocity`)."""
    return [(w, a) for w in windows_of(rec, v) if (a := aligned(rec.imu, rec, w)) is not None]


def misfit(rec: Recording) -> float:
    """Return chi^2 per degree of freedom of IMU and fixes, the median of windows; inf where there is none."""
    v = level_velocity(rec.aiding)
    if v is None or "position" not in rec.aiding:
        return float("inf")
    return float(np.median([a.chi2 for _, a in alignments(rec, v)] or [np.inf]))


def together(rec: Recording) -> list[Finding]:
    """Alignments in several windows: does an attitude make both go together, how late are fixes, does that change?"""
    v = level_velocity(rec.aiding)
    if v is None or "position" not in rec.aiding or float(np.median(rec.imu.dt)) > 0.1:
        return []
    each = alignments(rec, v)
    moving = [(w, a) for w, a in each if a.sd[2] < 20 * DEG]
    if not moving:
        return [finding("motion.little")] if each else []
    chi2, count = float(np.median([a.chi2 for _, a in moving])), len(moving)
    if chi2 > BAD_FIT:
        return [_what_else(rec, min(moving, key=lambda each: abs(each[1].chi2 - chi2)), chi2, count)]
    name = "velocity" if "velocity" in rec.aiding and rec.aiding["velocity"].t.size > 10 else "position"
    together = finding("motion", value=chi2, count=count)
    return [together, *_timing(moving, name), *_arm(rec, moving), *_biases(moving), *_mounting(moving)]


def _what_else(rec: Recording, case: tuple[tuple[float, float], Alignment], usual: float, count: int) -> Finding:
    """Return which mix-up of axes or units makes a bad fit a good one; ``usual``: chi^2 in ``count`` windows."""
    window, was = case
    rows = (rec.imu.t > window[0] - 1) & (rec.imu.t <= window[1] + 1)
    imu = ImuLog(*(a[rows] for a in rec.imu))
    found = []
    for code, cause, other in _mixups(imu):
        a = aligned(other, rec, window)
        if a is not None:
            found.append((a.chi2, code, cause))
    if found:
        chi2, code, cause = min(found)
        if chi2 < 0.35 * was.chi2:
            message = f"IMU and fixes disagree: chi^2/dof {usual:.2g} in {count} windows, {chi2:.2g} with another IMU"
            return finding(code, code.partition(".")[0], usual, chi2, message=message, cause=cause)
    severity = None if was.chi2 > 3 * BAD_FIT else Severity.INFO
    return finding("motion.misfit", value=usual, limit=BAD_FIT, count=count, severity=severity)


def _mixups(imu: ImuLog) -> list[tuple[str, str, ImuLog]]:
    out = []
    for sensor in ("gyro", "accel"):
        values = getattr(imu, sensor)
        for i, axis in enumerate("xyz"):
            sign = np.ones(3)
            sign[i] = -1
            out.append(
                (f"{sensor}.sign", f"{sensor} {axis} has the wrong sign", imu._replace(**{sensor: values * sign}))
            )
        for a, b in ((0, 1), (0, 2), (1, 2)):
            order = [0, 1, 2]
            order[a], order[b] = b, a
            means = f"{sensor} {'xyz'[a]} and {'xyz'[b]} are swapped"
            out.append((f"{sensor}.swapped", means, imu._replace(**{sensor: values[:, order]})))
    out.append(("gyro.sign", "all gyros have the wrong sign", imu._replace(gyro=-imu.gyro)))
    out.append(("gyro.units", "the gyro's unit is another: degrees for radians", imu._replace(gyro=imu.gyro * DEG)))
    out.append(("gyro.units", "the gyro's unit is another: radians for degrees", imu._replace(gyro=imu.gyro / DEG)))
    return out


def _timing(each: list[tuple[tuple[float, float], Alignment]], name: str) -> list[Finding]:
    """How late the stream ``name`` is against the IMU, and whether that changes."""
    t = np.array([0.5 * (w[0] + w[1]) for w, _ in each])
    late, sd = np.array([a.delay for _, a in each]), np.array([np.hypot(a.sd[9], 0.005) for _, a in each])
    weight = 1 / sd**2
    mean, mean_sd = float((weight * late).sum() / weight.sum()), float(1 / np.sqrt(weight.sum()))
    spread = float(np.sqrt((weight * (late - mean) ** 2).sum() / max(len(late) - 1, 1))) if len(late) > 1 else 1.0
    mean_sd *= max(spread, 1.0)
    late_enough = abs(mean) >= max(0.03, 3 * mean_sd)
    numbers: dict[str, Any] = {"size": abs(mean), "side": "late" if mean >= 0 else "early", "sd": mean_sd}
    code = "time.late" if abs(mean) > max(0.15, 5 * mean_sd) else "time.delay"
    value, setting = mean if late_enough else 0.0, f"measurements.{name}.latency_s"
    found = [finding(code, name, value, setting=setting, **numbers)]
    if len(late) >= 4 and np.ptp(t) >= 100.0:
        centred = t - (weight * t).sum() / weight.sum()
        power = float((weight * centred**2).sum())
        drift = float((weight * centred * late).sum() / power)
        left = late - mean - drift * centred
        loose = max(1.0, float(np.sqrt((weight * left**2).sum() / max(len(late) - 2, 1))))
        drift_sd = loose / np.sqrt(power)
        if abs(drift) > max(4 * drift_sd, 100 * units.PPM):
            setting, sd_ppm = "mounting.clock_drift_ppm", drift_sd / units.PPM
            found.append(finding("time.drift", name, drift / units.PPM, setting=setting, sd=sd_ppm))
    return found


def _arm(rec: Recording, each: list[tuple[tuple[float, float], Alignment]]) -> list[Finding]:
    """The lever arm that fits, over all windows."""
    total, right = np.zeros((3, 3)), np.zeros(3)
    for window, _ in each:
        a = aligned(rec.imu, rec, window, arm=5.0)
        if a is not None and a.P.shape[0] == 13:
            N = np.linalg.inv(a.P[10:, 10:]) - np.eye(3) / 25.0
            total, right = total + N, right + N @ (a.arm - rec.lever_arm)
    if not total.any():
        return []
    P = np.linalg.inv(total + np.eye(3) / 25.0)
    off, sd = P @ right, np.sqrt(np.diag(P))
    sure = np.abs(off) > np.maximum(8 * sd, 1.5)
    if not sure.any():
        return []
    where = ", ".join(f"{o:+.1f} ({s:.1f})" for o, s in zip(off, sd, strict=True))
    return [finding("lever_arm", vector=where)]


def _biases(each: list[tuple[tuple[float, float], Alignment]]) -> list[Finding]:
    best = min(each, key=lambda e: e[1].sd[3:9].sum())[1]
    gyro = ", ".join(f"{b / DEG:+.2f}" for b in best.gyro_bias)
    accel = ", ".join(f"{b:+.2f}" for b in best.accel_bias)
    return [finding("imu.bias", gyro=gyro, accel=accel)]


def _mounting(each: list[tuple[tuple[float, float], Alignment]]) -> list[Finding]:
    """Heading of the IMU less the course, where that is alike in all windows."""
    off = []
    for _, a in each:
        if np.hypot(a.vel[0], a.vel[1]) > 2.0 and a.sd[2] < 8 * DEG:
            heading = np.arctan2(a.C[0, 0], a.C[1, 0])
            off.append((heading - np.arctan2(a.vel[0], a.vel[1]) + np.pi) % (2 * np.pi) - np.pi)
    if len(off) < 2:
        return []
    middle = float(np.median(off)) / DEG
    spread = 1.4826 * float(np.median(np.abs(np.array(off) / DEG - middle)))
    code = "mounting.turned" if abs(middle) > 20 and spread < 8 else "mounting.yaw"
    return [finding(code, value=middle, count=len(off), scatter=spread)]
