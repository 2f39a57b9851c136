"""Which change of axes, signs, units, scale or time scale makes IMU and fixes agree: by log-likelihood, over windows.

A window has M differences of fixes in three axes with standard deviations that are right up to a factor. With S the
least weighted sum of their squares over attitude and delay, the log-likelihood with that factor at its best is
-n/2 log S, n = 3 M; so a change is worth n/2 log(S0 / S1), for any stated sd of the fixes. All changes are tried by the
closed solution of Wahba's problem (`jaxnav.initialization.alignment.by_attitude`), the best ones by whole alignments.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from jaxnav.initialization import alignment
from jaxnav.initialization.alignment import Alignment, AlignmentPrior, align
from jaxnav.initialization.differences import DifferencedFixes, differences
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.states.grades import GRADES
from jaxnav.types import ImuLog, Recording, Samples, sample_rows

MIN_GAIN_PER_DIFFERENCE = 0.08  # log-likelihood a difference, least, of a change beyond imperfections of the model
MIN_GAIN = 20.0  # log-likelihood over all windows, least
MIN_WINDOW_GAIN = 4.0  # log-likelihood, least, in the second best window
MIN_SQUARES = 0.02  # of S a difference: no fit is taken for better
MAX_WITH_BIASES, BIAS_ITERATIONS = 12, 3  # changes that biases are estimated for, in so many iterations
MIN_SCREENING_GAIN, MAX_ALIGNED = 0.02, 4  # log-likelihood a difference then, least, and how many changes are aligned
SAMPLE_RATE_HZ, FIX_RATE_HZ = 50.0, 5.0  # of the IMU's means and of the fixes in an alignment
FIXES = {"position", "velocity"}
EQUAL_GAIN = 12.0  # log-likelihood within which changes are equal, but for where the nose points
NOSE_SD = 15 * DEG  # sd of the heading of an IMU's x axis less the course: how IMUs are mounted
TILT_SD = 40 * DEG  # sd of the angle of its z axis to down
COARSE = alignment.DELAYS[::3]
SCALES = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0)  # tried for the gyros


class Change(NamedTuple):
    """A change of the data, as y = A x of each sample."""

    code: str  # of its finding
    subject: str
    cause: str
    gyro: np.ndarray = np.eye(3)
    accel: np.ndarray = np.eye(3)
    fixes: np.ndarray = np.eye(3)  # of east, north, up
    late: float = 0.0  # s, by which fixes are stamped too late


class Case(NamedTuple):
    """A window of a recording."""

    begin: float  # s
    end: float  # s
    seen: DifferencedFixes  # whitened
    coarse: DifferencedFixes  # the same; of positions, with the effect of an accelerometer bias as noise


def _flip(*axes: int) -> np.ndarray:
    return np.diag([-1.0 if i in axes else 1.0 for i in range(3)])


def _swap(a: int, b: int) -> np.ndarray:
    order = [0, 1, 2]
    order[a], order[b] = b, a
    return np.eye(3)[order]


def changes() -> list[Change]:
    """Return the changes that are tried on every recording."""
    found = []
    for i, axis in enumerate("xyz"):
        found += [
            Change("gyro.sign", f"gyro {axis}", f"gyro {axis} has the wrong sign", gyro=_flip(i)),
            Change("accel.sign", f"accel {axis}", f"accelerometer {axis} has the wrong sign", accel=_flip(i)),
        ]
    for a, b in combinations(range(3), 2):
        pair, m = f"{'xyz'[a]} and {'xyz'[b]}", _swap(a, b)
        found += [
            Change("gyro.swapped", f"gyro {pair}", f"gyro {pair} are swapped", gyro=m),
            Change("accel.swapped", f"accel {pair}", f"accelerometer {pair} are swapped", accel=m),
            Change("imu.swapped", pair, f"{pair} of both sensors are swapped", gyro=m, accel=m),
        ]
    found.append(Change("gyro.sign", "gyro", "all gyros have the wrong sign", gyro=-np.eye(3)))
    for words, k in (("degrees for radians", DEG), ("radians for degrees", 1 / DEG)):
        found.append(Change("gyro.units", "gyro", f"the gyro's unit is another: {words}", gyro=k * np.eye(3)))
    for k in SCALES:
        found.append(Change("gyro.scale", "gyro", f"the gyros read {1 / k:.2g} times the rate", gyro=k * np.eye(3)))
    found += [
        Change("fixes.swapped", "position", "east and north of the fixes are swapped", fixes=_swap(0, 1)),
        Change("fixes.sign", "position", "east or north of the fixes has the wrong sign", fixes=_flip(0)),
    ]
    return found


def changed(rec: Recording, change: Change) -> Recording:
    """Return the recording with a change undone."""
    imu = rec.imu
    gyro, accel = imu.gyro @ change.gyro.T, imu.accel @ change.accel.T
    aiding = dict(rec.aiding)
    for name in ("position", "velocity"):
        if name not in aiding:
            continue
        s = aiding[name]
        value = s.value
        if not np.array_equal(change.fixes, np.eye(3)):
            value = s.value @ change.fixes.T
            if name == "position":
                metres = earth.enu_path(s.value, s.value[0]) @ change.fixes.T
                scale = np.asarray(earth.metres_per_radian(s.value[0]))
                value = s.value[0] + metres[:, [1, 0, 2]] / scale
        aiding[name] = s._replace(t=s.t - change.late, value=value)
    return rec._replace(imu=imu._replace(gyro=gyro, accel=accel), aiding=aiding)


def thinned(rec: Recording) -> Recording:
    """Return the recording thinned to `SAMPLE_RATE_HZ` (means of samples) and `FIX_RATE_HZ` (every k-th fix)."""
    every = lambda t, rate: max(1, int(1 / (rate * float(np.median(np.diff(t)))) + 1e-6)) if len(t) > 2 else 1
    imu, k = rec.imu, every(rec.imu.t, SAMPLE_RATE_HZ)
    first = np.arange(0, imu.t.size, k)
    dt = np.add.reduceat(imu.dt, first)
    mean = lambda a: np.add.reduceat(a * imu.dt[:, None], first) / dt[:, None]
    log = ImuLog(imu.t[np.append(first[1:], imu.t.size) - 1], dt, mean(imu.gyro), mean(imu.accel))
    fixes = {n: sample_rows(s, slice(None, None, every(s.t, FIX_RATE_HZ))) for n, s in rec.aiding.items() if n in FIXES}
    return rec._replace(imu=log, aiding=rec.aiding | fixes)


def source(rec: Recording) -> tuple[str, Samples]:
    """Name and stream of the fixes that an alignment goes by: velocities, else positions."""
    velocity = rec.aiding.get("velocity")
    name = "velocity" if velocity is not None and velocity.t.size > 10 else "position"
    return name, rec.aiding[name]


def prior(arm: float = 0.0) -> AlignmentPrior:
    """Return that of a consumer's sensors, twice as wide."""
    grade = GRADES["consumer"]
    return AlignmentPrior(2 * grade.gyro_turn_on, 2 * grade.accel_turn_on, 0.3, arm)


def aligned(rec: Recording, window: tuple[float, float], arm: float = 0.0) -> Alignment | None:
    """Align a window by the velocities, else the positions."""
    name, fixes = source(rec)
    lla = rec.aiding["position"].value[0]
    return align(rec.imu, fixes, name == "position", lla, *window, prior(arm), rec.lever_arm)


def moves(rec: Recording, window: tuple[float, float]) -> bool:
    """Return whether the fixes of a window vary by more than their noise, which second differences show."""
    name, fixes = source(rec)
    inside = alignment.within_margin(fixes, *window)
    z = (earth.enu_path(inside.value, inside.value[:1]) if name == "position" else inside.value)[:, :2]
    return len(z) > 4 and bool((z.std(0) > 2 * np.diff(z, 2, axis=0).std(0) / np.sqrt(6)).any())


class Search(NamedTuple):
    """Log-likelihood gains of the changes in the windows of a recording."""

    gain: np.ndarray  # (changes, windows) log-likelihood
    left: np.ndarray  # (windows,) log-likelihood without a change against constant acceleration, which needs no IMU
    size: np.ndarray  # (windows,) differences


def search(rec: Recording, windows: Sequence[tuple[float, float]], tried: Sequence[Change]) -> Search:
    """Try changes in every window: all by Wahba's problem, without biases; the `MAX_WITH_BIASES` best with biases."""
    cases = [_case(rec, begin, end) for begin, end in windows]
    n = np.array([3 * len(case.seen.D) for case in cases])
    every = [Change("", "", ""), *tried]
    guesses = [[_guess(rec, case, change) for case in cases] for change in every]
    S = np.array([[g[0] if g is not None else np.nan for g in row] for row in guesses]).reshape(len(every), -1)
    worth = lambda S: np.nan_to_num(
        0.5 * n * np.log(np.maximum(S[:1] / n, MIN_SQUARES) / np.maximum(S[1:] / n, MIN_SQUARES))
    )
    first = worth(S).sum(1)
    few = [i for i in np.argsort(-first)[:MAX_WITH_BIASES] if first[i] > 0.5 * MIN_GAIN]
    gain = np.full((len(tried), len(cases)), -np.inf)
    left = np.zeros(len(cases))
    if few:
        rows = [0, *(i + 1 for i in few)]
        S = np.array([[_with_biases(rec, case, every[i], g) for case, g in zip(cases, guesses[i])] for i in rows])
        gain[few] = worth(S)
        level = [case.seen.target - _steady(case.seen) for case in cases]
        still = np.array([(b**2 / [c[0, 0] for c in case.seen.covariances]).sum() for b, case in zip(level, cases)])
        left = worth(np.stack([still, S[0]]))[0]
    return Search(gain, left, n)


def _ramp(seen: DifferencedFixes) -> np.ndarray:
    """Return the effect of a unit acceleration on the differences, (M,)."""
    t = seen.t - seen.t[0]
    return np.asarray(seen.D @ (0.5 * t**2 if seen.positions else t))


def _steady(seen: DifferencedFixes) -> np.ndarray:
    """Return the constant acceleration that fits best in the differences, (M, 3)."""
    ramp = _ramp(seen)
    return np.outer(ramp, ramp @ seen.target / (ramp @ ramp))


def _case(rec: Recording, begin: float, end: float) -> Case:
    name, fixes = source(rec)
    inside = alignment.within_margin(fixes, begin, end)
    seen = differences(inside, name == "position", rec.aiding["position"].value[0], begin)
    return Case(begin, end, _whitened(seen), _whitened(seen, prior().accel_bias if seen.positions else 0.0))


def _read(rec: Recording, case: Case, seen: DifferencedFixes, change: Change) -> tuple[ImuLog, DifferencedFixes]:
    """Return samples and differences of a window with a change undone."""
    imu = alignment.window(rec.imu._replace(t=rec.imu.t + change.late), case.begin, case.end)
    imu = imu._replace(gyro=imu.gyro @ change.gyro.T, accel=imu.accel @ change.accel.T)
    return imu, seen._replace(target=seen.target @ change.fixes.T, gravity_free=seen.gravity_free @ change.fixes.T)


def _guess(rec: Recording, case: Case, change: Change) -> tuple[float, np.ndarray, float] | None:
    imu, seen = _read(rec, case, case.coarse, change)
    if imu.t.size < 10 or imu.t[-1] - imu.t[0] < 0.9 * (case.end - case.begin):  # beyond the IMU's time
        return None
    return min(alignment.by_attitude(imu, seen, COARSE, rec.lever_arm), key=lambda each: each[0])


def _with_biases(rec: Recording, case: Case, change: Change, guess: tuple[float, np.ndarray, float] | None) -> float:
    """Return the sum of squares, with the priors', after some iterations from a guess."""
    if guess is None:
        return float("nan")
    x, (imu, seen) = np.array([*np.zeros(6), guess[2]]), _read(rec, case, case.seen, change)
    sd = alignment.prior_sd(prior())
    return alignment.descend(imu, seen, guess[1], x, sd, 1.0, rec.lever_arm, BIAS_ITERATIONS).cost


def _whitened(seen: DifferencedFixes, accel_sd: float = 0.0) -> DifferencedFixes:
    """Return differences of unit variance: differences of neighbouring fixes are correlated by -1/2.

    ``accel_sd``: m/s^2, of a constant acceleration that is taken for noise.
    """
    band = 0.5 * (seen.covariances[0] + seen.covariances[1]) + seen.drift
    lower = sum(np.diag(diagonal[: diagonal.size - k], -k) for k, diagonal in enumerate(band))
    level = lower + np.tril(lower, -1).T + accel_sd**2 * np.outer(_ramp(seen), _ramp(seen))
    root = np.linalg.cholesky(level)
    ratio = [(c + seen.drift)[0].sum() / np.trace(level) for c in seen.covariances]
    D, target = (solve_triangular(root, a, lower=True) for a in (seen.D, seen.target))
    one = np.ones((1, len(D)))
    return seen._replace(D=D, target=target, covariances=[r * one for r in ratio], drift=0 * one)


class Best(NamedTuple):
    """The change that the fixes speak for."""

    change: Change
    others: list[Change]  # that are worth as much
    gain: float  # log-likelihood over all windows, by whole alignments
    was: float  # chi^2 per degree of freedom, the median of the windows, and
    then: float  # with the change


def best(rec: Recording, each: Sequence[tuple[tuple[float, float], Alignment]], tried: Sequence[Change]) -> Best | None:
    """Return the change that is worth enough, in two windows where there are two; None where none is.

    Args:
        rec: the recording.
        each: windows, and the alignments there without a change; those count in which the fixes move.
        tried: the changes.
    """
    each = [(window, a) for window, a in each if moves(rec, window)]
    if not each:
        return None
    found = search(rec, [w for w, _ in each], tried)
    total = found.gain.sum(1)
    close: list[int] = []
    for i in np.argsort(-total):
        scaled = any(tried[i].code == tried[j].code == "gyro.scale" for j in close)  # one scale stands for all
        enough = (
            total[i] > max(0.5 * MIN_GAIN, MIN_SCREENING_GAIN * found.size.sum())
            and total[i] + found.left.sum() > MIN_GAIN_PER_DIFFERENCE * found.size.sum()
        )
        if enough and len(close) < MAX_ALIGNED and not scaled:
            close.append(int(i))
    ranked = []
    for i in close:
        other, was, after, dof = changed(rec, tried[i]), [], [], []
        for j in np.argsort(-found.gain[i]):
            (begin, end), before = each[j]
            a = aligned(other, (begin - tried[i].late, end - tried[i].late))
            if a is not None:
                was.append(max(before.chi2, MIN_SQUARES))
                after.append(a)
                dof.append((2 if source(rec)[0] == "position" else 3) * before.fixes)
            if len(was) == 2 and was[0] * was[1] < after[0].chi2 * after[1].chi2:
                break  # worse where it should be best
        else:
            then = [max(a.chi2, MIN_SQUARES) for a in after]
            gain = 0.5 * np.array(dof) * np.log(np.array(was) / then)
            most = np.sort(gain)[::-1]
            if (
                gain.sum() < max(MIN_GAIN, MIN_GAIN_PER_DIFFERENCE * sum(dof))
                or most[min(1, len(most) - 1)] < MIN_WINDOW_GAIN
            ):
                continue
            if gain[gain > 0].sum() > -4 * gain[gain < 0].sum():
                total_gain, middle = float(gain.sum()), (float(np.median(was)), float(np.median(then)))
                ranked.append((total_gain - _nose(after), Best(tried[i], [], total_gain, *middle)))
    if not ranked:
        return None
    ranked.sort(key=lambda row: -row[0])
    others = [row.change for score, row in ranked[1:] if score > ranked[0][0] - EQUAL_GAIN]
    return ranked[0][1]._replace(others=others)


def _nose(found: Sequence[Alignment]) -> float:
    """Return half the squared angles of x to the course, where both are known, and of z to down, in their sd."""
    tilt = np.median([np.arccos(np.clip(-a.C[2, 2], -1, 1)) for a in found])
    upright = min(0.5 * float(tilt / TILT_SD) ** 2, 2 * EQUAL_GAIN)
    off = [
        np.arctan2(a.C[0, 0], a.C[1, 0]) - np.arctan2(a.vel[0], a.vel[1])
        for a in found
        if np.hypot(a.vel[0], a.vel[1]) > 2.0 and a.sd[2] < 15 * DEG
    ]
    if not off:
        return upright
    angle = float(np.abs(np.angle(np.mean(np.exp(1j * np.array(off))))))
    return upright + min(0.5 * (angle / NOSE_SD) ** 2, 2 * EQUAL_GAIN)
