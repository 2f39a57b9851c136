"""Scale factor errors of the inertial sensors: the reading is (1 + s) times the truth, axis by axis."""

import jax
import numpy as np

from jaxnav.maths import units
from jaxnav.states.state import BODY, Reading, State, UserUnit, constant


def diagonal(reading: Reading) -> jax.Array:
    """Return M = diag(w), (..., 3, 3)."""
    return reading.this[..., None] * np.eye(3)


def _scale(sensor: str) -> State:
    return constant(f"{sensor}_scale", BODY, 3000.0, UserUnit("ppm", units.PPM, "ppm"), sensor, diagonal)


GYRO_SCALE = _scale("gyro")
"""1, body: a constant unless it is driven."""
ACCEL_SCALE = _scale("accel")
"""1, body."""
