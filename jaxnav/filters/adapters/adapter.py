"""Adapters: a part of a filter, such as a network, that sets its noise and its measurements epoch by epoch.

Before an epoch is predicted and corrected its adapter sees the samples, navigation and the fix, and says by how much
noise of the sensors, and by which fix. It is a pure function inside of the scan, so that runs, batches, late fixes, the
smoother, the stream and gradients go through it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jaxnav.types import Fix, Imu, Nav, Noise, Tree


class Window(NamedTuple):
    """An epoch before it is used."""

    imu: Imu  # (k, ...) samples since the last fix; dt = 0 marks padding
    nav: Nav  # at the begin of the epoch, local level
    P: jax.Array  # (n, n) covariance there, position, velocity and attitude in ENU
    age: jax.Array  # (m,) s from the last use of each channel to the end of the epoch
    fix: Fix  # (m,) that ends it; missing channels have the value 0 and the sd 1, also those that are hidden


class Adapted(NamedTuple):
    """How an epoch is used."""

    fix: Fix  # (m,) with another sd, or with channels of pseudo-measurements: value, sd and valid
    noise: jax.Array | float = 1.0  # () or (2,) factor on the root PSD of gyro and accelerometer


class Adapt(Protocol):
    """An adapter's function, pure: compiled once, with every filter that has it."""

    def __call__(self, theta: Tree, memory: Tree, window: Window, /) -> tuple[Any, Adapted]:
        """``theta``: its parameters, ``memory``: its state -> the state for the next epoch, and how to use this one."""


class Adapter(NamedTuple):
    """A part of a filter that sets its noise and its measurements."""

    adapt: Adapt
    theta: Callable[[], Any]  # its first parameters, `Params.adapter`: the leaves that are learned
    memory: Callable[[], Any] = lambda: ()  # its state before the first epoch


def adapted(
    adapter: Adapter, theta: Tree, memory: Tree, window: Window, channels: tuple[int, ...]
) -> tuple[Any, Fix, jax.Array | float]:
    """Return the adapter's next state, the fix to correct by and the factor on the noise.

    Nothing of a missing channel is shown to the adapter, so that it cannot learn from hidden fixes; what it leaves
    missing stays as it was.

    Args:
        adapter: the adapter.
        theta: its parameters.
        memory: its state.
        window: the epoch, with the whole fix.
        channels: (m,) channel that each entry of a fix's value shows.

    Raises:
        ValueError: when traced, a fix of another shape.
    """
    fix, shows = window.fix, jnp.array(channels)
    seen = lambda a, none, valid=fix.valid: jnp.where(valid, a, none)
    value = seen(fix.value, 0.0, fix.valid[shows])
    blank = fix._replace(value=value, sd=seen(fix.sd, 1.0), corr=seen(fix.corr, 0.0))
    memory, (new, noise) = adapter.adapt(theta, memory, window._replace(fix=blank))
    for name in ("value", "sd", "corr", "valid"):
        found, expected = (jnp.shape(getattr(each, name)) for each in (new, fix))
        if found != expected:
            raise ValueError(f"the adapter's fix has {name} of shape {found}, expected {expected}")
    kept = lambda a, old, valid=new.valid: jnp.where(valid, a, old)
    value = kept(new.value, fix.value, new.valid[shows])
    return memory, new._replace(value=value, sd=kept(new.sd, fix.sd), corr=kept(new.corr, fix.corr)), noise


def times(fix: Fix, factor: jax.Array, at: slice = slice(None)) -> Fix:
    """Return the fix with the sd of some channels multiplied, () or one each."""
    return fix._replace(sd=fix.sd.at[at].multiply(factor))


def constrained(fix: Fix, at: slice, value: jax.Array | float, sd: jax.Array) -> Fix:
    """Return the fix with a pseudo-measurement in the channels ``at``: value and sd, () or one each."""
    return fix._replace(
        value=fix.value.at[at].set(value),
        sd=fix.sd.at[at].set(sd),
        corr=fix.corr.at[at].set(0.0),
        valid=fix.valid.at[at].set(True),
    )


def with_factor(noise: Noise, factor: jax.Array | float) -> Noise:
    """Return the noise with the root PSD of gyro and accelerometer multiplied by ``factor`` () or (2,)."""
    gyro, accel = jnp.broadcast_to(jnp.asarray(factor, float), (2,))
    return noise._replace(gyro=gyro * noise.gyro, accel=accel * noise.accel)
