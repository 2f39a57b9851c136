"""Minimise an objective over cases of very different difficulty, on new random numbers at every step.

One case that is chaotic can have a gradient of 1e14 beside others of order one: each case's gradient is clipped by
itself, and left out where it is not finite, before the mean over cases is taken.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxnav.analysis.progress import bar as progress_bar
from tuning.train import Fit, default_optimizer
from tuning.transforms import Spec, join, split


def clip(grads: Any, norm: float = 1.0) -> Any:
    """Gradients with a leading axis of cases, each case's global norm at most ``norm``; zero where it is not finite."""

    def one(grad):
        size = optax.tree.norm(grad)
        sound = jnp.isfinite(size)
        scale = jnp.where(size > norm, norm / jnp.where(size > 0, size, 1.0), 1.0)
        return jax.tree.map(lambda g: jnp.where(sound, scale * jnp.where(sound, g, 0.0), 0.0), grad)

    return jax.vmap(one)(grads)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _step(loss, free, optimizer, raw, state, params, cases, keys):
    def one(raw, case, key):
        return loss(join(dict(free), raw, params), case, key)

    values, grads = jax.vmap(jax.value_and_grad(one), (None, 0, 0))(raw, cases, keys)
    grad = jax.tree.map(lambda g: g.mean(0), clip(grads))
    updates, state = optimizer.update(grad, state, raw)
    return optax.apply_updates(raw, updates), state, values, jax.vmap(optax.tree.norm)(grads)


@partial(jax.jit, static_argnums=(0, 1))
def _score(loss, free, raw, params, cases, keys):
    return jax.vmap(lambda case, key: loss(join(dict(free), raw, params), case, key))(cases, keys)


def fit_cases(
    loss: Callable[..., jax.Array],
    spec: Spec,
    params: Any,
    cases: Any,
    key: jax.Array,
    steps: int,
    optimizer: optax.GradientTransformation | None = None,
    validation: Callable[..., jax.Array] | None = None,
    every: int = 10,
    progress: bool = False,
) -> Fit:
    """Minimise the mean over cases of ``loss(params, case, key) -> ()`` over the leaves that ``spec`` frees.

    ``cases`` is a tree with a leading axis; each step has its own keys, made from ``key``. Every so many steps the
    parameters are judged by ``validation`` (by default the loss) on keys that no step uses; the best are kept, and the
    start counts: those with the fewest cases that fail, then with the least mean over the others. ``grad_norm`` of the
    history is of each case before clipping.

    Raises:
        ValueError: no case's loss of the start is finite.
    """
    optimizer = default_optimizer(steps) if optimizer is None else optimizer
    validation = loss if validation is None else validation
    free = tuple(spec.items())
    count = jax.tree.leaves(cases)[0].shape[0]
    training, held = jax.random.split(key)
    held = jax.random.split(held, count)
    raw = split(spec, params)
    state = optimizer.init(raw)
    history: list[dict] = []
    best, best_score, stopped = raw, (count + 1, np.inf), "done"
    bar = progress_bar(steps + 1, "step", progress)
    try:
        for i in range(steps + 1):
            if i % every == 0 or i == steps:
                judged = np.asarray(_score(validation, free, raw, params, cases, held))
                sound = np.isfinite(judged)
                if i == 0 and not sound.any():
                    raise ValueError(f"the loss of the starting parameters is {judged}")
                score = int((~sound).sum()), float(judged[sound].mean()) if sound.any() else np.inf
                if score < best_score:
                    best, best_score = raw, score
            keys = jax.random.split(jax.random.fold_in(training, i), count)
            raw, state, values, norms = _step(loss, free, optimizer, raw, state, params, cases, keys)
            row = {"step": i, "loss": float(values.mean()), "validation": score[1], "failed": score[0]}
            history.append(row | {"cases": np.asarray(values).tolist(), "grad_norm": np.asarray(norms).tolist()})
            bar.set_postfix(loss=f"{row['loss']:.4g}", validation=f"{row['validation']:.4g}", refresh=False)
            bar.update()
    except KeyboardInterrupt:
        stopped = f"interrupted at step {len(history)}"
    finally:
        bar.close()
    return Fit(join(spec, best, params), best_score[1], history, stopped)
