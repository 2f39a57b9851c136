"""Errors of tangent frame navigation: x = (dr m, dv m/s, phi rad, ...), C_est = exp([phi x]) C_true.

    dr' = dv,    dv' = -[f x] phi - 2 w x dv + dg/dr dr - C b_a,    phi' = -w x phi - C b_g

all in the axes of the frame. The simple form has no gravity gradient: that is the GIP-KF paper's eq. 22. (Its eqs. 18
and 19 print -[f x] phi together with -C dw: one of them has the wrong sign with either definition of phi; eq. 19 lacks
the minus of the Coriolis term, which 18 and 22 have.)
"""

from typing import Literal

import jax
import jax.numpy as jnp

from jaxnav.maths import earth, rotations
from jaxnav.states.motion import A, P, V
from jaxnav.states.transition import Blocks
from jaxnav.strapdown.tangent_frame import earth_rate, from_ecef, gravity
from jaxnav.types import ErrorInputs, Nav


def retract(nav: Nav, x: jax.Array) -> Nav:
    """Position and velocity of the truth, if ``x`` (n,) is the error of ``nav``."""
    return nav._replace(pos=nav.pos - x[P], vel=nav.vel - x[V])


def dynamics(point: ErrorInputs, form: Literal["full", "simple"]) -> Blocks:
    """Return the 3x3 blocks of F in x' = F x, at one point of the path."""
    origin = point.nav.origin
    spin = rotations.skew(earth_rate(origin))
    blocks = {
        ("position", "velocity"): jnp.eye(3, dtype=point.force.dtype),
        ("velocity", "velocity"): -2 * spin,
        ("velocity", "attitude"): -rotations.skew(point.force),
        ("velocity", "accel"): -point.C,
        ("attitude", "attitude"): -spin,
        ("attitude", "gyro"): -point.C,
    }
    if form == "simple":
        return blocks
    C = from_ecef(origin)
    gradient = jax.jacfwd(gravity)(earth.lla_to_ecef(origin.lla) + C.T @ point.nav.pos)
    return blocks | {("velocity", "position"): C @ gradient @ C.T}


def enu_rows(local: Nav) -> jax.Array:
    """d(error in local level) / d(error in the tangent frame), (9, 9), at local level navigation.

    ENU at an estimate that is dp away from the truth is turned by a small angle, Theta dp: attitude and velocity in
    ENU see that, in the tangent frame they do not.
    """
    lat, _, h = local.pos
    C = earth.axes(lat, local.pos[1]).T @ from_ecef(local.origin).T
    meridian, prime = earth.radii(lat)
    zero = jnp.zeros_like(lat)
    east, north = 1 / (prime + h), 1 / (meridian + h)
    Theta = jnp.stack([jnp.stack([zero, east, east * jnp.tan(lat)]), jnp.stack([-north, zero, zero]), jnp.zeros(3)], 1)
    J = jnp.eye(9, dtype=C.dtype).at[P, P].set(C).at[V, V].set(C).at[A, A].set(C)
    return J.at[V, P].set(rotations.skew(local.vel) @ Theta @ C).at[A, P].set(-Theta @ C)
