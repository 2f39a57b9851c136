"""Values that stand for none, and positions that no vehicle reaches, as loggers write them without a fix."""

from collections.abc import Sequence

import numpy as np

from jaxnav.maths import earth
from jaxnav.measurements import POSITION
from jaxnav.measurements.columns import Column

SPEEDS = (-1.0, 102.3, 511.0, 999.0)  # in the file's unit
UNMEASURED_SD = 1e3  # m or m/s, of a component that nothing measured
MAX_SPEED, MAX_JUMP = 3000.0, 1000.0  # m/s between fixes; m, of fixes that are close in time


def without_value(value: np.ndarray, columns: Sequence[Column]) -> tuple[np.ndarray, np.ndarray]:
    """Return which values (K, s) are marks for none, and which are outside the plausible range of their columns."""
    low, high = np.array([c.plausible for c in columns]).T
    mark = np.stack([np.isclose(x[:, None], c.marks, 5e-8, 0.0).any(1) for x, c in zip(value.T, columns)], 1)
    return mark, (value < low * (1 - np.sign(low) * 1e-12)) | (value > high * (1 + np.sign(high) * 1e-12))


def no_value(value: np.ndarray, columns: Sequence[Column]) -> np.ndarray:
    """Return which values (K, s) stand for none.

    Where most are outside the plausible range the unit is probably another, and a check refuses it.
    """
    mark, beyond = without_value(value, columns)
    return mark | (beyond & (beyond.mean(0) < 0.5))


def no_position(lla: np.ndarray) -> np.ndarray:
    """Return which positions (K, 3), lat, lon rad, h m, stand for none: 0, 0 exactly, or a mark or beyond a pole."""
    none = no_value(lla[:, :2], POSITION.columns[:2]).any(1)
    return np.asarray(none | (lla[:, :2] == 0).all(1))


def no_height(height: np.ndarray) -> np.ndarray:
    """Return which heights (K,) m stand for none."""
    mark, beyond = without_value(height[:, None], POSITION.columns[2:])
    return np.asarray((mark | beyond)[:, 0] | np.isnan(height))


def no_speed(speed: np.ndarray) -> np.ndarray:
    """Return which speeds over ground (K,), in the file's unit, stand for none."""
    return np.isin(speed, SPEEDS)


def unreachable(t: np.ndarray, lla: np.ndarray) -> np.ndarray:
    """Return which positions are farther from the others than `MAX_SPEED` allows.

    Fixes within reach of each other are a piece; the longest piece is right, and so are fixes in reach of it.

    Args:
        t: (K,) s, increasing.
        lla: (K, 3) lat, lon rad, h m.
    """
    if len(t) < 3:
        return np.zeros(len(t), bool)
    lat, lon = lla[:, 0], lla[:, 1]
    axis = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    place = (earth.A + lla[:, 2:]) * axis  # of a sphere
    within = lambda i, j: np.linalg.norm(place[i] - place[j], axis=-1) <= MAX_SPEED * np.abs(t[i] - t[j]) + MAX_JUMP
    index = np.arange(len(t))
    piece = np.r_[0, np.cumsum(~within(index[1:], index[:-1]))]
    inside = np.flatnonzero(piece == np.bincount(piece).argmax())
    after = np.clip(np.searchsorted(inside, index), 0, len(inside) - 1)
    near = [inside[after], inside[np.maximum(after - 1, 0)]]
    nearest = np.where(np.abs(index - near[0]) <= np.abs(index - near[1]), *near)
    return ~within(index, nearest)
