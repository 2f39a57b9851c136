"""Strapdown navigation with an inertial quaternion and continuous correction (FWEKF paper, eqs. 1-12).

    q' = q * w / 2,                    q: body -> I    (1, 3)
    r' = v                                             (11)
    v' = g(r) - 2 u x v + A(t) C f,    C = C(q)        (12)

Two sets of axes. N is fixed to the Earth at the place of `Origin`: x to the right, y along its azimuth, which is the
direction of motion, z up; ``pos`` (m from the origin) and ``vel`` (m/s, relative to the Earth) are in N. I is inertial,
N as it stood at the origin's time; ``q`` takes body FRD to I. A(t) = exp(-[u x] (t - t0)) takes I to N (eq. 9), u is
the Earth's rate in N. The observer's feedback adds its rate, in I, to eq. 1, and its acceleration, in N, to eq. 12:
the printed u_w and u_a of eqs. 19 and 20 are the same vectors in body axes (eq. 20 lacks the A' that takes N to I).

Gravity is the project's, which contains the centrifugal part. The paper's eq. 12 has it as a term, - u x (u x r), with
gravity held at its value at the origin; here it must not stand a second time.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.maths import earth, rotations
from jaxnav.maths.components import split
from jaxnav.strapdown import tangent_frame
from jaxnav.strapdown.increments import increments, trace
from jaxnav.types import ErrorInputs, Forcing, Imu, Nav, Origin, Tree

AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # tangent frame (along, up, right) -> N
_AXES_Q = np.array([0.5, 0.5, 0.5, 0.5])


def earth_rate(origin: Origin) -> jax.Array:
    """Rotation of the Earth in N, rad/s, (3,): u of the paper."""
    return jnp.asarray(AXES) @ tangent_frame.earth_rate(origin)


def turned(origin: Origin, t: jax.Array) -> jax.Array:
    """Quaternion I -> N at time ``t`` (s), (4,): A of eq. 9."""
    return rotations.exp(-earth_rate(origin) * (t - origin.t))


def enter(nav: Nav) -> Nav:
    """Local level navigation in these frames, of its origin."""
    flat = tangent_frame.enter(nav)
    axes, q = jnp.asarray(AXES), rotations.multiply(jnp.asarray(_AXES_Q), flat.q)
    q = rotations.multiply(rotations.conjugate(turned(nav.origin, nav.t)), q)
    return flat._replace(pos=axes @ flat.pos, vel=axes @ flat.vel, q=q)


def leave(nav: Nav) -> Nav:
    """As local level navigation, the inverse of `enter`."""
    q = rotations.multiply(turned(nav.origin, nav.t), nav.q)
    q = rotations.multiply(rotations.conjugate(jnp.asarray(_AXES_Q)), q)
    return tangent_frame.leave(nav._replace(pos=nav.pos @ AXES, vel=nav.vel @ AXES, q=q))


def propagate(
    nav: Nav, u: Forcing | None, imu: Imu, stride: int = 1, keep: jax.Array | None = None
) -> tuple[Nav, ErrorInputs]:
    """Navigate through k samples (``imu`` fields (k, ...)); ``u`` is the observer's feedback, None without one.

    Returns the last state, or those after the samples ``keep`` (w,), and the path at every ``stride`` samples. A sample
    of dt = 0 changes nothing. Second order in the sample time; the rotation is exact but for coning. The path's ``C``
    and ``force`` are in I.
    """
    inc = increments(nav, imu)
    w, C_en = earth_rate(nav.origin), tangent_frame.from_ecef(nav.origin).T @ AXES.T
    start = earth.lla_to_ecef(nav.origin.lla)
    t = nav.t + jnp.cumsum(inc.dt)
    A = jax.vmap(lambda t: rotations.to_dcm(turned(nav.origin, t)))(t - inc.dt)  # at each sample's start

    def sample(carry: Tree, x: Tree) -> Tree:
        q, v, r = carry
        dt, theta, dv_b, A = x
        thrust = A @ (rotations.to_dcm(q) @ dv_b)
        turn = w * dt
        lag = jnp.cross(turn, thrust)  # N turns under the thrust
        thrust = thrust - lag / 2 + jnp.cross(turn, lag) / 12
        g = tangent_frame.gravity(start + C_en @ (r + 0.5 * dt * v)) @ C_en
        mid = v + 0.5 * (thrust + dt * (g - jnp.cross(2 * w, v)))
        dv = thrust + dt * (g - jnp.cross(2 * w, mid) + (u.accel if u else 0.0))
        q = rotations.multiply(q, rotations.exp(theta))
        q = rotations.normalize(rotations.multiply(rotations.exp(u.omega * dt), q) if u else q)
        out = (q, v + dv, r + dt * (v + 0.5 * dv))
        return out, out

    _, (q, vel, pos) = lax.scan(
        sample, (nav.q, nav.vel, nav.pos), (inc.dt, jnp.stack(inc.theta, -1), jnp.stack(inc.dv, -1), A)
    )
    return trace(nav, inc, split(pos), split(vel), split(q), stride, keep)
