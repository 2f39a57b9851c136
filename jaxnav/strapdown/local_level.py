"""Strapdown navigation in local level ENU: the plain form, an equation a line (Savage 1998; Groves 2013, chapter 5).

    lat' = v_n / (M + h),   lon' = v_e / ((N + h) cos lat),   h' = v_u
    v' = C f + g - (2 w_ie + w_en) x v + a
    C' = C [w_ib x] - [(w_ie + w_en) x] C + [s x] C

C takes the body (FRD) to ENU; w_ie is the Earth's rate, w_en the transport rate of ENU at velocity v, M and N the
ellipsoid's radii; a and s are an observer's forcing, zero without one. The increments over a sample, theta
and dv, comes from `jaxnav.strapdown.increments`, with coning and sculling. The rest is of second order in the sample
time: velocity by the midpoint rule, position with the mean velocity, latitude and height taken half-way.

`jaxnav.strapdown.fast.local_level` is the same several times faster, equal by test (tests/strapdown/test_plain.py).
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav.maths import earth, rotations
from jaxnav.maths.components import split
from jaxnav.strapdown.increments import increments, trace
from jaxnav.types import ErrorInputs, Forcing, Imu, Nav, Tree


def propagate(
    nav: Nav, u: Forcing | None, imu: Imu, stride: int = 1, keep: jax.Array | None = None
) -> tuple[Nav, ErrorInputs]:
    """Navigate through k samples (``imu`` fields (k, ...)); ``u`` is the observer's feedback, None without one.

    Returns the last state, or those after the samples ``keep`` (w,), and the path at every ``stride`` samples. ``pos``
    is (lat rad, lon rad, h m), ``vel`` is ENU m/s, ``q`` takes body FRD to ENU. A sample of dt = 0 changes nothing.
    """
    inc = increments(nav, imu)
    s, a = u or (jnp.zeros(3), jnp.zeros(3))

    def sample(carry: Tree, x: Tree) -> Tree:
        q, v, lla = carry
        dt, theta, dv_b = x
        half = lla + 0.5 * dt * jnp.stack([v[1] / earth.A, jnp.zeros_like(dt), v[2]])  # half-way; lon does not matter
        lat, _, h = half
        w_ie, g = earth.earth_rate(lat), jnp.array([0.0, 0.0, -1.0]) * earth.gravity(lat, h)

        def gravity_coriolis(v: jax.Array) -> jax.Array:  # all but specific force: gravity, Coriolis, transport
            return dt * (g + a - jnp.cross(2 * w_ie + earth.transport_rate(lat, h, v), v))

        dv_n = rotations.to_dcm(q) @ dv_b
        turn = (w_ie + earth.transport_rate(lat, h, v) - s) * dt
        dv_n = dv_n - 0.5 * jnp.cross(turn, dv_n)  # ENU turns under the thrust
        mid = v + 0.5 * (dv_n + gravity_coriolis(v))
        dv = dv_n + gravity_coriolis(mid)
        east, north, up = v + 0.5 * dv
        d_north, d_east, _ = earth.metres_per_radian(half)
        turn = (w_ie + earth.transport_rate(lat, h, mid)) * dt
        q = rotations.multiply(rotations.exp(-turn), rotations.multiply(q, rotations.exp(theta)))
        q = rotations.normalize(rotations.multiply(rotations.exp(s * dt), q) if u else q)
        out = (q, v + dv, lla + dt * jnp.stack([north / d_north, east / d_east, up]))
        return out, out

    _, (q, vel, pos) = lax.scan(
        sample, (nav.q, nav.vel, nav.pos), (inc.dt, jnp.stack(inc.theta, -1), jnp.stack(inc.dv, -1))
    )
    return trace(nav, inc, split(pos), split(vel), split(q), stride, keep)
