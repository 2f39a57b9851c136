"""`jaxnav.strapdown.local_level` made fast: the same equations in another order (GPID paper, section 3; Savage 1998).

    C' = C [w_ib x] - [(w_ie + w_en) x] C
    v' = C f - (2 w_ie + w_en) x v + g
    lat' = v_N / (R_M + h),  lon' = v_E / ((R_N + h) cos lat),  h' = v_U

Second order in the sample time. Not for the poles, where longitude and the transport rate are singular.

Only the body's rotation is truly sequential. With it, each interval's thrust is known in ENU as it stood at the first
sample; the rest turns with the Earth and the distance travelled, 1e-4 rad/s, and is integrated one interval after the
other. An interval is one sample, or up to `INTERVAL` where the error dynamics see means over so many: then the fast
half, `body`, still takes every sample, and only gravity, Coriolis and the way are added more slowly. The Earth is a
series of second order about the first sample of a block, so that no transcendental is in the loop: while a block lasts
ten seconds, that is wrong by less than 1e-9 rad/s up to latitude 85 degrees and 300 m/s. An observer's spin turns about
ENU of the block's first sample.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.maths import earth
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
    products,
    remat,
    rotate,
    running,
    scale,
    split,
    to_dcm,
)
from jaxnav.states.sensors import corrected
from jaxnav.strapdown.fast.body import (
    Body,
    BodyInterval,
    SummedIntervals,
    as_biases,
    divide_or_zero,
    readings,
    singles,
    sums,
    unbiased,
)
from jaxnav.strapdown.increments import after, sampled, thin
from jaxnav.types import Array, ErrorInputs, Forcing, Imu, Nav, Tree

INTERVAL = 10  # samples, at most: a tenth of a second at 100 Hz
STEP = 1e-4  # rad, of latitude: over it the Earth is a parabola to 1e-8 of the change even at 85 deg of latitude
BY_DIFFERENCES = np.array([[0.0, STEP**2, 0.0], [-0.5 * STEP, 0.0, 0.5 * STEP], [0.5, -1.0, 0.5]]) / STEP**2
BLOCK = 100  # samples at once; Earth's quantities are computed and ENU's rotation summed up once per block


class Level(NamedTuple):
    """Integrals in addition to the body's rotation, since the first sample but for velocity and height."""

    vel: Vector  # m/s, ENU
    north: Array  # rad, latitude
    east: Array  # rad, longitude
    h: Array  # m
    turn: Vector  # rad, rotation of ENU


class VelocityIncrement(NamedTuple):
    """Effect of the specific force in an interval, in ENU of the block's first sample."""

    t: Array  # s
    dv: Vector  # m/s
    gained: Vector  # m/s, mean over t of the velocity added by then; () is half of dv


def surface(lat: jax.Array) -> tuple[jax.Array, ...]:
    """Radii R_M and R_N (m), gravity at height 0 (m/s^2), Earth rate north and up (rad/s), tan and sec of latitude."""
    _, north, up = earth.earth_rate(lat)
    cos = jnp.cos(lat)
    return *earth.radii(lat), earth.gravity(lat, jnp.zeros_like(lat)), north, up, jnp.sin(lat) / cos, 1 / cos


def series(f: Callable[..., Any], x: jax.Array) -> list[tuple[Any, ...]]:
    """Taylor coefficients of ``f``, a number to a tuple, at x: to second order, by differences over `STEP`."""
    table = BY_DIFFERENCES @ jnp.stack(f(x + STEP * np.array([-1.0, 0.0, 1.0])), 1)
    return [tuple(jnp.unstack(row)) for row in jnp.unstack(table)]


def increment(
    ground: list[tuple[Any, ...]], u: tuple[Vector, Vector], samples: int, x: Level, thrust: VelocityIncrement
) -> Level:
    """Return the change over an interval of some samples, its thrust in ENU of the block's first one.

    ``ground``: `series` of `surface`; ``u``: feedback of an observer, () without one.
    """
    (spin, push), (t, dv, gained) = u, thrust
    # the Earth's shape, rate and gravity half-way, in first order; a mean radius is near enough for that
    off, h = x.north + 0.5 * t * x.vel[1] / earth.A, x.h + 0.5 * t * x.vel[2]
    meridian, prime, g, ie_north, ie_up, tan, sec = (a + off * (b + off * c) for a, b, c in zip(*ground, strict=True))
    north_curve, east_curve = t / (meridian + h), t / (prime + h)
    weight = (0.0, 0.0, -t * g * (1 - 2 / earth.A * h))
    pull = add(scale(t, push), weight) if push else weight
    ie = (0.0, t * ie_north, t * ie_up)

    def transport(v: Any) -> Any:
        east = v[0] * east_curve
        return -v[1] * north_curve, east, east * tan

    def gravity_coriolis(en: Any, v: Any) -> Any:
        return add(pull, cross(v, add(ie, ie, en)))

    def seen(v: Any) -> Any:  # in ENU as it has turned until the interval's start
        late = cross(v, x.turn)
        return add(v, late, scale(0.5, cross(late, x.turn)))

    dv = seen(dv)
    gained = seen(gained) if gained else scale(0.5, dv)
    # mean of a quantity that grows in the interval: half of it for one sample, for many the exact integral's shares
    s = (1 - 1 / samples**2) / 6
    en = transport(x.vel)
    turn = add(ie, en, scale(-t, spin)) if spin else add(ie, en)
    late = cross(add(dv, scale(-1.0, gained)), turn)  # ENU also turns inside the interval
    first = gravity_coriolis(en, x.vel)
    v = add(x.vel, gained, scale(0.5 - s, late), scale(0.5, first))  # mean velocity
    en = transport(v)
    fallen = gravity_coriolis(en, v)
    mean = add(x.vel, gained, scale(0.5 - s, late), scale(s, first), scale(0.5 - s, fallen))
    turn = add(ie, en)
    turn = add(turn, scale(0.5, cross(x.turn, turn)))  # two rotations in a row are not quite their sum
    return Level(add(dv, late, fallen), mean[1] * north_curve, mean[0] * east_curve * sec, t * mean[2], turn)


def by_scan(change: Callable[..., Any], start: Level, thrust: VelocityIncrement) -> Level:
    """After each interval, one after the other."""

    @remat
    def step(x: Level, thrust: VelocityIncrement) -> tuple[Level, Level]:
        x = jax.tree.map(jnp.add, x, change(x, thrust))
        return x, x

    return lax.scan(step, start, thrust)[1]


def attitudes(nav: Nav, spin: Vector, body: Body) -> tuple[Quaternion, Quaternion, Quaternion]:
    """At the start and end of each interval (n,) and, of any length, its mean; about axes of the first sample.

    The mean is () for intervals of one sample.
    """

    @remat
    def turn(q: Any, interval: Any) -> Any:
        dq, mean = interval
        after = multiply(q, dq)
        return after, (after, multiply(q, mean))

    if body.mean:
        ends, means = lax.scan(turn, split(nav.q), (body.q, body.mean))[1]
    else:
        ends, means = products(split(nav.q), body.q), ()
    starts = tuple(before(a, b) for a, b in zip(split(nav.q), ends, strict=True))
    if not spin:
        return starts, ends, means
    t = running(body.t)
    spun = exp(scale(t - body.t, spin))
    return multiply(spun, starts), multiply(exp(scale(t, spin)), ends), means and multiply(spun, means)


def thrust_of(q: Quaternion, body: Body) -> VelocityIncrement:
    """Return the velocity increment of ``body`` from attitude ``q`` on."""
    return VelocityIncrement(
        body.t, rotate(q, body.dv), rotate(q, divide_or_zero(body.t, body.displacement)) if body.displacement else ()
    )


def unit(nav: Nav) -> Nav:
    """Return navigation with a quaternion of length one; products of many drift by a rounding error each."""
    return nav._replace(q=jnp.stack(normalize(split(nav.q)), -1))


def _block(m: int, nav: Nav, u: Forcing | None, given: BodyInterval) -> tuple[Nav, ErrorInputs, Callable[..., Any]]:
    """Return the states after all intervals (n,) of m samples, the path, and the function of states inside them."""
    whole, omega, force = given
    spin, push = map(split, u) if u else ((), ())
    q_starts, q_ends, q_means = attitudes(nav, spin, whole)
    lat, lon, h = split(nav.pos)
    zero, t = jnp.zeros_like(lat), running(whole.t)
    # about a constant latitude: the derivative by it comes from the series' variable
    centre = lax.stop_gradient(lat)
    change = partial(increment, series(surface, centre), (spin, push), m)
    start = Level(split(nav.vel), lat - centre, zero, h, (zero, zero, zero))
    thrust = thrust_of(q_starts, whole)
    ends = by_scan(change, start, thrust)

    def state(level: Level, q: Any, t: Any, omega: Any, force: Any) -> Nav:
        q = multiply(exp_small_angle(scale(-1.0, level.turn)), q)
        return after(nav, nav.t + t, (centre + level.north, lon + level.east, level.h), level.vel, q, omega, force)

    points = state(ends, q_ends, t, omega, force)
    starts = jax.tree.map(before, start, ends)

    def inside(i: jax.Array, part: BodyInterval) -> Nav:
        """After the first samples, ``part``, of the intervals i (w,)."""
        level, q, begin = jax.tree.map(lambda a: a[i], (starts, q_starts, t - whole.t))
        # in a loop, where the compiler works out every number once: fused into its users each would be made many times
        thrust = thrust_of(q, part.body)
        level = lax.map(remat(lambda x: jax.tree.map(jnp.add, x[0], change(*x))), (level, thrust))
        q = multiply(q, part.body.q)
        q = multiply(exp_small_angle(scale(part.body.t, spin)), q) if spin else q
        return unit(state(level, q, begin + part.body.t, part.omega, part.force))

    if m == 1:
        return points, sampled(nav, unit(points), split(points.q), force), inside
    middle = exp_small_angle(scale(-0.5, add(starts.turn, ends.turn)))
    C = to_dcm(multiply(middle, normalize(q_means)))
    half = normalize(whole.mean)
    gyro = divide_or_zero(whole.t, scale(2.0, whole.q[1:]))
    accel = divide_or_zero(whole.t, rotate(conjugate(half), whole.dv))
    force = rotate(middle, divide_or_zero(whole.t, thrust.dv))
    path = ErrorInputs(unit(points), C, *(jnp.stack(v, -1) for v in (force, gyro, accel)))
    return points, path, inside


def _samples(nav: Nav, u: Forcing | None, imu: Imu, stride: int, keep: jax.Array) -> tuple[Nav, ErrorInputs]:
    """Return the states after the samples ``keep`` (w,) and the path, by intervals of one sample.

    They are corrected in a loop over up to `INTERVAL` rows of them.
    """
    k, flat = imu.dt.size, lambda a: a.reshape(-1, *a.shape[2:])

    def block(nav: Nav, imu: Any) -> Any:
        rows = max(d for d in range(1, INTERVAL + 1) if imu.dt.size % d == 0)
        # the state carries the rates before this epoch's bias correction: one sample in an epoch sees that difference
        x, last = readings(remove_errors(nav, imu), nav.omega, nav.force, rows)
        x, whole = jax.tree.map(lambda a: a.T.reshape(-1), (x, singles(x, last)))
        points, path, _ = _block(1, nav, u, BodyInterval(whole, x.omega, x.force))
        return unit(jax.tree.map(lambda a: a[-1], points)), (points, path)

    if k <= BLOCK:
        points, path = block(nav, imu)[1]
    else:
        blocks = jax.tree.map(lambda a: filled(a, BLOCK).reshape(-1, BLOCK, *a.shape[1:]), imu)
        points, path = jax.tree.map(flat, lax.scan(block, nav, blocks)[1])
    path = thin(jax.tree.map(lambda a: a[:k], path), imu.dt, stride)
    return unit(jax.tree.map(lambda a: a[keep], points)), path


def remove_errors(nav: Nav, imu: Imu) -> Imu:
    """Return samples without the errors of the sensors."""
    return corrected(imu, nav)


def filled(a: jax.Array, size: int) -> jax.Array:
    """(k, ...) up to a multiple of ``size`` by zeros, which are padding; as it is where one block holds all."""
    k = a.shape[0]
    return a if k <= size else jnp.pad(a, ((0, -k % size), *[(0, 0)] * (a.ndim - 1)))


def _intervals(
    m: int, nav: Nav, u: Forcing | None, whole: BodyInterval, parts: BodyInterval, place: jax.Array
) -> tuple[Nav, ErrorInputs]:
    """Return the states after the first samples, ``parts`` (w,), of the intervals ``place``, and the path of all (n,).

    More intervals than a block holds are a multiple of that.
    """
    n, size = whole.body.t.size, BLOCK // m

    def block(nav: Nav, whole: Tree, i: Any) -> Any:
        _, path, inside = _block(m, nav, u, whole)
        return jax.tree.map(lambda a: a[-1], path.nav), path, inside(jnp.clip(i, 0, whole.body.t.size - 1), parts)

    if n <= size:
        _, path, kept = block(nav, whole, place)
        return kept, path

    def one(carry: Tree, whole: Tree) -> Any:
        nav, kept, i = carry
        nav, path, here = block(nav, whole, i)
        mine = (i >= 0) & (i < size)
        kept = jax.tree.map(lambda a, b: jnp.where(mine.reshape(-1, *[1] * (a.ndim - 1)), a, b), here, kept)
        return (nav, kept, i - size), path

    kept = jax.tree.map(lambda a: jnp.broadcast_to(a, (place.size, *a.shape)), nav)
    blocks = jax.tree.map(lambda a: a.reshape(-1, size), whole)
    (_, kept, _), path = lax.scan(one, (nav, kept, place), blocks)
    return kept, jax.tree.map(lambda a: a.reshape(n, *a.shape[2:]), path)


def preintegrate(imu: Imu, last: tuple[Any, Any], stride: int, keep: jax.Array) -> Imu | SummedIntervals:
    """Compute the part of `propagate` that needs no state, of samples (k,); ``last``: rate and force before them.

    For a stride of 2 to 10, the sums over intervals of so many samples, and up to the samples ``keep`` (w,). They have
    the biases in them, which are taken out in first order. Else the samples themselves.
    """
    if not 2 <= stride <= INTERVAL:
        return imu
    whole, parts, place = sums(imu, *last, stride, keep)
    return SummedIntervals(jnp.stack(jax.tree.leaves(whole)), jnp.stack(jax.tree.leaves(parts)), place)


def propagate(
    nav: Nav, u: Forcing | None, imu: Imu | SummedIntervals, stride: int = 1, keep: jax.Array | None = None
) -> tuple[Nav, ErrorInputs]:
    """Navigate through k samples (``imu`` fields (k, ...)); ``u`` is the observer's feedback, None without one.

    Returns the last state, or those after the samples ``keep`` (w,), and the path at every ``stride`` samples: where it
    ends, and its means for the error dynamics. ``pos`` is (lat rad, lon rad, h m), ``vel`` is ENU m/s, ``q`` takes body
    FRD to ENU. A sample of dt = 0 changes nothing. ``imu`` may be the result of `preintegrate`.
    """
    size = BLOCK // stride if stride <= INTERVAL else 1
    if isinstance(imu, SummedIntervals):
        n = imu.whole.shape[1]
        whole = filled(imu.whole.T, size).T
        rows, k = jnp.concatenate([whole, imu.parts], 1), whole.shape[1]
        clean = unbiased(rows, *as_biases(rows, nav))
        whole, parts = jax.tree.map(lambda a: a[:k], clean), jax.tree.map(lambda a: a[k:], clean)
        out, path = _intervals(stride, nav, u, whole, parts, imu.place)
        return out, jax.tree.map(lambda a: a[:n], path)
    k = imu.dt.size
    at = jnp.array([k - 1]) if keep is None else keep
    if 2 <= stride <= INTERVAL:
        samples = jax.tree.map(lambda a: filled(a, size * stride), remove_errors(nav, imu))
        out, path = _intervals(stride, nav, u, *sums(samples, nav.omega, nav.force, stride, at))
        path = jax.tree.map(lambda a: a[: k // stride], path)
    else:
        out, path = _samples(nav, u, imu, stride, at)
    return jax.tree.map(lambda a: a[0], out) if keep is None else out, path
