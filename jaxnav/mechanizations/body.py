"""What the body does over samples and intervals of some, in its own axes: the fast half of a two-speed strapdown.

Savage (1998) integrates rotation and specific force at the rate of the sensors, and what turns with the Earth more
slowly. All intervals of an epoch are summed up at once, sample by sample: m steps on n numbers, components (m, n).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav.mechanizations.components import Quaternion, Vector, add, before, exp, multiply, rotate, scale, split
from jaxnav.mechanizations.increments import corrected
from jaxnav.types import Imu, Nav


class Readings(NamedTuple):
    """Bias-free samples; components of one shape."""

    dt: Any  # s
    omega: Vector  # rad/s
    force: Vector  # m/s^2


class Body(NamedTuple):
    """What the body did since an interval began, in its own axes then."""

    t: Any  # s
    q: Quaternion  # its rotation
    dv: Vector  # m/s, integral of specific force
    way: Vector  # m, integral of dv; () for a single sample
    mean: Quaternion  # s, integral of q; () for a single sample


def readings(nav: Nav, imu: Imu, m: int) -> tuple[Readings, Readings]:
    """The samples (k,) in intervals of m, (m, n), and the one before each interval, (n,)."""
    rows = lambda a: a.reshape(-1, m).T  # noqa: E731
    free = lambda a, b: tuple(rows(a[:, i] - b) for i, b in enumerate(split(b)))  # noqa: E731
    all_of_them = Readings(rows(imu.dt), free(imu.gyro, nav.b_g), free(imu.accel, nav.b_a))
    # the state carries the rates before this epoch's bias correction: one sample in an epoch sees that difference
    start = Readings(jnp.zeros_like(imu.dt[0]), split(nav.omega), split(nav.force))
    return all_of_them, jax.tree.map(lambda a, b: before(a, b[-1]), start, all_of_them)


def singles(x: Readings, last: Readings) -> Body:
    """Of each sample (m, n) by itself; row by row, for the compiler works out every number of a loop but once."""

    def single(last, x):
        theta, dv = corrected(x.dt, last.omega, last.force, x.omega, x.force)
        return x, Body(x.dt, exp(theta), dv, (), ())

    return lax.scan(single, last, x)[1]


def sums(x: Readings, last: Readings) -> tuple[Body, Body]:
    """Of whole intervals (n,), and from their starts to the end of each of their samples (m, n), that without mean."""

    def step(body, x):
        dt, dq, dv, _, _ = x
        q, dv = multiply(body.q, dq), rotate(body.q, dv)
        body = Body(
            body.t + dt, q, add(body.dv, dv),
            add(body.way, scale(dt, add(body.dv, scale(0.5, dv)))), add(body.mean, scale(0.5 * dt, add(body.q, q))),
        )  # fmt: skip
        return body, body._replace(mean=())

    zero = jnp.zeros_like(last.dt)
    start = Body(zero, (zero + 1, zero, zero, zero), (zero,) * 3, (zero,) * 3, (zero,) * 4)
    whole, parts = lax.scan(step, start, singles(x, last))
    # the mean rotation of nothing is none
    return whole._replace(mean=add(whole.mean, (jnp.where(whole.t > 0, 0.0, 1.0), 0.0, 0.0, 0.0))), parts


def over(t: Any, v: tuple) -> tuple:
    """V / t, zero where t is."""
    some = t > 0
    return scale(jnp.where(some, 1 / jnp.where(some, t, 1.0), 0.0), v)
