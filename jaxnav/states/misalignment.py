"""Misalignment and non-orthogonality of the inertial sensors: each axis sees a share of the two others.

The elements off the diagonal of M_g and M_a in Groves 2013, eqs. 4.16 and 4.17.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import units
from jaxnav.states.state import Reading, State, UserUnit, constant

PAIRS = (("x", "y"), ("x", "z"), ("y", "x"), ("y", "z"), ("z", "x"), ("z", "y"))
"""(axis that reads, axis that it sees): the sensor's axis is turned by so many rad towards the other."""
_OTHER = np.zeros((3, 6, 3))  # reading axis, state, axis that is seen
for _i, (_row, _seen) in enumerate(PAIRS):
    _OTHER["xyz".index(_row), _i, "xyz".index(_seen)] = 1.0


def crossed(reading: Reading) -> jax.Array:
    """Return M (..., 3, 6): column i has the seen axis of `PAIRS` in the row of the reading one."""
    return jnp.einsum("rij,...j->...ri", _OTHER, reading.this)


def _misalignment(sensor: str) -> State:
    axes = tuple(f"{a} sees {b}" for a, b in PAIRS)
    return constant(f"{sensor}_misalignment", axes, 3.0, UserUnit("mrad", units.MRAD, "mrad"), sensor, crossed)


GYRO_MISALIGNMENT = _misalignment("gyro")
"""rad, `PAIRS`: a constant unless it is driven."""
ACCEL_MISALIGNMENT = _misalignment("accel")
"""rad, `PAIRS`. A rotation common to gyros and accelerometers is one of the body's axes: only the prior bounds it."""
