"""In-motion alignment: attitude, sensor biases and the fixes' delay from some seconds of IMU samples and fixes.

With R(t) the rotation since t0 that the gyros show, R' = R [w - b_g x], R(t0) = 1, the velocity in ENU is

    v(t) = v(t0) + C(t0) S(t) + c(t),    S(t) = int R (f - b_a) dt,    c(t) = int g - (2 w_ie + w_en) x v dt

and the position its integral. Unknown are C(t0), b_g, b_a and the delay of the fixes: one that is stamped t is of
t - delay. First differences of velocities, or second ones of positions, do without v(t0) and the position there. A
first guess is the solution of Wahba's problem, an SVD that has no local minimum (Wu and Pan 2013, velocity integration
formula; Markley 1988); then Gauss-Newton, with the full covariance of the differences and priors on all but the
attitude. Where heading cannot be seen its standard deviation says so.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cholesky_banded
from scipy.spatial.transform import Rotation

from jaxnav.initialization.differences import DRIVING_NOISE, DifferencedFixes, differences, whitened
from jaxnav.maths.units import G0, TICK
from jaxnav.types import ImuLog, Samples, sample_rows

MIN_DELAY_S, DELAY_SIGMAS = 0.03, 3.0  # s, and its sd: a delay that fixes show
MAX_DELAY_S = 0.7  # s: the largest delay that is looked for, either way
MAX_ALIGNMENT_FIXES = 240  # of a window; more are thinned out
MAX_SAMPLE_RATE_HZ = 125.0  # Hz; faster samples are put together
DELAYS = np.arange(-0.65, 0.66, 0.05)  # s, tried in the first guess
TURN_S = 1.0  # s, for which gravity at the tilt that a turn leaves lasts, see `driving`
MIN_NOISE_FACTOR = 0.1  # fixes may be better than they say by so much; how much worse is open
UNKNOWN_ATTITUDE_SD = 10.0  # rad, prior of the attitude: nothing is known
ITERATIONS = 10
GOOD_CHI2_PER_DOF = 2.0  # chi^2 per degree of freedom from which on other headings are tried
MAX_MINIMA = 5  # of the delay that are followed
COST_WEIGHT = 0.2  # of a difference of two sums of squares, where a Gaussian would have 0.5: models are not that good
MIN_MOTION_SIGMAS = 6.0  # standard deviations of a chi-square that a change of velocity must stand out by
RATE_STEP, DELAY_STEP = 1e-5, 0.02  # rad/s, s: steps of the differences that gyro bias and delay are differentiated by
VELOCITY_SPAN_S = 5.0  # s before the end that velocity there is fitted to


class AlignmentPrior(NamedTuple):
    """Standard deviations of the unknowns other than attitude, about zero: (3,) or one number."""

    gyro_bias: Any  # rad/s
    accel_bias: Any  # m/s^2
    delay: float = 0.3  # s
    arm: float = 0.0  # m, of the lever arm's error; 0: it is as given, and not among the unknowns
    scale: float = 0.0  # of scale errors and misalignment


class Alignment(NamedTuple):
    """Estimate at the end of a window."""

    t: float  # s
    C: np.ndarray  # (3, 3) body -> ENU
    vel: np.ndarray  # (3,) m/s, ENU, of the IMU
    P_vel: np.ndarray  # (3, 3 + n) covariance of the velocity with itself and with the n unknowns of ``P``
    gyro_bias: np.ndarray  # (3,) rad/s, measured minus true
    accel_bias: np.ndarray  # (3,) m/s^2
    delay: float  # s, by which fixes are stamped too late, beyond the known delay
    P: np.ndarray  # (10, 10) covariance of attitude (rotation in ENU, rad), gyro and accelerometer bias, delay, and arm
    chi2: float  # of the whitened differences, per degree of freedom, by the fixes' stated sd
    fixes: int
    arm: np.ndarray  # (3,) m, IMU -> antenna, body; (13, 13) is P where it was among the unknowns

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations (10,) or (13,), in the order of ``P``."""
        return np.sqrt(np.diag(self.P))

    @property
    def is_late(self) -> bool:
        """Do the fixes show a delay, either way, beyond its sd?"""
        return abs(self.delay) > max(MIN_DELAY_S, DELAY_SIGMAS * float(self.sd[9]))

    @property
    def vel_sd(self) -> np.ndarray:
        """Standard deviations (3,) m/s of the velocity."""
        return np.sqrt(np.diag(self.P_vel))

    @property
    def joint(self) -> np.ndarray:
        """Covariance (3 + n, 3 + n) of the velocity and the unknowns of ``P``."""
        return np.block([[self.P_vel], [self.P_vel[:, 3:].T, self.P]])


def align(
    imu: ImuLog, fixes: Samples, positions: bool, lla: np.ndarray, begin: float, end: float, prior: AlignmentPrior,
    arm: np.ndarray,
) -> Alignment | None:  # fmt: skip
    """Align over (begin, end] s; None where there are too few fixes or samples in it.

    ``fixes``: positions (rad, rad, m) or velocities (ENU m/s), as ``positions`` says, at IMU times from which all known
    delays are taken out. ``lla`` (3,): about where. ``arm`` (3,) m: IMU -> antenna, body.
    """
    fixes = within_margin(fixes, begin, end)
    samples = window(imu, begin, end)
    if fixes.t.size < 5 or samples.t.size < 10:
        return None
    seen = differences(fixes, positions, lla, begin, driving(samples, prior.scale))
    C, x, P, chi2, noise = _solve(samples, seen, prior, arm)
    R_end, G = rotation_at_end(samples, x[:3])
    reference = (
        Rotation.from_rotvec(-seen.spin * (end - begin)).as_matrix() @ C
    )  # the attitude at the begin, in ENU now
    forward = np.eye(len(P))
    forward[:3, 3:6] = reference @ G
    arm = arm + x[7:] if x.size > 7 else arm
    at_end = lambda C, x: _velocity(samples, seen, fixes, C, x[:7], arm, max(noise, 1.0))
    vel, vel_sd = at_end(reference, x)
    moved = [at_end(Rotation.from_rotvec(RATE_STEP * e).as_matrix() @ reference, x)[0] for e in np.eye(3)]
    steps = np.repeat([RATE_STEP, 1e-3, DELAY_STEP], [3, 3, 1])
    moved += [at_end(reference, x + np.pad(step, (0, x.size - 7)))[0] for step in np.diag(steps)]
    J = np.zeros((3, len(P)))  # of the velocity by the unknowns at the begin; that of the arm is small
    J[:, :10] = (np.array(moved) - vel).T / np.concatenate([np.full(3, RATE_STEP), steps])
    P_vel = np.hstack([J @ P @ J.T + np.diag(vel_sd**2 + seen.driving**2 * VELOCITY_SPAN_S), J @ P @ forward.T])
    P = forward @ P @ forward.T
    return Alignment(
        end, reference @ R_end, vel, P_vel, x[:3], x[3:6], float(x[6]), P, chi2, fixes.t.size, arm,
    )  # fmt: skip


def within_margin(fixes: Samples, begin: float, end: float) -> Samples:
    """Return the fixes that keep `MAX_DELAY_S` from both ends, for a delay; thinned to `MAX_ALIGNMENT_FIXES`."""
    rows = np.flatnonzero((fixes.t >= begin + MAX_DELAY_S) & (fixes.t <= end - MAX_DELAY_S))
    return sample_rows(fixes, rows[:: max(1, -(-rows.size // MAX_ALIGNMENT_FIXES))])


# ---------------------------------------------------------------------------- prediction of an attitude by the samples


def window(imu: ImuLog, begin: float, end: float) -> ImuLog:
    """Return the samples in (begin, end], each from the one before on, without gaps; fast ones are merged."""
    rows = (imu.t > begin + TICK) & (imu.t <= end + TICK)
    t, gyro, accel = imu.t[rows], imu.gyro[rows], imu.accel[rows]
    if not t.size:
        return ImuLog(t, t, gyro, accel)
    if end - t[-1] > TICK:  # the last sample is held up to the end
        t, gyro, accel = np.append(t, end), np.vstack([gyro, gyro[-1]]), np.vstack([accel, accel[-1]])
    dt = np.diff(t, prepend=begin)
    together = max(1, int(1 / (MAX_SAMPLE_RATE_HZ * float(np.median(dt)))))
    if together > 1:
        first = np.arange(0, t.size, together)
        span = np.add.reduceat(dt, first)
        gyro, accel = (np.add.reduceat(a * dt[:, None], first) / span[:, None] for a in (gyro, accel))
        t, dt = t[np.append(first[1:], t.size) - 1], span
    return ImuLog(t, dt, gyro, accel)


def driving(imu: ImuLog, scale: float) -> float:
    """Return the noise of the samples' integral, m/s/sqrt(s), with what scale errors and misalignment make of turns.

    A turn by an angle leaves ``scale`` times it as tilt, and gravity at that tilt is an acceleration. The angle is that
    of the rotations R about their mean, 2 angle^2 = 3 - |mean(R)|^2.

    Args:
        imu: samples of a window, rad/s.
        scale: sd of scale errors and misalignment, 1.
    """
    if not scale:
        return DRIVING_NOISE
    mean = rotations_since(imu.gyro, imu.dt)[1].mean(0)
    angle = np.sqrt(max(0.5 * (3.0 - float((mean**2).sum())), 0.0))
    return float(np.hypot(DRIVING_NOISE, scale * G0 * angle * np.sqrt(TURN_S)))


def rotations_since(gyro: np.ndarray, dt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R in the middle and at the end of every sample, (N, 3, 3) each, by prefix products."""
    ends = Rotation.from_rotvec(gyro * dt[:, None]).as_matrix()
    half, n = Rotation.from_rotvec(0.5 * gyro * dt[:, None]).as_matrix(), 1
    while n < len(ends):
        ends[n:] = ends[:-n] @ ends[n:]
        n *= 2
    return np.concatenate([np.eye(3)[None], ends[:-1]]) @ half, ends


class Series(NamedTuple):
    """Running integrals of the samples with biases taken out, in the body's axes at the window's begin.

    Columns of the last axis: the value, its derivative by the accelerometer bias (3), and by the gyro bias (3).
    """

    middle: np.ndarray  # (N, 3, 3) R in the middle of each sample
    turn: np.ndarray  # (N, 3, 3) minus the derivative of R's rotation by the gyro bias, there
    a: np.ndarray  # (N, 3, 7) specific force
    S: np.ndarray  # (N, 3, 7) integral of a up to each sample
    twice: np.ndarray  # (N, 3, 7) integral of S


def _series(imu: ImuLog, x: np.ndarray) -> Series:
    """For x = gyro bias (3), accelerometer bias (3), ...; with a gyro bias b, R turns by -b times its integral."""
    middle, _ = rotations_since(imu.gyro - x[:3], imu.dt)
    dt = imu.dt[:, None, None]
    whole = np.cumsum(middle * dt, 0)
    turn = whole - 0.5 * middle * dt
    force = np.einsum("nij,nj->ni", middle, imu.accel - x[3:6])[:, :, None]
    a = np.concatenate([force, -middle, _skew(force[:, :, 0]) @ turn], 2)
    before = lambda sums: np.concatenate([np.zeros((1, 3, 7)), sums[:-1]])
    S = before(np.cumsum(a * dt, 0))
    return Series(middle, turn, a, S, before(np.cumsum(S * dt + 0.5 * a * dt**2, 0)))


def _path(imu: ImuLog, series: Series, x: np.ndarray, t: np.ndarray, positions: bool, arm: np.ndarray) -> np.ndarray:
    """Return the change of the antenna's velocity or position up to t - delay, and its derivatives, (K, 3, 7)."""
    t = t - x[6]
    i = np.minimum(np.searchsorted(imu.t, t), imu.t.size - 1)
    into = (t - (imu.t - imu.dt)[i])[:, None, None]
    if positions:
        path = series.twice[i] + series.S[i] * into + 0.5 * series.a[i] * into**2
    else:
        path = series.S[i] + series.a[i] * into
    if arm.any():
        path = path + _lever(series, i, imu.gyro[i] - x[:3], positions, arm)
    return path


def _lever(series: Series, i: np.ndarray, rate: np.ndarray, positions: bool, arm: np.ndarray) -> np.ndarray:
    """Return the lever arm's part at samples ``i`` (K,), (K, 3, 7); ``rate`` (K, 3) rad/s there."""
    R, turn = series.middle[i], series.turn[i]
    lever = R @ arm if positions else np.einsum("kij,kj->ki", R, np.cross(rate, arm))
    by_gyro = _skew(lever) @ turn + (0 * R if positions else R @ _skew(arm[None])[0])
    return np.concatenate([lever[:, :, None], 0 * R, by_gyro], 2)


def rotation_at_end(imu: ImuLog, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R at the end of the samples, and d(its rotation, in the axes of the begin) / d(gyro bias), (3, 3)."""
    middle, ends = rotations_since(imu.gyro - bias, imu.dt)
    return ends[-1], -np.einsum("nij,n->ij", middle, imu.dt)


# ---------------------------------------------------------------------------- least squares


def _wahba(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the rotation C that minimises sum weight |b - C a|^2."""
    U, _, Vt = np.linalg.svd((b * weight).T @ a)
    return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt


def _skew(a: np.ndarray) -> np.ndarray:
    """(M, 3) -> (M, 3, 3)."""
    zero = np.zeros(len(a))
    x, y, z = a.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)


class LeastSquares(NamedTuple):
    """A solution of the least squares, at the window's begin."""

    C: np.ndarray  # (3, 3) body -> ENU
    x: np.ndarray  # (7,) gyro bias, accelerometer bias, delay, and (10,) correction of the lever arm
    P: np.ndarray  # (10, 10) or (13, 13) covariance of attitude and x
    chi2: float  # per degree of freedom, by the fixes' stated sd
    noise: float  # factor on the variance of the fixes


def prior_sd(prior: AlignmentPrior) -> np.ndarray:
    """Return standard deviations (10,) or (13,) of attitude and all unknowns."""
    sd = np.concatenate([np.full(3, UNKNOWN_ATTITUDE_SD), *(np.broadcast_to(s, 3) for s in prior[:2]), [prior.delay]])
    return np.concatenate([np.maximum(sd, 1e-12), np.full(3 if prior.arm else 0, prior.arm)])


def _solve(imu: ImuLog, seen: DifferencedFixes, prior: AlignmentPrior, arm: np.ndarray) -> LeastSquares:
    """Gauss-Newton from Wahba's solutions; once more with the noise that the fixes turn out to have."""
    sd = prior_sd(prior)
    more = np.zeros(sd.size - 10)
    guesses = [(C, np.concatenate([x, more])) for C, x in _guesses(imu, seen, prior.delay, arm)]
    found = [descend(imu, seen, C, x, sd, 1.0, arm) for C, x in guesses]
    best = min(found, key=lambda each: each.cost)
    if best.left > GOOD_CHI2_PER_DOF:  # a bias may have led the first guess to another heading
        turned = [Rotation.from_rotvec([0.0, 0.0, k * np.pi / 2]).as_matrix() @ best.C for k in (1, 2, 3)]
        found += [descend(imu, seen, C, best.x, sd, 1.0, arm) for C in turned]
        best = min(found, key=lambda each: each.cost)
    chi2 = best.left
    noise = max(chi2, MIN_NOISE_FACTOR)
    last = descend(imu, seen, best.C, best.x, sd, noise, arm)
    P = sd[:, None] * np.linalg.inv(last.N) * sd * max(last.left, 1.0)
    # other minima that fit nearly as well: covariance of a mixture of all about the best
    weights = np.exp([-COST_WEIGHT * (each.cost - best.cost) / noise for each in found])
    for each, weight in zip(found, weights / weights.sum(), strict=True):
        turn = Rotation.from_matrix(each.C @ best.C.T).as_rotvec()
        off = np.concatenate([turn, each.x - best.x])
        P = P + weight * np.outer(off, off)
    if not _moved(seen, last.roots):
        P[2, :], P[:, 2] = 0.0, 0.0
        P[2, 2] = UNKNOWN_ATTITUDE_SD**2
    return LeastSquares(last.C, last.x, P, chi2, noise)


class Minimum(NamedTuple):
    """Where Gauss-Newton ended."""

    C: np.ndarray
    x: np.ndarray
    N: np.ndarray  # information, in units of the priors' sd
    cost: float  # sum of squares, with the priors'
    left: float  # chi^2 per degree of freedom
    roots: list[np.ndarray]  # that the differences were whitened by


def descend(
    imu: ImuLog, seen: DifferencedFixes, C: np.ndarray, x: np.ndarray, sd: np.ndarray, noise: float, arm: np.ndarray,
    iterations: int = ITERATIONS,
) -> Minimum:  # fmt: skip
    """Run Gauss-Newton from attitude ``C`` at the begin and ``x``, with the prior ``sd`` of both."""
    roots = [cholesky_banded(noise * c + seen.drift, lower=True) for c in seen.covariances]
    for _ in range(iterations):
        J, r = _linear(imu, seen, C, x, arm)
        white = np.concatenate([whitened(L, np.column_stack([J[:, a], r[:, a]])) for a, L in enumerate(roots)])
        A, r = white[:, :-1] * sd, white[:, -1]
        N, offset = A.T @ A + np.eye(sd.size), np.concatenate([np.zeros(3), x]) / sd
        delta = sd * np.linalg.solve(N, A.T @ r - offset)
        delta *= min(1.0, 0.5 / max(float(np.linalg.norm(delta[:3])), 1e-12))
        C, x = Rotation.from_rotvec(delta[:3]).as_matrix() @ C, x + delta[3:]
        x[6] = np.clip(x[6], -MAX_DELAY_S, MAX_DELAY_S)
        if float(np.abs(delta[:3]).max()) < 1e-5:
            break
    return Minimum(C, x, N, float(r @ r + offset @ offset), float(r @ r / max(r.size - 6, 1)), roots)


def _guesses(
    imu: ImuLog, seen: DifferencedFixes, delay_sd: float, arm: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return C and x without biases: Wahba's solution for delays that fit better than their neighbours, best first.

    For periodic motion the delay is ambiguous by a period; half a period mimics the opposite heading.
    """
    found = by_attitude(imu, seen, DELAYS, arm)
    cost = np.array([np.inf, *(left + (delay / delay_sd) ** 2 for left, _, delay in found), np.inf])
    lows = np.flatnonzero((cost[1:-1] <= cost[:-2]) & (cost[1:-1] <= cost[2:]))
    lows = lows[np.argsort(cost[1:-1][lows])][:MAX_MINIMA]
    return [(found[i][1], np.concatenate([np.zeros(6), found[i][2:]])) for i in lows]


def by_attitude(
    imu: ImuLog, seen: DifferencedFixes, delays: np.ndarray, arm: np.ndarray
) -> list[tuple[float, np.ndarray, float]]:
    """Solve Wahba's problem for every delay, s: weighted sum of squares, attitude (3, 3) at the begin, delay."""
    series, found = _series(imu, np.zeros(7)), []
    weight = 1 / np.stack([c[0] + seen.drift[0] for c in seen.covariances], 1)
    for delay in delays:
        x = np.concatenate([np.zeros(6), [delay]])
        a = seen.D @ _path(imu, series, x, seen.t, seen.positions, arm)[:, :, 0]
        C = _wahba(a, seen.target, weight)
        found.append((float((weight * (seen.target - a @ C.T) ** 2).sum()), C, float(delay)))
    return found


def _linear(
    imu: ImuLog, seen: DifferencedFixes, C: np.ndarray, x: np.ndarray, arm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return J (M, 3, 3 + x), derivatives of the differences by attitude and x, and the residual, (M, 3)."""
    arm, eye = arm + x[7:] if x.size > 7 else arm, np.eye(x.size)
    look = lambda series, x: seen.D @ _path(imu, series, x, seen.t, seen.positions, arm)[:, :, 0]
    series = _series(imu, x)
    path = _path(imu, series, x, seen.t, seen.positions, arm)
    here = seen.D @ path[:, :, 0]
    J = np.zeros((*here.shape, 3 + x.size))
    J[:, :, :3] = -_skew(here @ C.T)
    by = C @ np.einsum("mk,kij->mij", seen.D, path[:, :, 1:])
    J[:, :, 3:6], J[:, :, 6:9] = by[:, :, 3:], by[:, :, :3]
    later, sooner = (x + sign * DELAY_STEP * eye[6] for sign in (1, -1))
    J[:, :, 9] = (look(series, later) - look(series, sooner)) @ C.T / (2 * DELAY_STEP)
    for j in range(x.size - 7):  # the path is linear in the lever arm
        by = _path(imu, series, x, seen.t, seen.positions, arm + np.eye(3)[j])[:, :, 0] - path[:, :, 0]
        J[:, :, 10 + j] = seen.D @ by @ C.T
    return J, seen.target - here @ C.T


def _moved(seen: DifferencedFixes, roots: list[np.ndarray]) -> bool:
    """Do the fixes show a change of level velocity above noise? Without one the IMU's noise shows any heading."""
    white = np.concatenate([whitened(L, seen.target[:, a]) for a, L in enumerate(roots[:2])])
    return float(white @ white) > white.size + MIN_MOTION_SIGMAS * np.sqrt(2 * white.size)


def _velocity(
    imu: ImuLog, seen: DifferencedFixes, fixes: Samples, C: np.ndarray, x: np.ndarray, arm: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the IMU's velocity at the window's end by the latest fixes and the samples, and its sd by their noise."""
    last = max(4 if seen.positions else 1, int((seen.t > seen.t[-1] - VELOCITY_SPAN_S).sum()))
    series = _series(imu, x)
    rest = (seen.gravity_free - _path(imu, series, x, seen.t, seen.positions, arm)[:, :, 0] @ C.T)[-last:]
    t, end = seen.t[-last:], imu.t[-1] + x[6]
    gained = _path(imu, series, x, np.array([end]), False, np.zeros(3))[0, :, 0] @ C.T  # S at the end
    gravity_dv = seen.gravity_dv * (end - seen.t[0]) / (seen.t[-1] - seen.t[0])
    sd = np.sqrt(noise) * fixes.sd[-last:]
    if not seen.positions:
        weight = 1 / sd**2
        return (rest * weight).sum(0) / weight.sum(0) + gained + gravity_dv, 1 / np.sqrt(weight.sum(0))
    line = np.column_stack([np.ones(last), t - t.mean()])
    fit = np.linalg.lstsq(line, rest, rcond=None)[0][1]
    return fit + gained + gravity_dv, np.sqrt(np.mean(sd**2, 0) / np.sum((t - t.mean()) ** 2))
