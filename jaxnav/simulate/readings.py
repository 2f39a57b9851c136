"""Readings of other sensors, and errors that are states, added to a simulated run: by the models that filter it.

A measurement's residual is expected minus measured, so that the value expected of the truth is its
residual against zero. Errors of a state are drawn from its prior, `Params.states`.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxnav.filters.parameters import datasheet_states
from jaxnav.maths import earth, rotations
from jaxnav.measurements import GNSS, MEASUREMENTS, Measurement
from jaxnav.measurements.measurement import Kinematics
from jaxnav.simulate.processes import gauss_markov, normal
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import Simulated, matched_params
from jaxnav.states.grades import GRADES
from jaxnav.states.sensors import OTHER
from jaxnav.states.state import Reading, State
from jaxnav.states.table import chosen
from jaxnav.types import Fix, Nav, Params, StateParams

WALKING = 1.5  # m/s


def expected(
    measurement: Measurement, params: Params, truth: Nav, valid: jax.Array | None = None, auxiliary: Any = None
) -> jax.Array:
    """Return residuals (E, s) against zero at the true epochs (E, ...): an ideal reading, of a position m ENU.

    ``valid`` (E, s) bool and ``auxiliary`` (E, s, a): of a measurement that has auxiliary values.
    """
    zero = jnp.zeros(measurement.size)
    theta = params.measurements[measurement.name]

    def one(nav: Nav, valid: jax.Array | None, auxiliary: Any) -> jax.Array:
        kin = Kinematics(nav.pos, nav.vel, rotations.to_dcm(nav.q))
        blind = Fix(zero, zero + 1.0, zero, zero > -1 if valid is None else valid, auxiliary)
        at_it = blind._replace(value=nav.pos) if measurement.name == "position" else blind
        return measurement.observe(theta, params.mounting, nav, kin, at_it).y

    return jax.vmap(one)(truth, valid, auxiliary)


def with_equipment(key: jax.Array, sim: Simulated, scenario: Scenario) -> Simulated:
    """Return the run with the further states and sensors of the scenario, by the defaults of their rows.

    There is no course below `WALKING` m/s.
    """
    params = matched_params(scenario)
    further = [name for name in scenario.sensor_states if name not in params.states]
    params = params._replace(states=params.states | datasheet_states(GRADES[scenario.imu.grade], further))
    sim = with_states(jax.random.fold_in(key, 0), sim, params, scenario.sensor_states)
    for i, (name, sd) in enumerate(scenario.sensors, 1):
        least = WALKING if name == "course" else 0.0
        sim = with_sensor(jax.random.fold_in(key, i), sim, params, name, sd, least)
    return sim


def with_sensor(
    key: jax.Array, sim: Simulated, params: Params, name: str, sd: float, least_speed: float = 0.0
) -> Simulated:
    """Return the run with a further measurement behind the channels that are there, its noise ``sd``.

    At every epoch, or at those that are faster than ``least_speed`` m/s: a course means nothing at rest.
    """
    measurement, f = MEASUREMENTS[name], sim.epochs.fix
    exact = expected(measurement, params, sim.truth)
    value = exact + sd * normal(key, exact.shape) if measurement.columns else jnp.zeros_like(exact)
    there = jnp.linalg.norm(sim.truth.vel[:, :2], axis=1, keepdims=True) >= least_speed
    more = Fix(value, jnp.full_like(value, sd), jnp.zeros_like(value), jnp.broadcast_to(there, value.shape))
    fix = jax.tree.map(lambda a, b: jnp.concatenate([a, b], 1), f._replace(auxiliary={}), more)
    fix = fix._replace(auxiliary=f.auxiliary)
    return sim._replace(epochs=sim.epochs._replace(fix=fix))


def with_states(key: jax.Array, sim: Simulated, params: Params, names: Sequence[str]) -> Simulated:
    """Return the run with the errors that these states are, in the truth, the IMU's samples and the receiver's fixes.

    Other sensors have them when they are put on top by `with_sensor`, after this.
    """
    errors = {
        state.name: draw_state(jax.random.fold_in(key, i), state, params.states[state.name], sim)
        for i, state in enumerate(chosen(names))
    }
    if "vehicle_axes" in errors:
        sim = with_axes_error(sim, params, errors["vehicle_axes"][0])
    truth = sim.truth._replace(errors=sim.truth.errors | errors)
    imu = sim.epochs.imu
    readings = {"gyro": imu.gyro, "accel": imu.accel}
    auxiliary = {name: value[:, None] for name, value in sim.epochs.auxiliary.items()}
    for state in chosen(names):
        if state.enters is None:
            continue
        w, other, s = readings[state.enters], readings[OTHER[state.enters]], errors[state.name][:, None, :, None]
        M = jnp.eye(3) if state.effect is None else state.effect(Reading(w, other, auxiliary))
        readings[state.enters] = w + (M @ s)[..., 0]
    value = sim.epochs.fix.value
    late = errors.get("clock_offset", jnp.zeros((truth.t.size, 1)))
    force = jax.vmap(lambda nav: rotations.to_dcm(nav.q) @ nav.force)(truth)
    accel = force - jnp.array([0.0, 0.0, 1.0]) * jax.vmap(lambda p: earth.gravity(p[0], p[2]))(truth.pos)[:, None]
    by_position, by_velocity = (expected(m, params, truth) - expected(m, params, sim.truth) for m in GNSS)
    moved = by_position - late * truth.vel + 0.5 * late**2 * accel
    value = value.at[:, :3].set(jax.vmap(earth.move)(value[:, :3], moved))
    value = value.at[:, 3:6].add(by_velocity - late * accel)
    epochs = sim.epochs._replace(imu=imu._replace(**readings), fix=sim.epochs.fix._replace(value=value))
    return sim._replace(epochs=epochs, truth=truth)


def with_axes_error(sim: Simulated, params: Params, angles: jax.Array) -> Simulated:
    """Return the run with its IMU turned in the vehicle by pitch and yaw (2,) rad in addition to `Mounting.vehicle`.

    The lever arm stays constant in the IMU's axes, so that the antenna moves.
    """
    axes = lambda v: rotations.to_dcm(rotations.exp(jnp.concatenate([jnp.zeros(1), v])))
    before, after = axes(params.mounting.vehicle), axes(params.mounting.vehicle + angles)
    turn = before @ after.T  # from the new axes to the old: a vector along the vehicle stays along it
    bend = lambda v: v @ turn
    q = rotations.from_dcm(turn)

    def turned(nav: Nav) -> Nav:
        biases = {name: bend(b) for name, b in nav.errors.items() if name in ("gyro_bias", "accel_bias")}
        new = rotations.normalize(rotations.multiply(nav.q, q))
        return nav._replace(q=new, omega=bend(nav.omega), force=bend(nav.force), errors=nav.errors | biases)

    truth, imu, fix = jax.vmap(turned)(sim.truth), sim.epochs.imu, sim.epochs.fix
    ends = [expected(m, params, nav) for nav in (truth, sim.truth) for m in GNSS]
    value = fix.value.at[:, :3].set(jax.vmap(earth.move)(fix.value[:, :3], ends[0] - ends[2]))
    value = value.at[:, 3:6].add(ends[1] - ends[3])
    imu = imu._replace(gyro=bend(imu.gyro), accel=bend(imu.accel))
    epochs = sim.epochs._replace(imu=imu, fix=fix._replace(value=value))
    return sim._replace(epochs=epochs, truth=truth, start=turned(sim.start), initial=turned(sim.initial))


def draw_state(key: jax.Array, state: State, prior: StateParams, sim: Simulated) -> jax.Array:
    """Return a state over time (E, size): constant, a walk, or a Gauss-Markov process of its root PSD and tau."""
    E, interval = sim.truth.t.size, sim.truth.t[1] - sim.truth.t[0]
    first, steps = normal(key, (state.size,)), normal(jax.random.fold_in(key, 1), (E, state.size))
    endless = jnp.isinf(jnp.asarray(prior.tau, float)).all()
    walk = prior.sd * first + prior.driving_noise * jnp.sqrt(interval) * jnp.cumsum(steps, 0)
    tau = jnp.where(jnp.isinf(prior.tau), 1.0, prior.tau)
    bounded = prior.driving_noise * jnp.sqrt(tau / 2) * gauss_markov(steps, interval, tau)
    return jnp.where(endless, walk, bounded)
