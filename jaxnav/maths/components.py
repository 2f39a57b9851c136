"""Vectors and quaternions as tuples of their components: scalars in a scan, (k,) arrays over samples.

`vmap` turns a scan with a carry of scalars into long loops over a batch, several times faster than
arrays of three; and an array over samples is one loop for each component. No function here is transcendental.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

Vector = tuple[Any, ...]  # of three
Quaternion = tuple[Any, ...]  # of four

remat = partial(jax.checkpoint, prevent_cse=False)
"""Of a loop's step: a gradient works its inside out once more, which takes less time than to keep all of it."""


def split(a: Any) -> tuple[jax.Array, ...]:
    """Return the components along the last axis."""
    return tuple(jnp.unstack(jnp.asarray(a), axis=-1))


def add(*vectors: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the sum, component by component."""
    return tuple(sum(c[1:], c[0]) for c in zip(*vectors, strict=True))


def scale(s: Any, v: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return s v."""
    return tuple(s * c for c in v)


def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Quaternion product: first q, then p."""
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


@jax.custom_jvp
def products(first: Quaternion, steps: Quaternion) -> Quaternion:
    """After each of the rotations ``steps``, components (k,), from ``first`` on; all of unit length.

    A scan, but its derivative is a sum: d q_k = (d first first* + sum_j q_(j-1) d step_j q_j*) q_k over j <= k, so that
    a gradient walks back through no loop.
    """

    def turn(q: Quaternion, step: Quaternion) -> tuple[Quaternion, Quaternion]:
        q = multiply(q, step)
        return q, q

    return lax.scan(turn, first, steps)[1]


@products.defjvp
def _products_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Quaternion, Quaternion]:
    (first, steps), (d_first, d_steps) = primals, tangents
    q = products(first, steps)
    start = tuple(before(a, b) for a, b in zip(first, q, strict=True))
    turned = multiply(multiply(start, d_steps), conjugate(q))
    offset = multiply(d_first, conjugate(first))
    return q, multiply(tuple(a + jnp.cumsum(b) for a, b in zip(offset, turned, strict=True)), q)


def conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def rotate(q: Quaternion, v: Vector) -> Vector:
    """C(q) v, in fewer products than by the matrix."""
    u = q[1:]
    t = scale(2.0, cross(u, v))
    return add(v, scale(q[0], t), cross(u, t))


def exp_small_angle(phi: Vector) -> Quaternion:
    """Return the rotation by a small vector phi, to fifth order: 1e-11 at 0.1 rad."""
    n2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    return (1 - n2 / 8 * (1 - n2 / 48), *scale(0.5 * (1 - n2 / 24 * (1 - n2 / 80)), phi))


def exp(phi: Vector) -> Quaternion:
    """Return the rotation by phi, to 1e-13 up to half a turn and 1e-9 up to a whole one.

    By a series of a quarter of it, squared twice.
    """
    eighth = scale(0.125, phi)
    n2 = eighth[0] * eighth[0] + eighth[1] * eighth[1] + eighth[2] * eighth[2]
    cos = 1 - n2 / 2 * (1 - n2 / 12 * (1 - n2 / 30 * (1 - n2 / 56 * (1 - n2 / 90))))
    sinc = 1 - n2 / 6 * (1 - n2 / 20 * (1 - n2 / 42 * (1 - n2 / 72 * (1 - n2 / 110))))
    w, u = cos, scale(sinc, eighth)
    for _ in range(2):
        w, u = 2 * w * w - 1, scale(2 * w, u)
    return (w, *u)


def normalize(q: Quaternion) -> Quaternion:
    """Return a quaternion of unit length."""
    return scale(1 / jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), q)


def to_dcm(q: Quaternion) -> jax.Array:
    """(..., 3, 3) from unit quaternions."""
    w, x, y, z = q
    rows = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def running(a: jax.Array) -> jax.Array:
    """Return the sums of a (k, ...) over its rows up to each, same shape.

    By a scan, at a fraction of the cost of `jnp.cumsum` in a batch, which is a reduction over windows there.
    """

    def step(total: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        total = total + x
        return total, total

    return lax.scan(step, jnp.zeros_like(a[0]), a)[1]


def before(first: Any, a: jax.Array) -> jax.Array:
    """Return a component at the start of each sample, from that at the ends (k,) and the first start."""
    return jnp.concatenate([jnp.asarray(first)[None], a[:-1]])
