"""Streams against each other: velocity and positions, wheel and barometer, and fixes against their stated sd."""

import numpy as np

from jaxnav.checkup import witnesses
from jaxnav.checkup.shared import level_velocity, local, rms
from jaxnav.findings import finding
from jaxnav.maths.interpolation import columns_at, running
from jaxnav.maths.units import DEG
from jaxnav.types import Finding, Recording, Samples, Severity

SPAN_S = 2.0  # s, over which positions are differenced
FEET = 3.28084  # of a metre
UNITS = {"km/h": 3.6, "knots": 1.943844, "feet per second": FEET, "mm/s": 1000.0, "cm/s": 100.0}
MAX_SD_STEP = 1.15  # times: the step of a stated sd from one fix to the next, in the median
MIN_SPEED = 1.0  # m/s, of a course
MAX_TURN, MAX_CRAB = 5 * DEG, 30 * DEG  # of directions by another north; of a heading on one course, by wind or leeway
MAX_SCATTER = 6 * DEG  # of a heading about the course
MIN_BACKWARDS = 0.3  # m/s, of a wheel speed that has a sign
MAX_STOP_S, MAX_OFF_HALF_TURN = 30.0, 25 * DEG  # of a stop in which gyros tell a half turn from a reversal
AXES = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]])


def velocity(rec: Recording) -> list[Finding]:
    """Velocity against differences of positions, over `SPAN_S` s."""
    if not {"position", "velocity"} <= set(rec.aiding):
        return []
    p, v = rec.aiding["position"], rec.aiding["velocity"]
    if min(p.t.size, v.t.size) < 20:
        return []
    n = max(1, round(SPAN_S / float(np.median(np.diff(p.t)))))
    a, b = p.t[:-n], p.t[n:]
    rows = (a >= v.t[0]) & (b <= v.t[-1]) & (b - a < 2 * n * float(np.median(np.diff(p.t))))
    if rows.sum() < 10:
        return []
    T, place, total = (b - a)[rows, None], local(p.value), running(v.t, v.value)
    shown = (place[n:] - place[:-n])[rows] / T
    said = (columns_at(b[rows], v.t, total) - columns_at(a[rows], v.t, total)) / T
    sd = np.hypot(np.sqrt(2) * p.sd[n:][rows] / T, np.median(v.sd, 0))
    found = _level(shown[:, :2], said[:, :2], rms(sd[:, :2]))
    if found[0].code in ("velocity", "velocity.columns"):
        found = _turned(shown[:, :2], said[:, :2], a[rows], n) or found
    found += _vertical(shown[:, 2], said[:, 2], rms(sd[:, 2]), float(np.median(v.sd[:, 2])))
    if not any(f.warns for f in found):
        found += _late(shown[:, :2], said[:, :2], a[rows])
    return found


def _level(shown: np.ndarray, said: np.ndarray, sd: float) -> list[Finding]:
    off, size = rms(shown - said), rms(shown)
    if off < max(0.35 * max(size, rms(said)), 3 * sd, 0.3):
        return [finding("velocity", value=off, size=size)]
    tries = {
        "velocity.swapped: east and north look swapped": said[:, ::-1],
        "velocity.sign: east has the wrong sign, or longitude is counted to the west": said * [-1, 1],
        "velocity.sign: north has the wrong sign, or latitude is counted to the south": said * [1, -1],
        "velocity.sign: both have the wrong sign": -said,
    }
    tries |= {f"velocity.units: looks like {unit}": said / k for unit, k in UNITS.items()}
    tries |= {"velocity.units: looks like km/h, converted once too often": said * UNITS["km/h"]}
    tries |= {"velocity.units: positions look like feet": said * FEET}
    best = min(tries, key=lambda key: rms(shown - tries[key]))
    if rms(shown - tries[best]) < 0.4 * off:
        code, cause = best.split(": ")
        return [finding(code, value=off, size=size, cause=cause)]
    return [finding("velocity.columns", value=off, size=size, cause="other columns, or other times")]


def _turned(shown: np.ndarray, said: np.ndarray, t: np.ndarray, n: int) -> list[Finding]:
    """Velocity from another north than that of the positions: shown = c said + s J said + delay acceleration.

    In turns of one sense a delay is a turn as well: then the sd of both is large.
    """
    left = said[:, ::-1] * [-1, 1]  # turned to the left by 90 deg
    A = np.stack([said, left, np.gradient(said, t, axis=0)], axis=-1).reshape(-1, 3)
    normal = A.T @ A
    if np.linalg.cond(normal) > 1e10 or rms(said) < MIN_SPEED:
        return []
    c, s, late = np.linalg.solve(normal, A.T @ shown.ravel())
    noise = rms(shown.ravel() - A @ [c, s, late]) * np.sqrt(n)  # differences overlap
    angle, sd = np.arctan2(s, c), noise * np.sqrt(np.linalg.inv(normal)[1, 1]) / np.hypot(c, s)
    if abs(angle) < max(MAX_TURN, 5 * sd) or not 0.7 < np.hypot(c, s) < 1.4:
        return []
    return [finding("velocity.turned", value=angle / DEG, sd=sd / DEG, north=-angle / DEG)]


def heading(rec: Recording) -> list[Finding]:
    """Heading of two antennas against the course: mounted across, from another north, or to the left."""
    v, h = level_velocity(rec.aiding), rec.aiding.get("heading")
    if v is None or h is None or h.t.size < 20:
        return []
    east, north = columns_at(h.t, v.t, v.value[:, :2]).T
    speed, sd = np.hypot(east, north), float(np.median(v.sd[:, :2]))
    rows = (h.t >= v.t[0]) & (h.t <= v.t[-1]) & (speed > max(MIN_SPEED, 8 * sd))
    if rows.sum() < 20:
        return []
    pointed, course = np.exp(1j * h.value[rows, 0]), np.exp(1j * np.arctan2(east, north)[rows])
    around = abs(course.mean()) < 0.97  # courses of more than about 50 deg
    for mirrored, off in enumerate((pointed * course.conj(), pointed * course)):
        mean = np.angle(off.mean())
        scatter = rms(np.angle(off * np.exp(-1j * mean)))
        if scatter > MAX_SCATTER or (mirrored and not around):
            continue
        if mirrored:
            return [finding("heading.mirrored", value=mean / DEG, sd=scatter / DEG, north=mean / DEG)]
        code = "heading.turned" if abs(mean) > (MAX_TURN if around else MAX_CRAB) else "heading"
        return [finding(code, value=mean / DEG, sd=scatter / DEG)]
    return []


def _vertical(shown: np.ndarray, said: np.ndarray, sd: float, stated: float) -> list[Finding]:
    if stated > 50 or rms(said) < 0.05:
        return []  # not measured
    both = np.column_stack([shown - shown.mean(), said - said.mean()])
    corr = float(np.corrcoef(both.T)[0, 1]) if min(both.std(0)) > 1e-6 else 0.0
    ratio = float(shown.std() / max(said.std(), 1e-9))
    for unit, factor in (("heights look like feet", FEET), ("vertical velocity looks like feet per second", 1 / FEET)):
        if corr > 0.8 and abs(np.log(ratio / factor)) < 0.15:
            return [finding("velocity.vertical_units", value=ratio, corr=corr, cause=unit)]
    bad = corr < -0.4 and rms(shown + said) < 0.7 * rms(shown - said)
    return [finding("velocity.vertical_sign" if bad else "velocity.vertical", value=corr)]


def _late(shown: np.ndarray, said: np.ndarray, t: np.ndarray) -> list[Finding]:
    """Velocity that is older than its position is wrong by acceleration times that age."""
    acceleration = np.gradient(said, t, axis=0)
    power = float((acceleration**2).sum())
    if power < 1.0:
        return []
    late = float(((shown - said) * acceleration).sum() / power)
    sd = rms(shown - said - late * acceleration) * np.sqrt(6 / power)  # differences overlap
    if abs(late) < max(0.05, 5 * sd):
        return []
    side, severity = "older" if late > 0 else "younger", Severity.WARNING if abs(late) > 0.4 else None
    return [finding("velocity.latency", value=late, size=abs(late), side=side, sd=sd, severity=severity)]


def speed(rec: Recording) -> list[Finding]:
    """Wheel speed, or that of both sides, against the receiver's: unit, scale, and where they part."""
    fixes, wheel = level_velocity(rec.aiding), rec.aiding.get("speed", rec.aiding.get("wheels"))
    if fixes is None or wheel is None or wheel.t.size < 20:
        return []
    rows = (fixes.t >= wheel.t[0]) & (fixes.t <= wheel.t[-1])
    ground = np.hypot(*fixes.value[rows, :2].T)
    turned = np.abs(np.interp(fixes.t[rows], wheel.t, wheel.value.mean(1)))
    sd = float(np.median(fixes.sd[:, :2]))
    fast = ground > max(1.0, 3 * sd)
    if fast.sum() < 10 or fast.mean() < 0.5 * np.mean(ground > max(1.0, sd)):  # else noise is compared
        return []
    ratio = float(np.median(turned[fast] / ground[fast]))
    near = min(UNITS, key=lambda unit: abs(np.log(max(ratio, 1e-9) / UNITS[unit])))
    if abs(np.log(max(ratio, 1e-9) / UNITS[near])) < 0.12:
        return [finding("speed.units", value=ratio, cause=f"looks like {near}")]
    if not 0.8 < ratio < 1.25:
        return [finding("speed.scale", value=ratio)]
    found = witnesses.speeds(fixes.t[rows], ground, turned / ratio, sd) or [finding("speed", value=ratio)]
    backwards = reverses(rec, fixes) if wheel.value.mean(1).min() > -MIN_BACKWARDS else None
    return found if backwards is None else [*found, finding("speed.unsigned", value=backwards)]


def reverses(rec: Recording, v: Samples) -> float | None:
    """Return when the vehicle turns from forwards to backwards or the other way, s; None where it never does.

    Then the course changes by half a turn in a stop, and gyros about the vertical do not.
    """
    imu = rec.imu
    down = -np.median(imu.accel, axis=0)
    yaw = np.cumsum(imu.gyro @ (down / max(float(np.linalg.norm(down)), 1e-9)) * imu.dt)
    speed, course = np.hypot(*v.value[:, :2].T), np.arctan2(v.value[:, 0], v.value[:, 1])
    moving = np.flatnonzero(speed > max(MIN_SPEED, 5 * float(np.median(v.sd[:, :2]))))
    for i, j in zip(moving[:-1], moving[1:]):
        if j - i < 2 or v.t[j] - v.t[i] > MAX_STOP_S:
            continue
        turned = course[j] - course[i] - np.diff(np.interp(v.t[[i, j]], imu.t, yaw))[0]
        if abs(turned - np.pi * (2 * np.floor(turned / (2 * np.pi)) + 1)) < MAX_OFF_HALF_TURN:
            return float(v.t[j])
    return None


def barometer(rec: Recording) -> list[Finding]:
    """Barometric height against the receiver's: sign, slope, and where they part."""
    p, baro = rec.aiding.get("position"), rec.aiding.get("barometer")
    if p is None or baro is None or baro.t.size < 20:
        return []
    rows = (p.t >= baro.t[0]) & (p.t <= baro.t[-1])
    if rows.sum() < 20:
        return []
    height, said = p.value[rows, 2], np.interp(p.t[rows], baro.t, baro.value[:, 0])
    spread = float(height.std())
    if spread < 1.5 * min(float(np.median(p.sd[:, 2])), 3.0):
        return []
    corr, noise = float(np.corrcoef(height, said)[0, 1]), float(np.median(p.sd[:, 2]))
    # noise of the receiver's height makes the slope smaller (Fuller 1987, section 1.1)
    variance = max(height.var(ddof=1) - noise**2, corr**2 * height.var(ddof=1))
    slope = float(np.cov(height, said)[0, 1] / variance)
    if corr < -0.5:
        return [finding("barometer.sign", value=slope, corr=corr)]
    if corr > 0.7 and not 0.7 < slope < 1.4:
        unit = "feet" if 2.5 < slope < 4.2 else "another unit, or pressure"
        return [finding("barometer.units", value=slope, corr=corr, cause=f"looks like {unit}")]
    return witnesses.heights(p.t[rows], height, said, noise) or [finding("barometer", value=slope, corr=corr)]


def fixes(rec: Recording) -> list[Finding]:
    """Check positions by themselves: rate, gaps, repeats, and scatter against the stated sd."""
    p = rec.aiding.get("position")
    if p is None or p.t.size < 20:
        return []
    dt = np.diff(p.t)
    usual = float(np.median(dt))
    gaps = dt[dt > 2.5 * usual]
    long = f", {gaps.size} gaps, up to {gaps.max():.1f} s" if gaps.size else ""
    found = [finding("position", value=1 / usual, gaps=long)]
    same = np.all(np.diff(p.value[:, :2], axis=0) == 0, axis=1)
    place, n = local(p.value)[:, :2], max(1, round(1.5 / usual))
    moves = np.hypot(*(place[2 * n :] - place[: -2 * n]).T) > 1.5 * n * usual if p.t.size > 2 * n + 20 else np.zeros(0)
    again = float(np.mean(same[n : n + moves.size][moves.astype(bool)])) if np.sum(moves) > 20 else 0.0
    if again > 0.3:
        found.append(finding("position.repeats", value=100 * again))
    second = np.diff(local(p.value), 2, axis=0)[(dt[1:] < 1.5 * usual) & (dt[:-1] < 1.5 * usual)]
    if second.size:
        noise = 1.4826 * np.median(np.abs(second), 0) / np.sqrt(6)  # of white noise; motion only adds
        stated = np.median(p.sd, 0)
        if (noise[:2] > 3 * stated[:2]).all() and usual <= 1.0:
            value, limit = float(noise[:2].max()), float(stated[:2].max())
            squared = abs(np.log(value / np.sqrt(limit))) < np.log(1.5)
            cause = "variances in the place of sd: variance = true" if squared else "a stated sd that is too small"
            found.append(finding("position.sd", value=value, limit=limit, cause=cause))
    return found


def stated(rec: Recording) -> list[Finding]:
    """Check the stated sd of fixes, from one to the next: it changes slowly."""
    found = []
    for name in ("position", "velocity"):
        s = rec.aiding.get(name)
        if s is None or s.t.size < 20:
            continue
        steps = np.median(np.abs(np.diff(np.log(np.maximum(s.sd, 1e-12)), axis=0)), 0)
        worst = int(steps.argmax())
        if steps[worst] > np.log(MAX_SD_STEP):
            axis, factor = ("east", "north", "up")[worst], float(np.exp(steps[worst]))
            found.append(finding("stream.sd_jumps", f"{name} {axis}", factor))
    return found
