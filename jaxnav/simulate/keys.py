"""The keys of simulated runs: of a seed, of the purpose of the run, and of its number."""

from enum import IntEnum
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike


class Purpose(IntEnum):
    """Purpose of a run; runs of two purposes share no key."""

    TRAIN = 0
    VALIDATION = 1
    TEST = 2
    SINGLE = 3  # `jaxnav simulate`
    STUDY = 5  # Monte Carlo


def run_keys(seed: int, purpose: Purpose, numbers: ArrayLike) -> jax.Array:
    """Return the keys of runs.

    Args:
        seed: of the study.
        purpose: runs of two purposes share no key.
        numbers: (N,) int, of the runs.

    Returns:
        (N,) keys.
    """
    return jax.vmap(partial(run_key, seed, purpose))(np.asarray(numbers, np.uint32))


def run_key(seed: int, purpose: Purpose, run: Any) -> jax.Array:
    """Return the key of a run (); the number may be traced."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), int(purpose)), run)
