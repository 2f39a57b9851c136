"""Errors of inertial quaternion navigation: x = (dr m, dp m/s, dtheta rad[, b_g, b_a body]), C_est = exp([dtheta x]) C.

dr and dp are in N, dtheta in I (see `jaxnav.strapdown.inertial_quaternion`), and dp = dv + u x dr is the error of
p = v + u x r, the velocity in inertial space (FWEKF paper, eq. 13). The paper's eq. 15 is missing; it follows from
differentiating p. With v' = g(r) - 2 u x v + f_N and f_N = A C f,

    p' = v' + u x v = g(r) + u x (u x r) - u x p + f_N,

in which gravity's centrifugal part cancels the double cross product up to what is constant. So, with a wrong C and
sensor errors,

    dr' = dp - u x dr
    dp' = -u x dp - A [f_I x] dtheta + (dg/dr + [u x]^2) dr - A C b_a
    dtheta' = -C b_g                                              (14)

Coriolis and centrifugal acceleration have become one term, which is why p is the state. The simple form, the paper's,
has no gradient of gravitation, dg/dr + [u x]^2, which is 1.5e-6 / s^2 across and 3e-6 / s^2 along the vertical.
"""

from functools import cache, partial
from typing import Literal

import jax
import jax.numpy as jnp

from jaxnav.filters.core import ErrorModel
from jaxnav.maths import earth, rotations
from jaxnav.measurements import GNSS, Kinematics, Measurement, stack
from jaxnav.states.frames import tangent_frame as tangent_errors
from jaxnav.states.names import A, P, V, prior_sd
from jaxnav.states.transition import discretize, retract_common
from jaxnav.strapdown.inertial_quaternion import AXES, earth_rate, enter, leave, turned
from jaxnav.strapdown.tangent_frame import from_ecef, gravity
from jaxnav.types import Drive, Nav, Noise, Path, Prior


def retract(nav: Nav, x: jax.Array) -> Nav:
    """The truth, if ``x`` (n,) is the error of ``nav``."""
    dv = x[V] - jnp.cross(earth_rate(nav.origin), x[P])
    nav = retract_common(nav, x)
    return nav._replace(pos=nav.pos - x[P], vel=nav.vel - dv)


def absorb(nav: Nav, drive: Drive) -> Nav:
    """Feed a constant model error (a rate in I, an acceleration in N) to the sensors as bias in body axes."""
    C = rotations.to_dcm(nav.q)
    accel = rotations.to_dcm(turned(nav.origin, nav.t)).T @ drive.accel
    return nav._replace(b_g=nav.b_g + C.T @ drive.omega, b_a=nav.b_a + C.T @ accel)


def dynamics(point: Path, form: Literal["full", "simple"]) -> dict[tuple[str, str], jax.Array]:
    """The 3x3 blocks of F in x' = F x, at one point of the path."""
    origin = point.nav.origin
    to_n = rotations.to_dcm(turned(origin, point.nav.t))
    spin = rotations.skew(earth_rate(origin))
    blocks = {
        ("position", "position"): -spin,
        ("position", "velocity"): jnp.eye(3, dtype=spin.dtype),
        ("velocity", "velocity"): -spin,
        ("velocity", "attitude"): -to_n @ rotations.skew(point.force),
        ("velocity", "accel_bias"): -to_n @ point.C,
        ("attitude", "gyro_bias"): -point.C,
    }
    if form == "simple":
        return blocks
    C_en = from_ecef(origin).T @ AXES.T
    gradient = jax.jacfwd(gravity)(earth.lla_to_ecef(origin.lla) + C_en @ point.nav.pos)
    return blocks | {("velocity", "position"): C_en.T @ gradient @ C_en + spin @ spin}


def enu_rows(nav: Nav, local: Nav, n: int) -> jax.Array:
    """d(error in local level) / dx, (n, n); ``local`` is ``nav`` in local level."""
    J = tangent_errors.enu_rows(local, n)
    to_n = rotations.to_dcm(turned(nav.origin, nav.t))
    spin = rotations.skew(earth_rate(nav.origin))
    flat = jnp.eye(n, dtype=spin.dtype)  # x -> errors in the tangent frame
    flat = flat.at[P, P].set(AXES.T).at[V, V].set(AXES.T).at[A, A].set(AXES.T @ to_n).at[V, P].set(-AXES.T @ spin)
    return J @ flat


def report(nav: Nav, x: jax.Array, P: jax.Array) -> tuple[Nav, jax.Array, jax.Array]:
    """Corrected navigation, x (n,) and P (n, n) as those of local level."""
    local = leave(nav)
    J = enu_rows(nav, local, x.shape[0])
    P = J @ P @ J.T
    return local, J @ x, 0.5 * (P + P.T)


def kinematics(nav: Nav, n: int) -> Kinematics:
    """Position, velocity and attitude in ENU, and how the error state moves them."""
    local = leave(nav)
    J = enu_rows(nav, local, n)
    return Kinematics(local.pos, local.vel, rotations.to_dcm(local.q), J[P], J[V], J[A])


@cache
def error_model(
    n_states: int = 15, form: Literal["full", "simple"] = "full", measurements: tuple[Measurement, ...] = GNSS
) -> ErrorModel:
    """The inertial frame's error model with 9 or 15 states, observed through ``measurements``."""
    if n_states not in (9, 15) or form not in ("full", "simple"):
        raise ValueError(f"n_states is 9 or 15 and form 'full' or 'simple', got {n_states} and {form!r}")

    def covariance(prior: Prior, nav: Nav) -> jax.Array:
        root = tangent_errors.inverse_rows(enu_rows(nav, leave(nav), n_states)) * prior_sd(prior, n_states)
        return root @ root.T

    def discretized(noise: Noise, points: Path, T: jax.Array, u: Drive | None):
        return discretize(partial(dynamics, form=form), noise, points, T, u, n_states)

    observe, n_channels = stack(measurements, lambda nav: kinematics(nav, n_states))
    return ErrorModel(n_states, n_channels, retract, absorb, covariance, discretized, observe, enter, report)
