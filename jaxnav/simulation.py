"""A truth, its IMU and GNSS with errors, and a start for a filter, from a scenario and a key; vmap over keys.

Each purpose has its own key folded in: another GNSS noise, IMU or start does not change the drive.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav import earth, rotations, units
from jaxnav.run import require_x64, track
from jaxnav.scenarios import Scenario
from jaxnav.sensors import gnss, imu
from jaxnav.sensors.grades import GRADES, datasheet_params, mounting
from jaxnav.trajectories import travel, urban
from jaxnav.types import Epoch, Imu, ImuLog, Nav, Origin, Params, Recording, Samples, Track

DRIVE, SENSOR, RECEIVER, OUTAGES, START = range(5)  # the purposes that are folded into the key


class Simulated(NamedTuple):
    """One run, or many with a leading axis; E epochs of k samples, fixes for `jaxnav.measurements.GNSS`."""

    epochs: Epoch  # (E, k, ...) and (E, 6); in an outage not valid, but with the values of a working receiver
    truth: Nav  # (E, ...) at the end of each epoch; biases are what the IMU's really were
    start: Nav  # () the truth at t = 0
    initial: Nav  # () the start for a filter: ``start`` with errors of the prior's size, biases zero
    hidden: jax.Array  # (E,) bool, in an outage
    outages: jax.Array  # (W, 2) s, start < t <= end


def sizes(scenario: Scenario) -> tuple[int, int]:
    """Epochs of a run, and IMU samples of an epoch.

    Raises:
        ValueError: rates or duration that do not divide, or an unknown grade.
    """
    k = scenario.imu_rate_hz / scenario.gnss_rate_hz
    E = scenario.duration_s * scenario.gnss_rate_hz
    if abs(k - round(k)) > 1e-9 or round(k) < 1:
        raise ValueError(f"imu_rate_hz must be a multiple of gnss_rate_hz, got {scenario.imu_rate_hz:g} and "
                         f"{scenario.gnss_rate_hz:g}")  # fmt: skip
    if abs(E - round(E)) > 1e-9 or round(E) < 1:
        raise ValueError(f"duration_s must hold whole epochs of {1 / scenario.gnss_rate_hz:g} s, "
                         f"got {scenario.duration_s:g}")  # fmt: skip
    if scenario.grade not in GRADES:
        raise ValueError(f"no IMU grade {scenario.grade!r}; known are {', '.join(GRADES)}")
    return round(E), round(k)


def perturb(key: jax.Array, nav: Nav, scenario: Scenario) -> Nav:
    """A start with errors drawn from the scenario's prior; its biases are zero, their errors the true biases."""
    e_pos, e_vel, e_att = jax.random.normal(key, (3, 3), float)
    tilt, heading = scenario.prior_tilt_sd_deg, scenario.prior_heading_sd_deg
    phi = units.DEG * np.array([tilt, tilt, heading]) * e_att
    zero = jnp.zeros(3)
    return nav._replace(
        pos=earth.move(nav.pos, np.array(scenario.prior_position_sd_m) * e_pos),
        vel=nav.vel + np.array(scenario.prior_velocity_sd_mps) * e_vel,
        q=rotations.multiply(rotations.exp(phi), nav.q),
        b_g=zero,
        b_a=zero,
    )


def simulate(scenario: Scenario, key: jax.Array) -> Simulated:
    """One run from a key; pure, to be jitted (scenario static) and vmapped over keys.

    Raises:
        ValueError: a scenario that does not fit together (at trace time).
        DataError: float32.
    """
    E, k = sizes(scenario)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, np.arange(5))
    dt = 1 / scenario.imu_rate_hz
    lat, lon, h = scenario.start_deg_m
    lla = jnp.asarray([lat * units.DEG, lon * units.DEG, h], float)
    require_x64(lla)

    shape = urban(keys[DRIVE], scenario.duration_s, scenario.standstill_s, scenario.speed_max_mps)
    way = travel(shape, lla, dt, k, E)
    perfect, omega, force = imu.ideal(way)
    scales = scenario.gyro_scale_sd_ppm * units.PPM, scenario.accel_scale_sd_ppm * units.PPM
    samples, b_g, b_a = imu.corrupt(keys[SENSOR], perfect, dt, GRADES[scenario.grade], *scales)
    last = np.maximum(np.arange(E + 1) * k - 1, 0)  # the sample that ends at each of these times
    q = jax.vmap(lambda rph: rotations.from_dcm(rotations.from_rph(rph)))(way.ends.rph)
    origin = jax.tree.map(lambda a: jnp.broadcast_to(a, (E + 1, *a.shape)), Origin(lla, jnp.zeros(()), jnp.zeros(())))
    navs = Nav(way.ends.t, way.ends.lla, way.ends.vel, q, b_g[last], b_a[last], omega, force, origin)
    start, truth = (jax.tree.map(lambda a, s=s: a[s], navs) for s in (0, slice(1, None)))

    outages = jnp.asarray(scenario.outages_s, float).reshape(-1, 2)
    if scenario.random_outages:
        span = (scenario.standstill_s, scenario.duration_s)
        more = gnss.random_outages(keys[OUTAGES], scenario.random_outages, *span, scenario.random_outage_s)
        outages = jnp.concatenate([outages, more])
    hidden = gnss.inside(truth.t, outages)
    arm, *sd = (jnp.asarray(a, float) for a in (scenario.lever_arm_m, scenario.position_sd_m, scenario.velocity_sd_mps))
    fix = gnss.fixes(keys[RECEIVER], truth, arm, sd[0], sd[1], hidden)
    epochs = Epoch(Imu(*(a.reshape(E, k, *a.shape[1:]) for a in samples)), fix)
    return Simulated(epochs, truth, start, perturb(keys[START], start, scenario), hidden, outages)


simulate_jit = jax.jit(simulate, static_argnums=0)
"""`simulate`, compiled once for a scenario."""


def matched_params(scenario: Scenario, rule=(), feedback=()) -> Params:
    """The parameters that know what was simulated: the grade's datasheet, the scenario's prior and lever arm."""
    return datasheet_params(
        GRADES[scenario.grade],
        scenario.prior_position_sd_m,
        scenario.prior_velocity_sd_mps,
        scenario.prior_tilt_sd_deg * units.DEG,
        scenario.prior_heading_sd_deg * units.DEG,
        mounting(scenario.lever_arm_m),
        rule,
        feedback,
    )


def to_recording(sim: Simulated, scenario: Scenario, t0: float = 0.0) -> Recording:
    """One run as streams on the host, like a recorded one; its start is at ``t0`` s, fixes in outages are left out."""
    host = jax.tree.map(np.asarray, sim)
    flat = [a.reshape(-1, *a.shape[2:]) for a in host.epochs.imu]
    log = ImuLog(t0 + np.arange(1, flat[0].size + 1) / scenario.imu_rate_hz, *flat)
    fix, t = host.epochs.fix, t0 + host.truth.t
    aiding = {}
    for name, s in (("position", slice(0, 3)), ("velocity", slice(3, 6))):
        seen = fix.valid[:, s].all(1)
        aiding[name] = Samples(t[seen], fix.value[seen, s], fix.sd[seen, s], fix.corr[seen, s])
    navs = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), sim.start, sim.truth)
    truth = track(navs)
    truth = Track(t0 + truth.t, *truth[1:])
    return Recording(scenario.name, log, aiding, truth, np.array(scenario.lever_arm_m, float), "simulated")
