"""Quaternions (scalar first, Hamilton, ``q_ab`` takes b to a), direction cosines and angles, for one rotation each.

Gradients are finite everywhere, at zero rotation included: every norm is guarded by a double ``where``.
"""

import jax
import jax.numpy as jnp
import numpy as np

ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # NED -> ENU and back: equal to its inverse


def skew(v: jax.Array) -> jax.Array:
    """[v x], (3, 3): ``skew(a) @ b = a x b``."""
    x, y, z = jnp.unstack(v)
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def multiply(p: jax.Array, q: jax.Array) -> jax.Array:
    """Quaternion product: first q, then p."""
    a, b, c, d = jnp.unstack(p)
    e, f, g, h = jnp.unstack(q)
    return jnp.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ]
    )


def conjugate(q: jax.Array) -> jax.Array:
    """Return the inverse rotation of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def exp(phi: jax.Array) -> jax.Array:
    """Rotation vector (rad, (3,)) -> unit quaternion; below 1e-2 rad by a series that is exact to 1e-17."""
    n2 = phi @ phi
    small = n2 < 1e-4
    n = jnp.sqrt(jnp.where(small, 1.0, n2))
    cos = jnp.where(small, 1 - n2 / 8 * (1 - n2 / 48 * (1 - n2 / 120)), jnp.cos(n / 2))
    sinc = jnp.where(small, 0.5 * (1 - n2 / 24 * (1 - n2 / 80 * (1 - n2 / 168))), jnp.sin(n / 2) / n)
    return jnp.concatenate([cos[None], sinc * phi])


def log(q: jax.Array) -> jax.Array:
    """Return the rotation vector, rad, (3,), of a unit quaternion, of length at most pi: the inverse of `exp`."""
    q = jnp.where(q[0] < 0, -q, q)
    s2 = q[1:] @ q[1:]
    small = s2 < 1e-4
    s = jnp.sqrt(jnp.where(small, 1.0, s2))
    # arcsin(s)/s = 1 + s^2/6 + 3 s^4/40 + 15 s^6/336 + 105 s^8/3456, and the angle is twice the arc
    series = 2 * (1 + s2 / 6 * (1 + s2 * 9 / 20 * (1 + s2 * 25 / 42 * (1 + s2 * 49 / 72))))
    return jnp.where(small, series, 2 * jnp.arctan2(s, jnp.where(small, 1.0, q[0])) / s) * q[1:]


def normalize(q: jax.Array) -> jax.Array:
    """Return a quaternion of unit length, which integration has changed."""
    return q / jnp.sqrt(q @ q)


def to_dcm(q: jax.Array) -> jax.Array:
    """Return C_ab, (3, 3), of a unit quaternion q_ab: ``C_ab @ v_b = v_a``."""
    w, x, y, z = jnp.unstack(q)
    return jnp.stack(
        [
            jnp.stack([w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]),
        ]
    )


def from_dcm(C: jax.Array) -> jax.Array:
    """C_ab -> q_ab with a positive scalar part, by the largest of the four components (no loss near 180 degrees)."""
    t = jnp.stack(
        [
            1 + C[0, 0] + C[1, 1] + C[2, 2],
            1 + C[0, 0] - C[1, 1] - C[2, 2],
            1 - C[0, 0] + C[1, 1] - C[2, 2],
            1 - C[0, 0] - C[1, 1] + C[2, 2],
        ]
    )
    x, y, z = C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]
    a, b, c = C[1, 0] + C[0, 1], C[0, 2] + C[2, 0], C[2, 1] + C[1, 2]
    rows = jnp.stack(
        [jnp.stack([t[0], x, y, z]), jnp.stack([x, t[1], a, b]), jnp.stack([y, a, t[2], c]), jnp.stack([z, b, c, t[3]])]
    )
    q = normalize(rows[jnp.argmax(t)])
    return jnp.where(q[0] < 0, -q, q)


def from_rph(rph: jax.Array) -> jax.Array:
    """Roll, pitch, heading (rad; FRD against NED, applied heading, pitch, roll) -> C_nb, FRD -> **ENU**, (3, 3)."""
    (sr, sp, sh), (cr, cp, ch) = jnp.sin(rph), jnp.cos(rph)
    ned = jnp.stack(
        [
            jnp.stack([cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh]),
            jnp.stack([cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch]),
            jnp.stack([-sp, sr * cp, cr * cp]),
        ]
    )
    return jnp.asarray(ENU_NED) @ ned


def to_rph(C: jax.Array) -> jax.Array:
    """C_nb (FRD -> ENU) -> roll, pitch, heading, rad, (3,); heading in (-pi, pi]. Undefined at pitch of 90 degrees."""
    ned = ENU_NED @ C
    pitch = jnp.arctan2(-ned[2, 0], jnp.hypot(ned[0, 0], ned[1, 0]))
    return jnp.stack([jnp.arctan2(ned[2, 1], ned[2, 2]), pitch, jnp.arctan2(ned[1, 0], ned[0, 0])])
