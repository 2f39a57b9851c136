"""Motion of the body over samples and intervals, in body axes: the fast half of a two-speed strapdown.

Savage (1998) integrates rotation and specific force at the rate of the sensors, and the Earth's part more
slowly. All intervals of an epoch are summed up at once, sample by sample: m steps on n numbers, components (m, n).

The sums need nothing of the state but the biases, and those enter so weakly that the first order will do (as in
preintegration: Forster et al. 2017): sums made with the biases in are good for many runs on the same samples.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav.maths.components import (
    Quaternion,
    Vector,
    add,
    before,
    conjugate,
    cross,
    exp,
    exp_small_angle,
    multiply,
    normalize,
    remat,
    rotate,
    scale,
    split,
)
from jaxnav.states.sensors import OTHER, corrected_reading
from jaxnav.states.table import STATES
from jaxnav.strapdown.increments import coned
from jaxnav.types import Imu, Nav, Tree


class Readings(NamedTuple):
    """Samples; components of one shape."""

    dt: Any  # s
    omega: Vector  # rad/s
    force: Vector  # m/s^2


class Body(NamedTuple):
    """Motion of the body since an interval began, in its axes at that time."""

    t: Any  # s
    q: Quaternion  # its rotation
    dv: Vector  # m/s, integral of specific force
    displacement: Vector  # m, integral of dv; () for a single sample
    mean: Quaternion  # s, integral of q; () for a single sample


class BodyInterval(NamedTuple):
    """Intervals, or the first samples of some."""

    body: Body
    omega: Vector  # rad/s, of the last sample
    force: Vector  # m/s^2


class SummedIntervals(NamedTuple):
    """The intervals of an epoch as the sensors saw them, their errors in it; rows are the leaves of `BodyInterval`."""

    whole: jax.Array  # (21, n)
    parts: jax.Array  # (21, w) first samples of intervals, up to those that are kept
    place: jax.Array  # (w,) int, which intervals


def readings(imu: Imu, omega: jax.Array, force: jax.Array, m: int) -> tuple[Readings, Readings]:
    """Return the samples (k,) in intervals of m, (m, n), and the one before each interval, (n,).

    ``omega`` (rad/s) and ``force`` (m/s^2), (3,), are those before the first sample.
    """
    rows = lambda a: a.reshape(-1, m).T
    all_of_them = Readings(rows(imu.dt), *(tuple(rows(a[:, i]) for i in range(3)) for a in (imu.gyro, imu.accel)))
    start = Readings(jnp.zeros_like(imu.dt[0]), split(omega), split(force))
    return all_of_them, jax.tree.map(lambda a, b: before(a, b[-1]), start, all_of_them)


def singles(x: Readings, last: Readings) -> Body:
    """Return the increments of each sample (m, n); scanned, so that XLA does not duplicate work."""

    @remat
    def single(last: Tree, x: Tree) -> Tree:
        theta, dv = coned(x.dt, last.omega, last.force, x.omega, x.force)
        return x, Body(x.dt, exp(theta), dv, (), ())

    return lax.scan(single, last, x)[1]


def sums(
    imu: Imu, omega: jax.Array, force: jax.Array, m: int, keep: jax.Array
) -> tuple[BodyInterval, BodyInterval, jax.Array]:
    """Return increments over intervals of m samples, those up to the samples ``keep`` (w,), and each one's interval.

    ``omega`` (rad/s) and ``force`` (m/s^2), (3,), are those before the first sample.
    """
    x, first = readings(imu, omega, force, m)

    @remat
    def step(body: Tree, x: Tree) -> Tree:
        dt, dq, dv, _, _ = x
        q, dv = multiply(body.q, dq), rotate(body.q, dv)
        body = Body(
            body.t + dt,
            q,
            add(body.dv, dv),
            add(body.displacement, scale(dt, add(body.dv, scale(0.5, dv)))),
            add(body.mean, scale(0.5 * dt, add(body.q, q))),
        )
        return body, body

    zero = jnp.zeros_like(first.dt)
    start = Body(zero, (zero + 1, zero, zero, zero), (zero,) * 3, (zero,) * 3, (zero,) * 4)
    whole, parts = lax.scan(step, start, singles(x, first))
    # the mean rotation of nothing is none
    whole = whole._replace(mean=add(whole.mean, (jnp.where(whole.t > 0, 0.0, 1.0), 0.0, 0.0, 0.0)))
    place, at = keep // m, keep % m * first.dt.size + keep // m
    kept = jax.tree.map(lambda a: a.ravel()[at], BodyInterval(parts, *x[1:]))
    return BodyInterval(whole, *jax.tree.map(lambda a: a[-1], x[1:])), kept, place


def unbiased(rows: jax.Array, b_g: Vector, b_a: Vector) -> BodyInterval:
    """Return the interval without the biases b_g (rad/s) and b_a (m/s^2), of rows of `SummedIntervals`.

    A bias of the rate turns by t C b_g, C the mean rotation, and specific force with it, of which the integral of t f
    is t dv - displacement. First order in the biases and in how far the body turns: in intervals of 0.1 s at 0.3 rad/s
    less than 0.3 % of a bias's effect is lost (tests/strapdown/test_preintegration.py).
    """
    t, *v = jnp.unstack(rows)
    q, dv, displacement, mean, omega, force = (tuple(v[a:b]) for a, b in pairwise((0, 4, 7, 10, 14, 17, 20)))
    q, mean = ((jnp.where(t > 0, q[0], 1.0), *q[1:]) for q in (q, mean))  # padding does not turn
    half = normalize(mean)
    drift = rotate(half, b_g)
    back = exp_small_angle(scale(-0.5 * t, drift))
    push = rotate(multiply(back, half), b_a)
    body = Body(
        t,
        multiply(multiply(back, back), q),
        add(dv, cross(drift, add(displacement, scale(-t, dv))), scale(-t, push)),
        add(displacement, cross(drift, scale(-t / 3, displacement)), scale(-0.5 * t * t, push)),
        multiply(back, mean),
    )
    return BodyInterval(body, *(add(a, scale(-1.0, b)) for a, b in ((omega, b_g), (force, b_a))))


def as_biases(rows: jax.Array, nav: Nav) -> tuple[Vector, Vector]:
    """Return the errors of gyro (rad/s) and accelerometer (m/s^2) readings per interval, of rows of `SummedIntervals`.

    Biases as they are; errors that depend on the reading at the interval's mean, so that 3,000 ppm of scale cost 2 mm
    after a minute at 0.2 rad/s, and centimetres at 1 rad/s.
    """
    t, *v = jnp.unstack(rows)
    q, dv, mean = tuple(v[:4]), tuple(v[4:7]), tuple(v[10:14])
    half = normalize((jnp.where(t > 0, mean[0], 1.0), *mean[1:]))
    means = {"gyro": divide_or_zero(t, scale(2.0, q[1:])), "accel": divide_or_zero(t, rotate(conjugate(half), dv))}

    def excess(sensor: str) -> Vector:
        errors, names = nav.errors, [name for name in nav.errors if STATES[name].enters == sensor]
        if all(STATES[name].effect is None for name in names):
            return split(sum((errors[name] for name in names), jnp.zeros(3)))
        raw, other = jnp.stack(means[sensor], -1), jnp.stack(means[OTHER[sensor]], -1)
        return split(raw - corrected_reading(raw, sensor, errors, other, nav.auxiliary))

    return excess("gyro"), excess("accel")


def divide_or_zero(t: Any, v: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return v / t, zero where t is."""
    some = t > 0
    return scale(jnp.where(some, 1 / jnp.where(some, t, 1.0), 0.0), v)
