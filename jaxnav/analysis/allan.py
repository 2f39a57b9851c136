"""Allan deviation of a resting IMU and the noise figures read off it (IEEE Std 952-1997, annex C).

Host numpy: a recording is read once and nothing here is differentiated. The Allan variance at a cluster time tau is
half the mean squared difference of the means over neighbouring clusters; a constant bias drops out. Noise processes
show as straight lines of log deviation over log tau.

    white noise of root PSD N           N / sqrt(tau)                   slope -1/2
    bias instability B (1/f noise)      sqrt(2 ln 2 / pi) B             flat
    random walk of root PSD K           K sqrt(tau / 3)                 slope +1/2
    Gauss-Markov of sd s and time T     `gauss_markov_variance`         a hump at 1.89 T
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar, nnls

from jaxnav.types import DataError, ImuLog

FLAT = np.sqrt(2 * np.log(2) / np.pi)  # deviation of 1/f noise over B
# slope of a process -> how far a local slope may be from it: a walk shows at the far end, where slopes are uncertain
SLOPES = {-0.5: 0.12, 0.0: 0.06, 0.5: 0.18}
SPAN = 2.5  # least ratio of the cluster times that a process must show over
EDF = 8.0  # least degrees of freedom of a point that counts: 25 % of the deviation


class Allan(NamedTuple):
    """Allan deviation over cluster time, of one or more axes alike."""

    tau: np.ndarray  # (M,) s
    deviation: np.ndarray  # (M, axes) in the unit of the data
    edf: np.ndarray  # (M,) degrees of freedom of the variance: its relative sd is sqrt(2 / edf)


class Line(NamedTuple):
    """A noise figure and the cluster times that it was read from."""

    value: float  # N in unit sqrt(s), B in the unit of the data, K in unit / sqrt(s)
    start: float  # s
    stop: float  # s


class GaussMarkov(NamedTuple):
    """First-order Gauss-Markov noise, as a filter models a bias."""

    sd: float  # in the unit of the data
    tau: float  # s


class ReadOff(NamedTuple):
    """Noise figures of one axis; None where the data do not show it."""

    N: Line | None  # white noise: angular or velocity random walk
    B: Line | None  # bias instability: the flat bottom
    K: Line | None  # random walk of the bias
    gauss_markov: GaussMarkov | None


def allan_deviation(x: np.ndarray, dt: float, per_decade: int = 20) -> Allan:
    """Overlapping Allan deviation of regular samples ``x`` (n,) or (n, axes), means over ``dt`` s.

    Cluster times are spaced evenly in their logarithm up to a third of the record, where there is hardly one degree of
    freedom left. ``edf`` is the smaller of those for white and for random walk noise (NIST SP 1065, table 5).

    Raises:
        ValueError: fewer than 9 samples, ``dt`` not positive, or data that are not finite.

    White noise falls with the root of the cluster time:

    >>> curve = allan_deviation(np.random.default_rng(0).normal(size=100_000), 0.01)
    >>> float(np.interp(1.0, curve.tau, curve.deviation[:, 0]).round(2))  # 1 / sqrt(100)
    0.1
    """
    x = np.asarray(x, float)
    x = x[:, None] if x.ndim == 1 else x
    n = x.shape[0]
    if n < 9 or not dt > 0:
        raise ValueError(f"x must have at least 9 samples and dt be > 0 s, got {n} and {dt:g}")
    if not np.isfinite(x).all():
        raise ValueError(f"x must be finite, sample {int(np.argmin(np.isfinite(x).all(1)))} is not")
    # means are differences of the running sum, which is kept small by taking the overall mean out
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x - x.mean(0), axis=0)])
    largest = n // 3
    m = np.unique(np.round(np.geomspace(1, largest, max(2, int(per_decade * np.log10(largest))))).astype(int))
    variance = np.empty((m.size, x.shape[1]))
    for i, size in enumerate(m):
        step = max(1, size // 32)  # neighbouring clusters are nearly equal
        second = total[2 * size :: step] - 2 * total[size:-size:step] + total[: -2 * size : step]
        variance[i] = np.mean(second**2, axis=0) / (2.0 * size**2)
    N = n + 1  # points of the phase
    white = (3 * (N - 1) / (2 * m) - 2 * (N - 2) / N) * 4 * m**2 / (4 * m**2 + 5)
    walk = (N - 2) / m * ((N - 1) ** 2 - 3 * m * (N - 1) + 4 * m**2) / (N - 3) ** 2
    return Allan(m * dt, np.sqrt(variance), np.maximum(np.minimum(white, walk), 1.0))


def gauss_markov_variance(tau: np.ndarray, sd: float, time: float) -> np.ndarray:
    """Allan variance of a first-order Gauss-Markov process of the given sd and correlation time (s).

    At its largest, 0.382 sd^2, at tau = 1.89 time; 2 sd^2 time / tau far above, 2 sd^2 tau / (3 time) far below.
    """
    x = np.asarray(tau) / time
    small = x < 1e-3  # the closed form loses all digits there
    y = np.where(small, 1.0, x)
    exact = 2 / y * (1 - (3 - 4 * np.exp(-y) + np.exp(-2 * y)) / (2 * y))
    return sd**2 * np.where(small, 2 * x / 3 * (1 - 3 * x / 4), exact)


def read_off(allan: Allan, axis: int = 0) -> ReadOff:
    """N, B, K by the slopes of the curve, and the Gauss-Markov process that explains a hump."""
    good = allan.edf >= EDF
    tau, deviation, edf = allan.tau[good], allan.deviation[good, axis], allan.edf[good]
    if tau.size < 5 or not (deviation > 0).all():
        return ReadOff(None, None, None, None)
    slope = _slopes(np.log(tau), np.log(deviation), edf)
    runs = {s: _runs(np.abs(slope - s) < within) for s, within in SLOPES.items()}
    long = lambda run: tau[run.stop - 1] >= SPAN * tau[run.start]
    falling = slope < -0.1  # behind a hump comes another slope of -1/2, which is not of white noise
    white = next((run for run in runs[-0.5] if long(run) and falling[: run.start].all()), None)
    walk = next((run for run in reversed(runs[0.5]) if long(run)), None)
    bottom = int(np.argmin(deviation))
    flat = next((run for run in runs[0.0] if run.start <= bottom < run.stop), None)
    if flat is None and edf[bottom] > 4 * EDF and slope[bottom:].max() > 0.2:
        flat = slice(bottom, bottom + 1)  # a sharp bend
    elif flat is not None and flat.stop == tau.size and not long(flat):
        flat = None  # the record ends before it shows that this is the bottom

    def line(run: slice | None, power: float, factor: float) -> Line | None:
        if run is None:
            return None
        values = np.log(deviation[run] * tau[run] ** power)
        return Line(float(np.exp(_median(values, edf[run])) * factor), float(tau[run][0]), float(tau[run][-1]))

    first = 0 if white is None else white.start
    hump = _fit_gauss_markov(tau[first:], deviation[first:], edf[first:])
    return ReadOff(line(white, 0.5, 1.0), line(flat, 0.0, 1 / FLAT), line(walk, -0.5, np.sqrt(3.0)), hump)


def at_least_rounding(found: ReadOff, deviation: float, step: float, dt: float) -> ReadOff:
    """Return figures with at least the white noise of rounding, step / sqrt(12) a sample (Widrow and Kollar 2008).

    Noise below a third of the step hardly changes the reading and does not show in the curve: nor do slower processes.

    Args:
        found: figures of one axis.
        deviation: of the curve at the interval of the samples, in the unit of the readings.
        step: resolution of its readings in their unit, 0 for none.
        dt: interval of the samples, s.
    """
    if deviation >= step / np.sqrt(12):
        return found
    return found._replace(N=Line(float(step * np.sqrt(dt / 12)), dt, dt))


def _slopes(u: np.ndarray, v: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Slope of v over u at every point, by weighted straight lines over a factor of 2.1 to either side."""
    w = weight * (np.abs(u[:, None] - u) < np.log(2.1))
    w = w / w.sum(1, keepdims=True)
    du, dv = u - (w @ u)[:, None], v - (w @ v)[:, None]
    return (w * du * dv).sum(1) / (w * du * du).sum(1)


def _runs(flag: np.ndarray) -> list[slice]:
    """Where a flag is true without a break."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flag.astype(int), [0]])))
    return [slice(a, b) for a, b in edges.reshape(-1, 2)]


def _median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(np.interp(0.5 * total[-1], total - 0.5 * weight[order], values[order]))


def _fit_gauss_markov(tau: np.ndarray, deviation: np.ndarray, edf: np.ndarray) -> GaussMarkov | None:
    """Least squares of N^2 / tau + Gauss-Markov, each point relative to the fit at it.

    None unless the curve falls again behind the hump, the hump stands out of the white noise, and the fit is as good
    as the degrees of freedom promise.
    """
    variance = deviation**2

    def solve(log_time: float) -> tuple[np.ndarray, np.ndarray]:
        shapes = np.stack([1 / tau, gauss_markov_variance(tau, 1.0, np.exp(log_time))], 1)
        model = variance
        for _ in range(5):  # relative to the model: relative to the data, low points would weigh more
            w = np.sqrt(edf / 2) / model
            parts, _ = nnls(shapes * w[:, None], variance * w)
            model = np.maximum(shapes @ parts, 1e-3 * variance)
        return parts, np.log(variance / model) * np.sqrt(edf / 2)

    cost = lambda log_time: float(np.sum(solve(log_time)[1] ** 2))
    grid = np.log(np.geomspace(tau[0], tau[-1], 60))
    best = int(np.argmin([cost(g) for g in grid]))
    if not 0 < best < grid.size - 1:
        return None
    log_time = float(minimize_scalar(cost, bounds=(grid[best - 1], grid[best + 1]), method="bounded").x)
    (white, hump), residual = solve(log_time)
    time = np.exp(log_time)
    peak = 1.89 * time
    if peak * 2 > tau[-1] or 0.38 * hump < 0.5 * white / peak or np.sqrt(np.mean(residual**2)) > 2.0:
        return None
    return GaussMarkov(float(np.sqrt(hump)), float(time))


def regular(imu: ImuLog, max_gap: float = 1.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Gyro and accelerometer (n, 3) as means over equal steps, and the step (s).

    A stream with unequal steps is resampled through its running integral, which keeps every cluster's mean.

    Raises:
        DataError: a gap longer than ``max_gap`` s.
    """
    steps = np.diff(imu.t)
    dt = float(np.median(steps))
    if steps.max() > max_gap:
        i = int(steps.argmax())
        raise DataError(f"imu: gap of {steps[i]:.3f} s at t = {imu.t[i]:.3f} s: choose a span without one")
    if np.ptp(steps) < 1e-3 * dt:
        return imu.gyro, imu.accel, dt
    t = np.concatenate([imu.t[:1] - imu.dt[0], imu.t])
    grid = t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + 1e-9) + 1)

    def means(a: np.ndarray) -> np.ndarray:
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(a * np.diff(t)[:, None], axis=0)])
        return np.diff(np.stack([np.interp(grid, t, c) for c in total.T], 1), axis=0) / dt

    return means(imu.gyro), means(imu.accel), dt
