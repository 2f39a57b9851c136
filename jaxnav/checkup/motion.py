"""The IMU against the fixes: turns, and the attitude that makes both go together."""

from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from jaxnav.checkup.alternatives import (
    MIN_GAIN,
    MIN_GAIN_PER_DIFFERENCE,
    MIN_SQUARES,
    SCALES,
    Best,
    Change,
    aligned,
    best,
    changed,
    changes,
    source,
    thinned,
)
from jaxnav.checkup.shared import level_velocity
from jaxnav.findings import finding
from jaxnav.initialization.alignment import Alignment
from jaxnav.initialization.initialize import MAX_CHI2_PER_DOF
from jaxnav.maths import units
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import DEG
from jaxnav.types import Finding, Json, Recording, Samples, Severity

STEP_S = 0.1  # s, of the series that are correlated
MAX_LAG_S = 40.0  # s: leap seconds, and a logger that was started early
SAME_CORRELATION = 0.6  # correlation of turns that belong together
SCALE_CORRELATION = 0.8  # correlation from which on a wrong scale shows; slip and its delay may explain 0.6 to 1.6
MIN_LAG_CORRELATION = 0.4  # correlation from which on a lag is tried
TURN_SD = 2 * DEG  # rad/s, difference of gyros and course by slip, tilt and smoothing, in addition to noise
WINDOW_S = 20.0  # s, of an alignment
BIAS_SIGMAS = 3.0  # of a bias beyond its limit
MAX_GYRO_BIAS, MAX_ACCEL_BIAS = 2 * DEG, 0.5  # rad/s, m/s^2: more is no bias of a consumer's sensor
STATED_SD_DOF = 6  # degrees of freedom that the stated sd of delays are worth against their scatter
DRIFT_FALSE_ALARM = 5e-4  # of a drift of the clock that is none
SD_FACTOR = 4.0  # by which stated sd are too large, beyond which it is named; half of it where they are too small
MAX_HEADING_SD = 20 * DEG  # of an alignment that counts
MAX_WINDOWS = 6
MIN_LEVER_SPEED, MAX_LEVER_M, LEVER_CHI2 = 0.5, 3.0, 6.0  # m/s, m, chi^2 of a lever arm that looks like a delay
MAX_SAMPLE_INTERVAL_S = 0.1  # s between samples, beyond which their means say too little of the motion


class Turns(NamedTuple):
    """Rate of the course and of the gyros on one grid of time."""

    t: np.ndarray  # (N,) s
    course: np.ndarray  # (N,) rad/s, clockwise
    weight: np.ndarray  # (N,) of the course's rate, 0 to 1; 0 where the vehicle hardly moves or fixes are missing
    gyro: np.ndarray  # (N, 3) rad/s


def smooth(a: np.ndarray, n: int) -> np.ndarray:
    """Return running mean (N, c) over n."""
    kernel = np.ones(n) / n
    return np.column_stack([np.convolve(c, kernel, "same") for c in a.T])


def turns_of(rec: Recording) -> Turns | None:
    """None where there are no velocities, or where it never moves."""
    v = level_velocity(rec.aiding)
    if v is None or v.t[-1] - v.t[0] < 10.0:
        return None
    t = np.arange(v.t[0], v.t[-1], STEP_S)
    n = max(3, round(max(1.0, float(np.median(np.diff(v.t)))) / STEP_S))
    vel = smooth(columns_at(t, v.t, v.value[:, :2]), n)
    acc = np.gradient(vel, STEP_S, axis=0)
    square = (vel**2).sum(1)
    sd = float(np.median(v.sd[:, :2]))
    least = max(0.5, 3 * sd)
    # a rate from two velocities over the interval T has the variance 2 sd^2 / (speed T)^2
    weight = np.where(
        square > least**2, 1 / (1 + 2 * (sd / (n * STEP_S * TURN_SD)) ** 2 / np.maximum(square, least**2)), 0
    )
    course = np.where(weight > 0, (vel[:, 1] * acc[:, 0] - vel[:, 0] * acc[:, 1]) / np.maximum(square, least**2), 0.0)
    steps = np.diff(v.t)
    for i in np.flatnonzero(steps > max(2.5 * float(np.median(steps)), 2 * n * STEP_S)):
        weight[(t > v.t[i] - n * STEP_S) & (t < v.t[i + 1] + n * STEP_S)] = 0.0
    total = np.vstack([np.zeros(3), np.cumsum(rec.imu.gyro * rec.imu.dt[:, None], 0)])
    when = np.concatenate([[rec.imu.t[0] - rec.imu.dt[0]], rec.imu.t])
    gyro = smooth(np.gradient(columns_at(t, when, total), STEP_S, axis=0), n)
    weight[:n], weight[-n:] = 0.0, 0.0  # a running mean ends there
    if (weight > 0).sum() * STEP_S < 5.0 or np.sqrt((weight * course**2).sum() / weight.sum()) < 0.5 * DEG:
        return None
    return Turns(t, course, weight, gyro)


def correlation(x: Turns, axis: int, lag: int) -> float:
    """Return the correlation of the course's rate with a gyro that is read ``lag`` steps earlier than the fix."""
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
    return max(_correlations(rec)) > SAME_CORRELATION


def _correlations(rec: Recording) -> list[float]:
    """Return correlations of the course's rate with gyro z within a second; 0 where there are no turns."""
    x = turns_of(rec)
    most = 0 if x is None else min(round(1.0 / STEP_S), x.t.size // 2)
    return [0.0] if x is None else [correlation(x, 2, lag) for lag in range(-most, most + 1)]


def lags_of(rec: Recording) -> list[tuple[float, int]]:
    """Return up to three lags (s) at which the course's rate is most like a gyro's, with its axis.

    Lags below a second are a delay, which alignments find.
    """
    x = turns_of(rec)
    if x is None:
        return []
    most = min(round(MAX_LAG_S / STEP_S), x.t.size // 2)
    lags = np.arange(-most, most + 1)
    table = np.abs([[correlation(x, axis, int(lag)) for lag in lags] for axis in range(3)])
    best = table.max(0)
    peak = np.r_[False, (best[1:-1] >= best[:-2]) & (best[1:-1] >= best[2:]), False]
    at = np.flatnonzero(peak & (np.abs(lags) * STEP_S > 1.0) & (best > MIN_LAG_CORRELATION))
    at = at[np.argsort(-best[at])][:3]
    return [(float(lags[i] * STEP_S), int(table[:, i].argmax())) for i in at]


def turns(rec: Recording) -> list[Finding]:
    """Correlation of the course's rate with the gyros, read within a second of it.

    A vehicle that banks turns about its y axis as well, and one that flies sideways turns its course alone: gyro z is
    at fault only where the alignments fit better with its scale changed.
    """
    x = turns_of(rec)
    if x is None:
        return []
    most = min(round(1.0 / STEP_S), x.t.size // 2)
    table = np.array([[correlation(x, axis, lag) for lag in range(-most, most + 1)] for axis in range(3)])
    near = table[range(3), np.abs(table).argmax(1)]
    slope = float((x.weight * x.course * x.gyro[:, 2]).sum() / (x.weight * x.course**2).sum())
    vector = ", ".join(f"{name} {c:+.2f}" for name, c in zip("xyz", near, strict=True))
    size = abs(slope) / max(near[2] ** 2, 1e-6)  # noise of the course makes the slope that much smaller
    if abs(near[2]) > SCALE_CORRELATION and not 0.6 < size < 1.6 and _scaled_fits_better(rec, size):
        return [finding("gyro.turns", "gyro z", size, vector=vector)]
    return [finding("gyro", value=slope, vector=vector)]


def _scaled_fits_better(rec: Recording, size: float) -> bool:
    """Return whether alignments speak for another scale of gyro z, such as 1 / ``size``; True where there is none."""
    v = level_velocity(rec.aiding)
    if v is None or "position" not in rec.aiding:
        return True
    plain = thinned(rec)
    known = [(w, a) for w, a in alignments(plain, v) if a.sd[2] < MAX_HEADING_SD]
    axes = 2 if source(plain)[0] == "position" else 3

    def gain(scale: float) -> float:
        """Return the gain in log-likelihood beyond what imperfect models may show (`alternatives.best`)."""
        other = changed(plain, Change("gyro.turns", "gyro z", "", gyro=np.diag([1.0, 1.0, scale])))
        pairs = [(a, b) for w, a in known if (b := aligned(other, w)) is not None]
        dof = np.array([axes * a.fixes for a, _ in pairs])
        better = 0.5 * dof @ np.log([a.chi2 / max(b.chi2, MIN_SQUARES) for a, b in pairs])
        return float(better - max(MIN_GAIN, MIN_GAIN_PER_DIFFERENCE * dof.sum()))

    return not known or max(map(gain, (1 / max(size, 1e-3), *SCALES))) > 0.0


# ---------------------------------------------------------------------------- by alignment


def windows_of(rec: Recording, v: Samples) -> list[tuple[float, float]]:
    """Return windows all along the recording, in each part of it the one with the most change of velocity.

    Of `WINDOW_S` s, by positions alone twice that: it takes them longer to show an acceleration.
    """
    usual = WINDOW_S if source(rec)[0] == "velocity" else 2 * WINDOW_S
    first, last = max(rec.imu.t[0], v.t[0]), min(rec.imu.t[-1], v.t[-1])
    count = int(np.clip((last - first) // usual, 1, MAX_WINDOWS))
    if last - first < 0.5 * usual:
        return []
    length, found = min(usual, last - first), []
    for k in range(count):
        lo, hi = first + k * (last - first) / count, first + (k + 1) * (last - first) / count
        begins = np.arange(lo, max(hi - length, lo) + 1e-6, 5.0)
        power = [np.square(np.diff(v.value[(v.t > b) & (v.t <= b + length), :2], axis=0)).sum() for b in begins]
        b = float(begins[int(np.argmax(power))])
        found.append((b, min(b + length, last)))
    return found


def alignments(rec: Recording, v: Samples) -> list[tuple[tuple[float, float], Alignment]]:
    """Return the alignments in windows all along a recording; ``v``: its velocities (`level_velocity`)."""
    return [(w, a) for w in windows_of(rec, v) if (a := aligned(rec, w)) is not None]


def both_point_up(rec: Recording) -> bool:
    """Whether the gyros have z up where gravity says so of the accelerometer.

    By turns against the course; where they are not clear, the fixes must speak against another sign of the
    accelerometer.
    """
    near = _correlations(rec)
    if max(map(abs, near)) > SAME_CORRELATION:
        return min(near) < -SAME_CORRELATION and max(near) < SAME_CORRELATION
    sign = Change("accel.sign", "accel", "the accelerometer has the wrong sign", accel=-np.eye(3))
    other = changed(thinned(rec), sign)
    v = level_velocity(other.aiding)
    return v is not None and best(other, alignments(other, v), [sign]) is not None


def misfit(rec: Recording) -> float:
    """Return chi^2 per degree of freedom of IMU and fixes, the median of windows; inf where there is none."""
    v = level_velocity(rec.aiding)
    if v is None or "position" not in rec.aiding:
        return float("inf")
    return float(np.median([a.chi2 for _, a in alignments(rec, v)] or [np.inf]))


def together(rec: Recording) -> list[Finding]:
    """Alignments in several windows: does an attitude make both go together, how late are fixes, does that change?"""
    v = level_velocity(rec.aiding)
    if v is None or "position" not in rec.aiding or float(np.median(rec.imu.dt)) > MAX_SAMPLE_INTERVAL_S:
        return []
    rec = thinned(rec)
    each = alignments(rec, v)
    mixed, found = mixup(rec, each), []
    if mixed is not None:
        found.append(named(mixed))
        rec = changed(rec, mixed.change)
        each = alignments(rec, level_velocity(rec.aiding) or v)
    moving = [(w, a) for w, a in each if a.sd[2] < MAX_HEADING_SD]
    if not moving:
        return found or ([finding("motion.little")] if each else [])
    chi2, count = float(np.median([a.chi2 for _, a in moving])), len(moving)
    if chi2 > MAX_CHI2_PER_DOF:
        severity = None if chi2 > 3 * MAX_CHI2_PER_DOF else Severity.INFO
        return [*found, finding("motion.misfit", value=chi2, limit=MAX_CHI2_PER_DOF, count=count, severity=severity)]
    name, _ = source(rec)
    found.append(finding("motion", value=chi2, count=count))
    if not 1 / SD_FACTOR < np.sqrt(chi2) < SD_FACTOR / 2:
        side = "small" if chi2 > 1 else "large"
        found.append(finding("motion.sd", name, float(np.sqrt(max(chi2, 1 / chi2))), side=side, span=WINDOW_S))
    return [*found, *_timing(moving, name), *_arm(rec, moving), *_biases(moving), *_mounting(moving)]


def mixup(rec: Recording, each: list[tuple[tuple[float, float], Alignment]]) -> Best | None:
    """Return the change of axes, signs, units, scale or time that the fixes speak for; None where none is."""
    tried = changes() + [
        Change(
            "time.offset", "xyz"[axis], f"another time scale (leap seconds) or zone: fixes {lag:+.1f} s late", late=lag
        )
        for lag, axis in lags_of(rec)
    ]
    return best(rec, each, tried)


def mixups(rec: Recording) -> list[Finding]:
    """Return the finding of `mixup`, where there is one, else of gyro z that does not turn as the course does."""
    v = level_velocity(rec.aiding)
    if v is None or "position" not in rec.aiding or float(np.median(rec.imu.dt)) > MAX_SAMPLE_INTERVAL_S:
        return []
    rec = thinned(rec)
    found = mixup(rec, alignments(rec, v))
    return [f for f in turns(rec) if f.warns] if found is None else [named(found)]


def named(found: Best) -> Finding:
    """Return the finding of a change."""
    change = found.change
    cause = ", or ".join((change.cause, *(other.cause for other in found.others)))
    numbers: Json = {"gain": found.gain, "was": found.was, "then": found.then, "cause": cause}
    if change.code == "time.offset":
        return finding("time.offset", change.subject, change.late, setting="data.options.time_shift_s", **numbers)
    return finding(change.code, change.subject, **numbers)


def delay_of(rec: Recording) -> tuple[float, float] | None:
    """Return the delay of the fixes by alignments all along a recording, s, and its sd; None where none is known."""
    moving = _in_motion(rec)
    return None if moving is None else _mean_delay(*_delays(moving))


def clock_rate_of(rec: Recording) -> tuple[float, float] | None:
    """Return the rate at which the delay of the fixes grows, s/s, and its sd; None where none is known."""
    moving = _in_motion(rec)
    found = None if moving is None else _rate(moving)
    return None if found is None else found[:2]


def _in_motion(rec: Recording) -> list[tuple[tuple[float, float], Alignment]] | None:
    """Return alignments that know the heading; None where there are none, or fixes and IMU do not go together."""
    v, position = level_velocity(rec.aiding), rec.aiding.get("position")
    if v is None or position is None or not position.t.size or float(np.median(rec.imu.dt)) > MAX_SAMPLE_INTERVAL_S:
        return None
    moving = [(w, a) for w, a in alignments(thinned(rec), v) if a.sd[2] < MAX_HEADING_SD]
    if not moving or float(np.median([a.chi2 for _, a in moving])) > MAX_CHI2_PER_DOF:
        return None
    return moving


def _rate(each: list[tuple[tuple[float, float], Alignment]]) -> tuple[float, float, float] | None:
    """Return the growth of delays, s/s, its sd, and what it must exceed to be one; None of too few or too short."""
    t = np.array([0.5 * (w[0] + w[1]) for w, _ in each])
    late, sd = _delays(each)
    if len(late) < 4 or np.ptp(t) < 100.0:
        return None
    weight = 1 / sd**2
    centred = t - (weight * t).sum() / weight.sum()
    power = float((weight * centred**2).sum())
    drift = float((weight * centred * late).sum() / power)
    left = late - _mean_delay(late, sd)[0] - drift * centred
    dof = STATED_SD_DOF + len(late) - 2
    drift_sd = float(np.sqrt(max(1.0, (STATED_SD_DOF + float((weight * left**2).sum())) / dof) / power))
    return drift, drift_sd, max(float(stdtrit(dof, 1 - DRIFT_FALSE_ALARM)) * drift_sd, 100 * units.PPM)


def _delays(each: list[tuple[tuple[float, float], Alignment]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the delays of alignments and their sd, (K,) s."""
    return np.array([a.delay for _, a in each]), np.array([np.hypot(a.sd[9], 0.005) for _, a in each])


def _mean_delay(late: np.ndarray, sd: np.ndarray) -> tuple[float, float]:
    """Return the weighted mean of delays (K,) s and its sd, by their scatter where that is larger than stated."""
    weight = 1 / sd**2
    mean, mean_sd = float((weight * late).sum() / weight.sum()), float(1 / np.sqrt(weight.sum()))
    spread = float(np.sqrt((weight * (late - mean) ** 2).sum() / max(len(late) - 1, 1))) if len(late) > 1 else 1.0
    return mean, mean_sd * max(spread, 1.0)


def _timing(each: list[tuple[tuple[float, float], Alignment]], name: str) -> list[Finding]:
    """How late the stream ``name`` is against the IMU, and whether that changes."""
    mean, mean_sd = _mean_delay(*_delays(each))
    late_enough = abs(mean) >= max(0.03, 3 * mean_sd)
    numbers: Json = {"size": abs(mean), "side": "late" if mean >= 0 else "early", "sd": mean_sd}
    far = _behind(each, mean)
    cause = "latency of the receiver" + ("" if far is None else f", or an antenna {far}: set lever_arm_frd_m")
    numbers["cause"] = cause
    code = "time.late" if abs(mean) > max(0.15, 5 * mean_sd) else "time.delay"
    value, setting = mean if late_enough else 0.0, f"measurements.{name}.latency_s"
    found = [finding(code, name, value, setting=setting, **numbers)]
    if (rate := _rate(each)) is not None and abs(rate[0]) > rate[2]:
        setting, sd_ppm = "mounting.clock_drift_ppm", rate[1] / units.PPM
        found.append(finding("time.drift", name, rate[0] / units.PPM, setting=setting, sd=sd_ppm))
    return found


def _behind(each: list[tuple[tuple[float, float], Alignment]], mean: float) -> str | None:
    """Return where an antenna would be whose distance looks like this delay, s; None where it can be none.

    At a speed v a delay d looks like an antenna v d behind the IMU; of other speeds the one fits or the other.
    """
    speed = np.array([np.hypot(a.vel[0], a.vel[1]) for _, a in each])
    late, sd = _delays(each)
    slow = 1 / np.maximum(speed, MIN_LEVER_SPEED)
    arm = float((slow * late / sd**2).sum() / (slow**2 / sd**2).sum())
    off = lambda model: float((((late - model) / sd) ** 2).sum())
    if abs(arm) > MAX_LEVER_M or off(arm * slow) > off(mean) + LEVER_CHI2:
        return None
    return f"{abs(arm):.1f} m {'behind' if arm > 0 else 'ahead of'} the IMU"


def arm_of(rec: Recording, each: list[tuple[tuple[float, float], Alignment]]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the correction of the lever arm, and its sd, (3,) m each, over all windows."""
    found = []
    for window, plain in each:
        a = aligned(rec, window, arm=5.0)
        if a is not None and a.P.shape[0] == 13 and a.chi2 < 1.2 * plain.chi2:  # no other minimum
            found.append((a.arm - rec.lever_arm, np.linalg.inv(a.P[10:, 10:]) - np.eye(3) / 25.0))
    if not found:
        return None
    arms, N = (np.array(column) for column in zip(*found, strict=True))
    P = np.linalg.inv(N.sum(0) + np.eye(3) / 25.0)
    mean = P @ np.einsum("kij,kj->i", N, arms)
    off = arms - mean
    scatter = float(np.einsum("ki,kij,kj->", off, N, off)) / max(3 * (len(arms) - 1), 1)
    return mean, np.sqrt(max(1.0, scatter) * np.diag(P))


def _arm(rec: Recording, each: list[tuple[tuple[float, float], Alignment]]) -> list[Finding]:
    found = arm_of(rec, each)
    if found is None:
        return []
    off, sd = found
    sure = np.abs(off) > np.maximum(8 * sd, 1.5)
    if not sure.any():
        return []
    where = ", ".join(f"{o:+.1f} ({s:.1f})" for o, s in zip(off, sd, strict=True))
    return [finding("lever_arm", vector=where)]


def _biases(each: list[tuple[tuple[float, float], Alignment]]) -> list[Finding]:
    """Biases, weighted means over the windows; those that no sensor of its kind has are wrong."""
    bias, sd = (
        np.array(a) for a in zip(*((np.r_[a.gyro_bias, a.accel_bias], a.sd[3:9]) for _, a in each), strict=True)
    )
    weight = 1 / sd**2
    mean, mean_sd = (weight * bias).sum(0) / weight.sum(0), 1 / np.sqrt(weight.sum(0))
    mean_sd *= np.sqrt(np.maximum(1.0, (weight * (bias - mean) ** 2).mean(0)))
    units = np.repeat([DEG, 1.0], 3)
    gyro, accel = (", ".join(f"{b:+.2f}" for b in part) for part in np.split(mean / units, 2))
    found = [finding("imu.bias", gyro=gyro, accel=accel)]
    large = np.abs(mean) - BIAS_SIGMAS * mean_sd > np.repeat([MAX_GYRO_BIAS, MAX_ACCEL_BIAS], 3)
    for code, part, unit, most in (
        ("gyro.bias", slice(3), DEG, MAX_GYRO_BIAS),
        ("accel.bias", slice(3, 6), 1.0, MAX_ACCEL_BIAS),
    ):
        if large[part].any():
            worst = int(np.argmax(np.abs(mean[part]) * large[part]))
            value = float(mean[part][worst] / unit)
            found.append(finding(code, "xyz"[worst], value, most / unit, sd=float(mean_sd[part][worst] / unit)))
    return found


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
    code = "mounting.turned" if abs(middle) > max(20, 5 * spread) else "mounting.yaw"
    return [finding(code, value=middle, count=len(off), scatter=spread)]
