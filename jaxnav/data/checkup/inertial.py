"""The IMU by itself: sampling, axes that are dead or clipped, gravity and noise where it is quiet."""

import numpy as np

from jaxnav.data.checks import quiet_force
from jaxnav.data.checkup.finding import Finding
from jaxnav.data.checkup.motion import turns_with_course
from jaxnav.data.gaps import holes, in_words
from jaxnav.maths import units
from jaxnav.types import ImuLog, Recording

QUIET = 0.05  # share of the windows that count as quiet
G = 9.81
STUCK = 20  # rows of one value in a row from which on an axis that otherwise changes hangs


def sampling(rec: Recording) -> list[Finding]:
    """Rate, jitter, gaps and repeated rows."""
    imu = rec.imu
    dt = np.diff(imu.t)
    usual = float(np.median(dt))
    jitter = float(np.std(dt[dt < 2.5 * usual]) / usual)
    words = f"IMU at {1 / usual:.4g} Hz, intervals vary by {100 * jitter:.1f} %"
    found = [Finding("imu", words)]
    if 1 / usual < 10:
        means = "strapdown navigation needs 10 Hz or more: what turns and shakes in between is lost"
        found.append(Finding("imu.slow", words, means, True))
    long = in_words(holes(imu))
    if long:
        found.append(Finding("imu.gaps", long))
    values = np.hstack([imu.gyro, imu.accel])
    same = float(np.mean(np.all(values[1:] == values[:-1], axis=1)))
    if same > 0.005:
        words = f"{100 * same:.1f} % of the IMU's rows repeat the row before"
        means = "the logger polled the sensor, and lost as many samples: repair = true in a column map mends it"
        found.append(Finding("imu.polled", words, means, same > 0.01))
    return found


def axes(rec: Recording) -> list[Finding]:
    """Axes that show nothing, and axes that are clipped."""
    found = []
    for name, values in (("gyro", rec.imu.gyro), ("accel", rec.imu.accel)):
        spread = values.std(0)
        for axis, own, column in zip("xyz", spread, values.T, strict=True):
            if own < 1e-3 * max(float(np.median(spread)), 1e-9):
                words = f"{name} {axis} does not move: {column[0]:.3g} throughout"
                found.append(Finding(f"{name}.dead", words, "a dead axis, or a column that is another", True))
                continue
            rows, begin = longest_repeat(column)
            if rows > STUCK and rows * float(np.median(rec.imu.dt)) > 1.0 and np.mean(np.diff(column) != 0) > 0.5:
                words = f"{name} {axis} repeats {column[begin]:.4g} in {rows} rows from t = {rec.imu.t[begin]:.1f} s on"
                found.append(Finding(f"{name}.stuck", words, "the sensor or its driver hung", True))
            top = np.abs(column).max()
            share = float(np.mean((np.abs(column[1:]) > 0.999 * top) & (column[1:] == column[:-1])))
            if share > 0.003 and column.size > 1000 and top > 3 * own:
                words = f"{name} {axis} is at {top:.3g} in {100 * share:.1f} % of the rows"
                found.append(Finding(f"{name}.clipped", words, "beyond the sensor's range", True))
    return found


def longest_repeat(column: np.ndarray) -> tuple[int, int]:
    """Rows of the longest run of one value in a row, and where it begins."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(column) != 0, [True]]))
    lengths = np.diff(edges)
    return int(lengths.max()), int(edges[lengths.argmax()])


def quiet(imu: ImuLog, span: float = 1.0) -> tuple[np.ndarray, int]:
    """Windows (W, n) of rows in which the IMU is quietest, and their length."""
    n = max(2, round(span / float(np.median(imu.dt))))
    m = imu.t.size // n
    rows = np.arange(m * n).reshape(m, n)
    unrest = np.sqrt(imu.accel[rows].var(1).sum(-1)) + G * np.sqrt(imu.gyro[rows].var(1).sum(-1))
    unrest = unrest + G * np.linalg.norm(imu.gyro[rows].mean(1) - np.median(imu.gyro, 0), axis=-1)
    return rows[np.argsort(unrest)[: max(3, int(QUIET * m))]], n


def gravity(rec: Recording) -> list[Finding]:
    """Specific force where it is quiet: its size, and which axis it lies on."""
    rows, _ = quiet(rec.imu)
    if len(rows) < 3:
        return []
    force = np.median(rec.imu.accel[rows].mean(1), 0)
    size = float(np.linalg.norm(force))
    words = f"specific force where it is quiet: {', '.join(f'{f:.2f}' for f in force)} m/s^2, together {size:.2f}"
    found = [Finding("imu.gravity", words)]
    if abs(size - G) > 0.35:
        means = (
            f"{100 * (size / G - 1):+.1f} % from gravity: a bias or scale error of the accelerometer, or never at rest"
        )
        elsewhere = abs(quiet_force(rec.imu) - G) < 0.35
        if elsewhere:
            means = "gravity shows in other seconds: a free fall, or another motion without turns"
        found.append(Finding("imu.gravity_size", words, means, abs(size - G) > 0.7 and not elsewhere))
    axis = int(np.abs(force).argmax())
    if abs(force[axis]) > 0.9 * size and (axis, np.sign(force[axis])) != (2, -1.0):
        name = "xyz"[axis]
        guess = 'FLU or ENU? say axes = "flu"' if axis == 2 else "the IMU lies on its side: say axes"
        if axis == 2 and turns_with_course(rec):
            guess = "gyro z agrees with the course: the accelerometer alone has the other sign, say accel_sign = -1"
        means = f"{name} reads {force[axis]:+.1f} at rest, where forward, right, down has z = -9.8: {guess}"
        found.append(Finding("axes.gravity", words, means, True))
    return found


def noise(rec: Recording) -> list[Finding]:
    """White noise where it is quiet: an upper limit of the sensor's own."""
    floor = noise_floor(rec.imu)
    if floor is None:
        return []
    gyro, accel = np.median(floor[0]) / units.DEG_PER_SQRT_HOUR, np.median(floor[1]) / units.UG
    words = f"noise where it is quiet: gyro {gyro:.2g} deg/sqrt(h), accelerometer {accel:.3g} ug/sqrt(Hz)"
    return [Finding("imu.noise", words)]


def noise_floor(imu: ImuLog) -> tuple[np.ndarray, np.ndarray] | None:
    """Root PSD (3,) of gyro rad/s/sqrt(Hz) and accelerometer m/s^2/sqrt(Hz) where it is quiet; None of too few samples.

    By third differences, in which motion of f Hz is (2 pi f dt)^3 of itself and white noise is sqrt(20) of itself. An
    axis in coarse steps has at least the noise of rounding: step / sqrt(12) a sample.
    """
    if imu.t.size < 40:
        return None
    rows, n = quiet(imu)
    if n < 10 or len(rows) < 3:
        return None
    root = np.sqrt(float(np.median(imu.dt)))
    spread = lambda a: np.median(np.diff(a[rows], n=3, axis=1).std(1) / np.sqrt(20), 0)
    own = lambda a: root * np.maximum(spread(a), resolution(a) / np.sqrt(12))
    return own(imu.gyro), own(imu.accel)


def resolution(values: np.ndarray) -> np.ndarray:
    """The step (c,) in which columns (K, c) are told: the smallest difference of two values; 0 if they vary freely."""
    steps = []
    for column in values.T:
        size = float(np.abs(column).max())
        levels = np.unique(column)
        gaps = np.diff(levels)
        gaps = gaps[gaps > 1e-9 * size]  # two ways of writing one value
        steps.append(float(gaps.min()) if gaps.size and 4 * levels.size < column.size else 0.0)
    return np.array(steps)
