"""Errors of tangent frame navigation: x = (dr m, dv m/s, phi rad[, b_g, b_a body]), C_est = exp([phi x]) C_true.

    dr' = dv,    dv' = -[f x] phi - 2 w x dv + dg/dr dr - C b_a,    phi' = -w x phi - C b_g

all in the axes of the frame. The simple form has no gravity gradient: that is the GIP-KF paper's eq. 22. (Its eqs. 18
and 19 print -[f x] phi together with -C dw, of which one has the wrong sign with either definition of phi; eq. 19 lacks
the minus of the Coriolis term, which 18 and 22 have.)
"""

from functools import cache, partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.core import ErrorModel
from jaxnav.maths import earth, rotations
from jaxnav.measurements import GNSS, Kinematics, Measurement, stack
from jaxnav.states.names import A, P, V, prior_sd
from jaxnav.states.transition import absorb, discretize, retract_common
from jaxnav.strapdown.tangent_frame import earth_rate, enter, from_ecef, gravity, leave
from jaxnav.types import Drive, Nav, Noise, Path, Prior


def retract(nav: Nav, x: jax.Array) -> Nav:
    """The truth, if ``x`` (n,) is the error of ``nav``."""
    nav = retract_common(nav, x)
    return nav._replace(pos=nav.pos - x[P], vel=nav.vel - x[V])


def reset_balanced(theta, retract, nav: Nav, x: jax.Array, T: jax.Array):
    """`jaxnav.filters.feedback.reset` of 15 states, to second order where a tilt stands for accelerometer bias.

    Levelled on biased accelerometers, navigation starts with a tilt and a bias that balance in body axes:
    C_est' g + b_est = C' g + b. Corrected to first order, they leave g phi^2 / 2 in the vertical bias: for 16 mg 1 to
    10 mm/s^2, when the covariance has that bias to less than 1. Here the balance is kept.
    """
    up = jnp.zeros(3).at[1].set(earth.gravity(nav.origin.lla[0], nav.origin.lla[2]))  # what holds the IMU up
    bend = rotations.to_dcm(rotations.exp(x[A])) @ up - up - jnp.cross(x[A], up)
    after = retract(nav, x)
    return after._replace(b_a=after.b_a - rotations.to_dcm(nav.q).T @ bend), jnp.zeros_like(x), None


def dynamics(point: Path, form: Literal["full", "simple"]) -> dict[tuple[str, str], jax.Array]:
    """The 3x3 blocks of F in x' = F x, at one point of the path."""
    origin = point.nav.origin
    spin = rotations.skew(earth_rate(origin))
    blocks = {
        ("position", "velocity"): jnp.eye(3, dtype=point.force.dtype),
        ("velocity", "velocity"): -2 * spin,
        ("velocity", "attitude"): -rotations.skew(point.force),
        ("velocity", "accel_bias"): -point.C,
        ("attitude", "attitude"): -spin,
        ("attitude", "gyro_bias"): -point.C,
    }
    if form == "simple":
        return blocks
    C = from_ecef(origin)
    gradient = jax.jacfwd(gravity)(earth.lla_to_ecef(origin.lla) + C.T @ point.nav.pos)
    return blocks | {("velocity", "position"): C @ gradient @ C.T}


def enu_rows(local: Nav, n: int) -> jax.Array:
    """d(error in local level) / d(error in the tangent frame), (n, n), at local level navigation.

    ENU at an estimate that is dp away from the truth is turned by a small angle, Theta dp: attitude and velocity in
    ENU see that, in the tangent frame they do not.
    """
    lat, _, h = local.pos
    C = earth.axes(lat, local.pos[1]).T @ from_ecef(local.origin).T
    meridian, prime = earth.radii(lat)
    zero = jnp.zeros_like(lat)
    east, north = 1 / (prime + h), 1 / (meridian + h)
    Theta = jnp.stack([jnp.stack([zero, east, east * jnp.tan(lat)]), jnp.stack([-north, zero, zero]), jnp.zeros(3)], 1)
    J = jnp.eye(n, dtype=C.dtype).at[P, P].set(C).at[V, V].set(C).at[A, A].set(C)
    return J.at[V, P].set(rotations.skew(local.vel) @ Theta @ C).at[A, P].set(-Theta @ C)


def inverse_rows(J: jax.Array) -> jax.Array:
    """J^-1 (n, n) of `enu_rows`: rotations on the diagonal, and off it only what position does to the others."""
    own = np.kron(np.eye(J.shape[0] // 3), np.ones((3, 3)))
    turn = (own * J).T
    return turn - turn @ ((1 - own) * J) @ turn


def report(nav: Nav, x: jax.Array, P: jax.Array) -> tuple[Nav, jax.Array, jax.Array]:
    """Corrected navigation, x (n,) and P (n, n) as those of local level."""
    local = leave(nav)
    J = enu_rows(local, x.shape[0])
    P = J @ P @ J.T
    return local, J @ x, 0.5 * (P + P.T)


def kinematics(nav: Nav, n: int) -> Kinematics:
    """Position, velocity and attitude in ENU, and how the error state moves them."""
    local = leave(nav)
    J = enu_rows(local, n)
    return Kinematics(local.pos, local.vel, rotations.to_dcm(local.q), J[P], J[V], J[A])


@cache
def error_model(
    n_states: int = 15, form: Literal["full", "simple"] = "full", measurements: tuple[Measurement, ...] = GNSS
) -> ErrorModel:
    """The tangent frame's error model with 9 or 15 states, observed through ``measurements``."""
    if n_states not in (9, 15) or form not in ("full", "simple"):
        raise ValueError(f"n_states is 9 or 15 and form 'full' or 'simple', got {n_states} and {form!r}")

    def covariance(prior: Prior, nav: Nav) -> jax.Array:
        root = inverse_rows(enu_rows(leave(nav), n_states)) * prior_sd(prior, n_states)
        return root @ root.T

    def discretized(noise: Noise, points: Path, T: jax.Array, u: Drive | None):
        return discretize(partial(dynamics, form=form), noise, points, T, u, n_states)

    observe, n_channels = stack(measurements, lambda nav: kinematics(nav, n_states))
    return ErrorModel(n_states, n_channels, retract, absorb, covariance, discretized, observe, enter, report)
