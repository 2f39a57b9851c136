"""Feedback of the corrected error state: (theta, retract, nav, x, T) -> nav, x, u.

u is None but for an observer. T is the length of the epoch, or the time between fixes of one kind where that is longer.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.states.motion import A, P, V
from jaxnav.types import Forcing, Nav, Tree

Retract = Callable[[Nav, jax.Array], Nav]
Applied = tuple[Nav, jax.Array, Forcing | None]


def reset(theta: Tree, retract: Retract, nav: Nav, x: jax.Array, T: jax.Array) -> Applied:
    """Remove the error from navigation (closed loop); its estimate starts again from zero."""
    return retract(nav, x), jnp.zeros_like(x), None


def open_loop(theta: Tree, retract: Retract, nav: Nav, x: jax.Array, T: jax.Array) -> Applied:
    """Navigation runs free and the filter carries the whole error: only while that stays small enough to be linear."""
    return nav, x, None


class Poles(NamedTuple):
    """Time constants of the observer."""

    attitude: jax.Array  # () s
    position: jax.Array  # () s, both poles of position and velocity


def poles(attitude: float = 1.0, position: float = 1.0) -> Poles:
    """`Poles` from plain numbers."""
    return Poles(jnp.asarray(attitude, float), jnp.asarray(position, float))


def observer(theta: Poles, retract: Retract, nav: Nav, x: jax.Array, T: jax.Array) -> Applied:
    """Continuous correction (FWEKF paper, eqs. 17-20): rates and accelerations drive the error to zero.

    The paper has gains for continuous time and no values of them. With its poles at tau they are 1/tau, 1/tau^2 and
    2/tau, which is unstable for T >= tau; these put the poles of the sampled system at exp(-T/tau) for any T, and
    tend to those for T << tau. The next epoch must not be several times longer than T. Biases are reset, having no
    driving noise.
    """
    T = jnp.where(T > 0, T, 1.0)
    spin = -jnp.expm1(-T / theta.attitude) / T
    rho = jnp.exp(-T / theta.position)
    stiffness, damping = (1 - rho) ** 2 / T**2, (3 - 2 * rho - rho**2) / (2 * T)
    u = Forcing(-spin * x[A], -stiffness * x[P] - damping * x[V])
    biases = jnp.where(jnp.arange(x.size) >= 9, x, 0.0)
    return retract(nav, biases), x - biases, u
