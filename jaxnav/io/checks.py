"""The last step of every reader: data that passes here is finite, ordered, in SI and in range."""

import numpy as np

from jaxnav.io.files import MAX_VALUE, Source, place
from jaxnav.measurements import POSITION, with_data
from jaxnav.types import DataError, ImuLog, Recording, Samples, Track

MAX_DT = 2.0  # s; no inertial sample stands for longer
MAX_GAPS = 0.1  # share of the rows that may come after a gap; more, and it is dt that is wrong
MIN_DT = 1e-6  # s
MAX_RATE = 35.0  # rad/s, 2000 deg/s: full scale of the fastest common gyros
MAX_FORCE = 5000.0  # m/s^2
MAX_LINEAR = 1.5  # m/s^2, mean on any axis of an accelerometer without gravity
NO_GRAVITY = (
    "gravity was taken out by the logger, and no filter can do without it: log the raw or calibrated accelerometer "
    "(phone apps: TotalAcceleration, AccelerometerUncalibrated; BNO055: ACC_DATA; BNO08x: accelerometer, not linear "
    "acceleration; ROS drivers: imu/data_raw)"
)
QUIET_SPEED = 10.0  # m/s: weighs a turn against vibration when looking for a quiet window
GRAVITY, GRAVITY_TOLERANCE = 9.8, 2.2  # m/s^2; accelerometers of public logs are off by up to 2
MAX_LEVER_ARM = 100.0  # m


def check_recording(rec: Recording, sources: dict[str, Source] | None = None) -> Recording:
    """Return the recording if every stream is usable, else raise DataError with file, line or row, and field.

    ``sources`` says where "imu", "truth", "lever_arm" and each aiding came from; the default is the recording's name.
    """
    sources = sources or {}
    default = Source(rec.name)
    check_imu(rec.imu, sources.get("imu", default))
    for name, samples in rec.aiding.items():
        source = sources.get(name, default)
        check_samples(name, samples, source)
        _overlap(name, samples.t, rec.imu, source)
    if rec.truth is not None:
        check_track(rec.truth, sources.get("truth", default))
        _overlap("truth", rec.truth.t, rec.imu, sources.get("truth", default))
    source = sources.get("lever_arm", default)
    arm = _bounded(rec.lever_arm, (3,), source, "lever_arm")
    if np.abs(arm).max() > MAX_LEVER_ARM:
        raise DataError(f"{source.file}: lever_arm must be below {MAX_LEVER_ARM:g} m, got {arm}")
    return rec


def check_imu(imu: ImuLog, source: Source) -> ImuLog:
    """Return the log if times, steps, units and ranges are right."""
    t = check_time(imu.t, source, "imu")
    n = len(t)
    dt = _bounded(imu.dt, (n,), source, "imu dt")
    _require((dt >= MIN_DT) & (dt <= MAX_DT), source, "imu", f"dt in [{MIN_DT:g}, {MAX_DT:g}] s{_unit_of(dt)}", dt)
    hole = np.r_[0.0, (t[1:] - dt[1:]) - t[:-1]]
    slack = 0.5 * np.median(dt)
    gap = hole >= slack  # time that no sample covers
    fits = np.abs(hole) < slack if gap.mean() > MAX_GAPS else hole > -slack
    _require(fits, source, "imu", "dt the time since the row before", dt)
    gyro = _bounded(imu.gyro, (n, 3), source, "imu gyro")
    hint = f"|gyro| below {MAX_RATE:g} rad/s (degrees per second? counts of the sensor? gyro_unit = '1/131 deg/s')"
    _require(np.abs(gyro) < MAX_RATE, source, "imu", hint, gyro)
    accel = _bounded(imu.accel, (n, 3), source, "imu accel")
    _require(
        np.abs(accel) < MAX_FORCE,
        source,
        "imu",
        f"|accel| below {MAX_FORCE:g} m/s^2 (mg? counts of the sensor?)",
        accel,
    )
    force = quiet_force(imu)
    if abs(force - GRAVITY) > GRAVITY_TOLERANCE:
        raise DataError(
            f"{source.file}: imu accel must show gravity, {GRAVITY} +- {GRAVITY_TOLERANCE} m/s^2, in some quiet 2 s, "
            f"got {force:.4g}{_guess(force, float(np.median(dt)), imu.accel)}"
        )
    return imu


def check_samples(name: str, samples: Samples, source: Source) -> Samples:
    """Return the stream if times, values, standard deviations and correlations are usable."""
    n = len(check_time(samples.t, source, name))
    width = np.shape(samples.value)[1] if np.ndim(samples.value) == 2 else 3
    if name in (streams := with_data()) and width != streams[name].size:
        raise DataError(f"{source.file}: {name} must have {streams[name].size} columns, got {width}")
    if not width:
        raise DataError(f"{source.file}: {name} must have values, got none")
    value = _bounded(samples.value, (n, width), source, f"{name} value")
    sd = _bounded(samples.sd, (n, width), source, f"{name} sd")
    _require((sd > 1e-9) & (sd < 1e9), source, name, "sd > 0", sd)
    corr = _bounded(samples.corr, (n, width), source, f"{name} corr")
    _require(np.abs(corr) < 1.0, source, name, "correlations inside (-1, 1)", corr)
    if width == 3:  # 1 + 2abc - a^2 - b^2 - c^2 is the determinant of the correlation matrix
        determinant = 1.0 + 2.0 * corr.prod(axis=1) - np.square(corr).sum(axis=1)
        _require(determinant > 0.0, source, name, "correlations of a positive definite covariance", corr)
    if name == "position":
        _geodetic(value, source, name)
    elif name in streams:
        for column, x in zip(streams[name].columns, value.T):
            low, high = column.plausible
            words = f"{column.names[0][0]} within {low:g} and {high:g} (another unit?)"
            _require((x >= low) & (x <= high), source, name, words, x)
    return samples


def uncertainty(name: str, sd: np.ndarray) -> str:
    """``3, 3, 6 m`` for a sentence."""
    unit = streams[name].columns[0].unit if name in (streams := with_data()) else ""
    return f"{', '.join(f'{x:g}' for x in sd)} {unit}".strip()


def check_track(track: Track, source: Source) -> Track:
    """Return the track if it is usable; only its angles may be nan (unknown)."""
    n = len(check_time(track.t, source, "truth"))
    _geodetic(_bounded(track.lla, (n, 3), source, "truth position"), source, "truth")
    _bounded(track.vel, (n, 3), source, "truth velocity")
    rph = np.asarray(track.rph)
    known = np.where(np.isnan(rph), 0.0, rph)
    _bounded(known, (n, 3), source, "truth attitude")
    _require(np.abs(known) <= 2.001 * np.pi, source, "truth", "roll, pitch, heading within 2 pi rad (degrees?)", rph)
    return track


def check_time(t: np.ndarray, source: Source, stream: str) -> np.ndarray:
    """Return the times if there are any and they strictly increase."""
    t = np.asarray(t)
    if t.ndim != 1 or not len(t):
        raise DataError(f"{source.file}: {stream} time must have rows, got shape {t.shape}")
    _bounded(t, (len(t),), source, f"{stream} time")
    _require(np.r_[True, np.diff(t) > 0.0], source, stream, "time later than in the row before", t)
    return t


def steps(t: np.ndarray, source: Source) -> np.ndarray:
    """(N,) s since the row before; the median for the first row and after more than MAX_DT, when nothing says more."""
    check_time(t, source, "imu")
    if len(t) < 2:
        raise DataError(f"{source.file}: imu must have two rows or more")
    dt = np.diff(t)
    usual = np.median(dt)
    dt = np.r_[usual, np.where((dt > MAX_DT) & (usual <= MAX_DT), usual, dt)]
    _require((dt >= MIN_DT) & (dt <= MAX_DT), source, "imu", f"dt in [{MIN_DT:g}, {MAX_DT:g}] s{_unit_of(dt)}", dt)
    return dt


def increments_to_means(increments: np.ndarray, dt: np.ndarray) -> np.ndarray:
    """(N, 3) increments to means; after a gap an increment still covers one nominal step, and its mean is held."""
    nominal = np.median(dt)
    return increments / np.where(dt > 1.5 * nominal, nominal, dt)[:, None]


def ned_to_enu(v: np.ndarray) -> np.ndarray:
    """(N, 3) vectors from NED to ENU axes; the same map goes back."""
    return v[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])


def _geodetic(lla: np.ndarray, source: Source, stream: str) -> None:
    _require(
        np.abs(lla[:, 0]) <= np.pi / 2, source, stream, "latitude within pi/2 rad, 90 deg (degrees as radians?)", lla
    )
    _require(
        np.abs(lla[:, 1]) <= 2 * np.pi, source, stream, "longitude within 2 pi rad, 360 deg (degrees as radians?)", lla
    )
    low, high = POSITION.columns[2].plausible
    height = lla[:, 2]
    _require((height >= low) & (height <= high), source, stream, "a height above the ellipsoid in m", lla)


def _overlap(name: str, t: np.ndarray, imu: ImuLog, source: Source) -> None:
    if t[-1] < imu.t[0] - imu.dt[0] or t[0] > imu.t[-1]:
        raise DataError(
            f"{source.file}: {name} runs from {t[0]:.3f} to {t[-1]:.3f} s and the imu from {imu.t[0]:.3f} to "
            f"{imu.t[-1]:.3f} s: expected the same zero of time"
        )


def _bounded(x: np.ndarray, shape: tuple[int, ...], source: Source, field: str) -> np.ndarray:
    x = np.asarray(x)
    if x.shape != shape or x.dtype.kind != "f":
        raise DataError(f"{source.file}: {field} must be floats of shape {shape}, got {x.dtype} of shape {x.shape}")
    _require(np.abs(x) < MAX_VALUE, source, "", f"{field} finite", x)
    return x


def _require(ok: np.ndarray, source: Source, stream: str, expected: str, got: np.ndarray) -> None:
    rows = ok.reshape(len(ok), -1).all(axis=1)
    if not rows.all():
        i = int(np.argmin(rows))
        label = f"{stream}: " if stream and source.lines is not None else ""
        raise DataError(f"{place(source, i, stream)}: {label}expected {expected}, got {got[i]}")


def _unit_of(dt: np.ndarray) -> str:
    """Return the unit of time that steps of ``dt`` (N,) s suggest, or nothing."""
    usual = float(np.median(dt))
    units = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
    fits = [name for name, k in units.items() if usual > MAX_DT and 5e-4 < usual * k < 0.2]
    return f" (times in {fits[0]}? set time_unit)" if fits else ""


def _guess(force: float, dt: float, accel: np.ndarray) -> str:
    """Return what a quiet force (m/s^2) other than gravity looks like."""
    guesses = []
    if abs(force - 1.0) < 0.35:
        guesses.append("g instead of m/s^2")
    if abs(force / (GRAVITY * dt) - 1.0) < 0.2:
        guesses.append("increments instead of rates")
    if abs(force / 32.17 - 1.0) < 0.1:
        guesses.append("feet")
    if guesses:
        return f": looks like {' or '.join(guesses)}"
    if not accel.any():
        return ": it reads 0 on all axes: accelerations are in another topic, message or file"
    mean = np.abs(accel.mean(axis=0)).max()
    return f": the mean is at most {mean:.2g} m/s^2 on any axis: {NO_GRAVITY}" if mean < MAX_LINEAR else ""


def quiet_force(imu: ImuLog) -> float:
    """Return the mean specific force (m/s^2) of 2 s that is nearest to gravity, of the quieter half of the log.

    Quiet is a small spread of the specific force and a small rate: in a steady turn the force is as constant as at
    rest, but it is not gravity. A vehicle that falls freely, or hovers, shows gravity in other seconds.
    """
    n = min(len(imu.t), max(1, round(2.0 / float(np.median(imu.dt)))))
    m = len(imu.t) // n
    accel, gyro = imu.accel[: m * n].reshape(m, n, 3), imu.gyro[: m * n].reshape(m, n, 3)
    unrest = np.sqrt(accel.var(axis=1).sum(axis=-1)) + QUIET_SPEED * np.linalg.norm(gyro.mean(axis=1), axis=-1)
    force = np.linalg.norm(accel.mean(axis=1), axis=-1)[unrest <= np.median(unrest)]
    return float(force[np.argmin(np.abs(force - GRAVITY))])
