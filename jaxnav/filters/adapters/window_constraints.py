"""`window_constraints`: wheels that do not slip, with an sd by a convolution over the last samples of the IMU.

Brossard, Barrau & Bonnabel 2020, AI-IMU Dead-Reckoning, IEEE Transactions on Intelligent Vehicles 5(4), section IV-B:
two layers over the last N samples with kernels of 5 and dilations of 1 and 3, one linear layer, eq. 18. There the
constraint holds at every sample, here at the end of every epoch.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.filters.adapters.adapter import Adapted, Adapter, Window, constrained
from jaxnav.measurements.measurement import Measurement, layout
from jaxnav.types import Json

SAMPLES = 15  # N of the paper
KERNEL, DILATIONS, CHANNELS = 5, (1, 3), 32
BETA = 3.0  # sd^2 are within 10^-BETA and 10^BETA of those of `theta`
SD = (1.0, 3.0)  # m/s, lateral and vertical, of the paper
SCALES = np.array([0.1, 0.1, 0.3, 2.0, 2.0, 2.0])  # rad/s, m/s^2: of the inputs
GRAVITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -9.8])  # m/s^2, of a level vehicle at rest


@cache
def window_constraints(measurements: tuple[Measurement, ...]) -> Adapter:
    """Return the adapter of a filter with ``nonholonomic``, which it gives an sd at the end of every epoch."""
    at = layout(measurements)["nonholonomic"]

    def theta() -> Json:
        """Return the weights of the layers (5, a, b) and (b, 2); the last is zero: constant sd at the start."""
        rng, sizes = np.random.default_rng(0), (6, CHANNELS, CHANNELS)
        layer = lambda a, b: {
            "weights": jnp.asarray(rng.normal(size=(KERNEL, a, b)) * np.sqrt(2 / (KERNEL * a))),
            "biases": jnp.zeros(b),
        }
        layers = {f"layer_{k + 1}": layer(a, b) for k, (a, b) in enumerate(zip(sizes, sizes[1:]))}
        out = {"weights": jnp.zeros((CHANNELS, 2)), "biases": jnp.zeros(2)}
        return layers | {"out": out, "log_sd": jnp.log(jnp.array(SD))}

    def adapt(theta: Json, memory: jax.Array, window: Window) -> tuple[jax.Array, Adapted]:
        memory = latest(memory, jnp.concatenate([window.imu.gyro, window.imu.accel], 1), window.imu.dt)
        seen = (memory - GRAVITY) / SCALES
        for k, dilation in enumerate(DILATIONS):
            seen = jax.nn.relu(convolved(seen, dilation, **theta[f"layer_{k + 1}"]))
        z = seen[-1] @ theta["out"]["weights"] + theta["out"]["biases"]
        sd = jnp.exp(theta["log_sd"] + 0.5 * BETA * jnp.log(10.0) * jnp.tanh(z))  # eq. 18
        return memory, Adapted(constrained(window.fix, at, 0.0, sd))

    return Adapter(adapt, theta, lambda: jnp.tile(jnp.asarray(GRAVITY), (SAMPLES, 1)))


def latest(memory: jax.Array, samples: jax.Array, dt: jax.Array) -> jax.Array:
    """Return the last N of the samples in memory (N, 6) and of further ones (k, 6), without padding."""
    both = jnp.concatenate([memory, samples])
    return lax.dynamic_slice_in_dim(both, jnp.sum(dt > 0), memory.shape[0])


def convolved(seen: jax.Array, dilation: int, weights: jax.Array, biases: jax.Array) -> jax.Array:
    """Return a causal convolution over samples (N, a) -> (N, b); the first sample stands for those before it."""
    back = dilation * np.arange(KERNEL)
    rows = np.maximum(np.arange(seen.shape[0])[:, None] - back, 0)
    return jnp.einsum("nka,kab->nb", seen[rows], weights) + biases
