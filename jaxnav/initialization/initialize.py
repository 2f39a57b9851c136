"""Initialization of navigation: levelling at rest, heading by motion, by a sensor, by the course, or as hypotheses.

`initialize` finds all of it in a recording; its parts are the functions before it, `alignment`, `pointing` and `bank`.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.parameters import datasheet_params, datasheet_states, mounting
from jaxnav.filters.programs import stored
from jaxnav.filters.run import initial_nav
from jaxnav.findings import finding
from jaxnav.initialization.alignment import Alignment, AlignmentPrior, align
from jaxnav.initialization.bank import with_headings
from jaxnav.initialization.magnetic import Field, field_of
from jaxnav.initialization.pointing import MAX_HEADING_SD, MIN_TILT_SD, HeadingSource, heading_by_sensor
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG, TICK
from jaxnav.states.grades import GRADES
from jaxnav.states.table import BIASES, STATES
from jaxnav.types import ConfigError, DataError, Finding, ImuLog, Nav, Params, Prior, Recording, Samples


def coarse_leveling(imu: ImuLog, start: float, stop: float) -> tuple[float, float]:
    """Return roll and pitch from the mean specific force between two times, at rest (Groves 2013, eq. 5.101).

    An accelerometer bias b tilts it by b / g, 1 mrad for 1 mg.

    Args:
        imu: the IMU's samples.
        start: s.
        stop: s.

    Returns:
        Roll and pitch, rad.

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
    """Return the course over ground of the first velocity faster than ``min_speed`` and three times its sd.

    It is the heading of a vehicle that does not slip and drives forward.

    Args:
        velocity: ENU m/s.
        min_speed: m/s.
        after: s, earliest time.

    Returns:
        Time, s, and course, rad from north, clockwise.

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


_rph, _moved = stored(rotations.to_rph), stored(earth.move)  # one program each, where they are called by themselves


# ---------------------------------------------------------------------------- initialization of a recording

MIN_VELOCITY_SD = 0.1  # m/s, of an alignment: errors by scale factors, misalignment and thrust between fixes
MAX_STREAM_OFFSET = 2.0  # s, at most, from the first position to the nearest velocity
CHORD_S = 4.0  # s, over which 3 m of noise are 1 m/s
UNCORRELATED = np.eye(12)  # of a prior: every start has some, so that runs from any of them share their programs


class Initialization(NamedTuple):
    """Initial navigation of a recording, with its standard deviations."""

    navs: Nav  # (B, ...) one, or one for each hypothesis of the heading
    prior: Prior  # standard deviations there, and how attitude and biases are correlated
    t: float  # s
    findings: tuple[Finding, ...] = ()  # source and sd of attitude and heading, and what looks wrong
    states: dict[str, np.ndarray] = {}  # standard deviations (size,) of the sensor states that it found
    alignment: Alignment | None = None  # in motion, its result
    field: Field | None = None  # magnetic, where the recording has a magnetometer
    earliest: float = math.inf  # s, from which on it was looked for: a smoother goes back to there

    @property
    def how(self) -> str:
        """Return the findings in one line."""
        return "; ".join(map(str, self.findings))

    def apply_to(self, params: Params) -> Params:
        """Return the parameters with the sd of this initialization as their prior, one an axis for those of biases."""
        sds = {name: params.states[name].sd for name in BIASES if name in params.states} | self.states
        wide = lambda name, sd: jnp.broadcast_to(jnp.asarray(sd), (STATES[name].size,))
        states = {name: params.states[name]._replace(sd=wide(name, sd)) for name, sd in sds.items()}
        params = params._replace(prior=self.prior, states=params.states | states)
        if self.field is None or "magnetometer" not in params.measurements:
            return params
        there = {name: jnp.asarray(getattr(self.field, name)) for name in ("declination", "inclination", "strength")}
        magnetometer = params.measurements["magnetometer"]._replace(**there)
        return params._replace(measurements=params.measurements | {"magnetometer": magnetometer})


class Attitude(NamedTuple):
    """Attitude and its sd at a time."""

    t: float  # s
    rph: tuple[float, float, float]  # rad, roll, pitch, heading
    sd: tuple[float, float]  # rad, of each tilt and of the heading
    words: str
    unknown: bool = False  # the heading
    alignment: Alignment | None = None  # that it came from, if it came from one
    heading_source: HeadingSource | None = None  # source of the heading, where motion was not


def require_positions(rec: Recording) -> None:
    """Refuse a recording without two positions, with what its reader says of them."""
    if "position" in rec.aiding and rec.aiding["position"].t.size >= 2:
        return
    why = [f.message for f in rec.findings if f.subject == "position"]
    streams = ", ".join(rec.aiding) or "no other stream"
    raise DataError("\n".join([f"{rec.name}: has no positions to start from, and {streams}", *why]))


def initialize(
    rec: Recording,
    params: Params | None = None,
    *,
    t_start: float | None = None,
    heading: float | str = "motion",
    course_speed_mps: float = 5.0,
    position_sd_m: Any = None,
    velocity_sd_mps: Any = None,
    tilt_sd_deg: float = 2.0,
    heading_sd_deg: float = 5.0,
    hypotheses: int = 12,
) -> Initialization:
    """Return the initial navigation of a recording: position and velocity by a fix, attitude by ``heading``.

    Only data up to the start are used, and of a compass the second after it, as in a live filter.

    Args:
        rec: the recording, with positions.
        params: parameters of a filter; timing, lever arm, the biases' priors and the magnetic field count. None is a
            consumer's IMU, the recording's lever arm and no delays.
        t_start: s, earliest time; None is the begin of the recording.
        heading: "motion" aligns in motion (`jaxnav.initialization.alignment`) over 10 s to a minute, until the heading
            is known to 10 deg; else two antennas or a magnetometer give it, else it is unknown. "unknown" starts
            ``hypotheses`` (`heading_bank`). "course" takes the first velocity above ``course_speed_mps``. "truth" is
            the recording's truth, a number degrees. All but "motion" and "truth" level by a standstill, else by motion,
            else take the vehicle for flat.
        course_speed_mps: m/s, least speed for a course.
        position_sd_m: initial sd, m, one number or one per axis in ENU; None is the fix's sd and 0.5 m.
        velocity_sd_mps: initial sd, m/s, likewise; None is the fix's sd and 0.3 m/s.
        tilt_sd_deg: deg, of levelling.
        heading_sd_deg: deg, of a course or of degrees.
        hypotheses: number of headings where it is unknown.

    Raises:
        DataError: fewer than two positions, never fast enough for a course, or no truth with attitude for "truth".
        ConfigError: an unusable heading or sd.
    """
    require_positions(rec)
    position = rec.aiding["position"]
    for key, sd in (("position_sd_m", position_sd_m), ("velocity_sd_mps", velocity_sd_mps)):
        if sd is not None and (np.shape(sd) not in ((), (3,)) or not np.all(np.asarray(sd) > 0)):
            raise ConfigError(f"initialization.{key} must be one number or 3, > 0, got {sd!r}")
    if isinstance(heading, str) and heading not in ("motion", "course", "unknown", "truth"):
        choices = '"motion", "course", "unknown", "truth" or degrees'
        raise ConfigError(f"initialization.heading must be {choices}, got {heading!r}")
    if not isinstance(heading, str) and not np.all(np.isfinite(heading)):
        raise ConfigError(f"initialization.heading must be finite, got {heading!r}")
    known = recorded_timing(rec) if params is None else params
    from_t = max(rec.imu.t[0] - rec.imu.dt[0], -math.inf if t_start is None else t_start)
    velocity = ground_velocity(rec)
    sds = (tilt_sd_deg * DEG, (360.0 / hypotheses if heading == "unknown" else heading_sd_deg) * DEG)
    if heading == "motion":
        at = _align_in_motion(rec, known, velocity, from_t, hypotheses)
    elif heading == "truth":
        at = _true_attitude(rec, known, position, from_t, sds)
    else:
        at = _attitude_from_setting(rec, known, velocity, from_t, heading, course_speed_mps, sds)
    t, lla, vel, sd = first_fix(rec, known, position, velocity, at.t)
    aligned_velocity = at.alignment is not None and t <= at.t + TICK
    if at.alignment is not None and aligned_velocity:
        vel, sd = at.alignment.vel, (sd[0], np.hypot(at.alignment.vel_sd, MIN_VELOCITY_SD))
    elif "velocity" in rec.aiding and np.abs(rec.aiding["velocity"].t - t).min() > MAX_STREAM_OFFSET:
        near = f"within {MAX_STREAM_OFFSET:g} s of the first position"
        raise DataError(f"velocity: none {near}, at {t:.3f} s: set data.start")
    nav = initial_nav(lla, vel, at.rph, halfway(rec))._replace(t=jnp.asarray(t, float))
    angles = 2 * np.pi * np.arange(hypotheses) / hypotheses if at.unknown else np.array([at.rph[2]])
    navs = with_headings(nav, angles, rec.lever_arm)
    attitude_sd, states, correlated = np.array([at.sd[0], at.sd[0], at.sd[1]]), {}, UNCORRELATED
    if at.alignment is not None:
        found = at.alignment
        biases = {"gyro_bias": (found.gyro_bias, found.sd[3:6]), "accel_bias": (found.accel_bias, found.sd[6:9])}
        biases = {name: bias for name, bias in biases.items() if name in known.states}
        states = {name: bias_sd for name, (_, bias_sd) in biases.items()}
        navs = navs._replace(errors={n: jnp.tile(jnp.asarray(b), (len(angles), 1)) for n, (b, _) in biases.items()})
        # a tilt in ENU axes turns with the heading: where that is not the alignment's, its correlations are left out
        if not at.unknown and at.heading_source is None:
            attitude_sd = np.maximum(found.sd[:3], MIN_TILT_SD)
            correlated = correlation_root(_covariance(found, aligned_velocity))
    prior = Prior(
        jnp.asarray(sd[0] if position_sd_m is None else position_sd_m, float),
        jnp.asarray(sd[1] if velocity_sd_mps is None else velocity_sd_mps, float),
        jnp.asarray(attitude_sd, float),
        jnp.asarray(correlated),
    )
    about = f"{hypotheses} hypotheses" if at.unknown else f"sd {at.sd[1] / DEG:.2g} deg"
    said = [finding("start", value=t, words=f"{at.words} ({about})"), *_remarks(at)]
    field = field_of(known, lla) if "magnetometer" in rec.aiding else None
    if field is not None and field.about is not None:
        said.append(field.about)
    return Initialization(navs, prior, t, tuple(said), states, at.alignment, field, from_t)


WINDOWS_S = (10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0)  # s of the windows that are tried one after the other
MAX_CONTRADICTION = 5.0  # sd, of a heading by two antennas from that of the motion
KNOWN_HEADING_SD = 10 * DEG  # sd of a heading that is known
MAX_CHI2_PER_DOF = 8.0  # chi^2 per degree of freedom from which on fixes and IMU do not belong together


def _align_in_motion(rec: Recording, known: Params, velocity: Samples, begin: float, hypotheses: int) -> Attitude:
    """By alignment over windows that grow until heading is known; else its tilt and an unknown heading."""
    position = rec.aiding["position"]
    begin = max(begin, float(position.t[0]) - 1.0)
    half = 0.5 * (min(float(position.t[-1]), float(rec.imu.t[-1])) - begin)
    ends = [begin + min(length, half) for length in WINDOWS_S if length <= half or length == WINDOWS_S[0]]
    first: Alignment | None = None
    last: Alignment | None = None
    for end in ends:
        t = float(position.t[min(int(np.searchsorted(position.t, end - TICK)), position.t.size - 2)])
        found = aligned(rec, known, begin, t)
        first, last = first or found, found or last
        if found is not None and found.sd[2] <= KNOWN_HEADING_SD:
            break
    if first is None or last is None:
        rp, by, sd = _levelled(rec, known, velocity, begin, begin, 10 * DEG)
        if (source := heading_by_sensor(rec, known, rp, sd, begin)) is not None:
            words = f"level by {by} (sd {sd / DEG:.2g} deg), heading {source.words}"
            return Attitude(begin, (*rp, source.heading), (sd, source.sd), words, heading_source=source)
        sds = (sd, 2 * np.pi / hypotheses)
        return Attitude(begin, (*rp, 0.0), sds, f"level by {by} (sd {sd / DEG:.2g} deg), heading unknown", True)
    unknown = last.sd[2] > MAX_HEADING_SD
    best = first if unknown else last
    rph = np.asarray(_rph(best.C))
    tilt = float(max(best.sd[:2].max(), MIN_TILT_SD))
    words = (
        f"aligned over {best.t - begin:.0f} s by {best.fixes} fixes: roll {rph[0] / DEG:.1f}, pitch {rph[1] / DEG:.1f} "
        f"deg (sd {tilt / DEG:.2g} deg), heading "
    )
    source = heading_by_sensor(rec, known, (float(rph[0]), float(rph[1])), tilt, best.t)
    off = 0.0 if source is None or unknown else abs(math.remainder(source.heading - float(rph[2]), 2 * math.pi))
    contradicted = source is not None and off > MAX_CONTRADICTION * math.hypot(source.sd, float(best.sd[2]))
    if source is not None and (unknown or (not source.magnetic and source.sd < best.sd[2] and not contradicted)):
        words, rph = f"{words}{source.words}", np.array([rph[0], rph[1], source.heading])
        return Attitude(best.t, tuple(rph), (tilt, source.sd), words, False, best, source)
    if unknown:
        words += "not shown by the motion"
        return Attitude(best.t, tuple(rph), (tilt, 2 * np.pi / hypotheses), words, True, best)
    words += f"{rph[2] / DEG % 360:.1f} deg"
    if source is not None and not source.magnetic and contradicted:
        words += f" by the motion, which {source.words} contradict"
    return Attitude(best.t, tuple(rph), (tilt, float(best.sd[2])), words, False, best)


def aligned(rec: Recording, params: Params, begin: float, end: float) -> Alignment | None:
    """Align over (begin, end] s by the velocities, by the positions where those fit badly.

    ``params``: a filter's; its delays are taken out of the fixes' times first, its biases' priors are the alignment's.
    None where there are too few fixes.
    """
    grade = datasheet_states(GRADES["consumer"], BIASES) | params.states
    prior = AlignmentPrior(
        np.asarray(grade["gyro_bias"].sd), np.asarray(grade["accel_bias"].sd), scale=float(params.noise.scale)
    )
    lla = rec.aiding["position"].value[0]
    best: Alignment | None = None
    for name in ("velocity", "position"):
        if name not in rec.aiding:
            continue
        fixes = rec.aiding[name]
        offset = _clock_offset(rec, params, 0.5 * (begin + end))
        fixes = fixes._replace(t=fixes.t - offset - latency_of(params, name))
        found = align(rec.imu, fixes, name == "position", lla, begin, end, prior, np.asarray(params.mounting.lever_arm))
        if found is not None and (best is None or (found.chi2 < best.chi2 and found.sd[2] < 2 * best.sd[2])):
            best = found
        if best is not None and best.chi2 < MAX_CHI2_PER_DOF:
            break
    return best


def _remarks(at: Attitude) -> list[Finding]:
    """Return findings on an alignment."""
    said: list[Finding] = []
    found = at.alignment
    if found is None:
        return said
    if found.is_late:
        side = "late" if found.delay > 0 else "early"
        said.append(finding("start.late", value=abs(found.delay), side=side, sd=float(found.sd[9])))
    if abs(at.rph[0]) > 90 * DEG:
        said.append(finding("start.upside_down", value=abs(at.rph[0]) / DEG))
    if found.chi2 > MAX_CHI2_PER_DOF:
        said.append(finding("start.misfit", value=float(found.chi2), limit=MAX_CHI2_PER_DOF))
    return said


def _covariance(found: Alignment, aligned_velocity: bool) -> np.ndarray:
    """Return that of velocity, attitude and biases (12, 12), SI, ENU; a fix's velocity is independent of the rest."""
    P = found.joint[:12, :12]
    P[:3, :3] += MIN_VELOCITY_SD**2 * np.eye(3)
    if not aligned_velocity:
        P[:3, 3:], P[3:, :3] = 0.0, 0.0
    return P


def correlation_root(P: np.ndarray) -> np.ndarray:
    """Lower root of the correlations of a covariance (n, n): its rows have length one."""
    sd = np.sqrt(np.diag(P))
    n = len(sd)
    C = P / np.outer(sd, sd)
    root = np.linalg.cholesky((1 - 1e-9) * 0.5 * (C + C.T) + 1e-9 * np.eye(n))
    return root / np.linalg.norm(root, axis=1, keepdims=True)


def _attitude_from_setting(
    rec: Recording, known: Params, velocity: Samples, begin: float, heading: float | str, least_speed: float,
    sds: tuple[float, float],
) -> Attitude:  # fmt: skip
    """Return level by standstill or motion, heading by course, degrees or unknown."""
    at, angle, why = begin, 0.0, "unknown"
    if heading == "course":
        at, angle = course(velocity, least_speed, begin)
        why = f"by course over ground at t = {at:.3f} s"
    elif not isinstance(heading, str):
        angle, why = heading * DEG, f"{heading:g} deg as said"
    (roll, pitch), by, tilt = _levelled(rec, known, velocity, begin, at, sds[0])
    words = f"level by {by} (sd {tilt / DEG:.2g} deg), heading {why}"
    return Attitude(at, (roll, pitch, angle), (tilt, sds[1]), words, heading == "unknown")


def recorded_timing(rec: Recording) -> Params:
    """Parameters of a filter that knows a recording's lever arm and of no delays."""
    return datasheet_params(GRADES["consumer"], install=mounting(rec.lever_arm))


def halfway(rec: Recording) -> float:
    """Stamp, s, that drift of the clock is counted from, wherever a run starts: its offset there is the mean one."""
    return 0.5 * float(rec.imu.t[0] + rec.imu.t[-1])


def _clock_offset(rec: Recording, known: Params, t: float) -> float:
    """Return the known part of GNSS time minus the IMU's stamp ``t``, s."""
    return float(known.mounting.time_offset) + float(known.mounting.clock_drift) * (t - halfway(rec))


def latency_of(params: Params, name: str) -> float:
    """Return the latency, s, of a measurement; 0 where the filter has none of that name."""
    return float(getattr(params.measurements.get(name), "latency", 0.0))


def timed(params: Params) -> bool:
    """Return whether parameters state a latency or estimate one."""
    ages = [params.mounting.time_offset, *(t.latency for t in params.measurements.values() if hasattr(t, "latency"))]
    return any(float(age) != 0 for age in ages) or "clock_offset" in params.states


def ground_velocity(rec: Recording) -> Samples:
    """Return the stream of velocities, or differences of the positions where there is none."""
    return rec.aiding.get("velocity") or _differences(rec.aiding["position"])


def _differences(position: Samples) -> Samples:
    """Return the mean velocity over the last `CHORD_S` s of positions: over shorter times noise looks like motion."""
    n = max(1, min(round(CHORD_S / float(np.median(np.diff(position.t)))), position.t.size - 1))
    dt = (position.t[n:] - position.t[:-n])[:, None]
    value = earth.enu_path(position.value[n:], position.value[:-n]) / dt
    return Samples(position.t[n:], value, 1.5 * position.sd[n:] / dt, np.zeros_like(value))


def _levelled(
    rec: Recording, known: Params, velocity: Samples, begin: float, at: float, sd: float
) -> tuple[tuple[float, float], str, float]:
    """Return roll and pitch (rad), source, and sd: from a standstill at ``begin``, else by motion at ``at``.

    Where there is not enough of that either, flat.

    Raises:
        DataError: nothing to level by, and specific force that points down: z is up.
    """
    after = velocity.t >= begin
    moving = after & (np.hypot(velocity.value[:, 0], velocity.value[:, 1]) > 0.5)
    until = velocity.t[np.argmax(moving)] if moving.any() else velocity.t[-1]
    until = min(until - 0.5, begin + 30.0)
    if until - begin >= 2.0:
        return coarse_leveling(rec.imu, begin, until), f"standing from {begin:.1f} to {until:.1f} s", sd
    found = aligned(rec, known, max(begin, at - WINDOWS_S[0]), at) if at - begin >= 0.5 * WINDOWS_S[0] else None
    if found is not None:
        roll, pitch, _ = np.asarray(_rph(found.C)).tolist()
        return (roll, pitch), "motion", max(float(found.sd[:2].max()), MIN_TILT_SD)
    down = float(rec.imu.accel[(rec.imu.t > begin) & (rec.imu.t <= begin + 30.0), 2].mean())
    if down > 0:
        raise DataError(f"imu: z of specific force is {down:+.1f} m/s^2 on average: body axes are forward, right, down")
    return (0.0, 0.0), "assumed level: no standstill found", sd


def _interpolated(rec: Recording, t: float) -> np.ndarray:
    truth = rec.truth
    assert truth is not None
    return np.array([np.interp(t, truth.t, np.unwrap(c)) for c in truth.rph.T])


def _true_attitude(
    rec: Recording, known: Params, position: Samples, begin: float, sds: tuple[float, float]
) -> Attitude:
    """Return the truth's attitude at the first fix from ``begin`` on."""
    sure = np.isfinite(rec.truth.rph).all(1) if rec.truth is not None else np.zeros(0, bool)
    if rec.truth is None or not sure.all():
        raise DataError(f'{rec.name}: has no true attitude, which initialization.heading = "truth" asks for')
    i = int(np.searchsorted(position.t, max(begin, rec.truth.t[0]) - TICK))
    t = float(position.t[min(i, position.t.size - 1)])
    roll, pitch, heading = _interpolated(rec, t + _clock_offset(rec, known, t))
    return Attitude(t, (roll, pitch, heading), sds, "level and heading by the truth")


def first_fix(
    rec: Recording, known: Params, position: Samples, velocity: Samples, begin: float
) -> tuple[float, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Time, position, velocity and their sd at the first fix from ``begin`` on; moved on by the position's latency."""
    i = int(np.searchsorted(position.t, begin - TICK))
    if i >= position.t.size - 1:
        raise DataError(f"position: no fix after {begin:.3f} s to start from")
    t = float(position.t[i])
    j = int(np.argmin(np.abs(velocity.t - t)))
    late = _clock_offset(rec, known, t) + latency_of(known, "position")
    lla = _moved(position.value[i], late * velocity.value[j])
    return t, np.asarray(lla), velocity.value[j], (np.hypot(position.sd[i], 0.5), np.hypot(velocity.sd[j], 0.3))
