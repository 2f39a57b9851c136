"""A truth, its IMU and GNSS with errors, and a start for a filter, from a scenario and a key; vmap over keys.

Each purpose has a key folded in: another GNSS noise, IMU or start does not change the drive.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.compiler import require_memory
from jaxnav.filters.parameters import datasheet_params, late, mounting
from jaxnav.filters.run import require_x64, track
from jaxnav.initialization import initialize as alignment
from jaxnav.maths import earth, rotations, units
from jaxnav.measurements import GNSS, MEASUREMENTS, layout
from jaxnav.simulate import gnss, imu
from jaxnav.simulate.processes import normal
from jaxnav.simulate.scenarios import PATTERN, InitialErrors, Scenario
from jaxnav.simulate.trajectories import Point, Shape, shape_of, travel
from jaxnav.states.grades import GRADES
from jaxnav.states.receiver_clock import SLOTS
from jaxnav.types import (
    ConfigError,
    DataError,
    Epoch,
    Fix,
    Imu,
    ImuLog,
    Nav,
    Origin,
    Params,
    Recording,
    Samples,
    Track,
    Tree,
)

DRIVE, SENSOR, RECEIVER, OUTAGES, START = range(5)  # the purposes that are folded into the key


class Simulated(NamedTuple):
    """One run, or many with a leading axis; E epochs of k samples, fixes for `jaxnav.measurements.GNSS`."""

    epochs: Epoch  # (E, k, ...) and (E, 6); in an outage not valid, but with the antenna's values free of error
    truth: Nav  # (E, ...) at the end of each epoch; errors are the IMU's true ones
    start: Nav  # () the truth where the run starts: t = 0, or the end of the alignment
    initial: Nav  # () the start for a filter
    hidden: jax.Array  # (E,) bool, in an outage
    outages: jax.Array  # (W, 2) s, start < t <= end


def sizes(scenario: Scenario) -> tuple[int, int]:
    """Epochs of a run, without those of the alignment, and IMU samples of an epoch.

    Raises:
        ValueError: rates or times that do not divide, an unknown grade, or an sd of zero.
    """
    rate, grade, aligned = scenario.gnss_rate_hz, scenario.imu.grade, scenario.start.alignment_s
    for name in ("imu_rate_hz", "gnss_rate_hz", "duration_s"):
        if not 0 < (value := getattr(scenario, name)) < np.inf:
            raise ValueError(f"{name} must be positive and finite, got {value:g}")
    k, E, before = scenario.imu_rate_hz / rate, scenario.duration_s * rate, aligned * rate
    if abs(k - round(k)) > 1e-9 or round(k) < 1:
        raise ValueError(f"imu_rate_hz must be a multiple of gnss_rate_hz, got {scenario.imu_rate_hz:g} and {rate:g}")
    if abs(E - round(E)) > 1e-9 or round(E) < 1:
        raise ValueError(f"duration_s must hold whole epochs of {1 / rate:g} s, got {scenario.duration_s:g}")
    if abs(before - round(before)) > 1e-9 or not 0 <= round(before) < round(E):
        raise ValueError(f"alignment_s must be whole epochs of {1 / rate:g} s and less than the run, got {aligned:g}")
    if scenario.start.calibrate_gyro and not aligned:
        raise ValueError("calibrate_gyro needs an alignment_s")
    if grade not in GRADES:
        raise ValueError(f"no IMU grade {grade!r}; known are {', '.join(GRADES)}")
    for name in ("position_sd_m", "velocity_sd_mps"):
        if not min(getattr(scenario.gnss, name)) > 0:
            raise ValueError(f"{name} must be positive, got {getattr(scenario.gnss, name)}: see gnss_noise_factor")
    return round(E) - round(before), round(k)


def perturb(key: jax.Array, nav: Nav, start: InitialErrors) -> Nav:
    """Return a start with errors drawn from its prior, or by the pattern, and sensor errors of zero."""
    draw_state = normal(key, (3, 3))
    e_pos, e_vel, e_att = jnp.tile(jnp.asarray(PATTERN, float), (3, 1)) if start.fixed_errors else draw_state
    tilt, heading = start.prior_tilt_sd_deg, start.prior_heading_sd_deg
    phi = units.DEG * jnp.asarray([tilt, tilt, heading], float) * e_att
    return nav._replace(
        pos=earth.move(nav.pos, np.array(start.prior_position_sd_m) * e_pos),
        vel=nav.vel + np.array(start.prior_velocity_sd_mps) * e_vel,
        q=rotations.multiply(rotations.exp(phi), nav.q),
        errors={},
    )


def _align(nav: Nav, still: Imu, start: InitialErrors) -> Nav:
    """Replace roll, pitch and, on request, the gyro bias of a perturbed start by those of samples (n, ...) at rest."""
    heading = rotations.to_rph(rotations.to_dcm(nav.q))[2]
    C = rotations.from_rph(jnp.stack([*alignment.levelled(still.accel.mean(0)), heading]))
    bias = still.gyro.mean(0) - C.T @ earth.earth_rate(nav.pos[0])
    return nav._replace(q=rotations.from_dcm(C), errors={"gyro_bias": bias} if start.calibrate_gyro else {})


def _nav(seen: tuple[Point, tuple[jax.Array, jax.Array]], errors: dict[str, jax.Array], origin: Origin) -> Nav:
    """Return the truth (...,) of points and the IMU's readings there."""
    point, (omega, force) = seen
    q = rotations.from_dcm(rotations.from_rph(point.rph))
    return Nav(point.t, point.lla, point.vel, q, omega, force, origin, errors)


def _observe(keys: jax.Array, scenario: Scenario, seen: Nav, t: jax.Array) -> tuple[Fix, jax.Array, jax.Array]:
    """Return fixes (n, 6) at t (n,) s of the truth ``seen`` (n, ...), their hidden mask (n,), and outages (W, 2)."""
    standstill = max(scenario.start.alignment_s, getattr(scenario.motion, "standstill_s", 0.0))
    outages = gnss.outages(keys[OUTAGES], scenario.gnss, standstill, scenario.duration_s)
    hidden = gnss.inside(t, outages)
    interval = 1 / scenario.gnss_rate_hz
    fix = gnss.fixes(keys[RECEIVER], seen, t, interval, hidden, scenario.gnss, scenario.faults)
    return fix, hidden, outages


def simulate(key: jax.Array, scenario: Scenario) -> Simulated:
    """One run from a key; pure, to be jitted (scenario static) and vmapped over keys.

    Raises:
        ValueError: a scenario that does not fit together (at trace time).
        DataError: float32.
    """
    shape = shape_of(jax.random.fold_in(key, DRIVE), scenario.motion, scenario.duration_s)
    return simulate_shape(key, scenario, shape)


def simulate_shape(key: jax.Array, scenario: Scenario, shape: Shape) -> Simulated:
    """`simulate` on any shape instead of the scenario's motion, such as that of a recorded track.

    Raises:
        ValueError, DataError: as `simulate`.
    """
    E, k = sizes(scenario)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, np.arange(5))
    dt = 1 / scenario.imu_rate_hz
    before = round(scenario.start.alignment_s * scenario.gnss_rate_hz)  # epochs of the alignment
    lat, lon, h = scenario.start_deg_m
    lla = jnp.asarray([lat * units.DEG, lon * units.DEG, h], float)
    require_x64(lla)

    way = travel(shape, lla, dt, k, before + E, imu.sense, scenario.gnss.latency_s)
    flat = [a.reshape(-1, 3) for a in way.means]
    samples, errors = imu.corrupt(
        keys[SENSOR], Imu(jnp.full(flat[0].shape[0], dt, float), *flat), dt, GRADES[scenario.imu.grade], scenario.imu
    )
    zero, ends = jnp.zeros(()), slice(k - 1, None, k)
    at = lambda i: jax.tree.map(lambda a: a[i], errors)
    first = _nav(way.start, at(0), Origin(lla, zero, zero))
    truth, seen = (jax.vmap(_nav, (0, 0, None))(points, at(ends), first.origin) for points in (way.ends, way.late))

    start = jax.tree.map(lambda a: a[before - 1], truth) if before else first
    start = start._replace(origin=Origin(start.pos, zero, start.t))
    initial = perturb(keys[START], start, scenario.start)
    if before:  # by the samples up to there
        initial = _align(initial, jax.tree.map(lambda a: a[: before * k], samples), scenario.start)

    fix, hidden, outages = _observe(keys, scenario, seen, truth.t)
    epochs = Epoch(Imu(*(a.reshape(before + E, k, *a.shape[1:]) for a in samples)), fix)
    epochs, truth, hidden = jax.tree.map(lambda a: a[before:], (epochs, truth, hidden))
    origin = jax.tree.map(lambda a: jnp.broadcast_to(a, (E, *a.shape)), start.origin)
    return Simulated(epochs, truth._replace(origin=origin), start, initial, hidden, outages)


simulate_jit = jax.jit(simulate, static_argnums=1)
"""`simulate`, compiled once for a scenario."""


def matched_params(scenario: Scenario, rule: Tree = (), feedback: Tree = ()) -> Params:
    """Return the parameters of the simulation: the grade's datasheet, and the scenario's prior and installation.

    Of the errors beyond a grade's datasheet they know nothing, nor of faults and correlated noise.

    Args:
        scenario: the simulated case.
        rule: parameters of the rule.
        feedback: parameters of the feedback.
    """
    grade, start, receiver = GRADES[scenario.imu.grade], scenario.start, scenario.gnss
    params = datasheet_params(
        grade._replace(scale=0.0),
        start.prior_position_sd_m,
        start.prior_velocity_sd_mps,
        start.prior_tilt_sd_deg * units.DEG,
        start.prior_heading_sd_deg * units.DEG,
        mounting(receiver.lever_arm_m),
        rule,
        feedback,
    )
    params = late(params, receiver.latency_s, receiver.latency_s)
    if not start.calibrate_gyro:
        return params
    left = np.hypot(grade.arw / np.sqrt(start.alignment_s), grade.gyro_instability)
    known = params.states["gyro_bias"]._replace(sd=jnp.asarray(left, float))
    return params._replace(states=params.states | {"gyro_bias": known})


def _satellites(fix: Fix, t: np.ndarray) -> dict[str, Samples]:
    """Return the streams of the satellites, whose channels are the last ones."""
    found, first = {}, fix.value.shape[1] - 2 * SLOTS
    for i, name in enumerate(("pseudorange", "range_rate")):
        place = slice(first + i * SLOTS, first + (i + 1) * SLOTS)
        some = np.asarray(fix.valid[:, place].any(1))
        value, sd, corr, there = (np.asarray(a[some, place]) for a in (fix.value, fix.sd, fix.corr, fix.valid))
        found[name] = Samples(t[some], np.where(there, value, 0.0), sd, corr, there, fix.auxiliary[name][some])
    return found


SAMPLE, EPOCH = 300.0, 1000.0  # bytes of a simulated IMU sample and of an epoch, with intermediate results


def simulate_runs(keys: jax.Array, scenario: Scenario) -> Simulated:
    """Return runs of the scenario.

    Args:
        keys: (B,) of the runs, such as of `run_keys`.
        scenario: the simulated case.

    Raises:
        ConfigError: a scenario that does not fit together. DataError: more memory than there is.
    """
    try:
        epochs, samples = sizes(scenario)
        hours = f"{len(keys)} runs of {scenario.duration_s:g} s at {scenario.imu_rate_hz:g} Hz"
        require_memory(len(keys) * epochs * (samples * SAMPLE + EPOCH), hours)
        return _runs_jit(keys, scenario)
    except DataError:
        raise
    except ValueError as error:
        raise ConfigError(f"data.options: {error}") from error


@partial(jax.jit, static_argnums=1)
def _runs_jit(keys: jax.Array, scenario: Scenario) -> Simulated:
    return jax.vmap(partial(simulate, scenario=scenario))(keys)


def to_recording(sim: Simulated, scenario: Scenario, t0: float = 0.0) -> Recording:
    """One run as streams on the host, like a recorded one, ``t0`` s later; fixes in outages are left out.

    Args:
        sim: one run.
        scenario: its scenario.
        t0: s, time of its start.
    """
    host = jax.tree.map(np.asarray, sim)
    flat = [a.reshape(-1, *a.shape[2:]) for a in host.epochs.imu]
    log = ImuLog(t0 + host.start.t + np.arange(1, flat[0].size + 1) / scenario.imu_rate_hz, *flat)
    fix, t = host.epochs.fix, t0 + host.truth.t
    aiding = {}
    sensors = (*GNSS, *(MEASUREMENTS[name] for name, _ in scenario.sensors))
    for name, s in layout(m for m in sensors if m.columns or m.receiver).items():
        seen = fix.valid[:, s].all(1)
        aiding[name] = Samples(t[seen], fix.value[seen, s], fix.sd[seen, s], fix.corr[seen, s])
    if "pseudorange" in fix.auxiliary:
        aiding |= _satellites(fix, t)
    navs = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b]), *(n._replace(errors={}) for n in (sim.start, sim.truth))
    )
    truth = track(navs)
    truth = Track(t0 + truth.t, *truth[1:])
    arm = np.array(scenario.gnss.lever_arm_m, float)
    return Recording(scenario.name, log, aiding, truth, arm, "simulated", (t, host.truth.errors))
