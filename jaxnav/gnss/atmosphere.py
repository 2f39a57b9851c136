"""Delays of the atmosphere: ionosphere by Klobuchar, troposphere by Saastamoinen."""

import math

import numpy as np

from jaxnav.gnss.ranges import LIGHT
from jaxnav.maths.gps_time import WEEK

DAY = 86_400.0


def klobuchar(
    alpha: np.ndarray,
    beta: np.ndarray,
    lat: np.ndarray,
    lon: np.ndarray,
    azimuth: np.ndarray,
    elevation: np.ndarray,
    tow: np.ndarray,
) -> np.ndarray:
    """Return the delay (N,) m of a signal at 1575.42 MHz (IS-GPS-200N, figure 20-4).

    Args:
        alpha: (4,) s/semicircle^k, of the broadcast model.
        beta: (4,) s/semicircle^k.
        lat: (N,) rad, of the receiver.
        lon: (N,) rad.
        azimuth: (N,) rad, of the satellite, clockwise from north.
        elevation: (N,) rad.
        tow: (N,) s of the week, GPS time.
    """
    E = elevation / math.pi
    psi = 0.0137 / (E + 0.11) - 0.022
    phi = np.clip(lat / math.pi + psi * np.cos(azimuth), -0.416, 0.416)
    lam = lon / math.pi + psi * np.sin(azimuth) / np.cos(phi * math.pi)
    magnetic = phi + 0.064 * np.cos((lam - 1.617) * math.pi)
    t = np.mod(43_200.0 * lam + np.mod(tow, WEEK), DAY)
    power = magnetic[..., None] ** np.arange(4)
    amplitude, period = np.maximum(power @ alpha, 0.0), np.maximum(power @ beta, 72_000.0)
    x = 2 * math.pi * (t - 50_400.0) / period
    slant = 1.0 + 16.0 * (0.53 - E) ** 3
    day = np.where(np.abs(x) < 1.57, amplitude * (1 - x**2 / 2 + x**4 / 24), 0.0)
    return LIGHT * slant * (5e-9 + day)


def saastamoinen(lat: np.ndarray, h: np.ndarray, elevation: np.ndarray, humidity: float = 0.7) -> np.ndarray:
    """Return the delay (N,) m of the troposphere in a standard atmosphere (Saastamoinen 1972), mapped by 1 / sin.

    Args:
        lat: (N,) rad.
        h: (N,) m above the ellipsoid.
        elevation: (N,) rad.
        humidity: relative, of the air at the ground.
    """
    h = np.clip(h, 0.0, 11_000.0)
    kelvin = 288.15 - 0.0065 * h
    pressure = 1013.25 * (1 - 2.2557e-5 * h) ** 5.2568  # hPa
    vapour = humidity * 6.108 * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))  # hPa
    dry = 0.0022768 * pressure / (1 - 0.00266 * np.cos(2 * lat) - 0.00028e-3 * h)
    wet = 0.002277 * (1255.0 / kelvin + 0.05) * vapour
    return (dry + wet) / np.sin(np.maximum(elevation, math.radians(3.0)))
