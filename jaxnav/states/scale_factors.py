"""Scale factor errors of the inertial sensors: what is read is (1 + s) times the truth, axis by axis."""

import jax
import numpy as np

from jaxnav.maths import units
from jaxnav.states.state import BODY, State, state_units
from jaxnav.types import StateParams


def diagonal(w: jax.Array, other: jax.Array) -> jax.Array:
    """M = diag(w), (..., 3, 3)."""
    return w[..., None] * np.eye(3)


def _scale(sensor: str) -> State:
    name = f"{sensor}_scale"
    drive = (f"{name}_ppm_per_sqrt_s", units.PPM, "ppm/sqrt(s)")
    units_of = state_units(name, "ppm", units.PPM, 3, "ppm", drive)
    constant = StateParams(sd=3000 * units.PPM, drive=0.0, tau=float("inf"))
    return State(name, BODY, sensor, diagonal, constant, units_of)


GYRO_SCALE = _scale("gyro")
"""1, body: a constant unless it is driven."""
ACCEL_SCALE = _scale("accel")
"""1, body."""
