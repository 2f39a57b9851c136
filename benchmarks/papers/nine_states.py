"""Nearly a filter of 15 states with a covariance of nine: value of the GIP-KF's increment beyond it."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.rule import Correction, Innovation, Rule
from jaxnav.maths import linalg
from jaxnav.states.motion import A, V
from jaxnav.states.table import BIASES
from jaxnav.types import Forcing


class NineKf(NamedTuple):
    """Parameters of `nine_states`: gains of states without a covariance."""

    walk: jax.Array  # () growth of the position's variance in an epoch, in variances of a fix
    lag: jax.Array  # () s: a correction of velocity moves the position as if it had been off for so long
    vertical: jax.Array  # (3,) shares of the vertical residuals: of position, of velocity, and that becomes bias
    kappa: jax.Array  # () share of the heading's correction that becomes bias of the z gyro, in the long run
    early: jax.Array  # () and early / (corrections so far + delay) on top, as of a bias that is learnt from the start
    delay: jax.Array  # ()
    fade: jax.Array  # () the heading's sd grows by this share at each correction, at first
    fading: jax.Array  # () corrections in which that falls to 1/e


def nine_params(
    walk: float = 0.001, lag: float = 5.0, vertical: tuple[float, float, float] = (0.06, 0.25, 0.01),
    kappa: float = 1e-5, early: float = 1e-5, delay: float = 5.0, fade: float = 1e-3, fading: float = 15.0,
) -> NineKf:  # fmt: skip
    """`NineKf` from plain numbers; the defaults are for gyros with biases calibrated at rest."""
    return NineKf(*(jnp.asarray(v, float) for v in (walk, lag, vertical, kappa, early, delay, fade, fading)))


#: horizontal velocity (the tangent frame's y is up), attitude, gyro biases x and y, accelerometer biases x and y
KEPT = np.array([3, 5, 6, 7, 8, 9, 10, 12, 13])
_PAIR, _UP, _FLAT = np.array([3, 4]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 1.0])


def correct_nine(theta: NineKf, memory: tuple[jax.Array, jax.Array], z: Innovation) -> Correction:
    """Kalman update of `KEPT` by the horizontal velocity; everything else by gains."""
    count, spread = memory
    K, kept = linalg.update(z.P[np.ix_(KEPT, KEPT)], z.H[_PAIR][:, KEPT], z.R[np.ix_(_PAIR, _PAIR)])
    delta = jnp.zeros(15).at[KEPT].set(K @ z.nu[_PAIR])
    T = jnp.where(z.T > 0, z.T, 1.0)
    spread = spread + theta.walk * (z.age[0] / T) ** 2  # as of a velocity that is off
    share = spread / (1 + spread)
    up, climb, bias = theta.vertical
    gap = theta.lag + 0.5 * (z.age[0] - T)
    delta = delta.at[:3].set(z.H[:3, :3].T @ (jnp.stack([share, share, up]) * z.nu[:3]) + gap * _FLAT * delta[V])
    delta = delta.at[V].add(_UP * climb * z.nu[5])
    learnt = theta.kappa + theta.early / (count + theta.delay)
    drive = Forcing(learnt * _UP * delta[A] / T, bias * _UP * z.nu[5] / T)
    fade = jnp.ones(15).at[A].add(_UP * theta.fade * jnp.exp(-count / theta.fading))
    P = jnp.zeros_like(z.P).at[np.ix_(KEPT, KEPT)].set(kept)
    return Correction(delta, P, (count + 1.0, (1 - share) * spread), z.valid, fade, drive)


@cache
def nine_states() -> Rule:
    """Not the paper's: nearly a filter of 15 states with a covariance of nine, for a car in the tangent frame at 1 Hz.

    Position, vertical states and the bias of the z gyro follow by constant gains, in the spirit of the increment; the
    other biases are states. For the model of 15 states, GNSS position and velocity, and no lever arm; of P only the
    rows and columns of `KEPT` have a meaning.
    """
    return Rule(lambda n, m: (jnp.zeros(()), jnp.ones(())), correct_nine, estimates=BIASES)
