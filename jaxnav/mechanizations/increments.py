"""What every mechanization does before and after its scan, vectorised over samples because nothing here is sequential.

Before: from IMU samples to what strapdown integrates, bias-free rotation vectors and velocity increments. After: the
path, for the error dynamics and for measurements.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.mechanizations.components import Quaternion, Vector, add, before, cross, scale, split, to_dcm
from jaxnav.types import Imu, Nav, Path


class Increments(NamedTuple):
    """Per sample, in body axes at the sample's start; vectors as tuples of components (k,)."""

    dt: jax.Array  # (k,) s
    theta: Vector  # rad, rotation vector over the sample
    dv: Vector  # m/s, integral of specific force in the axes at the sample's start
    omega: Vector  # rad/s, bias-free mean rate
    force: Vector  # m/s^2, bias-free mean specific force


def increments(nav: Nav, imu: Imu) -> Increments:
    """Remove biases, then correct for coning, sculling and rotation within the sample.

    Rate and force are taken as linear in time through this sample and the one before it (Savage 1998, two-sample
    forms): theta = w dt + (w0 x w) dt^2 / 12 and dv = f dt + (w dt) x (f dt) / 2 + (w0 x f + f0 x w) dt^2 / 12, where
    the subscript 0 marks the sample before. The first sample of a run has none and gets no such correction. The third
    order of the rotation, w x (w x f) dt^3 / 6, is kept as well: in a steady turn it is what adds up.
    """
    omega, force = split(imu.gyro - nav.b_g), split(imu.accel - nav.b_a)
    # the state carries the rates before this epoch's bias correction: one sample in an epoch sees that difference
    omega0 = tuple(before(a, b) for a, b in zip(nav.omega, omega, strict=True))
    force0 = tuple(before(a, b) for a, b in zip(nav.force, force, strict=True))
    dt = imu.dt
    coning = scale(dt**2 / 12, cross(omega0, omega))
    sculling = scale(dt**2 / 12, add(cross(omega0, force), cross(force0, omega)))
    theta = add(scale(dt, omega), coning)
    turn = cross(omega, force)
    dv = add(scale(dt, force), scale(dt**2 / 2, turn), scale(dt**3 / 6, cross(omega, turn)), sculling)
    return Increments(dt, theta, dv, omega, force)


def trace(nav: Nav, inc: Increments, pos: Vector, vel: Vector, q: Quaternion) -> tuple[Nav, Path]:
    """The last state and the path, from the components (k,) after each sample; ``q`` of unit length."""
    k = inc.dt.shape[0]
    stack = lambda v: jnp.stack(v, -1)  # noqa: E731
    after = Nav(
        nav.t + jnp.cumsum(inc.dt), stack(pos), stack(vel), stack(q),
        jnp.broadcast_to(nav.b_g, (k, 3)), jnp.broadcast_to(nav.b_a, (k, 3)), stack(inc.omega), stack(inc.force),
        jax.tree.map(lambda a: jnp.broadcast_to(a, (k, *a.shape)), nav.origin),
    )  # fmt: skip
    first = tuple(before(a, b) for a, b in zip(nav.q, q, strict=True))
    C = 0.5 * (to_dcm(first) + to_dcm(q))
    force = stack(tuple(sum(C[:, i, j] * inc.force[j] for j in range(3)) for i in range(3)))
    return jax.tree.map(lambda a: a[-1], after), Path(after, C, force)
