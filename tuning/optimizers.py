"""Optimisers by name, all of optax; what each is good for stands beside it."""

from collections.abc import Callable
from functools import cache

import optax

Make = Callable[[int, float, float, float], optax.GradientTransformation]
"""(steps, rate, clip, warmup) -> optimiser."""


def schedule(steps: int, rate: float, warmup: float = 0.0, end: float = 0.05) -> optax.Schedule:
    """From ``rate`` down to ``end`` of it on a cosine, after a linear rise over the share ``warmup`` of the steps."""
    steps = max(steps, 1)
    rise = round(warmup * steps)
    if not rise:
        return optax.cosine_decay_schedule(rate, steps, alpha=end)
    return optax.warmup_cosine_decay_schedule(rate / 100, rate, rise, max(steps, rise + 1), end * rate)


@cache
def adam(steps: int, rate: float = 0.05, clip: float = 1.0, warmup: float = 0.0) -> optax.GradientTransformation:
    """Adam on a cosine schedule, clipped by global norm; a non-finite gradient skips its step."""
    chain = optax.chain(optax.clip_by_global_norm(clip), optax.adam(schedule(steps, rate, warmup)))
    return optax.apply_if_finite(chain, max_consecutive_errors=5)


@cache
def lbfgs(steps: int, rate: float = 0.0, clip: float = 0.0, warmup: float = 0.0) -> optax.GradientTransformation:
    """L-BFGS with a zoom line search: few steps of several evaluations each, for losses without noise."""
    del steps, rate, clip, warmup  # the line search finds its own
    search = optax.scale_by_zoom_linesearch(
        max_linesearch_steps=10, max_learning_rate=1.0, initial_guess_strategy="one"
    )
    return optax.lbfgs(memory_size=10, linesearch=search)


@cache
def sgd(steps: int, rate: float = 0.05, clip: float = 1.0, warmup: float = 0.0) -> optax.GradientTransformation:
    """Gradient descent with momentum, same schedule and guards as Adam."""
    chain = optax.chain(optax.clip_by_global_norm(clip), optax.sgd(schedule(steps, rate, warmup), momentum=0.9))
    return optax.apply_if_finite(chain, max_consecutive_errors=5)


OPTIMIZERS: dict[str, Make] = {"adam": adam, "lbfgs": lbfgs, "sgd": sgd}
