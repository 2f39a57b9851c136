"""Errors of local level navigation: x = (dp ENU m, dv ENU, phi ENU, ...), C_est = exp([phi x]) C_true.

Full form: every first-order term of the mechanization (Groves 2013, section 14.2.4, in ENU and with the attitude
error to the left). Simplified form: the GPID paper's eqs. 9-13, that is the specific force, the levelling by velocity
and the kinematics only, with all noise of a block at its end (eq. 29).
"""

from typing import Any, Literal

import jax
import jax.numpy as jnp

from jaxnav.maths import earth, rotations
from jaxnav.states.motion import P, V
from jaxnav.states.transition import Blocks
from jaxnav.types import ErrorInputs, Nav


def retract(nav: Nav, x: jax.Array) -> Nav:
    """Position and velocity of the truth, if ``x`` (n,) is the error of ``nav``."""
    return nav._replace(pos=earth.move(nav.pos, -x[P]), vel=nav.vel - x[V])


def dynamics(point: ErrorInputs, form: Literal["full", "simple"]) -> Blocks:
    """Return the 3x3 blocks of F in x' = F x, at one point of the path."""
    lat, _, h = jnp.unstack(point.nav.pos)
    vel = point.nav.vel
    ve, vn, vu = jnp.unstack(vel)
    meridian, prime = earth.radii(lat)
    rn, re, tan = meridian + h, prime + h, jnp.tan(lat)
    zero = jnp.zeros_like(lat)

    def block(*rows: Any) -> jax.Array:
        return jnp.stack([jnp.stack([jnp.asarray(e, lat.dtype) for e in row]) for row in rows])

    level = block((0, 1 / rn, 0), (-1 / re, 0, 0), (-tan / re, 0, 0))  # minus d(w_en)/dv
    blocks = {
        ("position", "velocity"): jnp.eye(3, dtype=lat.dtype),
        ("velocity", "attitude"): -rotations.skew(point.force),
        ("attitude", "velocity"): level,
        ("velocity", "accel"): -point.C,
        ("attitude", "gyro"): -point.C,
    }
    if form == "simple":
        return blocks
    w_ie, w_en = earth.earth_rate(lat), earth.transport_rate(lat, h, vel)
    # how the rates change with position, per metre north and per metre up
    ie_north = earth.RATE / rn * jnp.stack([zero, -jnp.sin(lat), jnp.cos(lat)])
    en_north = jnp.stack([zero, zero, ve / (re * rn) * (1 + tan**2)])
    en_up = jnp.stack([vn / rn**2, -ve / re**2, -ve * tan / re**2])
    columns = lambda north, up: jnp.stack([jnp.zeros(3, lat.dtype), north, up], axis=1)
    gravity = block((0, 0, 0), (0, 0, 0), (0, 0, 2 * earth.gravity(lat, zero) / earth.A))
    return blocks | {
        ("position", "position"): block(
            (vu / re - vn * tan / rn, ve * tan / rn, -ve / re), (0, vu / rn, -vn / rn), (0, 0, 0)
        ),
        ("velocity", "position"): rotations.skew(vel) @ columns(2 * ie_north + en_north, en_up) + gravity,
        ("velocity", "velocity"): -rotations.skew(2 * w_ie + w_en) - rotations.skew(vel) @ level,
        ("attitude", "position"): -columns(ie_north + en_north, en_up),
        ("attitude", "attitude"): -rotations.skew(w_ie + w_en),
    }
