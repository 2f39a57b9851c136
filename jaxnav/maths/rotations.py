"""Quaternions (scalar first, Hamilton, ``q_ab`` takes b to a), direction cosines and angles, for one rotation each.

Gradients are finite everywhere, at zero rotation included: every norm is guarded by a double ``where``.
"""

import jax
import jax.numpy as jnp
import numpy as np

ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # NED -> ENU and back: equal to its inverse


def _table(shape: tuple[int, ...], entries: str) -> np.ndarray:
    """Return a constant array from its entries, such as "012+" for 1 at [0, 1, 2] and "012-" for -1."""
    table = np.zeros(shape)
    for entry in entries.split():
        table[tuple(map(int, entry[:-1]))] = 1.0 if entry.endswith("+") else -1.0
    return table


# Products with constant tables: one equation of a compiled program where the components take twenty.
SKEW = _table((3, 3, 3), "012- 021+ 102+ 120- 201- 210+").reshape(9, 3)
"""[v x] by (row, column), component of v."""
PRODUCT = _table(
    (4, 4, 4), "000+ 011- 022- 033-  101+ 110+ 123+ 132-  202+ 220+ 231+ 213-  303+ 330+ 312+ 321-"
).reshape(4, 16)
"""Hamilton's product p q by component, (component of p, component of q)."""
DCM = _table(
    (3, 3, 4, 4),
    "0000+ 0011+ 0022- 0033-  1100+ 1111- 1122+ 1133-  2200+ 2211- 2222- 2233+ "
    "0112+ 0121+ 0103- 0130-  0213+ 0231+ 0202+ 0220+  1012+ 1021+ 1003+ 1030+ "
    "1223+ 1232+ 1201- 1210-  2013+ 2031+ 2002- 2020-  2123+ 2132+ 2101+ 2110+",
).reshape(9, 16)
"""Direction cosines by (row, column), (component of q, component of q)."""


def skew(v: jax.Array) -> jax.Array:
    """[v x], (3, 3): ``skew(a) @ b = a x b``."""
    return jnp.matmul(SKEW, v).reshape(3, 3)


def axial(M: jax.Array) -> jax.Array:
    """Return the mean of a x b, (3,), for vectors of mean product M = E[a b'] (3, 3)."""
    return jnp.matmul(-SKEW.T, M.reshape(9))


def multiply(p: jax.Array, q: jax.Array) -> jax.Array:
    """Quaternion product: first q, then p."""
    return jnp.matmul(PRODUCT, jnp.outer(p, q).reshape(16))


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
    return jnp.matmul(DCM, jnp.outer(q, q).reshape(16)).reshape(3, 3)


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
