"""Generalized PID Kalman filter (Ansari et al. 2024, IJE 37(06), eqs. 18-34).

    x+ = x- + K r + x_I + x_D                       (27, 34)
    x_I(k) = leak x_I(k-1) + ki M K yt(k-1)         (25, 31)
    x_D(k) = kd M K (yt(k-1) - yt(k-2))             (26, 32)
    yt(k) = y(k) - H x+(k)                          (21)

K is the Kalman gain; integral and derivative do not enter its covariance recursion (28-33). The paper's form has
M = I and leak = 1: `literal`, which diverges on the paper's circle for both printed gain pairs (a double integrator
on the weakly observable heading). The default acts on the position states only, which is stable.

Anti-windup, which the paper lacks: where the channels that observe a state are missing, or a gate has rejected
them, its x_I stands still and is not applied, nor is its x_D. Added at every fix, it would push a position that nothing
corrects. With all channels there the equations are the paper's.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxnav.filters.rule import Correction, Innovation, Rule
from jaxnav.maths import linalg
from jaxnav.states.motion import MOTION
from jaxnav.states.table import BIASES, mask


class Gpid(NamedTuple):
    """Parameters of the rule."""

    ki: jax.Array  # () or (m,) integral gain per channel
    kd: jax.Array  # () or (m,) derivative gain per channel
    states: jax.Array  # (n,) 1 where integral and derivative act
    leak: jax.Array  # () share of the integral that stays from one fix to the next; 1 is a pure integral, 0 none
    reset: jax.Array  # () s; the memory of a channel that has not been used for longer is cleared


class GpidMemory(NamedTuple):
    """Integral state and the last two a-posteriori residuals; a missing channel keeps its values."""

    integral: jax.Array  # (n,)
    last: jax.Array  # (m,)
    before: jax.Array  # (m,)
    loop: jax.Array  # (n, m) share of its error that each channel takes out of a state, the parts of diag(K H)


def gpid_params(
    ki: ArrayLike,
    kd: ArrayLike,
    n_states: int = 9,
    states: tuple[str, ...] = ("position",),
    leak: float = 1.0,
    reset: float = np.inf,
) -> Gpid:
    """Parameters from plain numbers; ``states`` names where integral and derivative act."""
    return Gpid(
        *(jnp.asarray(v, float) for v in (ki, kd, mask(*states, states=BIASES if n_states > 9 else ()), leak, reset))
    )


def literal_params(ki: ArrayLike, kd: ArrayLike, n_states: int = 9) -> Gpid:
    """Return the paper's printed form: integral and derivative act on every state."""
    return gpid_params(ki, kd, n_states, (*MOTION, *BIASES)[: n_states // 3])


def share(loop: jax.Array, channels: jax.Array) -> jax.Array:
    """Return the part of each state's feedback (n,) through ``channels`` (m,) bool; 1 for a state without feedback."""
    total = loop.sum(1)
    some = total > 0
    part = jnp.where(channels, loop, 0.0).sum(1) / jnp.where(some, total, 1.0)
    return jnp.where(some, part, channels.any())


def clear_stale(memory: GpidMemory, stale: jax.Array) -> GpidMemory:
    """Return the memory without the parts of the ``stale`` (m,) channels."""
    drop = lambda a: jnp.where(stale, 0.0, a)
    kept = memory.integral * share(memory.loop, ~stale)
    return GpidMemory(kept, drop(memory.last), drop(memory.before), drop(memory.loop))


def correct(theta: Gpid, memory: GpidMemory, z: Innovation) -> Correction:
    """One correction; missing channels have columns of zeros in K, and add nothing to the integral."""
    memory = clear_stale(memory, z.age > theta.reset)
    K, P = linalg.update(z.P, z.H, z.R, z.inverse)
    loop = jnp.where(z.valid, jnp.abs(K * z.H.T), memory.loop)
    acting = share(loop, z.valid)
    M = theta.states * acting
    applied = theta.leak * acting * memory.integral + M * (K @ (theta.ki * memory.last))
    derivative = M * (K @ (theta.kd * (memory.last - memory.before)))
    delta = K @ z.nu + applied + derivative
    residual = z.nu - z.H @ delta
    last, before = jnp.where(z.valid, residual, memory.last), jnp.where(z.valid, memory.last, memory.before)
    memory = GpidMemory(applied + (1 - acting) * memory.integral, last, before, loop)
    return Correction(delta, P, memory, z.valid)


@cache
def gpid() -> Rule:
    """GpidMemory starts at zero (eqs. 19, 20)."""
    return Rule(lambda n, m: GpidMemory(jnp.zeros(n), jnp.zeros(m), jnp.zeros(m), jnp.zeros((n, m))), correct)
