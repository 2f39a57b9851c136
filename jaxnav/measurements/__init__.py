"""Measurement models, written once for every frame: a channel layout, a residual and its Jacobian.

A model is made with a tuple of these, and a `Fix` then carries their channels side by side. Each works on
`Kinematics`, what a frame says of a navigation state in ENU; x = estimate - truth, residual y = H x + noise.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from jaxnav.maths import earth, rotations
from jaxnav.states.names import G
from jaxnav.types import Fix, Mounting, Nav, Noise


class Kinematics(NamedTuple):
    """A navigation state in ENU, and the rows that map the error state to ENU errors."""

    lla: jax.Array  # (3,) rad, rad, m
    vel: jax.Array  # (3,) m/s ENU
    C: jax.Array  # (3, 3) body -> ENU
    position: jax.Array  # (3, n) d(position error, ENU m) / dx
    velocity: jax.Array  # (3, n) d(velocity error, ENU m/s) / dx
    attitude: jax.Array  # (3, n) d(attitude error, ENU rad) / dx


class Observation(NamedTuple):
    """Residual (estimate minus measurement), Jacobian and noise of one measurement of size s."""

    y: jax.Array  # (s,)
    H: jax.Array  # (s, n)
    sd: jax.Array  # (s,) of the noise
    root: jax.Array | float = 1.0  # (), (s,) or lower triangular (s, s): what multiplies noise of that sd


class Measurement(NamedTuple):
    """A named kind of measurement."""

    name: str
    size: int
    observe: Callable[[Noise, Mounting, Nav, Kinematics, Fix], Observation]
    # s, how long before its stamp the measured quantity held; of a mounting whose time_offset is that of the moment
    latency: Callable[[Mounting], jax.Array]
    pseudo: bool = False  # carries no receiver's data: it constrains, and never counts as a GNSS fix


def clock_offset(mounting: Mounting, nav: Nav) -> jax.Array:
    """GNSS time minus the IMU's stamps ``nav.t``, s, of their shape.

    What passes between two fixes is still measured by the IMU's clock: of the way without fixes the share
    ``clock_drift`` is lost, 1 m in 10 km at 100 ppm.
    """
    return mounting.time_offset + mounting.clock_drift * (nav.t - nav.origin.t)


def counted_from(nav: Nav, t: ArrayLike) -> Nav:
    """Navigation whose clock has drifted nothing at stamp ``t`` s: halfway, offset and drift are least correlated."""
    return nav._replace(origin=nav.origin._replace(t=jnp.broadcast_to(jnp.asarray(t, float), nav.origin.t.shape)))


def _offset(mounting: Mounting) -> jax.Array:
    return mounting.time_offset


def _body_rate_rows(n: int, M: jax.Array) -> jax.Array:
    """Rows of H for M @ (body rate error), (s, n): the gyro bias estimate lowers the rate; zero with 9 states."""
    H = jnp.zeros((M.shape[0], n))
    return H if n <= 9 else H.at[:, G].set(-M)


def _position(noise: Noise, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    arm = kin.C @ mounting.lever_arm
    y = earth.enu_difference(kin.lla, fix.value) + arm
    H = kin.position - rotations.skew(arm) @ kin.attitude
    return Observation(y, H, fix.sd, noise.position_scale)


def _velocity(noise: Noise, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    # the antenna moves with the body's rate with respect to the Earth; the Earth's own rate times an arm is < 1e-4 m/s
    swing = kin.C @ jnp.cross(nav.omega, mounting.lever_arm)
    y = kin.vel + swing - fix.value
    n = kin.velocity.shape[1]
    rate = _body_rate_rows(n, -kin.C @ rotations.skew(mounting.lever_arm))
    return Observation(y, kin.velocity - rotations.skew(swing) @ kin.attitude + rate, fix.sd, noise.velocity_scale)


def _zero_velocity(noise: Noise, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    return Observation(kin.vel, kin.velocity, jnp.broadcast_to(noise.zero_velocity, (3,)))


def _zero_rate(noise: Noise, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    # value: mean raw gyro rate over the stationary window; what is left after the Earth's rate is bias
    w_ie = earth.earth_rate(kin.lla[0])
    earth_b = kin.C.T @ w_ie
    n = kin.velocity.shape[1]
    y = fix.value - nav.b_g - earth_b
    H = _body_rate_rows(n, jnp.eye(3)) - kin.C.T @ rotations.skew(w_ie) @ kin.attitude
    return Observation(y, H, jnp.broadcast_to(noise.zero_rate, (3,)))


def _vehicle_velocity(mounting: Mounting, nav: Nav, kin: Kinematics) -> tuple[jax.Array, jax.Array]:
    """Velocity of the wheel point in vehicle axes (forward, right, down), (3,), and its Jacobian (3, n)."""
    pitch, yaw = mounting.vehicle
    zero = jnp.zeros_like(pitch)
    M = rotations.to_dcm(rotations.exp(jnp.stack([zero, pitch, yaw]))).T  # body -> vehicle
    v_b = kin.C.T @ kin.vel + jnp.cross(nav.omega, mounting.wheel_arm)
    n = kin.velocity.shape[1]
    # d(C' v) = C' (dv + [v x] phi); d(w x l) = [l x] db_g
    H = kin.C.T @ (kin.velocity + rotations.skew(kin.vel) @ kin.attitude)
    H = H + _body_rate_rows(n, -rotations.skew(mounting.wheel_arm))
    return M @ v_b, M @ H


def _nonholonomic(noise: Noise, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    v, H = _vehicle_velocity(mounting, nav, kin)
    return Observation(v[1:], H[1:], fix.sd, noise.nonholonomic)


def _speed(noise: Noise, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    v, H = _vehicle_velocity(mounting, nav, kin)
    scale = 1 + mounting.speed_scale
    return Observation(v[:1] * scale - fix.value, H[:1] * scale, fix.sd, noise.speed)


POSITION = Measurement("position", 3, _position, lambda m: m.time_offset + m.position_latency)
"""GNSS position: value (lat rad, lon rad, h m) of the antenna, sd and correlations in ENU m."""
VELOCITY = Measurement("velocity", 3, _velocity, lambda m: m.time_offset + m.velocity_latency)
"""GNSS velocity of the antenna: value, sd in ENU m/s."""
ZERO_VELOCITY = Measurement("zero_velocity", 3, _zero_velocity, _offset, pseudo=True)
"""The vehicle stands: no value; sd from `Noise.zero_velocity`."""
ZERO_RATE = Measurement("zero_rate", 3, _zero_rate, _offset, pseudo=True)
"""The vehicle does not turn: value = mean raw gyro rate, rad/s, body; sd from `Noise.zero_rate`."""
NONHOLONOMIC = Measurement("nonholonomic", 2, _nonholonomic, _offset, pseudo=True)
"""Wheels neither slide sideways nor lift: no value; sd = `Noise.nonholonomic` times the fix's own sd (1 by default)."""
SPEED = Measurement("speed", 1, _speed, _offset, pseudo=True)
"""Wheel speed: value forward m/s, its own sd."""

GNSS = (POSITION, VELOCITY)
MEASUREMENTS = {m.name: m for m in (POSITION, VELOCITY, ZERO_VELOCITY, ZERO_RATE, NONHOLONOMIC, SPEED)}


def layout(measurements: tuple[Measurement, ...]) -> dict[str, slice]:
    """Name -> its channels in a `Fix` of these measurements."""
    stops = np.cumsum([m.size for m in measurements]).tolist()
    return {m.name: slice(stop - m.size, stop) for m, stop in zip(measurements, stops, strict=True)}


def at(past: Nav, t: jax.Array) -> Nav:
    """The navigation state at time ``t`` by linear interpolation between the samples of ``past`` (w, ...).

    Outside of them the nearest two are extended, but rate and specific force are held: they are noisy.
    """
    w = past.t.shape[0]
    if w > 2:
        i = jnp.clip(jnp.sum(past.t <= t) - 1, 0, w - 2)
        past = jax.tree.map(lambda leaf: lax.dynamic_slice_in_dim(leaf, i, 2), past)
    before, after = jax.tree.map(lambda leaf: leaf[0], past), jax.tree.map(lambda leaf: leaf[1], past)
    gap = after.t - before.t
    share = jnp.where(gap > 0, (t - before.t) / jnp.where(gap > 0, gap, 1.0), 1.0)
    blend = lambda share, a, b: jax.tree.map(lambda a, b: a + share * (b - a), a, b)  # noqa: E731
    rates = lambda nav: {"omega": nav.omega, "force": nav.force}  # noqa: E731
    nav, held = blend(share, before, after), blend(jnp.clip(share, 0.0, 1.0), rates(before), rates(after))
    return nav._replace(t=t, q=rotations.normalize(nav.q), **held)


def covariance(root: jax.Array | float, sd: jax.Array, corr: jax.Array, valid: jax.Array) -> jax.Array:
    """R = L D C D L' (s, s) of a fix with its own ``sd`` D and correlations C (`Fix`); ``root`` is L or its diagonal.

    The correlation of two channels of which one is missing is dropped. What a missing channel says of its sd means
    nothing, so with a full L its share in another channel is taken at that channel's own sd: R of those that are there
    does not depend on those that are not.
    """
    C = jnp.eye(sd.size)
    if sd.size == 3:
        i, j = np.arange(3), np.array([1, 2, 0])
        c = jnp.where(valid & valid[j], corr, 0.0)
        C = C.at[i, j].set(c).at[j, i].set(c)
    if jnp.ndim(root) < 2:
        sd = root * sd
        return C * (sd[:, None] * sd)
    M = root * jnp.where(valid, sd, sd[:, None])
    R = M @ C @ M.T
    return 0.5 * (R + R.T)


def stack(
    measurements: tuple[Measurement, ...], kinematics: Callable[[Nav], Kinematics]
) -> tuple[Callable[[Noise, Mounting, Nav, Fix], tuple[jax.Array, jax.Array, jax.Array]], int]:
    """``observe(noise, mounting, past, fix) -> y (m,), H (m, n), R (m, m)`` for these measurements, and m.

    Each measurement is compared with the state at its own time, the end of ``past`` minus its latency; H refers to the
    error at the end: a position then is off by less, dp(t - s) = dp(t) - s dv(t). R is `covariance` of each.
    """
    slices = layout(measurements)
    m = sum(each.size for each in measurements)

    def observe(noise: Noise, mounting: Mounting, past: Nav, fix: Fix):
        parts, now = [], jax.tree.map(lambda a: a[-1], past)
        mounting = mounting._replace(time_offset=clock_offset(mounting, now))
        for each in measurements:
            s = slices[each.name]
            own = Fix(*(leaf[s] for leaf in fix))
            age = each.latency(mounting)
            nav = at(past, now.t - age)
            kin = kinematics(nav)
            kin = kin._replace(position=kin.position - age * kin.velocity)
            o = each.observe(noise, mounting, nav, kin, own)
            parts.append((o.y, o.H, covariance(o.root, o.sd, own.corr, own.valid)))
        R = jnp.zeros((m, m))
        for (_, _, block), s in zip(parts, slices.values(), strict=True):
            R = R.at[s, s].set(block)
        return jnp.concatenate([p[0] for p in parts]), jnp.concatenate([p[1] for p in parts]), R

    return observe, m
