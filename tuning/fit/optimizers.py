"""Optimisers by name, all of optax, each with its use."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, TypeAlias

import optax

Make = Callable[..., optax.GradientTransformation]
"""(steps, rate) -> optimiser."""


def schedule(steps: int, rate: float) -> optax.Schedule:
    """Return a cosine from ``rate`` to 5 % of it."""
    return optax.cosine_decay_schedule(rate, max(steps, 1), alpha=0.05)


def guarded(optimizer: optax.GradientTransformation, clip: float) -> optax.GradientTransformation:
    """Return an optimiser with a largest global norm of the gradient; a non-finite gradient skips its step."""
    return optax.apply_if_finite(optax.chain(optax.clip_by_global_norm(clip), optimizer), max_consecutive_errors=5)


@cache
def adam(steps: int, rate: float = 0.05, clip: float = 1.0) -> optax.GradientTransformation:
    """Return Adam on a cosine schedule."""
    return guarded(optax.adam(schedule(steps, rate)), clip)


@cache
def lbfgs(steps: int, rate: float = 0.0) -> optax.GradientTransformation:
    """Return L-BFGS with a zoom line search: few steps of several evaluations each, for losses without noise."""
    del steps, rate  # the line search finds them
    search = optax.scale_by_zoom_linesearch(
        max_linesearch_steps=10, max_learning_rate=1.0, initial_guess_strategy="one"
    )
    return optax.lbfgs(memory_size=10, linesearch=search)


@cache
def sgd(steps: int, rate: float = 0.05, clip: float = 1.0) -> optax.GradientTransformation:
    """Return gradient descent with momentum, with the schedule and guards of Adam."""
    return guarded(optax.sgd(schedule(steps, rate), momentum=0.9), clip)


OPTIMIZERS: dict[str, Make] = {"adam": adam, "lbfgs": lbfgs, "sgd": sgd}


class Method(NamedTuple):
    """An optimiser by name and numbers."""

    name: str  # a row of `OPTIMIZERS`
    steps: int  # of its schedule
    rate: float = 0.05


Optimizer: TypeAlias = Method | optax.GradientTransformation


def made(optimizer: Optimizer) -> optax.GradientTransformation:
    """Return the optimiser of optax."""
    if isinstance(optimizer, Method):
        return OPTIMIZERS[optimizer.name](optimizer.steps, optimizer.rate)
    return optimizer
