"""WGS-84: radii, gravity, rates and coordinates, for one point; batch with vmap.

Latitude and longitude in rad, height in m above the ellipsoid, axes ENU unless a name says otherwise.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

A = 6378137.0  # m, equatorial radius
F = 1 / 298.257223563  # flattening
E2 = F * (2 - F)  # first eccentricity squared
RATE = 7.292115e-5  # rad/s, rotation
GE = 9.7803253359  # m/s^2, normal gravity at the equator
GP = 9.8321849378  # m/s^2, normal gravity at the poles
SOMIGLIANA = (1 - F) * GP / GE - 1  # k of Somigliana's formula


def radii(lat: Any, xp: Any = jnp) -> tuple[Any, Any]:
    """Radii of curvature of the ellipsoid at a latitude: (meridian, prime vertical), m; ``xp``: np on the host."""
    w2 = 1 - E2 * xp.sin(lat) ** 2
    prime = A / xp.sqrt(w2)
    return prime * (1 - E2) / w2, prime


def gravity(lat: jax.Array, h: jax.Array) -> jax.Array:
    """Magnitude of gravity, m/s^2: Somigliana, with the linear free-air term; the centrifugal part is included.

    It acts along the ellipsoid's normal, downwards. This is the only gravity model: every frame rotates it.
    """
    s2 = jnp.sin(lat) ** 2
    return GE * (1 + SOMIGLIANA * s2) / jnp.sqrt(1 - E2 * s2) * (1 - 2 * h / A)


def earth_rate(lat: jax.Array) -> jax.Array:
    """Rotation of the Earth in ENU, rad/s, (3,)."""
    return RATE * jnp.stack([jnp.zeros_like(lat), jnp.cos(lat), jnp.sin(lat)])


def transport_rate(lat: jax.Array, h: jax.Array, vel: jax.Array) -> jax.Array:
    """Rotation of ENU with respect to the Earth at velocity ``vel`` (ENU m/s), rad/s, (3,); singular at the poles."""
    meridian, prime = radii(lat)
    ve, vn, _ = jnp.unstack(vel)
    east = ve / (prime + h)
    return jnp.stack([-vn / (meridian + h), east, east * jnp.tan(lat)])


def axes_turn(lat: jax.Array, h: jax.Array) -> jax.Array:
    """Rotation (3, 3) rad/m of the axes ENU by a displacement in ENU, of which `transport_rate` is the rate."""
    meridian, prime = radii(lat)
    east, zero = 1 / (prime + h), jnp.zeros_like(lat)
    return jnp.stack(
        [
            jnp.stack([zero, -1 / (meridian + h), zero]),
            jnp.stack([east, zero, zero]),
            jnp.stack([east * jnp.tan(lat), zero, zero]),
        ]
    )


def metres_per_radian(lla: jax.Array) -> jax.Array:
    """Return metres of (north, east, up) per unit of (lat, lon, h), (3,): m/rad, m/rad, 1."""
    lat, _, h = jnp.unstack(lla)
    meridian, prime = radii(lat)
    return jnp.stack([meridian + h, (prime + h) * jnp.cos(lat), jnp.ones_like(h)])


def enu_difference(lla: jax.Array, reference: jax.Array) -> jax.Array:
    """Position minus a near reference in metres of ENU at ``lla``, (3,).

    First order in the distance: wrong by distance^2 / (2 radius) in height, 1 mm at 100 m. Longitudes may
    differ by 360 deg.

    A minute of latitude is a nautical mile:

    >>> degrees = jnp.array([[45.0 + 1 / 60, 8.0, 0.0], [45.0, 8.0, 0.0]])
    >>> enu_difference(*jnp.radians(degrees)).round(1)
    Array([   0. , 1852.2,    0. ], dtype=float64)
    """
    off = lla - reference
    off = off - 2 * jnp.pi * jnp.round(off / (2 * jnp.pi)) * np.array([0.0, 1.0, 0.0])
    north, east, up = jnp.unstack(off * metres_per_radian(lla))
    return jnp.stack([east, north, up])


def move(lla: jax.Array, enu: jax.Array) -> jax.Array:
    """Return the position after an ENU displacement (m), (3,) lat, lon, h: first order, inverse of `enu_difference`."""
    east, north, up = jnp.unstack(enu)
    return lla + jnp.stack([north, east, up]) / metres_per_radian(lla)


def continuous(lla: np.ndarray) -> np.ndarray:
    """Positions (N, 3) along a path, the longitude carried on over the date line, fit to interpolate (host array)."""
    return np.stack([lla[:, 0], np.unwrap(lla[:, 1]), lla[:, 2]], 1)


def enu_path(lla: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Positions (N, 3) in metres of ENU from a near one (3,) or one each (N, 3), as `enu_difference` (host arrays)."""
    lla = np.asarray(lla, float)
    off = lla - origin
    east = off[:, 1] - 2 * np.pi * np.round(off[:, 1] / (2 * np.pi))
    meridian, prime = radii(lla[:, 0], np)
    height = lla[:, 2]
    return np.stack([east * (prime + height) * np.cos(lla[:, 0]), off[:, 0] * (meridian + height), off[:, 2]], 1)


def axes(lat: jax.Array, lon: jax.Array) -> jax.Array:
    """Rotation ENU -> ECEF, (3, 3): its columns are east, north and up in ECEF."""
    sl, cl, so, co = jnp.sin(lat), jnp.cos(lat), jnp.sin(lon), jnp.cos(lon)
    zero = jnp.zeros_like(sl)
    return jnp.stack(
        [jnp.stack([-so, -sl * co, cl * co]), jnp.stack([co, -sl * so, cl * so]), jnp.stack([zero, cl, sl])]
    )


def lla_to_ecef(lla: jax.Array) -> jax.Array:
    """(lat, lon, h) -> ECEF m, (3,)."""
    lat, lon, h = lla
    _, prime = radii(lat)
    r = (prime + h) * jnp.cos(lat)
    return jnp.stack([r * jnp.cos(lon), r * jnp.sin(lon), (prime * (1 - E2) + h) * jnp.sin(lat)])


def ecef_to_lla(r: jax.Array) -> jax.Array:
    """ECEF m -> (lat, lon, h), (3,): Bowring's formula, iterated: better than 1e-9 m near the ground.

    Not defined on the Earth's axis, where longitude has no meaning.
    """
    x, y, z = r
    p = jnp.hypot(x, y)
    b = A * (1 - F)
    tan_beta = z * A / (p * b)  # parametric latitude
    for _ in range(3):
        cos_beta = 1 / jnp.sqrt(1 + tan_beta**2)
        sin_beta = tan_beta * cos_beta
        tan_lat = (z + E2 / (1 - E2) * b * sin_beta**3) / (p - E2 * A * cos_beta**3)
        tan_beta = (1 - F) * tan_lat
    lat = jnp.arctan(tan_lat)
    _, prime = radii(lat)
    # from both coordinates, so that neither the poles nor the equator lose digits
    h = p * jnp.cos(lat) + z * jnp.sin(lat) - A**2 / prime
    return jnp.stack([lat, jnp.arctan2(y, x), h])
