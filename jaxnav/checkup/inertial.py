"""The IMU by itself: sampling, axes that are dead or clipped, gravity and noise where it is quiet."""

import numpy as np

from jaxnav.checkup.motion import turns_with_course
from jaxnav.checkup.shared import level_velocity
from jaxnav.filters.gaps import MIN_GAP_S, Holes, holes
from jaxnav.findings import finding
from jaxnav.io.checks import quiet_force
from jaxnav.maths import units
from jaxnav.maths.interpolation import columns_at
from jaxnav.types import Finding, ImuLog, Recording, Severity

QUIET_SHARE = 0.05  # share of the windows that count as quiet
G = 9.81
UNKNOWN_HEADING_DEG = 30.0  # deg that a hole may hide, from which on the heading behind it is said to be unknown
MIN_RATE_HZ = 10.0  # strapdown navigation loses rotation and vibration between samples
MAX_STEADY_ACCEL = 0.15  # m/s^2 by the fixes, more than their noise, below which specific force is gravity
MAX_LOST_SHARE = 0.1  # share of the rows, missing between others, from which on a log is said to lose them
MIN_LEVELS = 50  # values of an axis that is fine enough to show a stop
MAX_REPEATED_ROWS = 20  # rows of one value in a row from which on an axis that otherwise changes hangs


def sampling(rec: Recording) -> list[Finding]:
    """Rate, jitter, gaps and repeated rows."""
    imu = rec.imu
    dt = np.diff(imu.t)
    usual = float(np.median(dt))
    jitter = float(np.std(dt[dt < 2.5 * usual]) / usual)
    found = [finding("imu.rate", value=1 / usual, jitter=100 * jitter)]
    if 1 / usual < MIN_RATE_HZ:
        found.append(finding("imu.slow", value=1 / usual, limit=MIN_RATE_HZ))
    missing = np.maximum(np.round(dt[dt < MIN_GAP_S] / usual) - 1, 0).sum()
    share = float(missing / (missing + dt.size))
    if share > MAX_LOST_SHARE:
        found.append(finding("imu.lost", value=100 * share, limit=100 * MAX_LOST_SHARE))
    found += gap_findings(holes(imu))
    same = float(np.mean(np.logical_and.reduce([a[1:] == a[:-1] for a in (*imu.gyro.T, *imu.accel.T)])))
    if same > 0.005:
        found.append(finding("imu.polled", value=100 * same, severity=None if same > 0.01 else Severity.INFO))
    return found


def axes(rec: Recording) -> list[Finding]:
    """Axes that show nothing, and axes that are clipped."""
    found = []
    for name, values in (("gyro", rec.imu.gyro), ("accel", rec.imu.accel)):
        spread = values.std(0)
        for axis, sd, column in zip("xyz", spread, values.T, strict=True):
            if sd < 1e-3 * max(float(np.median(spread)), 1e-9):
                found.append(finding("imu.dead", f"{name} {axis}", column[0]))
                continue
            rows, begin = longest_repeat(column)
            if (
                rows > MAX_REPEATED_ROWS
                and rows * float(np.median(rec.imu.dt)) > 1.0
                and np.mean(np.diff(column) != 0) > 0.5
            ):
                found.append(finding("imu.stuck", f"{name} {axis}", column[begin], rows=rows, at=rec.imu.t[begin]))
            top = np.abs(column).max()
            share = float(np.mean((np.abs(column[1:]) > 0.999 * top) & (column[1:] == column[:-1])))
            fine = np.unique(np.abs(column)).size > MIN_LEVELS
            if share > 0.003 and column.size > 1000 and top > 3 * sd and fine:
                found.append(finding("imu.clipped", f"{name} {axis}", float(top), share=100 * share))
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
    accel, gyro = (a[: m * n].reshape(m, n, 3) for a in (imu.accel, imu.gyro))
    unrest = np.sqrt(accel.var(1).sum(-1)) + G * np.sqrt(gyro.var(1).sum(-1))
    unrest = unrest + G * np.linalg.norm(gyro.mean(1) - np.median(imu.gyro, 0), axis=-1)
    quietest = np.argsort(unrest)[: max(3, int(QUIET_SHARE * m))]
    return quietest[:, None] * n + np.arange(n), n


def steady(rec: Recording) -> np.ndarray | None:
    """Return rows (W, n) of 2 s in which the fixes say that the vehicle accelerates by less than `MAX_STEADY_ACCEL`.

    None without fixes, or where there are too few such seconds.
    """
    v = level_velocity(rec.aiding)
    if v is None:
        return None
    n = max(2, round(2.0 / float(np.median(rec.imu.dt))))
    rows = np.arange(rec.imu.t.size // n * n).reshape(-1, n)
    begin, end = rec.imu.t[rows[:, 0]], rec.imu.t[rows[:, -1]]
    middle = 0.5 * (begin + end)
    over = max(2.0, 2 * float(np.median(np.diff(v.t))))  # noise of velocities is the less, the longer
    covered = (middle - over > v.t[0]) & (middle + over < v.t[-1])
    at = lambda t: columns_at(t, v.t, v.value)
    halves = [at(middle) - at(middle - over), at(middle + over) - at(middle)]  # 2 s of a circle are not steady
    change = np.max([np.linalg.norm(h[:, :2], axis=1) for h in halves], 0)
    if float(np.median(v.sd[:, 2])) < 1.0:
        change = np.hypot(change, np.max([np.abs(h[:, 2]) for h in halves], 0))
    noise = 1.5 * np.sqrt(2) * float(np.median(v.sd[:, :2]))
    keep = covered & (change < MAX_STEADY_ACCEL * over + noise) & (end - begin < 2.5)
    return rows[keep] if keep.sum() >= 3 else None


def gravity(rec: Recording) -> list[Finding]:
    """Compare specific force with gravity where the fixes show no acceleration: size, and axis."""
    rows, when = steady(rec), "where the fixes show no acceleration"
    known = rows is not None
    if rows is None:
        rows, when = quiet(rec.imu)[0], "in the quietest seconds"
    if len(rows) < 3:
        return []
    force = np.median(rec.imu.accel[rows].mean(1), 0)
    size = float(np.median(np.linalg.norm(rec.imu.accel[rows].mean(1), axis=1)))
    found = [finding("imu.gravity", value=size, vector=", ".join(f"{f:.2f}" for f in force), when=when)]
    sure = known or level_velocity(rec.aiding) is None and abs(quiet_force(rec.imu) - G) > 0.35
    if abs(size - G) > 0.35:
        severity = None if sure and abs(size - G) > 0.7 else Severity.INFO
        found.append(finding("imu.gravity_size", value=size, share=100 * (size / G - 1), when=when, severity=severity))
    axis = int(np.abs(force).argmax())
    if abs(force[axis]) > 0.9 * size and (axis, np.sign(force[axis])) != (2, -1.0):
        name = "xyz"[axis]
        cause, action = "the IMU is mounted on its side", "set axes"
        if axis == 2:
            cause, action = "axes forward, left, up or east, north, up", 'set axes = "flu"'
            if turns_with_course(rec):
                cause, action = "gyro z agrees with the course: the accelerometer's sign alone", "set accel_sign = -1"
        found.append(finding("axes.gravity", name, float(force[axis]), cause=cause, action=action))
    return found


def gap_findings(holes: Holes) -> list[Finding]:
    """Return the finding of the long holes, where there are any."""
    if not holes.begin.size:
        return []
    length = holes.end - holes.begin
    i = int(length.argmax())
    turn, push = (float(n) * length[i] ** 0.5 for n in holes.noise[i])
    code = "imu.pause" if np.degrees(turn) > UNKNOWN_HEADING_DEG else "imu.gaps"
    return [
        finding(
            code,
            value=float(length[i]),
            limit=MIN_GAP_S,
            count=length.size,
            at=float(holes.begin[i]),
            angle=float(np.degrees(turn)),
            speed=push,
        )
    ]


def noise(rec: Recording) -> list[Finding]:
    """White noise in the quietest seconds: an upper limit of the sensor's noise."""
    floor = noise_floor(rec.imu)
    if floor is None:
        return []
    gyro, accel = np.median(floor[0]) / units.DEG_PER_SQRT_HOUR, np.median(floor[1]) / units.UG
    return [finding("imu.noise", gyro=gyro, accel=accel)]


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
    white = lambda a: root * np.maximum(spread(a), resolution(a) / np.sqrt(12))
    return white(imu.gyro), white(imu.accel)


def resolution(values: np.ndarray) -> np.ndarray:
    """Return the resolution (c,) of columns (K, c): the smallest difference of two values; 0 if they vary freely."""
    steps = []
    for column in values.T:
        size = float(np.abs(column).max())
        levels = np.unique(column)
        gaps = np.diff(levels)
        gaps = gaps[gaps > 1e-9 * size]  # two ways of writing one value
        steps.append(float(gaps.min()) if gaps.size and 4 * levels.size < column.size else 0.0)
    return np.array(steps)
