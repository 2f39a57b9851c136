"""Strapdown navigation in the local level frame: ENU axes, geodetic position (GPID paper, section 3; Savage 1998).

    C' = C [w_ib x] - [(w_ie + w_en) x] C
    v' = C f - (2 w_ie + w_en) x v + g
    lat' = v_N / (R_M + h),  lon' = v_E / ((R_N + h) cos lat),  h' = v_U

Second order in the sample time. Not for the poles, where longitude and the transport rate are singular.

Only the body's rotation is truly sequential. With it, each sample's thrust is known in ENU as it stood at the first
sample; what is left turns with the Earth and the way travelled, 1e-4 rad/s, and is integrated one sample after the
other (`propagate`) or for all samples at once in a few sweeps (`propagate_block`), to the same result. The Earth is a
series of second order about the first sample of a block, so that no transcendental is in the loop: while a block lasts
ten seconds, that is wrong by less than 1e-9 rad/s up to latitude 85 degrees and 300 m/s.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav import earth
from jaxnav.mechanizations.components import (
    Vector,
    add,
    before,
    cross,
    exp,
    multiply,
    normalize,
    rotate,
    scale,
    small,
)  # fmt: skip
from jaxnav.mechanizations.increments import increments, trace
from jaxnav.types import Drive, Imu, Nav, Path

BLOCK = 100  # samples at once; the Earth is looked up and ENU's turn is summed up anew for each block
SWEEPS = 4  # of `propagate_block`; each takes the error down by how far ENU turns in an epoch, 1e-4 a second


class Level(NamedTuple):
    """What is integrated beside the body's rotation, since the first sample but for velocity and height."""

    vel: Vector  # m/s, ENU
    north: Any  # rad, latitude
    east: Any  # rad, longitude
    h: Any  # m
    turn: Vector  # rad, rotation of ENU


def surface(lat: jax.Array) -> tuple[jax.Array, ...]:
    """Radii R_M and R_N (m), gravity at height 0 (m/s^2), Earth rate north and up (rad/s), tan and sec of latitude."""
    _, north, up = earth.earth_rate(lat)
    cos = jnp.cos(lat)
    return *earth.radii(lat), earth.gravity(lat, jnp.zeros_like(lat)), north, up, jnp.sin(lat) / cos, 1 / cos


def series(f: Callable, x: jax.Array) -> list[tuple]:
    """Taylor coefficients of ``f``, a scalar to a tuple, at x: to second order."""
    slope = lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]  # noqa: E731
    return [f(x), slope(x), scale(0.5, jax.jvp(slope, (x,), (jnp.ones_like(x),))[1])]


def increment(ground: list[tuple], push: Vector, x: Level, sample: tuple[Any, Vector]) -> Level:
    """The change over one sample (dt s, thrust m/s in ENU of the first one); ``ground``: `series` of `surface`."""
    dt, thrust = sample
    # the Earth's shape, rate and gravity half-way, in first order; a mean radius is near enough for that
    off, h = x.north + 0.5 * dt * x.vel[1] / earth.A, x.h + 0.5 * dt * x.vel[2]
    meridian, prime, g, ie_north, ie_up, tan, sec = (a + off * (b + off * c) for a, b, c in zip(*ground, strict=True))
    north_curve, east_curve = 1 / (meridian + h), 1 / (prime + h)
    g = g * (1 - 2 / earth.A * h)
    ie = (0.0, ie_north, ie_up)

    def transport(v):
        return -v[1] * north_curve, v[0] * east_curve, v[0] * east_curve * tan

    def fall(w_en, v):
        return scale(-dt, add(cross(add(ie, ie, w_en), v), (0.0, 0.0, g)))

    start = transport(x.vel)
    lag = add(x.turn, scale(0.5 * dt, add(ie, start)))  # ENU turns under the thrust
    late = cross(lag, thrust)
    thrust = add(thrust, scale(-1.0, late), scale(0.5, cross(lag, late)))
    mid = add(x.vel, scale(0.5, add(thrust, fall(start, x.vel))))  # velocity half-way
    w_en = transport(mid)
    dv = add(thrust, fall(w_en, mid), scale(dt, push))
    mean = add(x.vel, scale(0.5, dv))
    turn = scale(dt, add(ie, w_en))
    turn = add(turn, scale(0.5, cross(x.turn, turn)))  # two rotations in a row are not quite their sum
    return Level(dv, mean[1] * dt * north_curve, mean[0] * dt * east_curve * sec, mean[2] * dt, turn)


def by_scan(change: Callable, start: Level, samples: tuple[jax.Array, Vector]) -> Level:
    """After each sample, one after the other."""

    def step(x, sample):
        x = jax.tree.map(jnp.add, x, change(x, sample))
        return x, x

    return lax.scan(step, start, samples)[1]


def by_sweeps(change: Callable, start: Level, samples: tuple[jax.Array, Vector]) -> Level:
    """After each sample, all at once: the fixed point of "add up what the path of the last sweep changes"."""
    leaves, tree = jax.tree.flatten(start)
    first = jnp.stack(leaves)
    ends = jnp.broadcast_to(first, (samples[0].size, first.size))

    def add_up(a, b):  # in a scan: the cheapest form of a cumulative sum on a processor
        return a + b, a + b

    def sweep(ends, _):
        starts = jnp.concatenate([first[None], ends[:-1]])
        changes = jax.tree.leaves(change(jax.tree.unflatten(tree, starts.T), samples))
        return lax.scan(add_up, first, jnp.stack(changes, -1))[1], None

    ends, _ = lax.scan(sweep, ends, length=SWEEPS)
    return jax.tree.unflatten(tree, ends.T)


def _block(integrate: Callable, nav: Nav, u: Drive, imu: Imu) -> tuple[Nav, Path]:
    inc = increments(nav, imu)

    def turn(q, dq):
        q = multiply(q, dq)
        return q, q

    spin = exp(tuple(jnp.asarray(u.omega)[:, None] * jnp.cumsum(inc.dt)))  # about axes of the first sample
    q = multiply(spin, lax.scan(turn, tuple(nav.q), exp(inc.theta))[1])
    thrust = rotate(tuple(before(a, b) for a, b in zip(nav.q, q, strict=True)), inc.dv)
    lat, lon, h = nav.pos
    zero = jnp.zeros_like(lat)
    # about a latitude that is taken as a constant: the derivative by it comes from the series' own variable
    centre = lax.stop_gradient(lat)
    change = partial(increment, series(surface, centre), tuple(jnp.asarray(u.accel)))
    ends = integrate(change, Level(tuple(nav.vel), lat - centre, zero, h, (zero, zero, zero)), (inc.dt, thrust))
    q = normalize(multiply(small(scale(-1.0, ends.turn)), q))
    return trace(nav, inc, (centre + ends.north, lon + ends.east, ends.h), ends.vel, q)


def _blocks(integrate: Callable, nav: Nav, u: Drive, imu: Imu) -> tuple[Nav, Path]:
    """Block after block, the last one filled up with padding."""
    k = imu.dt.shape[0]
    if k <= BLOCK:
        return _block(integrate, nav, u, imu)
    fill = lambda a: jnp.pad(a, ((0, -k % BLOCK), *[(0, 0)] * (a.ndim - 1))).reshape(-1, BLOCK, *a.shape[1:])  # noqa: E731
    _, path = lax.scan(lambda nav, imu: _block(integrate, nav, u, imu), nav, jax.tree.map(fill, imu))
    path = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:k], path)
    return jax.tree.map(lambda a: a[-1], path.nav), path


def propagate(nav: Nav, u: Drive, imu: Imu) -> tuple[Nav, Path]:
    """Navigate through k samples (``imu`` fields (k, ...)); ``u`` is the observer's feedback, zero without one.

    ``pos`` is (lat rad, lon rad, h m), ``vel`` is ENU m/s, ``q`` takes body FRD to ENU. A sample of dt = 0 changes
    nothing.
    """
    return _blocks(by_scan, nav, u, imu)


def propagate_block(nav: Nav, u: Drive, imu: Imu) -> tuple[Nav, Path]:
    """`propagate` for all samples at once, to rounding; faster for one run and on accelerators, slower in a batch."""
    return _blocks(by_sweeps, nav, u, imu)
