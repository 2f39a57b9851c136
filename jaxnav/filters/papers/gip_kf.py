"""Incremental predictive Kalman filter GIP-KF (Journal of Control, English Edition, 01(01), July 2022, pp. 49-57).

The paper's error model has an unknown input m, x(k+1) = F x(k) + m(k) + w (23). Its increment makes the
residual small at least cost (32-34), nu = y - H (the prediction without it):

    dm = G nu,  G = (H' R_l H + R_m)^-1 H' R_l,    x- = x_predicted + dm,    x+ = x- + K (y - H x-)         (33, 35, 36)

K and P are those of the Kalman filter, without m. "Gain" in eq. 34 is the whole of dm, and "equation
(29)" before eq. 35 means eq. 33.

`literal` is the recursion as printed, x_predicted = (I + F_k) x_k - F_k-1 x_k-1 = F x_k + m, where m = x_k - F x_k-1 is
all that the model left unexplained, the Kalman correction included. In open loop (`gipkf_literal`) x carries the whole
error; under reset (`gipkf_literal_shift`) both past states are shifted by the correction of navigation, which
leaves m as it is. A tilt and the m that balances it are indistinguishable in an earth-fixed frame, so that m walks.

`gip_kf` works: both past states start from zero after a correction, and of dm the velocity part becomes accelerometer
bias, dm_v / T in body axes, which turns with the vehicle and holds through an outage, and its attitude part gyro bias,
as the paper's Fig. 3 has it. With diagonal weights there is none: it takes an R_m that couples attitude to velocity, or
``kappa`` (not in the paper), kappa (x+ - F x)_attitude / T.

R_m and Q have an index k in print (32, 35), and the biases that they stand for are learnt once: after t seconds with
fixes R_m is (1 + growth t) times its initial value, and the part ``unlearnt`` of the process noise is
1 / (1 + growth t) of it. With both zero the weights are constant.
"""

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

LEARNT = 600.0  # s after which weights stay as they are: biases drift


class GipKf(NamedTuple):
    """Parameters: weights L diag(exp(log)) L' with L unit lower triangular, positive definite for any numbers."""

    log_rl: jax.Array  # (m,) of the residual, per channel: log of 1/m^2, s^2/m^2 in ENU
    rl_lower: jax.Array  # (m (m - 1) / 2,) couplings, row by row below the diagonal of L; 0 is a diagonal weight
    log_rm: jax.Array  # (n,) of the increment, per state: log of 1/m^2, s^2/m^2, 1/rad^2 in the axes of the frame
    rm_lower: jax.Array  # (n (n - 1) / 2,)
    kappa: jax.Array  # () or (3,) share of the attitude correction that becomes gyro bias; 0 is the paper's
    growth: jax.Array  # () 1/s, of R_m with the time that there were fixes
    # (6,) m/s/sqrt(s), rad/sqrt(s): noise of velocity and attitude on top of Q at the start, which falls as R_m grows
    unlearnt: jax.Array


def gip_kf_params(
    position: float = 0.003,
    velocity: float = 0.02,
    kappa: float = 0.0,
    n_states: int = 9,
    channels: int = 6,
    growth: float = 0.0,
    unlearnt: tuple[float, float] = (0.0, 0.0),
) -> GipKf:
    """Diagonal weights that take these shares of a position and a velocity residual for model error, at the start.

    Only the six ratios R_l / R_m of a channel and its state matter: R_l is 1 here. A lever arm lets a position residual
    turn the attitude too; the weight of the other states is large enough that it does not. ``unlearnt`` is of velocity
    and of attitude, on all axes; units as in `GipKf`.

    Raises:
        ValueError: a share outside of 0 to 1, or a negative growth.
    """
    for name, share in (("position", position), ("velocity", velocity)):
        if not 0 < share < 1:
            raise ValueError(f"{name}: a share is between 0 and 1, got {share:g}")
    if growth < 0:
        raise ValueError(f"growth: R_m cannot shrink below zero, got {growth:g} 1/s")
    odds = lambda share: np.log(1 / share - 1)
    log_rm = np.full(n_states, np.log(1e6))
    log_rm[:3], log_rm[3:6] = odds(position), odds(velocity)
    pairs = lambda n: np.zeros(n * (n - 1) // 2)
    values = np.zeros(channels), pairs(channels), log_rm, pairs(n_states), kappa, growth, np.repeat(unlearnt, 3)
    return GipKf(*(jnp.asarray(v, float) for v in values))


def weight(log: jax.Array, lower: jax.Array) -> jax.Array:
    """L diag(exp(log)) L', (n, n), from (n,) and the couplings (n (n - 1) / 2,)."""
    n = log.shape[0]
    L = jnp.eye(n, dtype=log.dtype).at[np.tril_indices(n, -1)].set(lower)
    return (L * jnp.exp(log)) @ L.T


def gain(theta: GipKf, H: jax.Array, valid: jax.Array) -> jax.Array:
    """G of eq. 34, (n, m); its columns of missing channels are zero.

    Raises:
        ValueError: weights of other sizes than H (m, n).
    """
    if (theta.log_rl.shape[0], theta.log_rm.shape[0]) != H.shape:
        raise ValueError(
            f"rule.log_rl and rule.log_rm have {theta.log_rl.shape[0]} and {theta.log_rm.shape[0]} "
            f"entries for {H.shape[0]} channels and {H.shape[1]} states"
        )
    R_l = jnp.where(valid[:, None] & valid, weight(theta.log_rl, theta.rl_lower), 0.0)
    HR = H.T @ R_l
    return linalg.solve(HR @ H + weight(theta.log_rm, theta.rm_lower), HR)


def _update(theta: GipKf, z: Innovation) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the increment dm (n,), x+ minus the prediction without it (n,), and P."""
    dm = gain(theta, z.H, z.valid) @ z.nu
    K, P = linalg.update(z.P, z.H, z.R, z.inverse)
    return dm, dm + K @ (z.nu - z.H @ dm), P


def correct(theta: GipKf, t: jax.Array, z: Innovation) -> Correction:
    """Correct by the working form; needs the feedback `reset`. ``t`` () s: time with fixes so far."""
    pad_epochs = 1 + theta.growth * jnp.minimum(t, LEARNT)
    dm, delta, P = _update(theta._replace(log_rm=theta.log_rm + jnp.log(pad_epochs)), z)
    T = jnp.where(z.T > 0, z.T, 1.0)
    P = P.at[3:9, 3:9].add(jnp.diag((theta.unlearnt / pad_epochs) ** 2 * z.T))
    gyro = theta.kappa * delta[A] / T + dm[A] / T
    return Correction(delta, P, t + z.T, z.valid, drive=Forcing(gyro, dm[V] / T))


def extrapolate_literal(theta: GipKf, m: jax.Array, x0: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eq. 29 without the increment, F x_k + m; in an outage m (n,) stays."""
    return x + m, m


def correct_literal(theta: GipKf, m: jax.Array, z: Innovation) -> Correction:
    """Eqs. 33-36; the model error is then x+ - F x, the Kalman correction included."""
    _, delta, P = _update(theta, z)
    return Correction(delta, P, m + delta, z.valid)


@cache
def gip_kf() -> Rule:
    """Return the working form; its memory is the time of learning, the sensors' biases hold the result."""
    return Rule(lambda n, m: jnp.zeros(()), correct, estimates=BIASES)


@cache
def literal() -> Rule:
    """Return the recursion as printed, from x = m = 0."""
    return Rule(lambda n, m: jnp.zeros(n), correct_literal, extrapolate_literal)
