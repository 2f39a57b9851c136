"""Positions and clocks of satellites by their broadcast ephemerides: GPS, QZSS, Galileo, BeiDou."""

import math
from typing import NamedTuple

import numpy as np

from jaxnav.measurements.satellites import CONSTELLATION, CONSTELLATIONS

MU = {"G": 3.986005e14, "J": 3.986005e14, "E": 3.986004418e14, "C": 3.986004418e14}  # m^3/s^2
EARTH_RATE = {"G": 7.2921151467e-5, "J": 7.2921151467e-5, "E": 7.2921151467e-5, "C": 7.292115e-5}
"""rad/s, the Earth's rate that the elements are made for: IS-GPS-200N table 20-IV, IS-QZSS-PNT-005, Galileo OS SIS ICD
table 67, BDS-SIS-ICD-B1I-3.0. That of WGS 84 for GPS turns the satellites by 14 m at the end of a week."""
RELATIVITY = -4.442807633e-10  # s/sqrt(m), times e sqrt(a) sin E
VALID_S = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 7200.0}  # s about toe
GEO_TILT = math.radians(-5.0)
HALF_STEP = 0.5  # s of the difference that velocity and clock rate are
KEPLER_STEPS = 8


class Ephemeris(NamedTuple):
    """Broadcast ephemeris of one satellite, or columns (K,) of several; angles in rad, times s GPS since 1970."""

    satellite: np.ndarray  # number
    toe: np.ndarray
    toc: np.ndarray
    sqrt_a: np.ndarray  # sqrt(m)
    e: np.ndarray
    i0: np.ndarray
    idot: np.ndarray  # rad/s
    omega0: np.ndarray  # right ascension at the begin of the week
    omega_dot: np.ndarray  # rad/s
    omega: np.ndarray  # argument of perigee
    m0: np.ndarray
    delta_n: np.ndarray  # rad/s
    cuc: np.ndarray
    cus: np.ndarray
    crc: np.ndarray  # m
    crs: np.ndarray  # m
    cic: np.ndarray
    cis: np.ndarray
    af0: np.ndarray  # s
    af1: np.ndarray  # s/s
    af2: np.ndarray  # s/s^2
    group_delay: np.ndarray  # s, of the first frequency: T_GD or BGD
    toe_of_week: np.ndarray  # s of the constellation's week
    health: np.ndarray  # 0: usable


def stacked(rows: list[Ephemeris]) -> Ephemeris:
    """Return ephemerides as columns (K,)."""
    return (
        Ephemeris(*(np.array(column) for column in zip(*rows, strict=True)))
        if rows
        else Ephemeris(*(np.zeros(0) for _ in Ephemeris._fields))
    )


def chosen(eph: Ephemeris, satellite: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return for each row (N,) the healthy ephemeris with the nearest toe, -1 where none is valid."""
    found = np.full(t.shape, -1)
    for number in np.unique(satellite):
        usable = np.flatnonzero((eph.satellite == number) & (eph.health == 0))
        system = CONSTELLATIONS[int(number) // CONSTELLATION]
        if not usable.size or system not in MU:
            continue
        rows = satellite == number
        far = np.abs(t[rows][:, None] - eph.toe[usable])
        best = far.argmin(1)
        found[rows] = np.where(far[np.arange(best.size), best] <= VALID_S[system], usable[best], -1)
    return found


def state(eph: Ephemeris, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position (N, 3) m in ECEF axes of the time and clock error (N,) s of the first frequency.

    IS-GPS-200N, tables 20-IV and 20.3.3.3.3; Galileo OS SIS ICD 2.1, table 58; BDS-SIS-ICD-B1I-3.0, table 5-11.

    Args:
        eph: one row for each time.
        t: (N,) s of emission, GPS since 1970.
    """
    systems = np.array([CONSTELLATIONS[int(n) // CONSTELLATION] for n in eph.satellite])
    mu, rate = (np.array([of[s] for s in systems]) for of in (MU, EARTH_RATE))
    tk, a = t - eph.toe, eph.sqrt_a**2
    M = eph.m0 + (np.sqrt(mu / a**3) + eph.delta_n) * tk
    E = M
    for _ in range(KEPLER_STEPS):
        E = E - (E - eph.e * np.sin(E) - M) / (1 - eph.e * np.cos(E))
    true = np.arctan2(np.sqrt(1 - eph.e**2) * np.sin(E), np.cos(E) - eph.e)
    phi = true + eph.omega
    s2, c2 = np.sin(2 * phi), np.cos(2 * phi)
    u = phi + eph.cus * s2 + eph.cuc * c2
    r = a * (1 - eph.e * np.cos(E)) + eph.crs * s2 + eph.crc * c2
    i = eph.i0 + eph.idot * tk + eph.cis * s2 + eph.cic * c2
    x, y = r * np.cos(u), r * np.sin(u)
    geo = _geostationary(eph.satellite, systems)
    turn = eph.omega_dot - np.where(geo, 0.0, rate)
    node = eph.omega0 + turn * tk - rate * eph.toe_of_week
    position = np.stack(
        [
            x * np.cos(node) - y * np.cos(i) * np.sin(node),
            x * np.sin(node) + y * np.cos(i) * np.cos(node),
            y * np.sin(i),
        ],
        -1,
    )
    if geo.any():
        position[geo] = _from_tilted(position[geo], tk[geo])
    dt = t - eph.toc
    clock = eph.af0 + eph.af1 * dt + eph.af2 * dt**2 + RELATIVITY * eph.e * eph.sqrt_a * np.sin(E) - eph.group_delay
    return position, clock


def _geostationary(satellite: np.ndarray, systems: np.ndarray) -> np.ndarray:
    """Return which are BeiDou's satellites in a geostationary orbit, of which the elements are in tilted axes."""
    prn = satellite % CONSTELLATION
    return (systems == "C") & ((prn <= 5) | (prn >= 59))


def _from_tilted(position: np.ndarray, tk: np.ndarray) -> np.ndarray:
    """Return ECEF positions (N, 3) of geostationary satellites from the axes of their elements."""
    x, y, z = position.T
    y, z = y * math.cos(GEO_TILT) + z * math.sin(GEO_TILT), -y * math.sin(GEO_TILT) + z * math.cos(GEO_TILT)
    return turned(np.stack([x, y, z], -1), EARTH_RATE["C"] * tk)


def turned(position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return positions (N, 3) in axes that have turned with the Earth by ``angle`` (N,) rad."""
    x, y, z = np.moveaxis(position, -1, 0)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x + s * y, -s * x + c * y, z], -1)
