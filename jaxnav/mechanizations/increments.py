"""From IMU samples to what strapdown integrates: bias-free rotation vectors and velocity increments.

Vectorised over the samples of an epoch, because nothing here is sequential; shared by every mechanization.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.types import Imu, Nav


class Increments(NamedTuple):
    """Per sample, in body axes at the sample's start."""

    dt: jax.Array  # (k,) s
    theta: jax.Array  # (k, 3) rad, rotation vector over the sample
    dv: jax.Array  # (k, 3) m/s, integral of specific force in the axes at the sample's start
    omega: jax.Array  # (k, 3) rad/s, bias-free mean rate
    force: jax.Array  # (k, 3) m/s^2, bias-free mean specific force


def increments(nav: Nav, imu: Imu) -> Increments:
    """Remove biases, then correct for coning, sculling and rotation within the sample.

    Rate and force are taken as linear in time through this sample and the one before it (Savage 1998, two-sample
    forms): theta = w dt + (w0 x w) dt^2 / 12 and dv = f dt + (w dt) x (f dt) / 2 + (w0 x f + f0 x w) dt^2 / 12, where
    the subscript 0 marks the sample before. The first sample of a run has none and gets no such correction. The third
    order of the rotation, w x (w x f) dt^3 / 6, is kept as well: in a steady turn it is what adds up.
    """
    omega, force = imu.gyro - nav.b_g, imu.accel - nav.b_a
    # the state carries the rates before this epoch's bias correction: one sample in an epoch sees that difference
    omega0 = jnp.concatenate([nav.omega[None], omega[:-1]])
    force0 = jnp.concatenate([nav.force[None], force[:-1]])
    dt = imu.dt[:, None]
    coning = jnp.cross(omega0, omega) * dt**2 / 12
    sculling = (jnp.cross(omega0, force) + jnp.cross(force0, omega)) * dt**2 / 12
    theta = omega * dt + coning
    turn = jnp.cross(omega, force)
    dv = force * dt + turn * dt**2 / 2 + jnp.cross(omega, turn) * dt**3 / 6 + sculling
    return Increments(imu.dt, theta, dv, omega, force)
