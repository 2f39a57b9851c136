"""What the error models of all frames share: attitude and bias feedback, and the discrete model from 3x3 blocks."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import linalg, rotations
from jaxnav.maths.components import running
from jaxnav.states.names import STATES, A, B, G
from jaxnav.types import Drive, Nav, Noise, Path


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


FAST = {("velocity", "attitude"), ("velocity", "accel_bias"), ("attitude", "gyro_bias")}
"""Blocks that follow specific force and attitude from sample to sample, and must be linear in ``force`` (the first) or
``C`` (the others); all other blocks change over minutes."""

GAUSS3, GAUSS2 = np.array([-1, 0, 1]) * np.sqrt(3 / 5), np.array([-1, 1]) / np.sqrt(3)


class Maps(NamedTuple):
    """The fast blocks: A(f) = sum f_i force[i], and what stands before C."""

    force: jax.Array  # (3, 3, 3)
    accel: jax.Array  # (3, 3)
    gyro: jax.Array  # (3, 3)

    def A(self, f: jax.Array) -> jax.Array:
        """The block of velocity by attitude for specific forces (..., 3): (..., 3, 3)."""
        return jnp.tensordot(f, self.force, 1)


class Course(NamedTuple):
    """The points of an epoch, piecewise constants, and what adds up along them."""

    C: jax.Array  # (b, 3, 3)
    force: jax.Array  # (b, 3) m/s^2
    T: jax.Array  # (b,) s
    end: jax.Array  # (b,) s, of each point since the epoch's start
    weights: jax.Array  # (b, 2), see `_weights`
    done: jax.Array  # (b, 2, 3) m, m/s: what specific force has done by then to the position and velocity at the end


def discretize(
    dynamics: Callable[[Path], dict[tuple[str, str], jax.Array]],
    noise: Noise,
    points: Path,
    T: jax.Array,
    u: Drive | None,
    n: int,
    lumped: bool = False,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Phi (n, n), Q (n, n), d (n,) of a whole epoch: x -> Phi x + d, with noise of covariance Q.

    ``dynamics`` gives the 3x3 blocks of F at one point, ``points`` are b of them (constant over ``T`` (b,) s each; 0
    marks padding). The blocks of `FAST` and p' = v are nilpotent: their part is summed over the points in closed form,
    without error. The slow rest (Coriolis, transport, gravity, decay of biases) is taken at the epoch's mean point,
    half of it before and half after (Strang 1968): the error is of third order in the epoch's length, 1e-7 of an
    entry after a second. That is what lets the covariance move once an epoch instead of at every sample.

    The noise is integrated by Gauss' rule, of the sensors with three points and of the biases with two. ``lumped``: the
    sensors' enters at the end of each point, Q = G T, as textbook filters have it.

    Navigation holds the estimated bias constant while a Gauss-Markov bias decays, so that the error of a bias estimate
    b grows by b / tau: that is part of d.
    """
    total = T.sum()
    point = jax.tree.map(lambda a: jnp.tensordot(_shares(T), a, 1), points)
    eye = jnp.eye(3)

    def at(force):
        blocks = dynamics(point._replace(C=eye, force=force))
        return blocks.pop(("velocity", "attitude")), blocks

    pushes, bare = jax.vmap(at, out_axes=(0, None))(eye)  # no other block depends on specific force
    maps = Maps(pushes, bare["velocity", "accel_bias"], bare["attitude", "gyro_bias"])
    slow, d_slow = _slow({k: v for k, v in bare.items() if k not in FAST}, noise, point, 0.5 * total, n)
    end = running(T)
    weights = _weights(T, total - end)
    done = running(weights[:, :, None] * points.force[:, None])
    course = Course(points.C, points.force, T, end, weights, done)
    Phi, d = _nilpotent(maps, course, u, n)
    W = _white(maps, course, noise, lumped)
    W = linalg.times(slow[:, :9], W)
    if n > 9:
        W = jnp.concatenate([W, linalg.times(slow, _bias_noise(Phi, noise, total))], 1)
    return linalg.times(linalg.times(slow, Phi), slow), linalg.square(W), slow @ (Phi @ d_slow + d) + d_slow


def _shares(T: jax.Array) -> jax.Array:
    """T / sum T along the last axis, alike where all are zero."""
    total = T.sum(-1, keepdims=True)
    return jnp.where(total > 0, T / jnp.where(total > 0, total, 1.0), 1.0 / T.shape[-1])


def _weights(T: jax.Array, left: jax.Array) -> jax.Array:
    """(b, 2): what an acceleration over T (b,) s does to position and velocity ``left`` (b,) s after that."""
    return jnp.stack([T * (left + 0.5 * T), T], -1)


def _slow(blocks: dict, noise: Noise, point: Path, h: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
    """exp(S h), (n, n), to second order but for the biases' decay, and what that adds, (n,)."""
    S = assemble({k: v for k, v in blocks.items() if k != ("position", "velocity")}, n) * h
    tau = jnp.concatenate([jnp.broadcast_to(tau, (3,)) for tau in (noise.gyro_tau, noise.accel_tau)])
    # no other slow block has to do with them
    lost = jnp.concatenate([jnp.zeros(9), jnp.expm1(-h / tau)])[:n]
    b = jnp.concatenate([jnp.zeros(9), point.nav.b_g, point.nav.b_a])[:n]
    return jnp.eye(n) + S + linalg.times(0.5 * S, S) + jnp.diag(lost), -lost * b


def _nilpotent(maps: Maps, course: Course, u: Drive | None, n: int) -> tuple[jax.Array, jax.Array]:
    """Phi (n, n) and d (n,) of p' = v, v' = A(f) phi + B b_a + u, phi' = G b_g + u, exactly for piecewise constants."""
    C, f, T, end, weights, done = course
    total, weights = end[-1], weights.T
    A_w, A_T = maps.A(done[-1])
    d = [jnp.zeros(n)]
    if u:
        # u.omega turns phi by u.omega t: the integrals of A(f) t; within a point the mean of t s is 1/12 T^2 off
        at = (weights * (end - 0.5 * T)).at[0].add(-(T**3) / 12)
        u_w, u_T = maps.A(at @ f) @ u.omega
        d = [u_w + 0.5 * total**2 * u.accel, u_T + total * u.accel, total * u.omega, jnp.zeros(n - 9)]
    eye, zero = jnp.eye(3), jnp.zeros((3, 3))
    rows = [[eye, total * eye, A_w], [zero, eye, A_T], [zero, zero, eye]]
    if n > 9:
        flat = C.reshape(-1, 9)
        turned = running(T[:, None] * flat)
        middle = turned - 0.5 * T[:, None] * flat
        both = jnp.concatenate([weights[:, :, None] * f, (-(T**3) / 12)[None, :, None] * f])  # (3, b, 3)
        w_AG, T_AG = jnp.einsum("sba,bc->sac", both[:2], middle)
        w_AG = w_AG + both[2].T @ flat
        AG = lambda M: jnp.einsum("aij,jk,akl->il", maps.force, maps.gyro, M.reshape(3, 3, 3))  # noqa: E731
        B_w, B_T = maps.accel @ (weights @ flat).reshape(2, 3, 3)
        rows = [
            [*rows[0], AG(w_AG), B_w],
            [*rows[1], AG(T_AG), B_T],
            [*rows[2], maps.gyro @ turned[-1].reshape(3, 3), zero],
            [zero, zero, zero, eye, zero],
            [zero, zero, zero, zero, eye],
        ]
    return jnp.block(rows), jnp.concatenate(d)


def _white(maps: Maps, course: Course, noise: Noise, lumped: bool) -> jax.Array:
    """(9, 6 moments): what white noise of gyros and accelerometers at some moments does at the epoch's end."""
    C, f, T, end, _, done = course
    total = end[-1]
    if lumped:
        moments, lengths, C_then, to_come = end, T, C, done[-1] - done
    else:  # Gauss' points, which integrate polynomials up to the fifth order
        moments, lengths = total * (0.5 + 0.5 * GAUSS3), total * np.array([5, 8, 5]) / 18
        # the first point that ends after a moment; the last one where rounding or an empty epoch leaves none
        i = jnp.minimum((end <= moments[:, None]).sum(1), end.size - 1)
        rest = jnp.maximum(end[i] - moments, 0.0)  # how much of that point comes after the moment
        part = _weights(rest, total - end[i])[:, :, None] * f[i][:, None]
        C_then, to_come = C[i], done[-1] - done[i] + part
    pi, alpha = maps.A(to_come[:, 0]), maps.A(to_come[:, 1])
    column = lambda a: a[:, None, None]  # noqa: E731
    root = column(jnp.where(lengths > 0, jnp.sqrt(jnp.where(lengths > 0, lengths, 1.0)), 0.0))
    g = linalg.times_root(maps.gyro @ C_then, noise.gyro) * root
    a = linalg.times_root(maps.accel @ C_then, noise.accel) * root
    rows = [[pi @ g, column(total - moments) * a], [alpha @ g, a], [g, jnp.zeros_like(a)]]
    return jnp.moveaxis(jnp.block(rows), 0, 1).reshape(9, -1)


def _bias_noise(Phi: jax.Array, noise: Noise, total: jax.Array) -> jax.Array:
    """(15, 12): what unit noise that drives the biases does, at the points of Gauss; exact while C and f are constant.

    Of what a bias does over the whole epoch, noise with the share s of it to come does s, s^2 and s^3, by how many
    integrals lie between.
    """
    drives = ((slice(9, 12), noise.gyro_bias), (slice(12, 15), noise.accel_bias))
    driven = jnp.concatenate([linalg.times_root(Phi[:, s], leaf) for s, leaf in drives], 1)
    some = total > 0
    root = jnp.where(some, jnp.sqrt(jnp.where(some, 0.5 * total, 1.0)), 0.0)
    power = np.repeat(np.array([[3, 2], [2, 1], [1, 1], [0, 0], [0, 0]]), 3, 0).repeat(3, 1)  # (15, 6)
    return jnp.concatenate([driven * root * s**power for s in 0.5 + 0.5 * GAUSS2], 1)
