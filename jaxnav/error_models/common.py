"""What the error models of all frames share: attitude and bias feedback, and the discrete model from 3x3 blocks."""

import jax
import jax.numpy as jnp

from jaxnav import linalg, rotations
from jaxnav.error_models.states import STATES, A, B, G
from jaxnav.types import Drive, Nav, Noise


def retract_common(nav: Nav, x: jax.Array) -> Nav:
    """Remove the attitude and bias errors, which are alike in every frame."""
    nav = nav._replace(q=rotations.normalize(rotations.multiply(rotations.exp(-x[A]), nav.q)))
    if x.shape[0] <= 9:
        return nav
    return nav._replace(b_g=nav.b_g - x[G], b_a=nav.b_a - x[B])


def absorb(nav: Nav, drive: Drive) -> Nav:
    """Feed a constant model error (in the axes of the frame) to the sensors as bias in body axes.

    An estimate that accelerates too much by ``drive.accel`` has an accelerometer bias too small by that much.
    """
    C = rotations.to_dcm(nav.q)
    return nav._replace(b_g=nav.b_g + C.T @ drive.omega, b_a=nav.b_a + C.T @ drive.accel)


def assemble(blocks: dict[tuple[str, str], jax.Array], n: int) -> jax.Array:
    """A (n, n) matrix from 3x3 blocks by (row, column) names of states; zero elsewhere, those beyond n left out."""
    zero = jnp.zeros((3, 3))
    names = list(STATES)[: n // 3]
    return jnp.block([[blocks.get((row, column), zero) for column in names] for row in names])


def discretize_blocks(
    blocks: dict[tuple[str, str], jax.Array],
    C: jax.Array,
    noise: Noise,
    bias: tuple[jax.Array, jax.Array],
    T: jax.Array,
    u: Drive,
    n: int,
    C_attitude: jax.Array | None = None,
    lumped: bool = False,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Phi, Q, d over T from the kinematic blocks, with sensor noise through ``C`` and Gauss-Markov biases.

    ``C_attitude`` takes body to the axes of the attitude error, where those are not the velocity's. ``lumped``: see
    `jaxnav.linalg.discretize`.

    Navigation holds the estimated bias constant while a Gauss-Markov bias decays, so that the error of a bias
    estimate b grows by b / tau: that is part of d.
    """
    psd = lambda sd: jnp.broadcast_to(sd, (3,)) ** 2  # noqa: E731
    C_attitude = C if C_attitude is None else C_attitude
    rate = lambda tau: 1 / jnp.broadcast_to(tau, (3,))  # noqa: E731
    decay_g, decay_a = rate(noise.gyro_tau), rate(noise.accel_tau)
    F = assemble(
        blocks | {("gyro_bias", "gyro_bias"): -jnp.diag(decay_g), ("accel_bias", "accel_bias"): -jnp.diag(decay_a)}, n
    )
    Q = assemble(
        {
            ("velocity", "velocity"): (C * psd(noise.accel)) @ C.T,
            ("attitude", "attitude"): (C_attitude * psd(noise.gyro)) @ C_attitude.T,
            ("gyro_bias", "gyro_bias"): jnp.diag(psd(noise.gyro_bias)),
            ("accel_bias", "accel_bias"): jnp.diag(psd(noise.accel_bias)),
        },
        n,
    )
    b = jnp.concatenate([jnp.zeros(3), u.accel, u.omega, decay_g * bias[0], decay_a * bias[1]])[:n]
    return linalg.discretize(F, Q, b, T, lumped)
