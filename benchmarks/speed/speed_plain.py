"""The same filter as a good user of JAX writes it first: dense matrices, one sample after the other.

Three forms: one scan over samples with a `lax.cond` for the fix; a scan over epochs with one over samples inside; and
that with `jax.checkpoint` on the epoch, for gradients. The package is compared with them, so that nothing of
the package's filter is used here, and nothing should be made faster.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav.filters.parameters import change, get
from jaxnav.maths import earth, rotations
from jaxnav.states.table import BIASES
from jaxnav.types import Epoch, Fix, Imu, Nav, Params


class Noise(NamedTuple):
    """All noise of a filter of 15 states, in SI: variables of the benchmark's gradient."""

    gyro: jax.Array
    accel: jax.Array
    gyro_bias: jax.Array
    accel_bias: jax.Array
    position_scale: jax.Array  # (3,)
    velocity_scale: jax.Array


LEAVES = ("noise.gyro", "noise.accel", "states.gyro_bias.driving_noise", "states.accel_bias.driving_noise",
          "measurements.position.scale", "measurements.velocity.scale")  # fmt: skip


def noise_of(params: Params) -> Noise:
    """Out of a filter's parameters."""
    return Noise(*(get(params, name) for name in LEAVES))


def with_noise(params: Params, noise: Noise) -> Params:
    """And back."""
    return change(params, dict(zip(LEAVES, noise, strict=True)))


def prior_sd(params: Params, n: int) -> jax.Array:
    """Standard deviations at the start, (n,)."""
    biases = [params.states[name].sd for name in BIASES]
    return jnp.concatenate([jnp.broadcast_to(sd, (3,)) for sd in (*params.prior[:3], *biases)])[:n]


class State(NamedTuple):
    """Navigation, and the covariance of its error."""

    lla: jax.Array
    vel: jax.Array  # ENU
    q: jax.Array
    b_g: jax.Array
    b_a: jax.Array
    omega: jax.Array  # of the sample before
    force: jax.Array
    P: jax.Array  # (n, n)


class Solution(NamedTuple):
    """Result of the nested forms for each epoch."""

    lla: jax.Array  # (E, 3)
    vel: jax.Array  # (E, 3)
    nu: jax.Array  # (E, 6)
    S: jax.Array  # (E, 6, 6)


def strapdown(s: State, imu: Imu) -> tuple[State, jax.Array, jax.Array]:
    """One sample; also the mean attitude matrix and specific force."""
    dt, w, f = imu.dt, imu.gyro - s.b_g, imu.accel - s.b_a
    theta = w * dt + jnp.cross(s.omega, w) * dt**2 / 12
    push = f * dt + jnp.cross(w, f) * dt**2 / 2 + jnp.cross(w, jnp.cross(w, f)) * dt**3 / 6
    push = push + (jnp.cross(s.omega, f) + jnp.cross(s.force, w)) * dt**2 / 12
    before = rotations.to_dcm(s.q)
    lat, lon, h = s.lla
    lat, h = lat + 0.5 * dt * s.vel[1] / earth.A, h + 0.5 * dt * s.vel[2]  # half-way
    g = jnp.stack([0.0, 0.0, -earth.gravity(lat, h)])
    ie = earth.earth_rate(lat)
    en = earth.transport_rate(lat, h, s.vel)
    push = before @ push
    lag = jnp.cross((ie + en) * dt, push)
    push = push - lag / 2 + jnp.cross((ie + en) * dt, lag) / 12
    mid = s.vel + 0.5 * (push + dt * (g - jnp.cross(2 * ie + en, s.vel)))
    en = earth.transport_rate(lat, h, mid)
    dv = push + dt * (g - jnp.cross(2 * ie + en, mid))
    mean = s.vel + 0.5 * dv
    north, east, _ = earth.metres_per_radian(jnp.stack([lat, lon, h]))
    lla = s.lla + dt * jnp.stack([mean[1] / north, mean[0] / east, mean[2]])
    q = rotations.multiply(rotations.exp(-(ie + en) * dt), rotations.multiply(s.q, rotations.exp(theta)))
    q = rotations.normalize(q)
    C = 0.5 * (before + rotations.to_dcm(q))
    return s._replace(lla=lla, vel=s.vel + dv, q=q, omega=w, force=f), C, C @ f


def dynamics(s: State, C: jax.Array, f: jax.Array) -> jax.Array:
    """F of the full error dynamics, (n, n)."""
    lat, _, h = s.lla
    ve, vn, vu = s.vel
    meridian, prime = earth.radii(lat)
    rn, re, tan = meridian + h, prime + h, jnp.tan(lat)
    ie, en = earth.earth_rate(lat), earth.transport_rate(lat, h, s.vel)
    zero, eye = jnp.zeros((3, 3)), jnp.eye(3)
    level = jnp.array([[0.0, 1 / rn, 0.0], [-1 / re, 0.0, 0.0], [-tan / re, 0.0, 0.0]])
    north = earth.RATE / rn * jnp.array([0.0, -jnp.sin(lat), jnp.cos(lat)])
    turn = jnp.array([0.0, 0.0, ve / (re * rn) * (1 + tan**2)])
    up = jnp.array([vn / rn**2, -ve / re**2, -ve * tan / re**2])
    gravity = jnp.zeros((3, 3)).at[2, 2].set(2 * earth.gravity(lat, 0.0) / earth.A)
    pp = jnp.array([[vu / re - vn * tan / rn, ve * tan / rn, -ve / re], [0.0, vu / rn, -vn / rn], [0.0, 0.0, 0.0]])
    vp = rotations.skew(s.vel) @ jnp.stack([jnp.zeros(3), 2 * north + turn, up], 1) + gravity
    vv = -rotations.skew(2 * ie + en) - rotations.skew(s.vel) @ level
    ap = -jnp.stack([jnp.zeros(3), north + turn, up], 1)
    rows = [
        [pp, eye, zero, zero, zero],
        [vp, vv, -rotations.skew(f), zero, -C],
        [ap, level, -rotations.skew(ie + en), -C, zero],
        [zero] * 5,
        [zero] * 5,
    ]
    m = s.P.shape[0] // 3
    return jnp.block([row[:m] for row in rows[:m]])


def transition(noise: Noise, s: State, imu: Imu, order: int = 2) -> tuple[State, jax.Array, jax.Array]:
    """One sample of navigation, and Phi and Q of its errors."""
    s, C, f = strapdown(s, imu)
    n = s.P.shape[0]
    FT = dynamics(s, C, f) * imu.dt
    Phi = jnp.eye(n) + FT if order == 1 else jnp.eye(n) + FT + 0.5 * FT @ FT
    psd = [jnp.zeros(3), noise.accel, noise.gyro, noise.gyro_bias, noise.accel_bias]  # the same on all axes
    return s, Phi, jnp.diag(jnp.concatenate([jnp.broadcast_to(sd, (3,)) ** 2 for sd in psd])[:n]) * imu.dt


def predict(noise: Noise, s: State, imu: Imu, order: int = 2) -> State:
    """One sample of navigation, and P with a dense Phi."""
    s, Phi, Q = transition(noise, s, imu, order)
    return s._replace(P=Phi @ s.P @ Phi.T + Q)


def update(noise: Noise, s: State, fix: Fix) -> tuple[State, jax.Array, jax.Array]:
    """Position and velocity, Joseph form, closed loop; also the innovation and its covariance."""
    n = s.P.shape[0]
    scale = [jnp.broadcast_to(sd, (3,)) for sd in (noise.position_scale, noise.velocity_scale)]
    H, R = jnp.eye(6, n), jnp.diag((jnp.concatenate(scale) * fix.sd) ** 2)
    nu = jnp.concatenate([earth.enu_difference(s.lla, fix.value[:3]), s.vel - fix.value[3:]])
    S = H @ s.P @ H.T + R
    K = jnp.linalg.solve(S, H @ s.P).T
    A = jnp.eye(n) - K @ H
    x = K @ nu
    q = rotations.normalize(rotations.multiply(rotations.exp(-x[6:9]), s.q))
    turned = jnp.eye(n).at[6:9, 6:9].set(rotations.to_dcm(rotations.exp(-0.5 * x[6:9])))  # axes of the attitude's error
    P = turned @ (A @ s.P @ A.T + K @ R @ K.T) @ turned.T
    s = s._replace(lla=earth.move(s.lla, -x[:3]), vel=s.vel - x[3:6], q=q, P=P)
    if n == 15:
        s = s._replace(b_g=s.b_g - x[9:12], b_a=s.b_a - x[12:15])
    return s, nu, S


def initial(params: Params, nav: Nav, n: int) -> State:
    """The start, (n, n) covariance from the prior."""
    zero = jnp.zeros(3)
    return State(nav.pos, nav.vel, nav.q, zero, zero, zero, zero, jnp.diag(prior_sd(params, n) ** 2))


def naive(n: int, params: Params) -> Callable[[Noise, Nav, Epoch], jax.Array]:
    """One scan over all samples; positions at each, (N, 3). The fixes' times are the same in all runs of a batch."""

    def call(noise: Noise, nav: Nav, epochs: Epoch) -> jax.Array:
        E, k = epochs.imu.dt.shape
        imu = jax.tree.map(lambda a: a.reshape(E * k, *a.shape[2:]), epochs.imu)
        index = jnp.arange(E * k)

        def sample(s, x):
            imu, i = x
            s = predict(noise, s, imu)
            fix = jax.tree.map(lambda a: a[i // k], epochs.fix)
            s = lax.cond(i % k == k - 1, lambda s: update(noise, s, fix)[0], lambda s: s, s)
            return s, s.lla

        return lax.scan(sample, initial(params, nav, n), (imu, index))[1]

    return call


def nested(n: int, params: Params, checkpoint: bool = False, order: int = 2) -> Callable[[Noise, Nav, Epoch], Solution]:
    """A scan over epochs with a scan over samples inside.

    With Phi of first ``order`` it is faster by a fifth, and in an unmatched filter a centimetre away from the others.
    """

    def call(noise: Noise, nav: Nav, epochs: Epoch) -> Solution:
        def epoch(s, x):
            s, _ = lax.scan(lambda s, imu: (predict(noise, s, imu, order), None), s, x.imu)
            s, nu, S = update(noise, s, x.fix)
            return s, Solution(s.lla, s.vel, nu, S)

        return lax.scan(jax.checkpoint(epoch) if checkpoint else epoch, initial(params, nav, n), epochs)[1]

    return call


def nll(solution: Solution) -> jax.Array:
    """Mean negative log-likelihood of the innovations."""
    each = jax.vmap(lambda nu, S: nu @ jnp.linalg.solve(S, nu) + jnp.linalg.slogdet(S)[1])(solution.nu, solution.S)
    return 0.5 * (jnp.mean(each) + 6 * jnp.log(2 * jnp.pi))


def likelihood(one: Callable[[Noise, Nav, Epoch], Solution]) -> Callable[[Noise, Nav, Epoch], jax.Array]:
    """Innovation NLL of one run by a nested form."""
    return lambda noise, nav, epochs: nll(one(noise, nav, epochs))
