"""Errors of local level navigation: x = (dp ENU m, dv ENU, phi ENU[, b_g, b_a body]), C_est = exp([phi x]) C_true.

Full form: every first-order term of the mechanization (Groves 2013, section 14.2.4, in ENU and with the attitude
error to the left). Simplified form: the GPID paper's eqs. 9-13, that is the specific force, the levelling by velocity
and the kinematics only, with all noise of a block at its end (eq. 29).
"""

from functools import cache, partial
from typing import Literal

import jax
import jax.numpy as jnp

from jaxnav.filters.core import ErrorModel
from jaxnav.maths import earth, rotations
from jaxnav.measurements import GNSS, Kinematics, Measurement, stack
from jaxnav.states.names import A, P, V, prior_sd
from jaxnav.states.transition import absorb, discretize, retract_common
from jaxnav.types import Drive, Nav, Noise, Path, Prior


def retract(nav: Nav, x: jax.Array) -> Nav:
    """The truth, if ``x`` (n,) is the error of ``nav``."""
    nav = retract_common(nav, x)
    return nav._replace(pos=earth.move(nav.pos, -x[P]), vel=nav.vel - x[V])


def dynamics(point: Path, form: Literal["full", "simple"]) -> dict[tuple[str, str], jax.Array]:
    """The 3x3 blocks of F in x' = F x, at one point of the path."""
    lat, _, h = jnp.unstack(point.nav.pos)
    vel = point.nav.vel
    ve, vn, vu = jnp.unstack(vel)
    meridian, prime = earth.radii(lat)
    rn, re, tan = meridian + h, prime + h, jnp.tan(lat)
    zero = jnp.zeros_like(lat)

    def block(*rows):
        return jnp.stack([jnp.stack([jnp.asarray(e, lat.dtype) for e in row]) for row in rows])

    level = block((0, 1 / rn, 0), (-1 / re, 0, 0), (-tan / re, 0, 0))  # minus d(w_en)/dv
    blocks = {
        ("position", "velocity"): jnp.eye(3, dtype=lat.dtype),
        ("velocity", "attitude"): -rotations.skew(point.force),
        ("attitude", "velocity"): level,
        ("velocity", "accel_bias"): -point.C,
        ("attitude", "gyro_bias"): -point.C,
    }
    if form == "simple":
        return blocks
    w_ie, w_en = earth.earth_rate(lat), earth.transport_rate(lat, h, vel)
    # how the rates change with position, per metre north and per metre up
    ie_north = earth.RATE / rn * jnp.stack([zero, -jnp.sin(lat), jnp.cos(lat)])
    en_north = jnp.stack([zero, zero, ve / (re * rn) * (1 + tan**2)])
    en_up = jnp.stack([vn / rn**2, -ve / re**2, -ve * tan / re**2])
    columns = lambda north, up: jnp.stack([jnp.zeros(3, lat.dtype), north, up], axis=1)  # noqa: E731
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


def kinematics(nav: Nav, n: int) -> Kinematics:
    """Position, velocity and attitude in ENU, and how the error state moves them."""
    eye = jnp.eye(n, dtype=nav.vel.dtype)
    return Kinematics(nav.pos, nav.vel, rotations.to_dcm(nav.q), eye[P], eye[V], eye[A])


@cache
def error_model(
    n_states: int = 15, form: Literal["full", "simple"] = "full", measurements: tuple[Measurement, ...] = GNSS
) -> ErrorModel:
    """The local level error model with 9 or 15 states, observed through ``measurements``."""
    if n_states not in (9, 15) or form not in ("full", "simple"):
        raise ValueError(f"n_states is 9 or 15 and form 'full' or 'simple', got {n_states} and {form!r}")

    def covariance(prior: Prior, nav: Nav) -> jax.Array:
        return jnp.diag(prior_sd(prior, n_states) ** 2)

    def discretized(noise: Noise, points: Path, T: jax.Array, u: Drive | None):
        lumped = form == "simple"  # W in eq. 29: over an epoch of a second it changes the gains of the attitude
        return discretize(partial(dynamics, form=form), noise, points, T, u, n_states, lumped)

    observe, n_channels = stack(measurements, lambda nav: kinematics(nav, n_states))
    return ErrorModel(n_states, n_channels, retract, absorb, covariance, discretized, observe)
