"""A sky of known satellites, and messages and files made of it."""

import math

import numpy as np

from jaxnav.gnss.messages import INAV, LNAV, Field
from jaxnav.gnss.orbits import Ephemeris, stacked
from jaxnav.gnss.ranges import Ranges, number
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK

T0 = GPS_EPOCH + 2130 * WEEK + 364_500.0  # s
TOKYO = np.array([-3961909.8277, 3348999.2275, 3698216.8430])  # m, ECEF


def ephemeris(satellite: str, k: int = 0, toe: float = 367_200.0) -> Ephemeris:
    """Ephemeris of a satellite; ``k`` says which of some planes and places."""
    far = satellite[0] == "E"
    a = 29_600e3 if far else 26_560e3
    values = {
        "satellite": number(satellite), "toe": GPS_EPOCH + 2130 * WEEK + toe, "toc": GPS_EPOCH + 2130 * WEEK + toe,
        "sqrt_a": math.sqrt(a), "e": 0.004 + 0.001 * k, "i0": 0.96, "idot": 1e-10, "omega0": -2.0 + 1.05 * k,
        "omega_dot": -8e-9, "omega": 0.5, "m0": 0.7 * k - 1.0, "delta_n": 4.5e-9, "cuc": 1e-6, "cus": 8e-6,
        "crc": 220.0, "crs": -20.0, "cic": 1e-7, "cis": -5e-8, "af0": 4e-5 * (k - 12), "af1": 2e-12, "af2": 0.0,
        "group_delay": -4.6e-9, "toe_of_week": toe, "health": 0.0,
    }  # fmt: skip
    return Ephemeris(**{name: np.asarray(v) for name, v in values.items()})


def constellation(n: int = 24) -> Ephemeris:
    """Ephemerides of GPS satellites in six planes."""
    return stacked([ephemeris(f"G{k + 1:02d}", k) for k in range(n)])


def packed(values: dict[str, float], length: int, fields: tuple[Field, ...]) -> int:
    """The inverse of `jaxnav.gnss.messages.extract`: numbers rounded to the message's steps."""
    message = 0
    for name, start, bits, scale, _ in fields:
        whole = round(values.get(name, 0.0) / scale) & ((1 << bits) - 1)
        message |= whole << (length - start - bits)
    return message


def lnav(eph: Ephemeris, issue: int = 7) -> list[list[int]]:
    """Subframes 1 to 3 as ten words each, parity left at zero."""
    values = numbers(eph, issue)
    found = []
    for kind in (1, 2, 3):
        message = packed(values, 240, LNAV[kind]) | kind << 194
        found.append([((message >> 24 * (9 - i)) & 0xFFFFFF) << 6 for i in range(10)])
    return found


def inav(eph: Ephemeris, issue: int = 7) -> list[list[int]]:
    """Words 1 to 5 as two pages each."""
    values = numbers(eph, issue)
    found = []
    for kind in range(1, 6):
        message = packed(values, 128, INAV[kind]) | kind << 122
        even = (message >> 16) << 14
        odd = 0b10 << 126 | (message & 0xFFFF) << 110
        found.append([(part >> 32 * (3 - i)) & 0xFFFFFFFF for part in (even, odd) for i in range(4)])
    return found


def numbers(eph: Ephemeris, issue: int) -> dict[str, float]:
    """Values of a message by name."""
    own = {name: float(value) for name, value in eph._asdict().items()}
    return own | {"toe": own["toe_of_week"], "toc": own["toe_of_week"], "iode": issue}


def ranges_at(position: np.ndarray, satellites: np.ndarray, t: float = 1.0, clock: float = 100.0) -> Ranges:
    """Exact ranges from a place at rest; satellites (n, 3) at rest as well, their numbers 1, 2, ..."""
    n = len(satellites)
    distance = np.linalg.norm(satellites - position, axis=1)
    up = position / np.linalg.norm(position)
    elevation = np.arcsin((satellites - position) @ up / distance)
    return Ranges(np.full(n, t), 1 + np.arange(n), distance + clock, np.full(n, 3.0), satellites, np.zeros((n, 3)),
                  elevation, np.full(n, 45.0))  # fmt: skip


def overhead(position: np.ndarray, n: int = 8, seed: int = 0) -> np.ndarray:
    """Satellites (n, 3) m above a place, spread over the sky."""
    rng = np.random.default_rng(seed)
    up = position / np.linalg.norm(position)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    azimuth, elevation = 2 * np.pi * np.arange(n) / n, rng.uniform(0.3, 1.4, n)
    u = (np.outer(np.cos(elevation) * np.sin(azimuth), east) + np.outer(np.cos(elevation) * np.cos(azimuth), north)
         + np.outer(np.sin(elevation), up))  # fmt: skip
    return position + 2.2e7 * u
