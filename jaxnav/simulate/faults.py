"""Faults of a receiver in an interval of time, as multipath makes them: errors added to its fixes.

A fault is a frozen tuple of plain numbers, in force for start < t <= stop; the receiver's stated sd does not know of
it. Position and velocity are ENU.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths.units import TICK
from jaxnav.simulate.kinds import hashed_by_type
from jaxnav.simulate.processes import gauss_markov, normal

Axes = tuple[float, float, float]


@hashed_by_type
class Constant(NamedTuple):
    """A constant offset; with a stop of inf, a jump that stays."""

    start_s: float
    stop_s: float
    position_m: Axes = (0.0, 0.0, 0.0)
    velocity_mps: Axes = (0.0, 0.0, 0.0)
    random_sign: bool = False  # each axis of each has a random sign, from the key


@hashed_by_type
class Ramp(NamedTuple):
    """An offset that grows from zero to these sizes."""

    start_s: float
    stop_s: float
    position_m: Axes = (0.0, 0.0, 0.0)
    velocity_mps: Axes = (0.0, 0.0, 0.0)
    random_sign: bool = False


@hashed_by_type
class White(NamedTuple):
    """More white noise."""

    start_s: float
    stop_s: float
    position_sd_m: Axes = (0.0, 0.0, 0.0)
    velocity_sd_mps: Axes = (0.0, 0.0, 0.0)


@hashed_by_type
class GaussMarkov(NamedTuple):
    """Time-correlated noise."""

    start_s: float
    stop_s: float
    position_sd_m: Axes = (0.0, 0.0, 0.0)
    velocity_sd_mps: Axes = (0.0, 0.0, 0.0)
    tau_s: float = 60.0


@hashed_by_type
class Burst(NamedTuple):
    """The receiver's noise times a factor."""

    start_s: float
    stop_s: float
    factor: float


@hashed_by_type
class Slide(NamedTuple):
    """Position and velocity that slide away together, up to so many metres, and back, or not: then they jump back."""

    start_s: float
    stop_s: float
    position_m: Axes = (0.0, 0.0, 0.0)
    back: bool = True
    random_sign: bool = False


Fault = Constant | Ramp | White | GaussMarkov | Burst | Slide


def _size(position: Axes, velocity: Axes) -> jax.Array:
    return jnp.asarray([*position, *velocity], float)


def _signs(key: jax.Array, random: bool) -> jax.Array | float:
    return jnp.sign(normal(key, (6,))) if random else 1.0


def _constant(f: Constant, key: jax.Array, t: jax.Array, noise: jax.Array) -> jax.Array:
    return jnp.broadcast_to(_signs(key, f.random_sign) * _size(f.position_m, f.velocity_mps), noise.shape)


def _ramp(f: Ramp, key: jax.Array, t: jax.Array, noise: jax.Array) -> jax.Array:
    risen = (t - f.start_s) / (f.stop_s - f.start_s)
    return risen[:, None] * _signs(key, f.random_sign) * _size(f.position_m, f.velocity_mps)


def _white(f: White, key: jax.Array, t: jax.Array, noise: jax.Array) -> jax.Array:
    return _size(f.position_sd_m, f.velocity_sd_mps) * normal(key, noise.shape)


def _correlated(f: GaussMarkov, key: jax.Array, t: jax.Array, noise: jax.Array) -> jax.Array:
    white = normal(key, noise.shape)
    interval = (t[-1] - t[0]) / max(t.shape[0] - 1, 1)
    return _size(f.position_sd_m, f.velocity_sd_mps) * gauss_markov(white, interval, f.tau_s)


def _slide(f: Slide, key: jax.Array, t: jax.Array, noise: jax.Array) -> jax.Array:
    """P = size sin^2(w s), w = pi / length there and back, half of it there alone; v = dp/dt."""
    w = jnp.pi / (f.stop_s - f.start_s) * (1.0 if f.back else 0.5)
    s = (t - f.start_s)[:, None]
    size = (_signs(key, f.random_sign) * _size(f.position_m, f.position_m))[..., :3]
    return jnp.concatenate([size * jnp.sin(w * s) ** 2, size * w * jnp.sin(2 * w * s)], 1)


def _burst(f: Burst, key: jax.Array, t: jax.Array, noise: jax.Array) -> jax.Array:
    return (f.factor - 1) * noise


FAULTS: dict[type, Callable[[Any, jax.Array, jax.Array, jax.Array], jax.Array]] = {
    Constant: _constant,
    Ramp: _ramp,
    White: _white,
    GaussMarkov: _correlated,
    Burst: _burst,
    Slide: _slide,
}
"""Type of a fault -> ``(fault, key, t (E,), noise (E, 6)) -> offset (E, 6)`` of position (ENU m) and velocity."""


def offsets(key: jax.Array, faults: tuple[Any, ...], t: jax.Array, noise: jax.Array) -> jax.Array:
    """Return the sum of all faults (E, 6), ENU m and m/s, at regular times t (E,) s on receiver noise (E, 6).

    Raises:
        ValueError: no fault, or one that stops before it starts.
    """
    total = jnp.zeros_like(noise)
    for i, fault in enumerate(faults):
        if type(fault) not in FAULTS:
            raise ValueError(f"faults[{i}] must be one of {', '.join(f.__name__ for f in FAULTS)}, got {fault!r}")
        if not fault.stop_s > fault.start_s:
            raise ValueError(f"faults[{i}].stop_s must be after start_s, got {fault.start_s:g} to {fault.stop_s:g}")
        on = (t > fault.start_s + TICK) & (t <= fault.stop_s + TICK)
        offset = FAULTS[type(fault)](fault, jax.random.fold_in(key, i), t, noise)
        total = total + jnp.where(on[:, None], offset, 0.0)
    return total
