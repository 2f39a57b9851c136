"""Witnesses: two sensors of one quantity that part within a recording by more than either may be off."""

import numpy as np

from jaxnav.checkup.compass import EXPLAINED_SHARE, explained, hard_iron, turns_of
from jaxnav.findings import finding
from jaxnav.maths.units import DEG
from jaxnav.types import Finding, Recording

WINDOW_S = 20.0  # s, whose median differences are compared
MAX_WEATHER_M, MAX_TEMPERATURE_SHARE = 10.0, 0.08  # m, and of a climb, by which a barometer may be off within a drive
MAX_SLIP_MPS, MAX_SLIP_SHARE = 0.3, 0.05  # m/s, and of the speed, by which wheels may be off
MAX_IRON_DEG, MAX_IRON_SHARE = 45.0, 0.5  # deg of heading by iron that moves; hard iron over the field of a witness


def parting(code: str, t: np.ndarray, off: np.ndarray, limit: float) -> list[Finding]:
    """Return a finding where the median differences of windows part by more than a limit.

    Args:
        code: of the finding.
        t: (K,) s.
        off: (K,) difference of two sensors.
        limit: by which they may part.
    """
    window = ((t - t[0]) // WINDOW_S).astype(int) if t.size else np.zeros(0, int)
    full = [k for k in np.unique(window) if (window == k).sum() >= 5]
    middle = np.array([np.median(off[window == k]) for k in full])
    if middle.size < 2 or np.ptp(middle) < limit:
        return []
    a, b = np.sort([full[middle.argmin()], full[middle.argmax()]]) * WINDOW_S + t[0]
    return [finding(code, value=float(np.ptp(middle)), limit=limit, begin=float(a), end=float(b))]


def heights(t: np.ndarray, height: np.ndarray, said: np.ndarray, sd: float) -> list[Finding]:
    """Compare heights (K,) m of the receiver, of ``sd`` m, and of a barometer, beyond weather and temperature."""
    limit = MAX_WEATHER_M + MAX_TEMPERATURE_SHARE * float(np.ptp(said)) + 5 * sd
    return parting("barometer.parts", t, height - said, limit)


def speeds(t: np.ndarray, ground: np.ndarray, rolled: np.ndarray, sd: float) -> list[Finding]:
    """Compare speeds (K,) m/s of the receiver, of ``sd`` m/s, and of wheels without their scale error."""
    limit = MAX_SLIP_MPS + MAX_SLIP_SHARE * float(ground.max()) + 3 * sd
    return parting("speed.parts", t, ground - rolled, limit)


def headings(rec: Recording, t: np.ndarray, rph: np.ndarray, sd: float) -> list[Finding]:
    """Compare the heading of a solution with that of a magnetometer, whatever its declination.

    One is no witness whose field turns otherwise than the gyros, or whose hard iron is above half of the field.

    Args:
        rec: the recording.
        t: (E,) s, of the solution.
        rph: (E, 3) rad, its roll, pitch and heading.
        sd: rad, of its heading.
    """
    m = rec.aiding.get("magnetometer")
    moved = None if m is None or m.t.size < 20 else turns_of(rec)
    if m is None or moved is None:
        return []
    iron, inside = hard_iron(*moved), (m.t >= t[0]) & (m.t <= t[-1])
    x, y, z = field = (m.value[inside] - iron).T
    known = explained(moved[0], moved[1] - iron, moved[2]) > EXPLAINED_SHARE
    if not known or np.linalg.norm(iron) > MAX_IRON_SHARE * np.median(np.linalg.norm(field, axis=0)):
        return []
    roll, pitch, heading = rph[np.clip(np.searchsorted(t, m.t[inside]), 0, t.size - 1)].T
    right, down = np.cos(roll) * y - np.sin(roll) * z, np.sin(roll) * y + np.cos(roll) * z
    way = np.exp(1j * (heading + np.arctan2(right, np.cos(pitch) * x + np.sin(pitch) * down)))
    off = np.angle(way * np.conj(np.mean(way))) / DEG
    return parting("compass.parts", m.t[inside], off, MAX_IRON_DEG + 5 * sd / DEG)
