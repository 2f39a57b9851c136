"""Errors of inertial quaternion navigation: x = (dr m, dp m/s, dtheta rad, ...), C_est = exp([dtheta x]) C.

dr and dp are in N, dtheta in I (see `jaxnav.strapdown.inertial_quaternion`), and dp = dv + u x dr is the error of
p = v + u x r, the velocity in inertial space (FWEKF paper, eq. 13). The paper's eq. 15 is missing; it follows from
differentiating p. With v' = g(r) - 2 u x v + f_N and f_N = A C f,

    p' = v' + u x v = g(r) + u x (u x r) - u x p + f_N,

in which gravity's centrifugal part cancels the double cross product up to a constant. So, with a wrong C and
sensor errors,

    dr' = dp - u x dr
    dp' = -u x dp - A [f_I x] dtheta + (dg/dr + [u x]^2) dr - A C b_a
    dtheta' = -C b_g                                              (14)

Coriolis and centrifugal acceleration have become one term, which is why p is the state. The simple form, the paper's,
has no gradient of gravitation, dg/dr + [u x]^2, which is 1.5e-6 / s^2 across and 3e-6 / s^2 along the vertical.
"""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxnav.maths import earth, rotations
from jaxnav.states.motion import A, P, V
from jaxnav.states.transition import Blocks
from jaxnav.strapdown.errors import tangent_frame as tangent_errors
from jaxnav.strapdown.inertial_quaternion import AXES, earth_rate, turned
from jaxnav.strapdown.tangent_frame import from_ecef, gravity
from jaxnav.types import ErrorInputs, Nav


def retract(nav: Nav, x: jax.Array) -> Nav:
    """Position and velocity of the truth, if ``x`` (n,) is the error of ``nav``."""
    dv = x[V] - jnp.cross(earth_rate(nav.origin), x[P])
    return nav._replace(pos=nav.pos - x[P], vel=nav.vel - dv)


def velocity_axes(nav: Nav) -> jax.Array:
    """Return the rotation from the axes of attitude (I) to those of position and velocity (N), (3, 3)."""
    return rotations.to_dcm(turned(nav.origin, nav.t))


def dynamics(point: ErrorInputs, form: Literal["full", "simple"]) -> Blocks:
    """Return the 3x3 blocks of F in x' = F x, at one point of the path."""
    origin = point.nav.origin
    to_n = velocity_axes(point.nav)
    spin = rotations.skew(earth_rate(origin))
    blocks = {
        ("position", "position"): -spin,
        ("position", "velocity"): jnp.eye(3, dtype=spin.dtype),
        ("velocity", "velocity"): -spin,
        ("velocity", "attitude"): -to_n @ rotations.skew(point.force),
        ("velocity", "accel"): -to_n @ point.C,
        ("attitude", "gyro"): -point.C,
    }
    if form == "simple":
        return blocks
    C_en = from_ecef(origin).T @ AXES.T
    gradient = jax.jacfwd(gravity)(earth.lla_to_ecef(origin.lla) + C_en @ point.nav.pos)
    return blocks | {("velocity", "position"): C_en.T @ gradient @ C_en + spin @ spin}


def enu_rows(nav: Nav, local: Nav) -> jax.Array:
    """d(error in local level) / dx, (9, 9); ``local`` is ``nav`` in local level."""
    J = tangent_errors.enu_rows(local)
    to_n, spin = velocity_axes(nav), rotations.skew(earth_rate(nav.origin))
    flat = jnp.eye(9, dtype=spin.dtype)  # x -> errors in the tangent frame
    flat = flat.at[P, P].set(AXES.T).at[V, V].set(AXES.T).at[A, A].set(AXES.T @ to_n).at[V, P].set(-AXES.T @ spin)
    return J @ flat
