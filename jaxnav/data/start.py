"""Where navigation starts: levelling at rest, heading from the course, and unknown heading as a bank of hypotheses.

`start` finds all of it in a recording; the functions before it are its parts.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from jaxnav.data.epochs import TICK
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import datasheet_params, mounting
from jaxnav.filters.run import initial_nav, negative_log_likelihood, run
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError, DataError, Epoch, ImuLog, Info, Nav, Params, Prior, Recording, Samples


def level(imu: ImuLog, start: float, stop: float) -> tuple[float, float]:
    """Roll and pitch (rad) from the mean specific force between two times, at rest.

    An accelerometer bias b tilts it by b / g, 1 mrad for 1 mg.

    Raises:
        DataError: no sample between the times.
    """
    inside = (imu.t > start) & (imu.t <= stop)
    if not inside.any():
        raise DataError(f"imu: no sample in {start:.3f} to {stop:.3f} s to level with")
    roll, pitch = levelled(jnp.asarray(np.average(imu.accel[inside], axis=0, weights=imu.dt[inside])))
    return float(roll), float(pitch)


def levelled(force: jax.Array) -> jax.Array:
    """Roll and pitch (2,) rad that a mean specific force (3,) m/s^2, body FRD, shows at rest."""
    fx, fy, fz = force
    return jnp.stack([jnp.arctan2(-fy, -fz), jnp.arctan2(fx, jnp.hypot(fy, fz))])


def course(velocity: Samples, min_speed: float, after: float = -np.inf) -> tuple[float, float]:
    """Time (s) and course over ground (rad from north, clockwise) of the first velocity faster than ``min_speed``.

    And than three times its own sd. It is the heading of a vehicle that does not slip and drives forward.

    Raises:
        DataError: never that fast.
    """
    speed, sd = np.hypot(velocity.value[:, 0], velocity.value[:, 1]), velocity.sd[:, :2].max(1)
    fast = (speed >= min_speed) & (speed > 3 * sd) & (velocity.t >= after)
    if not fast.any():
        raise DataError(
            f"velocity: never faster than {min_speed:g} m/s and 3 sd after {after:g} s, no course to start from"
        )
    i = int(np.argmax(fast))
    return float(velocity.t[i]), float(np.arctan2(velocity.value[i, 0], velocity.value[i, 1]))


class Bank(NamedTuple):
    """Filters that started with different headings."""

    info: Info  # (B, E, ...)
    probability: jax.Array  # (B,) of each heading, given all innovations of the span
    best: jax.Array  # () index of the most probable


def heading_bank(filt: Filter, params: Params, navs: Nav, epochs: Epoch) -> Bank:
    """Unknown heading: run the filter from each of ``navs`` (B, ...) and weigh them by likelihood (a Gaussian sum).

    One linear filter cannot start with a heading sd of 100 deg, many that start 20 or 30 deg apart can, one of which
    is near enough. Give each a heading prior of about their spacing. They differ once the vehicle accelerates.
    """
    info = jax.vmap(run, (None, None, 0, None))(filt, params, navs, epochs)
    nll = jnp.sum(jax.vmap(jax.vmap(negative_log_likelihood))(info), axis=1)
    score = jnp.where(info.ok[:, -1], -nll, -jnp.inf)
    return Bank(info, jnp.exp(score - logsumexp(score)), jnp.argmax(score))


def with_headings(nav: Nav, headings: np.ndarray) -> Nav:
    """A level start (local level frame) turned to each heading (B,), rad: Nav with a leading axis B."""
    roll_pitch = rotations.to_rph(rotations.to_dcm(nav.q))[:2]

    def turned(heading):
        rph = jnp.concatenate([roll_pitch, heading[None]])
        return nav._replace(q=rotations.from_dcm(rotations.from_rph(rph)))

    return jax.vmap(turned)(jnp.asarray(headings, float))


# ---------------------------------------------------------------------------- the start of a recording

APART = 2.0  # s, at most, from the first position to the velocity beside it
CHORD = 4.0  # s, over which 3 m of noise are 1 m/s


class Start(NamedTuple):
    """Where a recording's navigation starts."""

    navs: Nav  # (B, ...) one, or one for each hypothesis of the heading
    prior: Prior  # standard deviations there
    t: float  # s
    how: str  # in words: from what, and how sure


def start(
    rec: Recording,
    params: Params | None = None,
    *,
    begin: float | None = None,
    heading: float | str = "course",
    course_speed_mps: float = 5.0,
    position_sd_m: Any = None,
    velocity_sd_mps: Any = None,
    tilt_sd_deg: float = 2.0,
    heading_sd_deg: float = 5.0,
    hypotheses: int = 12,
) -> Start:
    """Position and velocity from the first fix, level from standing, heading as said; from ``begin`` s on.

    ``heading``: "course" (of the first velocity above ``course_speed_mps``), "unknown" (``hypotheses`` of it, see
    `heading_bank`), "truth" (of the recording), or degrees. ``params``: a filter's, of which the timing and the lever
    arm count; None takes the recording's lever arm and no delays. The sd are of the start, one number or one an axis in
    ENU; None is the fix's own and 0.5 m or 0.3 m/s.

    Raises:
        DataError: no position, never fast enough for a course, no truth with attitude where it is asked for.
        ConfigError: a heading or an sd that is none.
    """
    position = rec.aiding.get("position")
    for key, sd in (("position_sd_m", position_sd_m), ("velocity_sd_mps", velocity_sd_mps)):
        if sd is not None and (np.shape(sd) not in ((), (3,)) or not np.all(np.asarray(sd) > 0)):
            raise ConfigError(f"start.{key} must be one number or 3, > 0, got {sd!r}")
    if position is None or position.t.size < 2:
        raise DataError(f"{rec.name}: needs a stream of positions to start from")
    if isinstance(heading, str) and heading not in ("course", "unknown", "truth"):
        raise ConfigError(f'start.heading must be "course", "unknown", "truth" or degrees, got {heading!r}')
    known = rec_timing(rec) if params is None else params
    from_t = max(rec.imu.t[0], -math.inf if begin is None else begin)
    own = rec.aiding.get("velocity")
    velocity = own or _differences(position)
    (roll, pitch), levelled_by = _level(rec, velocity, from_t)
    angle, why = 0.0, f"{heading} deg" if not isinstance(heading, str) else "unknown"
    if heading == "course":
        from_t, angle = course(velocity, course_speed_mps, from_t)
        why = f"course over ground at t = {from_t:.3f} s"
    elif heading == "truth":
        from_t, roll, pitch, angle = _true_attitude(rec, from_t)
    elif not isinstance(heading, str):
        angle = heading * DEG
    t, lla, vel, sd = _first_fix(rec, known, position, velocity, from_t)
    if own is not None and np.abs(own.t - t).min() > APART:
        raise DataError(f"velocity: none within {APART:g} s of the first position, at {t:.3f} s: set data.start")
    if heading == "truth":
        roll, pitch, angle = _interpolated(rec, t + _clock_offset(rec, known, t))
        levelled_by = why = "the truth"
    nav = initial_nav(lla, vel, (roll, pitch, angle), halfway(rec))
    arm = rotations.to_dcm(nav.q) @ jnp.asarray(rec.lever_arm, float)
    nav = nav._replace(pos=earth.move(nav.pos, -arm), t=jnp.asarray(t, float))
    many = heading == "unknown"
    angles = 2 * np.pi * np.arange(hypotheses) / hypotheses if many else np.array([angle])
    heading_sd = 360.0 / hypotheses if many else heading_sd_deg
    prior = Prior(
        jnp.asarray(sd[0] if position_sd_m is None else position_sd_m, float),
        jnp.asarray(sd[1] if velocity_sd_mps is None else velocity_sd_mps, float),
        jnp.asarray([tilt_sd_deg * DEG, tilt_sd_deg * DEG, heading_sd * DEG], float),
    )
    how = (
        f"starts at t = {t:.3f} s: level by {levelled_by} (sd {tilt_sd_deg:g} deg), heading by {why} "
        f"({f'{hypotheses} hypotheses' if many else f'sd {heading_sd:g} deg'})"
    )
    return Start(with_headings(nav, angles), prior, t, how)


def rec_timing(rec: Recording) -> Params:
    """Parameters of a filter that knows a recording's lever arm and of no delays."""
    return datasheet_params(GRADES["consumer"], install=mounting(rec.lever_arm))


def halfway(rec: Recording) -> float:
    """Stamp, s, that drift of the clock is counted from, wherever a run starts: its offset there is the mean one."""
    return 0.5 * float(rec.imu.t[0] + rec.imu.t[-1])


def _clock_offset(rec: Recording, known: Params, t: float) -> float:
    """What is known of GNSS time minus the IMU's stamp ``t``, s."""
    return float(known.mounting.time_offset) + float(known.mounting.clock_drift) * (t - halfway(rec))


def _differences(position: Samples) -> Samples:
    """Mean velocity over the last `CHORD` s of positions, whose noise would else pass for motion."""
    n = max(1, min(round(CHORD / float(np.median(np.diff(position.t)))), position.t.size - 1))
    lla = jnp.asarray(position.value)
    dt = (position.t[n:] - position.t[:-n])[:, None]
    value = np.asarray(jax.vmap(earth.enu_difference)(lla[n:], lla[:-n])) / dt
    return Samples(position.t[n:], value, 1.5 * position.sd[n:] / dt, np.zeros_like(value))


def _level(rec: Recording, velocity: Samples, begin: float) -> tuple[tuple[float, float], str]:
    """Roll and pitch (rad) from the standstill at the start, or flat where there is none of 2 s; and by what.

    Raises:
        DataError: nothing to level by, and specific force that points down: z is up.
    """
    after = velocity.t >= begin
    moving = after & (np.hypot(velocity.value[:, 0], velocity.value[:, 1]) > 0.5)
    until = velocity.t[np.argmax(moving)] if moving.any() else velocity.t[-1]
    until = min(until - 0.5, begin + 30.0)
    if until - begin >= 2.0:
        return level(rec.imu, begin, until), f"standing from {begin:.1f} to {until:.1f} s"
    down = float(rec.imu.accel[(rec.imu.t > begin) & (rec.imu.t <= begin + 30.0), 2].mean())
    if down > 0:
        raise DataError(f"imu: z of specific force is {down:+.1f} m/s^2 on average: body axes are forward, right, down")
    return (0.0, 0.0), "taking it for flat, for want of a standstill"


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


def _first_fix(
    rec: Recording, known: Params, position: Samples, velocity: Samples, begin: float
) -> tuple[float, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Time, position, velocity and their sd at the first fix from ``begin`` on; moved on by the position's latency."""
    i = int(np.searchsorted(position.t, begin - TICK))
    if i >= position.t.size - 1:
        raise DataError(f"position: no fix after {begin:.3f} s to start from")
    t = float(position.t[i])
    j = int(np.argmin(np.abs(velocity.t - t)))
    late = _clock_offset(rec, known, t) + float(known.measurements["position"].latency)
    lla = earth.move(jnp.asarray(position.value[i]), late * jnp.asarray(velocity.value[j]))
    return t, np.asarray(lla), velocity.value[j], (np.hypot(position.sd[i], 0.5), np.hypot(velocity.sd[j], 0.3))
