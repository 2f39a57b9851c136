"""Axes of sensors and places in other coordinates: host numpy, independent of jax's precision."""

from collections.abc import Sequence

import numpy as np

from jaxnav.maths.earth import E2, A, F
from jaxnav.maths.units import DEG
from jaxnav.types import DataError

DIRECTIONS = {"f": (1, 0, 0), "b": (-1, 0, 0), "r": (0, 1, 0), "l": (0, -1, 0), "d": (0, 0, 1), "u": (0, 0, -1)}


def rotation(axes: str | Sequence[float]) -> np.ndarray:
    """(3, 3) sensor -> body FRD.

    Args:
        axes: directions of the sensor's x, y, z, as letters of forward, back, left, right, up, down (``"flu"``); or
            the body's x, y, z in the sensor's axes (``"x,-y,-z"``); or roll, pitch, yaw in degrees of the body's
            axes in the sensor's (Groves 2013, eq. 2.22).

    Raises:
        DataError: text that is no right-handed set of axes.
    """
    if not isinstance(axes, str):
        if len(axes) != 3 or not all(isinstance(a, (int, float)) for a in axes):
            raise DataError(f"axes: expected roll, pitch and yaw in degrees, got {axes!r}")
        return euler(np.asarray(axes, float) * DEG)
    words = [word.strip() for word in axes.lower().split(",")]
    matrix = np.zeros((3, 3))
    if len(words) == 3 and all(word.lstrip("+-") in ("x", "y", "z") and len(word) <= 2 for word in words):
        for row, word in enumerate(words):
            matrix[row, "xyz".index(word[-1])] = -1.0 if word.startswith("-") else 1.0
    elif len(axes) == 3 and all(letter in DIRECTIONS for letter in axes.lower()):
        matrix = np.array([DIRECTIONS[letter] for letter in axes.lower()], float).T
    if abs(np.linalg.det(matrix) - 1.0) > 1e-9:
        left = "; of left-handed axes give a column the other sign, '-wy'" if np.linalg.det(matrix) < -0.5 else ""
        raise DataError(
            f"axes: expected right-handed axes like 'flu', 'x,-y,-z' or [roll, pitch, yaw], got {axes!r}{left}"
        )
    return matrix


def euler(rph: np.ndarray) -> np.ndarray:
    """(3, 3) that resolves reference axes along axes turned by roll, pitch, yaw in rad (Groves 2013, eq. 2.22)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rph), np.cos(rph)
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, sr], [0.0, -sr, cr]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    yaw = np.array([[cy, sy, 0.0], [-sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return roll @ pitch @ yaw


def attitude(q: np.ndarray) -> np.ndarray:
    """(N, 3) roll, pitch, heading in rad of quaternions (N, 4), scalar first, body FRD -> NED."""
    w, x, y, z = np.asarray(q, float).T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return np.stack([roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], axis=1)


def ecef(lla: np.ndarray) -> np.ndarray:
    """(N, 3) lat, lon rad, h m to ECEF m."""
    lat, lon, h = np.asarray(lla, float).T
    prime = A / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    r = (prime + h) * np.cos(lat)
    return np.stack([r * np.cos(lon), r * np.sin(lon), (prime * (1 - E2) + h) * np.sin(lat)], axis=1)


def geodetic(r: np.ndarray) -> np.ndarray:
    """(N, 3) ECEF m to lat, lon rad, h m: Bowring's formula, iterated."""
    x, y, z = np.asarray(r, float).T
    p, b = np.hypot(x, y), A * (1 - F)
    beta = np.arctan2(z * A, p * b)
    for _ in range(3):
        lat = np.arctan2(z + E2 / (1 - E2) * b * np.sin(beta) ** 3, p - E2 * A * np.cos(beta) ** 3)
        beta = np.arctan2((1 - F) * np.sin(lat), np.cos(lat))
    height = p * np.cos(lat) + z * np.sin(lat) - A * np.sqrt(1 - E2 * np.sin(lat) ** 2)
    return np.stack([lat, np.arctan2(y, x), height], axis=1)


def enu_to_ecef(origin: np.ndarray) -> np.ndarray:
    """(..., 3, 3) whose columns are east, north and up at ``origin`` (..., 3) lat, lon rad, h, in ECEF."""
    lat, lon, _ = np.moveaxis(np.asarray(origin, float), -1, 0)
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = [[-so, -sl * co, cl * co], [co, -sl * so, cl * so], [np.zeros_like(sl), cl, sl]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def local_to_lla(enu: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(N, 3) metres east, north, up on the plane that touches the Earth at ``origin`` (3,) to lat, lon rad, h m."""
    return geodetic(ecef(origin[None]) + enu @ enu_to_ecef(origin).T)


def lla_to_local(lla: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Inverse of `local_to_lla`."""
    return (ecef(lla) - ecef(origin[None])) @ enu_to_ecef(origin)


def utm_to_lla(utm: np.ndarray, zone: int, south: bool = False) -> np.ndarray:
    """(N, 3) UTM easting, northing, height above the ellipsoid, m, to lat, lon rad, h m.

    Kruger's series to the third power of the third flattening n, good to 1e-5 m within a zone (Karney, Transverse
    Mercator with an accuracy of a few nanometers, J. Geodesy 85, 2011, equations 7, 11, 14, 15, 36).
    """
    e2 = E2
    n = (1 - np.sqrt(1 - e2)) / (1 + np.sqrt(1 - e2))
    radius = A / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    beta = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    xi = (utm[:, 1] - 1e7 * south) / (0.9996 * radius)
    eta = (utm[:, 0] - 5e5) / (0.9996 * radius)
    z = xi + 1j * eta
    z = z - sum(b * np.sin(2 * j * z) for j, b in enumerate(beta, 1))
    chi = np.arcsin(np.sin(z.real) / np.cosh(z.imag))  # conformal latitude
    lat, e = chi, np.sqrt(e2)
    for _ in range(6):  # contracts by e^2
        lat = np.arcsin(np.tanh(np.arctanh(np.sin(chi)) + e * np.arctanh(e * np.sin(lat))))
    lon = np.deg2rad(6 * zone - 183) + np.arctan2(np.sinh(z.imag), np.cos(z.real))
    return np.stack([lat, lon, utm[:, 2]], axis=1)
