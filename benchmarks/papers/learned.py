"""A learned rule: a small network decides in the place of the fuzzy systems of `fuzzy_combined`, on the same inputs."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.filters.papers.fuzzy_combined import combined_params, deciding
from jaxnav.filters.papers.fwekf import Limits
from jaxnav.filters.rule import Rule
from tuning.fit.transforms import IDENTITY, Spec

UNITS = 8  # of the hidden layer: 59 numbers with two blocks, where the two fuzzy systems have 78
HIGHEST = 1.2  # of the weight a, as of the fuzzy systems
FADE, SHARE = -6.0, -2.0  # logits at the start: a = 1.0005, and an eighth of the way to a new R at every fix


class Network(NamedTuple):
    """Weights of one hidden layer of tanh."""

    hidden: jax.Array  # (UNITS, 3) from the mean and the sizes of position and velocity
    hidden_bias: jax.Array  # (UNITS,)
    out: jax.Array  # (3, UNITS) to the logits of fading and of both shares
    out_bias: jax.Array  # (3,)


class Learned(NamedTuple):
    """Parameters of the rule."""

    net: Network
    limit: Limits
    doubt: jax.Array
    bounds: jax.Array
    floor: jax.Array


def learned_params(seed: int = 0) -> Learned:
    """Random features of the inputs, with zero output weights."""
    one, two = jax.random.split(jax.random.key(seed))
    normal = lambda key, *shape: jax.random.normal(key, shape, float)
    net = Network(normal(one, UNITS, 3), normal(two, UNITS), jnp.zeros((3, UNITS)), jnp.array([FADE, SHARE, SHARE]))
    return Learned(net, *combined_params()[2:])


@cache
def learned(n: int = 20, witness: int = -1) -> Rule:
    """The rule, of the two blocks of a receiver, with a window of ``n`` fixes."""

    def decide(theta: Learned, m: jax.Array, e: jax.Array) -> tuple[jax.Array, jax.Array]:
        net = theta.net
        logits = net.out @ jnp.tanh(net.hidden @ jnp.concatenate([m[None], e]) + net.hidden_bias) + net.out_bias
        return 1 + (HIGHEST - 1) * jax.nn.sigmoid(logits[0]), jax.nn.sigmoid(logits[1:])

    return deciding(decide, n, witness)


FREE: Spec = dict.fromkeys((f"rule.net.{leaf}" for leaf in Network._fields), IDENTITY)
"""Trained leaves."""
