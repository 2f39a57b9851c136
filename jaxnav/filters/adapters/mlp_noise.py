"""`mlp_noise`: the sd of each receiver's measurement, by a small network of the epoch."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.adapters.adapter import Adapted, Adapter, Window, times
from jaxnav.measurements.measurement import Measurement, layout
from jaxnav.types import Json, Tree

WIDTH = 16  # of the hidden layer
MOST = 4.0  # the factor on an sd is within exp(-MOST) and exp(MOST)
SCALES = {"speed": 10.0, "turn": 0.3, "gyro": 0.05, "accel": 0.5}  # m/s, rad/s, rad/s, m/s^2: of the inputs


def features(window: Window, blocks: tuple[slice, ...]) -> jax.Array:
    """Return the inputs of the network, each about one: motion and spread of the samples, then of each measurement.

    These are its stated sd (log), its age (log), and whether it is there; the fix itself is none of them.
    """
    imu, fix = window.imu, window.fix
    weight = imu.dt / jnp.where(imu.dt.sum() > 0, imu.dt.sum(), 1.0)
    mean = weight @ imu.gyro, weight @ imu.accel
    spread = [
        jnp.sqrt(weight @ ((a - m) ** 2).sum(1) + 1e-12) for a, m in zip((imu.gyro, imu.accel), mean, strict=True)
    ]
    turn = jnp.sqrt((mean[0] ** 2).sum() + 1e-12)
    speed = jnp.sqrt((window.nav.vel**2).sum() + 1e-12)
    motion = [speed / SCALES["speed"], turn / SCALES["turn"], spread[0] / SCALES["gyro"], spread[1] / SCALES["accel"]]
    each = [
        jnp.stack([jnp.log(fix.sd[at]).mean(), jnp.log1p(window.age[at].max()), fix.valid[at].mean()]) for at in blocks
    ]
    return jnp.concatenate([jnp.stack(motion), *each])


@cache
def mlp_noise(measurements: tuple[Measurement, ...]) -> Adapter:
    """Return the adapter of a filter with these measurements: a factor on the stated sd of each of the receiver's."""
    blocks = tuple(at for each, at in zip(measurements, layout(measurements).values(), strict=True) if each.receiver)
    inputs = 4 + 3 * len(blocks)

    def theta() -> Json:
        """Return weights (a, b) and biases (b,); the last layer is zero: training starts at the plain filter."""
        draw = np.random.default_rng(0).normal(size=(inputs, WIDTH)) / np.sqrt(inputs)
        one = {"weights": jnp.asarray(draw), "biases": jnp.zeros(WIDTH)}
        return {"hidden": one, "out": {"weights": jnp.zeros((WIDTH, len(blocks))), "biases": jnp.zeros(len(blocks))}}

    def adapt(theta: Json, memory: Tree, window: Window) -> tuple[Any, Adapted]:
        hidden, out = theta["hidden"], theta["out"]
        seen = jnp.tanh(features(window, blocks) @ hidden["weights"] + hidden["biases"])
        factors = jnp.exp(MOST * jnp.tanh((seen @ out["weights"] + out["biases"]) / MOST))
        fix = window.fix
        for at, factor in zip(blocks, factors, strict=True):
            fix = times(fix, factor, at)
        return memory, Adapted(fix)

    return Adapter(adapt, theta)
