"""Strapdown navigation in the tangent frame, fixed to the Earth where and when navigation began (GIP-KF paper, II).

    C' = C [w_ib x] - [w x] C,    v' = C f + g(r) - 2 w x v,    r' = v        (16, 17)

Axes as in the paper: x horizontal at the azimuth A of `Origin`, y up, z horizontal to the right; with A = 0 they are
north, up, east. ``pos`` is m from the origin, ``vel`` m/s, ``q`` takes body FRD to these axes; w is the Earth's rate.

Corrections to the paper. Eqs. 1 and 3: Z_e has sin(latitude), not sin(longitude). Eqs. 4-8 turn through axes at the
vehicle that are linear in its way from the origin; here the rotations are exact. Eq. 6 (and 8) turns by -A, against
eq. 20, which is the one that fits the axes: C_n0^t is [[cA, sA, 0], [0, 0, -1], [-sA, cA, 0]] from north, east, down.
The paper rotates gravity by the constant C_e^t alone; it must also follow the ellipsoid's normal along the way.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav.maths import earth, rotations
from jaxnav.maths.components import split
from jaxnav.strapdown.increments import increments, trace
from jaxnav.types import ErrorInputs, Forcing, Imu, Nav, Origin, Tree


def from_enu(azimuth: jax.Array) -> jax.Array:
    """C_n0^t, (3, 3): ENU at the origin -> tangent frame; eq. 6 in the sense of eq. 20."""
    s, c = jnp.sin(azimuth), jnp.cos(azimuth)
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    return jnp.stack([jnp.stack([s, c, zero]), jnp.stack([zero, zero, one]), jnp.stack([c, -s, zero])])


def from_ecef(origin: Origin) -> jax.Array:
    """C_e^t, (3, 3): ECEF -> tangent frame."""
    return from_enu(origin.azimuth) @ earth.axes(origin.lla[0], origin.lla[1]).T


def earth_rate(origin: Origin) -> jax.Array:
    """Rotation of the Earth in the tangent frame, rad/s, (3,): eq. 20."""
    s, c = jnp.sin(origin.lla[0]), jnp.cos(origin.lla[0])
    return earth.RATE * jnp.stack([jnp.cos(origin.azimuth) * c, s, -jnp.sin(origin.azimuth) * c])


def gravity(r: jax.Array) -> jax.Array:
    """Gravity at an ECEF position (3,) m, in ECEF m/s^2: `earth.gravity` down the ellipsoid's normal there.

    The normal is Bowring's first, without iteration and without angles: 1e-11 rad near the ground.
    """
    x, y, z = r
    p = jnp.sqrt(x * x + y * y)
    tan_beta = z / ((1 - earth.F) * p)
    cos_beta = 1 / jnp.sqrt(1 + tan_beta**2)
    sin_beta = tan_beta * cos_beta
    rise = z + earth.E2 / (1 - earth.F) * earth.A * sin_beta**3
    run = p - earth.E2 * earth.A * cos_beta**3
    length = jnp.sqrt(rise**2 + run**2)
    s, c = rise / length, run / length
    h = p * c + z * s - earth.A * jnp.sqrt(1 - earth.E2 * s * s)
    up = jnp.stack([c * x / p, c * y / p, s])
    return -earth.gravity(jnp.arctan2(rise, run), h) * up


def enter(nav: Nav) -> Nav:
    """Local level navigation in the tangent frame of its origin (eqs. 1-9)."""
    C = from_ecef(nav.origin)
    turn = C @ earth.axes(nav.pos[0], nav.pos[1])  # ENU there -> tangent frame
    return nav._replace(
        pos=C @ (earth.lla_to_ecef(nav.pos) - earth.lla_to_ecef(nav.origin.lla)),
        vel=turn @ nav.vel,
        q=rotations.normalize(rotations.multiply(rotations.from_dcm(turn), nav.q)),
    )


def leave(nav: Nav) -> Nav:
    """Navigation in the tangent frame as local level navigation, the inverse of `enter`."""
    C = from_ecef(nav.origin)
    lla = earth.ecef_to_lla(earth.lla_to_ecef(nav.origin.lla) + C.T @ nav.pos)
    turn = earth.axes(lla[0], lla[1]).T @ C.T
    q = rotations.normalize(rotations.multiply(rotations.from_dcm(turn), nav.q))
    return nav._replace(pos=lla, vel=turn @ nav.vel, q=q)


def propagate(
    nav: Nav, u: Forcing | None, imu: Imu, stride: int = 1, keep: jax.Array | None = None
) -> tuple[Nav, ErrorInputs]:
    """Navigate through k samples (``imu`` fields (k, ...)); ``u`` is the observer's feedback, None without one.

    Returns the last state, or those after the samples ``keep`` (w,), and the path at every ``stride`` samples. A sample
    of dt = 0 changes nothing. Second order in the sample time.
    """
    inc = increments(nav, imu)
    spin, push = u or (0.0, 0.0)
    C_et, start, w = from_ecef(nav.origin), earth.lla_to_ecef(nav.origin.lla), earth_rate(nav.origin)

    def sample(carry: Tree, x: Tree) -> Tree:
        q, v, r = carry
        dt, theta, dv_b = x
        turn = w * dt
        thrust = rotations.to_dcm(q) @ dv_b
        lag = jnp.cross(turn, thrust)  # the frame turns under the thrust
        thrust = thrust - lag / 2 + jnp.cross(turn, lag) / 12
        # gravity turns with the way travelled, so that its place in the sample counts in first order
        g = C_et @ gravity(start + (r + 0.5 * dt * v) @ C_et)
        mid = v + 0.5 * (thrust + dt * (g - jnp.cross(2 * w, v)))
        dv = thrust + dt * (g - jnp.cross(2 * w, mid) + push)
        q = rotations.normalize(
            rotations.multiply(rotations.exp(spin * dt - turn), rotations.multiply(q, rotations.exp(theta)))
        )
        out = (q, v + dv, r + dt * (v + 0.5 * dv))
        return out, out

    _, (q, vel, pos) = lax.scan(
        sample, (nav.q, nav.vel, nav.pos), (inc.dt, jnp.stack(inc.theta, -1), jnp.stack(inc.dv, -1))
    )
    return trace(nav, inc, split(pos), split(vel), split(q), stride, keep)
