"""A magnetometer against the Earth and the gyros: a field that stands still turns in the body as the body turns."""

from itertools import permutations

import numpy as np

from jaxnav.findings import finding
from jaxnav.initialization.magnetic import field_at
from jaxnav.maths.axes import DIRECTIONS, rotation
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import DEG
from jaxnav.types import Finding, Recording

MIN_TURN, STEPS_S, MIN_TURNS = 3.0 * DEG, (0.2, 0.5, 1.0), 20  # above noise; between readings; enough for a check
EXPLAINED_SHARE, UNEXPLAINED_SHARE = 0.8, 0.4  # of the field's changes by turns: right axes, wrong axes
MAX_FIELD_RATIO, MIN_FIELD_RATIO = 1.3, 0.7  # times the field of the place
MIN_HARD_IRON_UT = 10.0  # uT of hard iron from which on it is said
AXES = {
    letters: np.asarray(rotation(letters))
    for letters in map("".join, permutations(DIRECTIONS, 3))
    if abs(np.linalg.det(np.array([DIRECTIONS[x] for x in letters], float)) - 1.0) < 1e-9
}
"""The 24 directions of three axes along three axes, by name."""


def compass(rec: Recording) -> list[Finding]:
    """Strength, and axes and hard iron by dm = -theta x (m - b) between readings."""
    m, p = rec.aiding.get("magnetometer"), rec.aiding.get("position")
    if m is None or m.t.size < 20:
        return []
    strength, known = float(np.median(np.linalg.norm(m.value, axis=1))), None if p is None else field_at(p.value[0])
    here = "" if known is None else f", here {known.strength:.1f} uT"
    low, high = (
        (MIN_FIELD_RATIO * known.strength, MAX_FIELD_RATIO * known.strength) if known is not None else (15.0, 90.0)
    )
    found = [finding("compass" if low < strength < high else "compass.strength", value=strength, here=here)]
    moved = turns_of(rec)
    if moved is None:
        return found
    turn, *field = moved
    share = {letters: explained(turn, *(a @ R.T for a in field)) for letters, R in AXES.items()}
    best = max(share, key=lambda letters: share[letters])
    as_is, most = share["frd"], share[best]
    if as_is < UNEXPLAINED_SHARE and most > EXPLAINED_SHARE:
        return [*found, finding("compass.axes", value=100 * max(as_is, 0.0), axes=best, most=100 * most)]
    iron = hard_iron(*moved)
    without = 100 * max(explained(turn, field[0] - iron, field[1]), 0.0)
    if without < 100 * UNEXPLAINED_SHARE:
        return [*found, finding("compass.inconsistent", value=without)]
    if np.linalg.norm(iron) > MIN_HARD_IRON_UT:
        return [*found, finding("compass.iron", value=without, vector=", ".join(f"{b:.0f}" for b in iron))]
    return [*found, finding("compass.turns", value=without)]


def turns_of(rec: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Turn of the body (K, 3) rad between two readings, their mean (K, 3) and change (K, 3) uT.

    Readings as near in time as turns of `MIN_TURN` allow; None where it hardly turns.
    """
    m, imu = rec.aiding["magnetometer"], rec.imu
    when = np.concatenate([[imu.t[0] - imu.dt[0]], imu.t])
    angle = columns_at(m.t, when, np.vstack([np.zeros(3), np.cumsum(imu.gyro * imu.dt[:, None], 0)]))
    for step in STEPS_S:
        n = max(1, round(step / max(float(np.median(np.diff(m.t))), 1e-3)))
        if m.t.size <= n:
            break
        turn, covered = angle[n:] - angle[:-n], (m.t[n:] <= imu.t[-1]) & (m.t[:-n] >= when[0])
        rows = covered & (np.linalg.norm(turn, axis=1) > MIN_TURN)
        if rows.sum() >= MIN_TURNS:
            return turn[rows], 0.5 * (m.value[n:] + m.value[:-n])[rows], (m.value[n:] - m.value[:-n])[rows]
    return None


def explained(turn: np.ndarray, middle: np.ndarray, change: np.ndarray) -> float:
    """Share of the changes (K, 3) that are -theta x m."""
    rest = change + np.cross(turn, middle)
    return 1.0 - float((rest**2).sum()) / max(float((change**2).sum()), 1e-30)


def hard_iron(turn: np.ndarray, middle: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the hard iron (3,) uT that explains most; zero along an axis without rotation about it."""
    x, y, z = turn.T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3)
    return np.linalg.lstsq(skew, (change + np.cross(turn, middle)).ravel(), rcond=1e-2)[0]
