"""Minimise an objective over the free parameters with optax; keep the best."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from tuning.transforms import Spec, join, split


class Fit(NamedTuple):
    """What training leaves."""

    params: Any  # the best parameters met
    loss: float  # their loss
    history: list[dict]  # one row a step: step, loss, grad_norm, validation, params {name: value}
    stopped: str  # "done", or why it ended early


def default_optimizer(steps: int, rate: float = 0.05, clip: float = 1.0) -> optax.GradientTransformation:
    """Adam on a cosine schedule, clipped by global norm; a non-finite gradient skips its step."""
    schedule = optax.cosine_decay_schedule(rate, steps, alpha=0.05)
    chain = optax.chain(optax.clip_by_global_norm(clip), optax.adam(schedule))
    return optax.apply_if_finite(chain, max_consecutive_errors=5)


def fit(
    loss: Callable[[Any], jax.Array],
    spec: Spec,
    params: Any,
    steps: int,
    optimizer: optax.GradientTransformation | None = None,
    validation: Callable[[Any], jax.Array] | None = None,
    progress: bool = False,
) -> Fit:
    """Minimise ``loss(params) -> ()`` over the leaves that ``spec`` frees.

    The best is by ``validation`` if there is one, else by the loss itself, and the start counts. Ctrl-C ends the run
    with what it has.

    Raises:
        ValueError: the loss of the start is not finite.
    """
    optimizer = default_optimizer(steps) if optimizer is None else optimizer
    raw = split(spec, params)
    state = optimizer.init(raw)

    @jax.jit
    def step(raw, state):
        value, grad = jax.value_and_grad(lambda r: loss(join(spec, r, params)))(raw)
        updates, state = optimizer.update(grad, state, raw)
        return optax.apply_updates(raw, updates), state, value, optax.global_norm(grad)

    judge = None if validation is None else jax.jit(lambda raw: validation(join(spec, raw, params)))
    history: list[dict] = []
    best, best_score, stopped = raw, np.inf, "done"
    bar = tqdm(range(steps + 1), disable=None if progress else True, unit="step")
    try:
        for i in bar:
            new, new_state, value, norm = step(raw, state)
            score = value if judge is None else judge(raw)
            if i == 0 and not np.isfinite(value):
                raise ValueError(f"the loss of the starting parameters is {float(value)}")
            row = {"step": i, "loss": float(value), "grad_norm": float(norm)}
            if judge is not None:
                row["validation"] = float(score)
            row["params"] = {name: np.asarray(t.forward(raw[name])).tolist() for name, t in spec.items()}
            history.append(row)
            bar.set_postfix(loss=f"{row['loss']:.4g}", grad=f"{row['grad_norm']:.3g}")
            if float(score) < best_score:
                best, best_score = raw, float(score)
            raw, state = new, new_state
    except KeyboardInterrupt:
        stopped = f"interrupted at step {len(history)}"
    bar.close()
    strong = jax.tree.map(lambda leaf: jnp.asarray(leaf), join(spec, best, params))
    return Fit(strong, best_score, history, stopped)
