"""Strapdown navigation in the local level frame: ENU axes, geodetic position (GPID paper, section 3; Savage 1998).

    C' = C [w_ib x] - [(w_ie + w_en) x] C
    v' = C f - (2 w_ie + w_en) x v + g
    lat' = v_N / (R_M + h),  lon' = v_E / ((R_N + h) cos lat),  h' = v_U

Second order in the sample time. Not for the poles, where longitude and the transport rate are singular.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav import earth, rotations
from jaxnav.mechanizations.increments import increments
from jaxnav.types import Drive, Imu, Nav, Path


def propagate(nav: Nav, u: Drive, imu: Imu) -> tuple[Nav, Path]:
    """Navigate through k samples (``imu`` fields (k, ...)); ``u`` is the observer's feedback, zero without one.

    ``pos`` is (lat rad, lon rad, h m), ``vel`` is ENU m/s, ``q`` takes body FRD to ENU. A sample of dt = 0 changes
    nothing.
    """
    inc = increments(nav, imu)
    spin, push = jnp.asarray(u.omega), jnp.asarray(u.accel)

    def sample(carry, x):
        q, v, (lat, lon, h) = carry
        dt, theta, dv_b = x
        # the Earth's shape, rate and gravity half-way, in first order; a mean radius is near enough for that
        lat_mid, h_mid = lat + 0.5 * dt * v[1] / earth.A, h + 0.5 * dt * v[2]
        s, c = jnp.sin(lat_mid), jnp.cos(lat_mid)
        w2 = 1 - earth.E2 * s * s
        root = jnp.sqrt(w2)
        prime = earth.A / root
        east_radius, north_radius = prime + h_mid, prime * (1 - earth.E2) / w2 + h_mid
        g = earth.GE * (1 + earth.SOMIGLIANA * s * s) / root * (1 - 2 * h_mid / earth.A)
        w_ie = earth.RATE * jnp.stack([jnp.zeros_like(s), c, s])
        down = jnp.stack([jnp.zeros_like(g), jnp.zeros_like(g), -g])

        def transport(v):
            rate = v[0] / east_radius
            return jnp.stack([-v[1] / north_radius, rate, rate * s / c])

        start = transport(v)
        thrust = rotations.to_dcm(q) @ dv_b
        lag = jnp.cross((w_ie + start) * dt, thrust)  # ENU turns under the thrust
        # the last term meets the third order of the body's own rotation: at rest the two turn together and cancel
        thrust = thrust - lag / 2 + jnp.cross((w_ie + start) * dt, lag) / 12
        mid = v + 0.5 * (thrust + dt * (down - jnp.cross(2 * w_ie + start, v)))  # velocity half-way
        w_en = transport(mid)
        turn = (w_ie + w_en) * dt
        dv = thrust + dt * (down - jnp.cross(2 * w_ie + w_en, mid) + push)
        mean = v + 0.5 * dv
        dlat, dlon = mean[1] * dt / north_radius, mean[0] * dt / (east_radius * c)
        pos = jnp.stack([lat + dlat, lon + dlon, h + mean[2] * dt])
        q = rotations.normalize(
            rotations.multiply(rotations.exp(spin * dt - turn), rotations.multiply(q, rotations.exp(theta)))
        )
        out = (q, v + dv, pos)
        return out, out

    start = (nav.q, nav.vel, nav.pos)
    _, (q, vel, pos) = lax.scan(sample, start, (inc.dt, inc.theta, inc.dv))
    k = imu.dt.shape[0]
    path = Nav(
        nav.t + jnp.cumsum(inc.dt), pos, vel, q,
        jnp.broadcast_to(nav.b_g, (k, 3)), jnp.broadcast_to(nav.b_a, (k, 3)), inc.omega, inc.force,
        jax.tree.map(lambda a: jnp.broadcast_to(a, (k, *a.shape)), nav.origin),
    )  # fmt: skip
    before = jnp.concatenate([nav.q[None], q[:-1]])
    C = 0.5 * (jax.vmap(rotations.to_dcm)(before) + jax.vmap(rotations.to_dcm)(q))
    force = jax.vmap(jnp.matmul)(C, inc.force)
    return jax.tree.map(lambda a: a[-1], path), Path(path, C, force)
