"""A GNSS receiver on a trajectory: position and velocity of the antenna with its errors, and when there is none."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.maths import earth, rotations
from jaxnav.maths.units import TICK
from jaxnav.simulate import faults as fault
from jaxnav.simulate.processes import gauss_markov, normal
from jaxnav.types import Fix, Nav


class Receiver(NamedTuple):
    """A receiver, its antenna, and when it sees no satellites."""

    position_sd_m: tuple[float, float, float] = (2.0, 2.0, 4.0)  # ENU, as it states them
    velocity_sd_mps: tuple[float, float, float] = (0.1, 0.1, 0.15)  # ENU
    gnss_noise_factor: float = 1.0  # real noise against stated
    correlated_share: float = 0.0  # of the noise's variance: first-order Gauss-Markov, the rest is white
    correlation_s: float = 60.0
    slow_position_sd_m: float = 0.0  # on each axis, in addition to all noise: first-order Gauss-Markov
    slow_position_s: float = 300.0  # its time constant
    integrates_velocity: bool = False  # errors of its velocity add up in its position, and fade over slow_position_s
    outlier_probability: float = 0.0  # of a fix
    outlier_factor: float = 10.0  # sd of an outlier, in sd of the receiver
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # IMU -> antenna, body FRD
    latency_s: float = 0.0  # age of a fix at its stamp; less than a fix interval
    outages_s: tuple[tuple[float, float], ...] = ()  # start < t <= end
    outage_shift_s: float = 0.0  # each of them is moved to later by a random time up to this
    random_outages: int = 0  # this many more from the key, after the standstill
    random_outage_s: tuple[float, float] = (10.0, 20.0)  # shortest and longest


def antenna(nav: Nav, lever_arm: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Position (lat, lon, h) and velocity (ENU m/s) of the antenna of local level navigation, (3,) each.

    ``lever_arm``: (3,) m, body FRD. The Earth's rotation is neglected.
    """
    C = rotations.to_dcm(nav.q)
    turning = C @ nav.omega - earth.earth_rate(nav.pos[0])
    arm = C @ lever_arm
    return earth.move(nav.pos, arm), nav.vel + jnp.cross(turning, arm)


def _noise(key: jax.Array, n: int, interval: float, sd: jax.Array, receiver: Receiver) -> jax.Array:
    """Noise and outliers of n fixes, (n, 6) ENU m and m/s."""
    noise, share = normal(key, (n, 6)), receiver.correlated_share
    if share:
        slow = normal(jax.random.fold_in(key, 1), (n, 6))
        noise = np.sqrt(1 - share) * noise + np.sqrt(share) * gauss_markov(slow, interval, receiver.correlation_s)
    noise = receiver.gnss_noise_factor * sd * noise
    if receiver.slow_position_sd_m or receiver.integrates_velocity:
        slow = _slow(jax.random.fold_in(key, 4), noise[:, 3:], interval, receiver)
        noise = jnp.concatenate([noise[:, :3] + slow, noise[:, 3:]], 1)
    if receiver.outlier_probability:
        where, size = jax.random.split(jax.random.fold_in(key, 2))
        hit = jax.random.uniform(where, (n, 1), float) < receiver.outlier_probability
        noise = noise + jnp.where(hit, receiver.outlier_factor * sd * normal(size, (n, 6)), 0.0)
    return noise


def _slow(key: jax.Array, velocity: jax.Array, interval: float, receiver: Receiver) -> jax.Array:
    """Return slow errors (n, 3) ENU m of position from a receiver with velocity errors (n, 3) m/s."""
    tau = receiver.slow_position_s
    slow = receiver.slow_position_sd_m * gauss_markov(normal(key, velocity.shape), interval, tau)
    if not receiver.integrates_velocity:
        return slow

    def add(sum_: jax.Array, error: jax.Array) -> tuple[jax.Array, jax.Array]:
        sum_ = np.exp(-interval / tau) * sum_ + interval * error
        return sum_, sum_

    return slow + lax.scan(add, jnp.zeros(3), velocity)[1]


def fixes(
    key: jax.Array,
    seen: Nav,
    t: jax.Array,
    interval: float,
    hidden: jax.Array,
    receiver: Receiver,
    faults: tuple[Any, ...] = (),
) -> Fix:
    """Return fixes (E, 6) for `jaxnav.measurements.GNSS`, stamped ``t`` (E,) s every ``interval`` s.

    ``seen`` (E, ...): the true values of the fixes, ``latency_s`` before ``t``. ``hidden`` (E,) bool: there the fix
    is not valid and its value is the antenna's without any error, so that the end of an outage can be scored by it.

    Raises:
        ValueError: a fault that is none.
    """
    lla, vel = jax.vmap(antenna, (0, None))(seen, jnp.asarray(receiver.lever_arm_m, float))
    sd = jnp.asarray([*receiver.position_sd_m, *receiver.velocity_sd_mps], float)
    error = _noise(key, t.shape[0], interval, sd, receiver)
    error = error + fault.offsets(jax.random.fold_in(key, 3), faults, t, error)
    error = jnp.where(hidden[:, None], 0.0, error)
    value = jnp.concatenate([jax.vmap(earth.move)(lla, error[:, :3]), vel + error[:, 3:]], 1)
    valid = jnp.broadcast_to(~hidden[:, None], value.shape)
    return Fix(value, jnp.broadcast_to(sd, value.shape), jnp.zeros_like(value), valid)


def inside(t: jax.Array, windows: jax.Array) -> jax.Array:
    """Is each of t (E,) in a window (W, 2) s, start < t <= end? (E,) bool."""
    t = t[:, None]
    return jnp.any((t > windows[:, 0] + TICK) & (t <= windows[:, 1] + TICK), axis=1)


def outages(key: jax.Array, receiver: Receiver, start: float, stop: float) -> jax.Array:
    """Return all outages of a run (W, 2) s; the random ones are between ``start`` and ``stop``.

    Raises:
        ValueError: they do not fit.
    """
    fixed = jnp.asarray(receiver.outages_s, float).reshape(-1, 2)
    if receiver.outage_shift_s:
        shift = jax.random.uniform(jax.random.fold_in(key, 1), (fixed.shape[0], 1), float)
        fixed = fixed + receiver.outage_shift_s * shift
    if not receiver.random_outages:
        return fixed
    more = random_outages(key, receiver.random_outages, start, stop, receiver.random_outage_s)
    return jnp.concatenate([fixed, more])


def random_outages(key: jax.Array, count: int, start: float, stop: float, length: tuple[float, float]) -> jax.Array:
    """``count`` windows (count, 2) s between start and stop, one at a random place of each of as many equal parts.

    Raises:
        ValueError: the longest one does not fit into its part.
    """
    part = (stop - start) / max(count, 1)
    if length[1] > part:
        raise ValueError(f"{count} outages of up to {length[1]:g} s do not fit between {start:g} and {stop:g} s")
    how_long, where = jax.random.uniform(key, (2, count), float)
    lasts = length[0] + (length[1] - length[0]) * how_long
    begin = start + part * np.arange(count) + (part - lasts) * where
    return jnp.stack([begin, begin + lasts], 1)
