"""Generalized PID Kalman filter (Ansari et al. 2024, IJE 37(06), eqs. 18-34).

    x+ = x- + K r + x_I + x_D                       (27, 34)
    x_I(k) = leak x_I(k-1) + ki M K yt(k-1)         (25, 31)
    x_D(k) = kd M K (yt(k-1) - yt(k-2))             (26, 32)
    yt(k) = y(k) - H x+(k)                          (21)

K is the Kalman gain, whose covariance recursion (28-33) the integral and derivative leave alone. The paper's form has
M = I and leak = 1: `literal`, which diverges on the paper's own circle for both printed gain pairs (a double integrator
on the weakly observable heading). The default acts on the position states only, which is stable.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav import linalg
from jaxnav.error_models.states import STATES, mask
from jaxnav.filters.core import Correction, Innovation, Rule


class Gpid(NamedTuple):
    """Parameters of the rule."""

    ki: jax.Array  # () or (m,) integral gain per channel
    kd: jax.Array  # () or (m,) derivative gain per channel
    states: jax.Array  # (n,) 1 where integral and derivative act
    leak: jax.Array  # () what the integral keeps from one fix to the next; 1 is a pure integral


class Memory(NamedTuple):
    """Integral state and the last two a-posteriori residuals; a missing channel keeps its own."""

    integral: jax.Array  # (n,)
    last: jax.Array  # (m,)
    before: jax.Array  # (m,)


def gpid_params(ki: float, kd: float, n_states: int = 9, states: tuple[str, ...] = ("position",), leak=1.0) -> Gpid:
    """Parameters from plain numbers; ``states`` names where integral and derivative act."""
    return Gpid(*(jnp.asarray(v, float) for v in (ki, kd, mask(*states, n_states=n_states), leak)))


def literal_params(ki: float, kd: float, n_states: int = 9) -> Gpid:
    """The paper's printed form: integral and derivative act on every state."""
    return gpid_params(ki, kd, n_states, tuple(STATES)[: n_states // 3])


def correct(theta: Gpid, memory: Memory, z: Innovation) -> Correction:
    """One correction. The integral stands still while its channels are missing: their columns of K are zero."""
    K = linalg.gain(z.P, z.H, z.H @ z.P @ z.H.T + z.R)
    integral = theta.leak * memory.integral + theta.states * (K @ (theta.ki * memory.last))
    derivative = theta.states * (K @ (theta.kd * (memory.last - memory.before)))
    delta = K @ z.nu + integral + derivative
    residual = z.nu - z.H @ delta
    memory = Memory(integral, jnp.where(z.valid, residual, memory.last), jnp.where(z.valid, memory.last, memory.before))
    return Correction(delta, linalg.joseph(z.P, K, z.H, z.R), memory, z.valid)


@cache
def gpid() -> Rule:
    """Memory starts at zero (eqs. 19, 20)."""
    return Rule(lambda n, m: Memory(jnp.zeros(n), jnp.zeros(m), jnp.zeros(m)), correct)
