"""From a configuration to what a filter runs on: start, parameters, epochs."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.app.config import Config
from jaxnav.app.parameters import override
from jaxnav.app.sources import load, scenario_of
from jaxnav.data import epochs as ep
from jaxnav.data import start as alignment
from jaxnav.filters import core
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.parameters import datasheet_params, mounting
from jaxnav.filters.run import initial_nav
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG, PPM
from jaxnav.measurements import GNSS, MEASUREMENTS, Measurement
from jaxnav.simulate.scenarios import Scenario
from jaxnav.states.grades import GRADES, Grade
from jaxnav.types import ConfigError, DataError, Nav, Params, Prior, Recording, Samples, nearest

REACH = 0.25  # s, latency that tuning may add
FALSE = 0.1  # of the epochs at rest by the detector, at most, that are in motion by the receiver
APART = 2.0  # s, at most, from the first position to the velocity beside it
CHORD = 4.0  # s, over which 3 m of noise are 1 m/s


class Case(NamedTuple):
    """One recording, ready to run."""

    recording: Recording
    filter: core.Filter
    measurements: tuple[Measurement, ...]
    params: Params
    packed: ep.Packed  # nothing hidden
    navs: Nav  # (B, ...) the start, or one for each hypothesis of the heading
    bias_truth: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # t, gyro rad/s, accelerometer m/s^2


# ---------------------------------------------------------------------------- filter and parameters


def filter_name(config: Config) -> str:
    """The filter's name, known.

    Raises:
        ConfigError: it is not in FILTERS.
    """
    name = config.filter.name
    if name not in FILTERS:
        raise ConfigError(f"filter.name: no filter {name!r}: {nearest(name, FILTERS)}")
    return name


def grade_name(config: Config, scenario: Scenario | None) -> str:
    """What the configuration says, else the scenario, else a consumer's unit."""
    return config.filter.grade or (scenario.imu.grade if scenario else "consumer")


def grade_of(config: Config, scenario: Scenario | None) -> Grade:
    """The IMU's datasheet.

    Raises:
        ConfigError: it is not in GRADES.
    """
    name = grade_name(config, scenario)
    if name not in GRADES:
        raise ConfigError(f"filter.grade: no IMU grade {name!r}: {nearest(name, GRADES)}")
    return GRADES[name]


def measurements_of(config: Config) -> tuple[Measurement, ...]:
    """Position, velocity and the constraints that are on."""
    return (*GNSS, *(m for m in MEASUREMENTS.values() if not m.receiver and config.filter.uses(m.name)))


def history_of(config: Config, known: Params, rate_hz: float, span: float, tuned: bool) -> int:
    """IMU samples of history: to cover the latencies that are known, and what tuning may add to them."""
    if config.filter.history:
        return max(2, config.filter.history)
    return covering(known, rate_hz, span, REACH if tuned else 0.0)


def covering(known: Params, rate_hz: float, span: float, more: float = 0.0) -> int:
    """IMU samples of history that reach back as far as the latest fix in ``span`` s of data, and ``more`` s."""
    offset = float(known.mounting.time_offset) + abs(float(known.mounting.clock_drift)) * span
    ages = [float(theta.latency) for theta in known.measurements.values() if hasattr(theta, "latency")]
    late = offset + max(ages, default=0.0) + more
    return 2 + math.ceil(late * rate_hz + 1e-6) if late > 0 else 2


def base_params(config: Config, grade: Grade, lever_arm: np.ndarray, position_sd: Any, velocity_sd: Any) -> Params:
    """The datasheet's parameters under the overrides of [params]; the prior of the start by [start]."""
    start, entry = config.start, FILTERS[filter_name(config)]
    heading_sd = 360.0 / start.hypotheses if start.heading == "unknown" else start.heading_sd_deg
    params = datasheet_params(
        grade, position_sd, velocity_sd, start.tilt_sd_deg * DEG, heading_sd * DEG,
        mounting(lever_arm), entry.theta(), states=(*entry.states, *config.filter.states),
    )  # fmt: skip
    return override(params._replace(feedback=entry.feedback_theta()), config.params)


def prepare(config: Config, tuned: bool = False) -> Case:
    """Read or simulate, align, and pack; nothing hidden yet.

    Raises:
        DataError: data that cannot be used. ConfigError: names that are not known.
    """
    name, scenario = filter_name(config), scenario_of(config)
    grade, measurements = grade_of(config, scenario), measurements_of(config)
    rec, sim = load(config)
    first, prior = start_of(config, rec)
    params = base_params(config, grade, rec.lever_arm, prior.position, prior.velocity)
    interval = config.filter.interval_s or float(np.median(np.diff(rec.aiding["position"].t)))
    packed = pack(config, rec, measurements, float(np.ravel(first.t)[0]), interval)
    rate = 1 / float(np.median(rec.imu.dt))
    filt = build(
        name,
        measurements,
        config.filter.cov_stride,
        history_of(config, params, rate, np.ptp(rec.imu.t), tuned),
        states=config.filter.states,
    )
    biases = (
        None
        if sim is None
        else jax.tree.map(np.asarray, (sim.truth.t, sim.truth.errors["gyro_bias"], sim.truth.errors["accel_bias"]))
    )
    return Case(rec, filt, measurements, params, packed, first, biases)


def pack(
    config: Config, rec: Recording, measurements: tuple[Measurement, ...], start: float, interval: float
) -> ep.Packed:
    """Epochs from ``start`` on, with the constraints that are on."""
    f, stop = config.filter, config.data.stop
    wanted = {m.name for m in measurements if m.columns}
    for name in wanted - set(rec.aiding) - {"velocity"}:
        raise DataError(f"{rec.name}: has no stream {name}, which filter.{name} asks for")
    aiding = {name: s for name, s in rec.aiding.items() if name in wanted}
    cuts = ep.cut_times(rec.imu, aiding, interval, start, stop)
    standing = None
    if f.uses("zero_velocity") or f.uses("zero_rate"):
        standing = ep.stationary(
            rec.imu, cuts, f.standing_window_s, f.standing_accel_sd_mps2, f.standing_gyro_sd_deg_per_s * DEG
        )
        _check_standing(rec, cuts[standing])
    made = ep.constraint_samples(
        rec.imu, cuts, nonholonomic=f.uses("nonholonomic"), standing=standing, window=f.standing_window_s
    )
    aiding |= {k: v for k, v in made.items() if f.uses(k)}
    return ep.pack(rec.imu, aiding, interval, measurements, start, stop, cuts, f.cov_stride)


def _check_standing(rec: Recording, t: np.ndarray) -> None:
    """Raise ConfigError where the detector of [filter] takes a smooth drive for a standstill.

    One in `FALSE` is let pass: which epochs these are must not be known where fixes are hidden.
    """
    if "velocity" not in rec.aiding or not t.size:
        return
    moving = ep.driving(rec.aiding["velocity"], t)
    if moving.mean() > FALSE:
        raise ConfigError(
            f"filter.standing_accel_sd_mps2, standing_gyro_sd_deg_per_s: {moving.sum()} of {t.size} epochs that these "
            f"take for rest have a velocity of over 0.5 m/s, the first at {t[moving][0]:.3f} s: lower them"
        )


# ---------------------------------------------------------------------------- the start


def start_of(config: Config, rec: Recording) -> tuple[Nav, Prior]:
    """Navigation states (B, ...) at the start, and the sd of position and velocity there.

    Raises:
        DataError: no position, never fast enough for a course, no truth with attitude where it is asked for.
        ConfigError: a heading that is none.
    """
    start, position = config.start, rec.aiding.get("position")
    for key in ("position_sd_m", "velocity_sd_mps"):
        sd = getattr(start, key)
        if sd is not None and (np.shape(sd) not in ((), (3,)) or not np.all(np.asarray(sd) > 0)):
            raise ConfigError(f"start.{key} must be one number or 3, > 0, got {sd!r}")
    if position is None or position.t.size < 2:
        raise DataError(f"{rec.name}: needs a stream of positions to start from")
    heading = start.heading
    if isinstance(heading, str) and heading not in ("course", "unknown", "truth"):
        raise ConfigError(f'start.heading must be "course", "unknown", "truth" or degrees, got {heading!r}')
    begin = max(rec.imu.t[0], -math.inf if config.data.start is None else config.data.start)
    own = rec.aiding.get("velocity")
    velocity = own or _differences(position)
    roll, pitch = _level(rec, velocity, begin)
    angle = 0.0
    if heading == "course":
        begin, angle = alignment.course(velocity, start.course_speed_mps, begin)
    elif heading == "truth":
        begin, roll, pitch, angle = _true_attitude(rec, begin)
    elif not isinstance(heading, str):
        angle = heading * DEG
    t, lla, vel, prior = _first_fix(config, rec, position, velocity, begin)
    if own is not None and np.abs(own.t - t).min() > APART:
        raise DataError(f"velocity: none within {APART:g} s of the first position, at {t:.3f} s: set data.start")
    if heading == "truth":
        roll, pitch, angle = _interpolated(rec, t + _clock_offset(config, rec, t))
    nav = initial_nav(lla, vel, (roll, pitch, angle), halfway(rec))
    arm = rotations.to_dcm(nav.q) @ jnp.asarray(rec.lever_arm, float)
    nav = nav._replace(pos=earth.move(nav.pos, -arm), t=jnp.asarray(t, float))
    angles = 2 * np.pi * np.arange(start.hypotheses) / start.hypotheses if heading == "unknown" else np.array([angle])
    return alignment.with_headings(nav, angles), prior


def _differences(position: Samples) -> Samples:
    """Mean velocity over the last `CHORD` s of positions, whose noise would else pass for motion."""
    n = max(1, min(round(CHORD / float(np.median(np.diff(position.t)))), position.t.size - 1))
    lla = jnp.asarray(position.value)
    dt = (position.t[n:] - position.t[:-n])[:, None]
    value = np.asarray(jax.vmap(earth.enu_difference)(lla[n:], lla[:-n])) / dt
    return Samples(position.t[n:], value, 1.5 * position.sd[n:] / dt, np.zeros_like(value))


def _level(rec: Recording, velocity: Samples, begin: float) -> tuple[float, float]:
    """Roll and pitch (rad) from the standstill at the start, or flat where there is none of 2 s.

    Raises:
        DataError: nothing to level by, and specific force that points down: z is up.
    """
    after = velocity.t >= begin
    moving = after & (np.hypot(velocity.value[:, 0], velocity.value[:, 1]) > 0.5)
    until = velocity.t[np.argmax(moving)] if moving.any() else velocity.t[-1]
    until = min(until - 0.5, begin + 30.0)
    if until - begin >= 2.0:
        return alignment.level(rec.imu, begin, until)
    down = float(rec.imu.accel[(rec.imu.t > begin) & (rec.imu.t <= begin + 30.0), 2].mean())
    if down > 0:
        raise DataError(f"imu: z of specific force is {down:+.1f} m/s^2 on average: body axes are forward, right, down")
    return 0.0, 0.0


def _interpolated(rec: Recording, t: float) -> np.ndarray:
    truth = rec.truth
    assert truth is not None
    return np.array([np.interp(t, truth.t, np.unwrap(c)) for c in truth.rph.T])


def _true_attitude(rec: Recording, begin: float) -> tuple[float, float, float, float]:
    """Time from which the truth has an attitude, and roll, pitch, heading there."""
    known = np.isfinite(rec.truth.rph).all(1) if rec.truth is not None else np.zeros(0, bool)
    if rec.truth is None or not known.all():
        raise DataError(f'{rec.name}: has no true attitude, which start.heading = "truth" asks for')
    begin = max(begin, rec.truth.t[0])
    return (begin, *_interpolated(rec, begin))


def halfway(rec: Recording) -> float:
    """Stamp, s, that drift of the clock is counted from, wherever a run starts: its offset there is the mean one."""
    return 0.5 * float(rec.imu.t[0] + rec.imu.t[-1])


def _clock_offset(config: Config, rec: Recording, t: float) -> float:
    """What is known of GNSS time minus the IMU's stamp ``t``, s."""
    known = config.params
    return known.number("time_offset_s") + known.number("clock_drift_ppm") * PPM * (t - halfway(rec))


def _first_fix(
    config: Config, rec: Recording, position: Samples, velocity: Samples, begin: float
) -> tuple[float, np.ndarray, np.ndarray, Prior]:
    """Time, position, velocity and their sd at the first fix from ``begin`` on; moved on by the position's latency."""
    i = int(np.searchsorted(position.t, begin - ep.TICK))
    if i >= position.t.size - 1:
        raise DataError(f"position: no fix after {begin:.3f} s to start from")
    t = float(position.t[i])
    j = int(np.argmin(np.abs(velocity.t - t)))
    start, known = config.start, config.params
    late = _clock_offset(config, rec, t) + known.number("position_latency_s")
    lla = earth.move(jnp.asarray(position.value[i]), late * jnp.asarray(velocity.value[j]))
    position_sd = np.hypot(position.sd[i], 0.5) if start.position_sd_m is None else start.position_sd_m
    velocity_sd = np.hypot(velocity.sd[j], 0.3) if start.velocity_sd_mps is None else start.velocity_sd_mps
    prior = Prior(jnp.asarray(position_sd, float), jnp.asarray(velocity_sd, float), jnp.zeros(()))
    return t, np.asarray(lla), velocity.value[j], prior
