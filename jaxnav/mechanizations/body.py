"""What the body does over intervals of some samples, in its own axes: the fast half of a two-speed strapdown.

Savage (1998) integrates rotation and specific force at the rate of the sensors, and what turns with the Earth more
slowly. All intervals of an epoch are summed up at once, sample by sample: m steps on n numbers, components (m, n).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav.mechanizations.components import Quaternion, Vector, add, before, exp, multiply, rotate, scale
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
    """The samples (k,) in intervals of m, (m, n), and those before each interval, (n,)."""
    rows = lambda a: a.reshape(-1, m).T  # noqa: E731
    free = lambda a, b: tuple(rows(a[:, i] - b[i]) for i in range(3))  # noqa: E731
    all_of_them = Readings(rows(imu.dt), free(imu.gyro, nav.b_g), free(imu.accel, nav.b_a))
    # the state carries the rates before this epoch's bias correction: one sample in an epoch sees that difference
    start = Readings(jnp.zeros_like(imu.dt[0]), tuple(nav.omega), tuple(nav.force))
    return all_of_them, jax.tree.map(lambda a, b: before(a, b[-1]), start, all_of_them)


def one(x: Readings, last: Readings) -> Body:
    """Of intervals of one sample."""
    theta, dv = corrected(x.dt, last.omega, last.force, x.omega, x.force)
    return Body(x.dt, exp(theta), dv, (), ())


def sums(x: Readings, last: Readings) -> Body:
    """From each interval's start to the end of each of its samples, (m, n).

    The integrals are by trapezoids and lack half of the last one, see `finish`.
    """

    def correct(last, x):
        _, dq, dv, _, _ = one(x, last)
        return x, (x.dt, 0.5 * (last.dt + x.dt), dq, dv)

    def step(body, x):
        dt, half, dq, dv = x
        body = Body(
            body.t + dt, multiply(body.q, dq), add(body.dv, rotate(body.q, dv)),
            add(body.way, scale(half, body.dv)), add(body.mean, scale(half, body.q)),
        )  # fmt: skip
        return body, body

    zero = jnp.zeros_like(last.dt)
    start = Body(zero, (zero + 1, zero, zero, zero), (zero,) * 3, (zero,) * 3, (zero,) * 4)
    return lax.scan(step, start, lax.scan(correct, last._replace(dt=zero), x)[1])[1]


def finish(body: Body, dt: Any) -> Body:
    """With the last trapezoid, of half a sample dt; the mean rotation of nothing is none."""
    none = jnp.where(body.t > 0, 0.0, 1.0)
    mean = add(body.mean, scale(0.5 * dt, body.q), (none, 0.0, 0.0, 0.0))
    return body._replace(way=add(body.way, scale(0.5 * dt, body.dv)), mean=mean)


def over(t: Any, v: tuple) -> tuple:
    """V / t, zero where t is."""
    some = t > 0
    return scale(jnp.where(some, 1 / jnp.where(some, t, 1.0), 0.0), v)
