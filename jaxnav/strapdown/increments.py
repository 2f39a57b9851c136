"""Vectorised work of mechanizations before and after their scans, where no sample depends on another.

Before: from IMU samples to bias-free rotation vectors and velocity increments. After: the
states that measurements are compared with, and the path for the error dynamics.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths.components import Quaternion, Vector, add, before, cross, scale, split, to_dcm
from jaxnav.states.sensors import corrected
from jaxnav.types import ErrorInputs, Imu, Nav


class Increments(NamedTuple):
    """Per sample, in body axes at the sample's start; vectors as tuples of components (k,)."""

    dt: jax.Array  # (k,) s
    theta: Vector  # rad, rotation vector over the sample
    dv: Vector  # m/s, integral of specific force in the axes at the sample's start
    omega: Vector  # rad/s, bias-free mean rate
    force: Vector  # m/s^2, bias-free mean specific force


def thin(path: ErrorInputs, T: jax.Array, stride: int) -> ErrorInputs:
    """Time-weighted means of a path over blocks of ``stride`` of its points, which last ``T`` s each.

    Padding weighs nothing. The inputs of the error dynamics are averaged, and the dynamics built once per block.
    """
    if stride == 1:
        return path
    T = T.reshape(-1, stride)
    total = T.sum(1, keepdims=True)
    w = jnp.where(total > 0, T / jnp.where(total > 0, total, 1.0), 1.0 / stride)
    return jax.tree.map(lambda a: jnp.einsum("bs,bs...->b...", w, a.reshape(w.shape + a.shape[1:])), path)


def coned(dt: Any, omega0: Vector, force0: Vector, omega: Vector, force: Vector) -> tuple[Vector, Vector]:
    """Rotation vector (rad) and velocity increment (m/s) of a sample, in body axes at its start.

    Rate and force are taken as linear in time through this sample and the one before it (Savage 1998, two-sample
    forms): theta = w dt + (w0 x w) dt^2 / 12 and dv = f dt + (w dt) x (f dt) / 2 + (w0 x f + f0 x w) dt^2 / 12, where
    the subscript 0 marks the sample before. The first sample of a run has none and gets no such correction. The third
    order of the rotation, w x (w x f) dt^3 / 6, is kept as well: it adds up in a steady turn.
    """
    turn = cross(omega, force)
    sculling = scale(dt**2 / 12, add(cross(omega0, force), cross(force0, omega)))
    theta = add(scale(dt, omega), scale(dt**2 / 12, cross(omega0, omega)))
    dv = add(scale(dt, force), scale(dt**2 / 2, turn), scale(dt**3 / 6, cross(omega, turn)), sculling)
    return theta, dv


def increments(nav: Nav, imu: Imu) -> Increments:
    """Remove biases, then correct for coning, sculling and rotation within the sample."""
    clean = corrected(imu, nav)
    omega, force = split(clean.gyro), split(clean.accel)
    # the state carries the rates before this epoch's bias correction: one sample in an epoch sees that difference
    omega0 = tuple(before(a, b) for a, b in zip(nav.omega, omega, strict=True))
    force0 = tuple(before(a, b) for a, b in zip(nav.force, force, strict=True))
    return Increments(imu.dt, *coned(imu.dt, omega0, force0, omega, force), omega, force)


def after(nav: Nav, t: jax.Array, pos: Vector, vel: Vector, q: Quaternion, omega: Vector, force: Vector) -> Nav:
    """Navigation states at times t (w,), from components (w,)."""
    w = t.shape[0]
    stack = lambda v: jnp.stack(v, -1)
    return Nav(
        t, stack(pos), stack(vel), stack(q), stack(omega), stack(force),
        *jax.tree.map(lambda a: jnp.broadcast_to(a, (w, *a.shape)), (nav.origin, nav.errors, nav.auxiliary)),
    )  # fmt: skip


def sampled(nav: Nav, states: Nav, q: Quaternion, force: Vector) -> ErrorInputs:
    """Return the path of single samples, from the states (k,) after them, their attitudes and body forces (m/s^2)."""
    C = to_dcm(tuple(jnp.concatenate([jnp.asarray(a)[None], b]) for a, b in zip(split(nav.q), q, strict=True)))
    C = 0.5 * (C[:-1] + C[1:])
    turned = jnp.stack([sum(C[:, i, j] * force[j] for j in range(3)) for i in range(3)], -1)
    return ErrorInputs(states, C, turned, states.omega, states.force)


def trace(
    nav: Nav, inc: Increments, pos: Vector, vel: Vector, q: Quaternion, stride: int, keep: jax.Array | None
) -> tuple[Nav, ErrorInputs]:
    """Return the result of a mechanization, from the components (k,) after each sample; ``q`` of unit length.

    The last state or those after the samples ``keep`` (w,), and the path at every ``stride`` samples.
    """
    states = after(nav, nav.t + jnp.cumsum(inc.dt), pos, vel, q, inc.omega, inc.force)
    out = jax.tree.map(lambda a: a[-1 if keep is None else keep], states)
    return out, thin(sampled(nav, states, q, inc.force), inc.dt, stride)
