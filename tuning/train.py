"""Minimise an objective over the free parameters with optax; keep the best."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from tqdm import tqdm

from tuning.transforms import Spec, join, split


class Fit(NamedTuple):
    """What training leaves."""

    params: Any  # the best parameters met
    loss: float  # their loss, or their validation score
    history: list[dict]  # one row a step: step, loss, grad_norm, validation, params {name: value}
    stopped: str  # "done", or why it ended early


@cache
def default_optimizer(steps: int, rate: float = 0.05, clip: float = 1.0) -> optax.GradientTransformation:
    """Adam on a cosine schedule, clipped by global norm; a non-finite gradient skips its step."""
    schedule = optax.cosine_decay_schedule(rate, max(steps, 1), alpha=0.05)
    chain = optax.chain(optax.clip_by_global_norm(clip), optax.adam(schedule))
    return optax.apply_if_finite(chain, max_consecutive_errors=5)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _step(loss, free, optimizer, raw, state, params, arguments):
    """One update; static are the loss, the spec as a tuple of items, and the optimiser."""
    value, grad = jax.value_and_grad(lambda r: loss(join(dict(free), r, params), *arguments))(raw)
    updates, state = optimizer.update(grad, state, raw)
    return optax.apply_updates(raw, updates), state, value, optax.tree.norm(grad)


@partial(jax.jit, static_argnums=(0, 1))
def _score(loss, free, raw, params, arguments):
    return loss(join(dict(free), raw, params), *arguments)


def fit(
    loss: Callable[..., jax.Array],
    spec: Spec,
    params: Any,
    steps: int,
    optimizer: optax.GradientTransformation | None = None,
    arguments: tuple = (),
    validation: Callable[..., jax.Array] | None = None,
    validation_arguments: tuple = (),
    progress: bool = False,
) -> Fit:
    """Minimise ``loss(params, *arguments) -> ()`` over the leaves that ``spec`` frees, by ``steps`` updates.

    Data belong into ``arguments``: fits of one loss to other data of the same shapes then compile once. The best is by
    ``validation(params, *validation_arguments)`` if there is one, else by the loss itself, and the start counts.
    Ctrl-C ends the run with what it has.

    Raises:
        ValueError: the loss of the start is not finite.
    """
    optimizer = default_optimizer(steps) if optimizer is None else optimizer
    free = tuple(spec.items())
    raw = split(spec, params)
    state = optimizer.init(raw)
    history: list[dict] = []
    best, best_score, stopped = raw, np.inf, "done"
    bar = tqdm(range(steps + 1), disable=None if progress else True, unit="step")
    try:
        for i in bar:
            new, new_state, value, norm = _step(loss, free, optimizer, raw, state, params, arguments)
            judged = value if validation is None else _score(validation, free, raw, params, validation_arguments)
            if i == 0 and not np.isfinite(value):
                raise ValueError(f"the loss of the starting parameters is {float(value)}")
            row = {"step": i, "loss": float(value), "grad_norm": float(norm)}
            if validation is not None:
                row["validation"] = float(judged)
            row["params"] = {name: np.asarray(t.forward(raw[name])).tolist() for name, t in spec.items()}
            history.append(row)
            bar.set_postfix(loss=f"{row['loss']:.4g}", grad=f"{row['grad_norm']:.3g}")
            if float(judged) < best_score:
                best, best_score = raw, float(judged)
            raw, state = new, new_state
    except KeyboardInterrupt:
        stopped = f"interrupted at step {len(history)}"
    finally:
        bar.close()
    return Fit(join(spec, best, params), best_score, history, stopped)
