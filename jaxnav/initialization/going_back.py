"""A start at the begin of a recording for its smoother, where a filter could only start later.

A live filter starts when its alignment ends, after 10 s to a minute. Smoothed attitude and biases are known there by
all fixes, and the gyro carries the attitude back, from t1 to t:

    C(t) = exp([w_ie x] (t1 - t)) C(t1) R(t1)'        R: body axes at t1 -> those at t

so that a filter with wide sd starts there at the right place, and takes its information from the fixes.
"""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxnav.filters.run import initial_nav
from jaxnav.findings import finding
from jaxnav.initialization.alignment import rotation_at_end, window
from jaxnav.initialization.bank import with_headings
from jaxnav.initialization.initialize import (
    KNOWN_HEADING_SD,
    UNCORRELATED,
    Initialization,
    first_fix,
    ground_velocity,
    halfway,
)
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG, TICK
from jaxnav.states.motion import A
from jaxnav.states.table import BIASES
from jaxnav.types import Info, Params, Prior, Recording

LEAST_S = 1.0  # s that a start is to be earlier
WIDER = 3.0  # times the smoothed sd: its fixes are used once more
LEAST_SD = np.array([1.0, 1.0, 3.0]) * DEG  # of tilt and heading
CHORD_SD = 3.0  # m/s, of a velocity by differences of positions over seconds


def gone_back(rec: Recording, params: Params, begin: Initialization, smoothed: Info, t: float) -> Initialization | None:
    """Return a start at the first fix of a recording; None where it is as early already, or the heading stays unknown.

    Args:
        rec: the recording.
        params: of the filter, with the sd of its datasheet.
        begin: the start of the filter.
        smoothed: (E, ...) from there on, by all fixes.
        t: s, end of its first epoch.
    """
    nav, sd = smoothed.nav, np.sqrt(np.diagonal(smoothed.P[0]))[A]
    if not (np.isfinite(sd).all() and sd[2] <= KNOWN_HEADING_SD):
        return None
    position = rec.aiding["position"]
    if not (position.t[:-1] >= begin.earliest - TICK).any():
        return None
    velocity = ground_velocity(rec)
    first, lla, vel, sds = first_fix(rec, params, position, velocity, begin.earliest)
    samples = window(rec.imu, first, t)
    if begin.t - first < LEAST_S or samples.t.size < 2:
        return None
    errors = {name: np.asarray(nav.errors[name])[:1] for name in BIASES if name in nav.errors}
    R, _ = rotation_at_end(samples, errors["gyro_bias"][0] if "gyro_bias" in errors else np.zeros(3))
    turned = Rotation.from_rotvec(np.asarray(earth.earth_rate(jnp.asarray(lla[0]))) * (t - first)).as_matrix()
    C = turned @ np.asarray(rotations.to_dcm(jnp.asarray(nav.q[0]))) @ R.T
    rph = np.asarray(rotations.to_rph(jnp.asarray(C)))
    start = initial_nav(lla, vel, rph, halfway(rec))._replace(t=jnp.asarray(first, float))
    navs = with_headings(start, rph[2:], params.mounting.lever_arm)
    navs = navs._replace(errors={name: jnp.asarray(b) for name, b in errors.items()})
    loose = 0.0 if "velocity" in rec.aiding else CHORD_SD
    attitude = np.maximum(WIDER * sd, LEAST_SD)
    prior = Prior(*map(jnp.asarray, (sds[0], np.hypot(sds[1], loose), attitude, UNCORRELATED)))
    found = (*begin.findings, finding("start.gone_back", value=first))
    return Initialization(navs, prior, first, found, field=begin.field, earliest=begin.earliest)
