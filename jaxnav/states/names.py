"""The error state by name, once for every frame; x = estimate - truth.

Order: position, velocity, attitude, gyro_bias, accel_bias; three each; a model with 9 states has the first three.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.types import Prior

STATES = {
    "position": slice(0, 3),  # m
    "velocity": slice(3, 6),  # m/s
    "attitude": slice(6, 9),  # rad, C_est = exp([phi x]) C_true
    "gyro_bias": slice(9, 12),  # rad/s, body
    "accel_bias": slice(12, 15),  # m/s^2, body
}
P, V, A, G, B = STATES.values()


def mask(*names: str, n_states: int = 15) -> np.ndarray:
    """1.0 on the named states and 0.0 elsewhere, (n_states,)."""
    unknown = set(names) - set(STATES)
    if unknown:
        raise ValueError(f"unknown states {sorted(unknown)}; known are {list(STATES)}")
    m = np.zeros(n_states)
    for name in names:
        if STATES[name].stop > n_states:
            raise ValueError(f"a model of {n_states} states has no {name}")
        m[STATES[name]] = 1.0
    return m


def prior_sd(prior: Prior, n_states: int) -> jax.Array:
    """The prior's standard deviations side by side, (n_states,)."""
    return jnp.concatenate([jnp.broadcast_to(sd, (3,)) for sd in prior])[:n_states]
