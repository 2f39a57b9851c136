"""Taking the estimated errors out of what the inertial sensors read, and how a reading changes with them."""

from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp

from jaxnav.states.state import State
from jaxnav.states.table import STATES
from jaxnav.types import Imu


def corrected_reading(reading: jax.Array, sensor: str, errors: Mapping[str, jax.Array]) -> jax.Array:
    """What ``sensor`` ("gyro" or "accel") would have read without its errors, (..., 3), from what it read (..., 3).

    reading = w + sum M_i(w) s_i, solved for w. Biases have M = I; the others' M is linear in w, and three rounds of
    w <- reading - sum M_i(w) s_i leave the fourth power of a scale error, 1e-10 of the reading at 3,000 ppm.
    """
    own = [(STATES[name], s) for name, s in errors.items() if STATES[name].enters == sensor]
    for state, s in own:
        if state.effect is None:
            reading = reading - s
    w = reading
    scaled = [(state.effect, s) for state, s in own if state.effect is not None]
    for _ in range(3 if scaled else 0):
        w = reading - sum(effect(w) @ s for effect, s in scaled)
    return w


def corrected(imu: Imu, errors: Mapping[str, jax.Array]) -> Imu:
    """Samples without the estimated errors of the sensors."""
    return imu._replace(
        gyro=corrected_reading(imu.gyro, "gyro", errors), accel=corrected_reading(imu.accel, "accel", errors)
    )


def columns(sensor: str, w: jax.Array, chosen: Iterable[State]) -> dict[str, jax.Array]:
    """D reading / d state, M(w) (..., 3, size), by name of those that enter ``sensor``; w (..., 3) its true value."""
    eye = jnp.broadcast_to(jnp.eye(3, dtype=w.dtype), (*w.shape, 3))
    return {s.name: eye if s.effect is None else s.effect(w) for s in chosen if s.enters == sensor}
