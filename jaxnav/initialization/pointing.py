"""Heading without motion: by two antennas, or by the Earth's magnetic field."""

import math
from typing import NamedTuple

import numpy as np

from jaxnav.initialization.magnetic import field_of, heading_of
from jaxnav.maths.units import DEG
from jaxnav.measurements.direction import HEADING
from jaxnav.types import Params, Recording

MAX_HEADING_SD = 20 * DEG  # sd of a heading that one filter can still start with
MAX_AGE_S, SIMULTANEOUS_S = 1.0, 0.1  # from a start to a heading sensor; within which no vehicle turns
HARD_IRON_SD = 3.0  # uT, sd of the remaining hard iron of a calibrated magnetometer
MAX_BENT_SHARE = 0.3  # of the field's strength, from which on iron is too near, or the axes are others
MIN_TILT_SD = 0.3 * DEG  # tilt error by scale errors and misalignment, after any averaging


class HeadingSource(NamedTuple):
    """A heading that needs no motion."""

    heading: float  # rad
    sd: float  # rad
    words: str
    magnetic: bool = False


def heading_by_sensor(
    rec: Recording, known: Params, rp: tuple[float, float], tilt_sd: float, t: float
) -> HeadingSource | None:
    """Heading at ``t`` s by two antennas, else by the magnetometer; None where it is not known to `MAX_HEADING_SD`.

    ``rp``, ``tilt_sd``: roll and pitch there, and their sd, rad. By the samples within `MAX_AGE_S` s.
    """
    near = {
        name: np.abs(rec.aiding[name].t - t) < MAX_AGE_S for name in ("heading", "magnetometer") if name in rec.aiding
    }
    if near.get("heading", np.zeros(1)).any():
        s, theta = rec.aiding["heading"], known.measurements.get("heading", HEADING.defaults)
        i = int(np.argmin(np.abs(s.t - t)))
        angle, sd = float(s.value[i, 0]) - float(theta.yaw), float(s.sd[i, 0] * theta.sd_scale)
        if sd <= MAX_HEADING_SD:
            return HeadingSource(angle, max(sd, MIN_TILT_SD), f"{angle / DEG % 360:.1f} deg by two antennas")
    if not near.get("magnetometer", np.zeros(1)).any():
        return None
    field = field_of(known, rec.aiding["position"].value[0])
    compass = rec.aiding["magnetometer"]
    closest = np.abs(compass.t - t).min()
    seen = compass.value[np.abs(compass.t - t) <= max(SIMULTANEOUS_S, closest)].mean(0)  # it may turn
    angle, level, bent = heading_of(seen, *rp, field)
    if bent > MAX_BENT_SHARE * field.strength:
        return None
    sd = math.sqrt((HARD_IRON_SD / level) ** 2 + (math.tan(field.inclination) * tilt_sd) ** 2 + field.sd**2)
    if sd > MAX_HEADING_SD:
        return None
    return HeadingSource(angle, sd, f"{angle / DEG % 360:.1f} deg by the magnetometer", True)
