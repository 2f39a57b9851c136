"""Functions that several checks use."""

import numpy as np

from jaxnav.maths import earth
from jaxnav.types import Samples


def local(lla: np.ndarray) -> np.ndarray:
    """Positions (K, 3) in ENU metres from the middle one."""
    return earth.enu_path(lla, lla[len(lla) // 2])


def level_velocity(aiding: dict[str, Samples]) -> Samples | None:
    """Return the stream of velocities, or differences of positions over two seconds where there is none."""
    if "velocity" in aiding and aiding["velocity"].t.size > 10:
        return aiding["velocity"]
    position = aiding.get("position")
    if position is None or position.t.size < 10:
        return None
    n = max(1, round(2.0 / float(np.median(np.diff(position.t)))))
    if position.t.size <= n + 5:
        return None
    dt = (position.t[n:] - position.t[:-n])[:, None]
    p = local(position.value)
    value = (p[n:] - p[:-n]) / dt
    keep = dt[:, 0] < 2 * float(np.median(dt))
    t = 0.5 * (position.t[n:] + position.t[:-n])
    return Samples(t[keep], value[keep], (1.5 * position.sd[n:] / dt)[keep], np.zeros_like(value)[keep])


def rms(a: np.ndarray) -> float:
    """Root mean square of all numbers."""
    return float(np.sqrt(np.mean(np.square(a)))) if np.size(a) else 0.0
