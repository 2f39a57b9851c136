"""The IMU of a trajectory, free of errors and independent of any mechanization, and errors on top.

The errors come from a key; the size of one changes nothing of the others.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from jaxnav.maths import earth, rotations, units
from jaxnav.simulate.processes import gauss_markov, normal
from jaxnav.simulate.trajectories import Point
from jaxnav.states.grades import Grade
from jaxnav.types import Imu

SPIN = np.array([0.0, 0.0, earth.RATE])  # rad/s, of the Earth, ECEF


class ImuErrors(NamedTuple):
    """Errors of an IMU: those of its grade, and others that a datasheet leaves out (none of it by default)."""

    grade: str = "adis16465"  # in `jaxnav.states.grades.GRADES`
    imu_noise_factor: float = 1.0  # on the grade's white noise and drift, not on its turn-on biases
    fixed_bias: bool = False  # the turn-on biases have exactly the grade's size and a random sign, axis by axis
    gyro_bias_sd_deg_per_hour: float = 0.0  # of another constant bias, which the datasheet leaves out
    accel_bias_sd_mg: float = 0.0
    gyro_scale_sd_ppm: float = 0.0
    accel_scale_sd_ppm: float = 0.0
    gyro_misalignment_sd_mrad: float = 0.0  # of each of the six angles between sensor axes and body axes
    accel_misalignment_sd_mrad: float = 0.0
    gyro_step_deg_per_s: float = 0.0  # quantisation of the samples; 0 is none
    accel_step_mg: float = 0.0
    vibration_hz: float = 0.0  # a sine on every axis, at a random phase
    gyro_vibration_deg_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)  # amplitudes, body FRD
    accel_vibration_mps2: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _in_ecef(lla: jax.Array, vel: jax.Array, rph: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Body -> ECEF, (3, 3), and velocity in ECEF, m/s (3,)."""
    C = earth.axes(lla[0], lla[1])
    return C @ rotations.from_rph(rph), C @ vel


def sense(point: Point) -> tuple[jax.Array, jax.Array]:
    """Rate against inertial space (rad/s) and specific force (m/s^2) of one instant, body FRD, (3,) each.

    By differentiation in ECEF: no transport rate, no strapdown equation. Gravity contains the centrifugal part, so
    that of the inertial acceleration, w x (w x r), cancels against the one in the gravitation.
    """
    here = (point.lla, point.vel, point.rph)
    (C, vel), (C_rate, accel) = jax.jvp(_in_ecef, here, (point.lla_rate, point.vel_rate, point.rph_rate))
    W = C.T @ C_rate  # [w_eb x] in the body
    omega = 0.5 * jnp.stack([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) + C.T @ SPIN
    up = earth.axes(point.lla[0], point.lla[1])[:, 2]
    return omega, C.T @ (accel + 2 * jnp.cross(SPIN, vel) + earth.gravity(point.lla[0], point.lla[2]) * up)


def _pair(gyro: ArrayLike, accel: ArrayLike) -> jax.Array:
    """Return a size of the gyro and one of the accelerometer, each one number or one an axis, as (2, 3)."""
    return jnp.stack([jnp.broadcast_to(jnp.asarray(a, float), (3,)) for a in (gyro, accel)])


def _biases(key: jax.Array, first: jax.Array, drift: jax.Array, dt: float, grade: Grade, e: ImuErrors) -> jax.Array:
    """Return true biases (n, 2, 3) from unit normal numbers: of the turn-on (2, 3) and of the drift (n, 2, 3)."""
    turn_on = _pair(grade.gyro_turn_on, grade.accel_turn_on) * (jnp.sign(first) if e.fixed_bias else first)
    untold = _pair(e.gyro_bias_sd_deg_per_hour * units.DEG_PER_HOUR, e.accel_bias_sd_mg * units.MG)
    turn_on = turn_on + untold * normal(jax.random.fold_in(key, 1), (2, 3))
    f = e.imu_noise_factor
    bias = turn_on + f * _pair(grade.gyro_instability, grade.accel_instability) * gauss_markov(drift, dt, grade.tau)
    if grade.gyro_walk or grade.accel_walk:
        steps = normal(jax.random.fold_in(key, 2), drift.shape)
        bias = bias + f * _pair(grade.gyro_walk, grade.accel_walk) * np.sqrt(dt) * jnp.cumsum(steps, 0)
    return bias


def _deform(key: jax.Array, factor: jax.Array, e: ImuErrors) -> jax.Array:
    """Scale errors and angles between axes as matrices, (2, 3, 3), from unit normal numbers (2, 3) for the scale."""
    angles = units.MRAD * _pair(e.gyro_misalignment_sd_mrad, e.accel_misalignment_sd_mrad)[..., None]
    skew = angles * normal(jax.random.fold_in(key, 3), (2, 3, 3)) * (1 - np.eye(3))
    scale = 1 + units.PPM * _pair(e.gyro_scale_sd_ppm, e.accel_scale_sd_ppm) * factor
    return scale[..., None] * np.eye(3) + skew


def _vibration(key: jax.Array, n: int, dt: float, e: ImuErrors) -> jax.Array:
    """Means over n samples of the sines, (n, 2, 3): at and above the sampling rate they are aliased, as in a sensor."""
    amplitude = _pair(np.array(e.gyro_vibration_deg_per_s) * units.DEG, np.array(e.accel_vibration_mps2))
    phase = 2 * np.pi * jax.random.uniform(jax.random.fold_in(key, 4), (2, 3), float)
    middle = dt * (np.arange(n)[:, None, None] + 0.5)
    return amplitude * np.sinc(e.vibration_hz * dt) * jnp.sin(2 * np.pi * e.vibration_hz * middle + phase)


def _quantise(value: jax.Array, step: jax.Array) -> jax.Array:
    """To whole steps, where they are not zero; the derivative is that of the value."""
    size = jnp.where(step > 0, step, 1.0)
    return value + jnp.where(step > 0, lax.stop_gradient(size * jnp.round(value / size) - value), 0.0)


def corrupt(
    key: jax.Array, imu: Imu, dt: float, grade: Grade, errors: ImuErrors = ImuErrors()
) -> tuple[Imu, dict[str, jax.Array]]:
    """Put the errors of a grade, and more, on regular samples (n, ...); ``errors.grade`` is not looked up.

    Returns the IMU's output and its true errors (n, size) by name of `jaxnav.states.STATES`: without them there remain
    misalignment, vibration, quantisation and white noise. Vibration is felt by the sensors only, the truth does not
    shake.
    """
    n = imu.dt.shape[0]
    draw_state = normal(key, (2 + 2 * n, 2, 3))  # axis 1: gyro, accelerometer
    bias = _biases(key, draw_state[0], draw_state[2 : 2 + n], dt, grade, errors)
    # a root PSD becomes the sd of a mean over dt
    noise = errors.imu_noise_factor * _pair(grade.arw, grade.vrw) / np.sqrt(dt) * draw_state[2 + n :]
    signal = jnp.stack([imu.gyro, imu.accel], 1)
    deformed = _deform(key, draw_state[1], errors)
    out = jnp.einsum("sij,nsj->nsi", deformed, signal) + bias + noise
    if errors.vibration_hz:
        out = out + _vibration(key, n, dt, errors)
    if errors.gyro_step_deg_per_s or errors.accel_step_mg:
        out = _quantise(out, _pair(errors.gyro_step_deg_per_s * units.DEG, errors.accel_step_mg * units.MG))
    scale = jnp.broadcast_to(jnp.diagonal(deformed, axis1=1, axis2=2) - 1, bias.shape)
    true = {"gyro_bias": bias[:, 0], "accel_bias": bias[:, 1], "gyro_scale": scale[:, 0], "accel_scale": scale[:, 1]}
    return Imu(imu.dt, out[:, 0], out[:, 1]), true
