"""The IMU of a trajectory, free of errors and independent of any mechanization, and the errors of a grade on top.

The errors come from a key; the size of one changes nothing of the others.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav import earth, rotations
from jaxnav.sensors.grades import Grade
from jaxnav.trajectories import WEIGHTS, Point, Travel
from jaxnav.types import Imu

SPIN = np.array([0.0, 0.0, earth.RATE])  # rad/s, of the Earth, ECEF


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


def ideal(travel: Travel) -> tuple[Imu, jax.Array, jax.Array]:
    """Error-free samples (E k, ...): means of rate and specific force over each, by quadrature of order 6.

    And both at the start and at the end of every epoch, (E + 1, 3) each.
    """
    omega, force = lax.map(jax.vmap(sense), travel.points)
    mean = lambda a: jnp.einsum("g,ngi->ni", WEIGHTS, a[:-1, 1:].reshape(-1, 3, 3))  # noqa: E731
    gyro = mean(omega)
    return Imu(jnp.full(gyro.shape[0], travel.dt, float), gyro, mean(force)), omega[:, 0], force[:, 0]


def gauss_markov(white: jax.Array, dt: float, tau: float) -> jax.Array:
    """First-order Gauss-Markov processes of unit sd, in their steady state, from unit white noise (n, ...)."""
    decay, drive = np.exp(-dt / tau), np.sqrt(-np.expm1(-2 * dt / tau))

    def advance(b, w):
        b = decay * b + drive * w
        return b, b

    _, b = lax.scan(advance, white[0], white[1:])
    return jnp.concatenate([white[:1], b])


def corrupt(
    key: jax.Array, imu: Imu, dt: float, grade: Grade, gyro_scale: float = 0.0, accel_scale: float = 0.0
) -> tuple[Imu, jax.Array, jax.Array]:
    """Put a grade's errors on regular samples (n, ...): bias, drift, white noise, scale error of the given sd.

    Returns what the IMU puts out and its true biases (n, 3), gyro (rad/s) and accelerometer (m/s^2): those that
    subtracted leave only scale error and white noise.
    """
    n = imu.dt.shape[0]
    normal = jax.random.normal(key, (2 + 2 * n, 2, 3), float)  # axis 1: gyro, accelerometer
    constant, factor, drift, white = normal[0], normal[1], normal[2 : 2 + n], normal[2 + n :]
    sd = lambda gyro, accel: np.array([[gyro], [accel]])  # noqa: E731
    bias = sd(grade.gyro_turn_on, grade.accel_turn_on) * constant
    bias = bias + sd(grade.gyro_instability, grade.accel_instability) * gauss_markov(drift, dt, grade.tau)
    # a root PSD becomes the sd of a mean over dt
    noise = sd(grade.arw, grade.vrw) / np.sqrt(dt) * white
    signal = jnp.stack([imu.gyro, imu.accel], 1)
    out = (1 + sd(gyro_scale, accel_scale) * factor) * signal + bias + noise
    return Imu(imu.dt, out[:, 0], out[:, 1]), bias[:, 0], bias[:, 1]
