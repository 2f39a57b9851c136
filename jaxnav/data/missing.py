"""Values that stand for none, and positions that no vehicle reaches: what loggers write where they have no fix."""

import numpy as np

from jaxnav.maths import earth
from jaxnav.maths.units import DEG

HEIGHTS = (-999.0, -9999.0, -99999.0, -32768.0)  # m
HIGHEST = 1e6  # m, from which on a height is none
SPEEDS = (-1.0, 102.3, 511.0, 999.0)  # in the file's own unit
UNMEASURED_SD = 1e3  # m or m/s, of a component that nothing measured
FASTEST, SLACK = 3000.0, 1000.0  # m/s between fixes; m, of fixes that are close in time


def no_height(height: np.ndarray) -> np.ndarray:
    """Return which heights (K,) m stand for none."""
    return np.isin(np.round(height, 3), HEIGHTS) | ~(np.abs(height) < HIGHEST)


def no_position(lla: np.ndarray) -> np.ndarray:
    """Return which positions (K, 3), lat, lon rad, h m, stand for none: 0, 0 exactly, 91 or 181 deg, beyond a pole.

    Where most are beyond a pole the unit is another, which is for a check to refuse.
    """
    lat, lon = np.abs(lla[:, :2]).T
    mark = ((lat == 0) & (lon == 0)) | np.isclose(lat, 91 * DEG, 1e-12) | np.isclose(lon, 181 * DEG, 1e-12)
    beyond = (lat > 90 * DEG * (1 + 1e-12)) | (lon > 360 * DEG * (1 + 1e-12))
    return mark | (beyond & (beyond.mean() < 0.5))


def no_speed(speed: np.ndarray) -> np.ndarray:
    """Return which speeds over ground (K,), in the file's unit, stand for none."""
    return np.isin(speed, SPEEDS)


def unreachable(t: np.ndarray, lla: np.ndarray) -> np.ndarray:
    """Return which positions are farther from the others than `FASTEST` allows.

    Fixes that follow each other within reach are a piece; the longest piece is right, and so is what is in reach of it.

    Args:
        t: (K,) s, increasing.
        lla: (K, 3) lat, lon rad, h m.
    """
    if len(t) < 3:
        return np.zeros(len(t), bool)
    lat, lon = lla[:, 0], lla[:, 1]
    axis = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    place = (earth.A + lla[:, 2:]) * axis  # of a sphere
    within = lambda i, j: np.linalg.norm(place[i] - place[j], axis=-1) <= FASTEST * np.abs(t[i] - t[j]) + SLACK
    index = np.arange(len(t))
    piece = np.r_[0, np.cumsum(~within(index[1:], index[:-1]))]
    inside = np.flatnonzero(piece == np.bincount(piece).argmax())
    after = np.clip(np.searchsorted(inside, index), 0, len(inside) - 1)
    near = [inside[after], inside[np.maximum(after - 1, 0)]]
    nearest = np.where(np.abs(index - near[0]) <= np.abs(index - near[1]), *near)
    return ~within(index, nearest)
