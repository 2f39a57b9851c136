"""Takagi-Sugeno fuzzy inference, differentiable in every parameter; nothing of it knows of filters.

    mu_ij(x_i) = exp(-((x_i - c_ij) / s_ij)^2 / 2)          membership of input i in its set j
    w_r = AND_i mu_ij(r)                                    strength of a rule (FWEKF paper, eq. 30)
    y = sum_r w_r y_label(r)(x) / sum_r w_r                 (eq. 29)

There is one rule for each combination of sets. A table of integers says which consequent each rule has; its shape says
how many sets each input has. Everything is done with log w: its softmax is the weighted mean. Far from all centres
the paper's products underflow to 0/0, there the rule that is nearest in standard deviations wins. Of sets of unequal
width that is the widest at the very end, so clip an input to where its sets are.

The parameters are raw: any real numbers give ordered centres, positive widths and consequents within their bounds.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Conjunction = Callable[[jax.Array, jax.Array], jax.Array]  # of two log memberships
product: Conjunction = jnp.add
"""And as a product."""
minimum: Conjunction = jnp.minimum
"""And as the smaller of the two."""

NARROWEST = 0.01  # least width, in units of the input
_FAR = 1e75  # inputs beyond are as good as infinite; their squares in standard deviations stay finite


class System(NamedTuple):
    """Raw parameters of a fuzzy system of I inputs, with s_i sets each, and L labels; see `system`."""

    centres: jax.Array  # (sum s_i,) for each input its first centre, then softplus^-1 of the gaps to the next
    widths: jax.Array  # (sum s_i,) softplus^-1 of the width beyond `NARROWEST`
    consequents: jax.Array  # (L, 1 + I) logit of the position of y between the bounds: constant and slopes
    bounds: jax.Array  # (2,) of y


def _unsoftplus(y: np.ndarray) -> np.ndarray:
    return y + np.log(-np.expm1(-y))


def system(
    centres: tuple[tuple[float, ...], ...],
    widths: tuple[tuple[float, ...], ...],
    consequents: Sequence[float] | np.ndarray,
    bounds: tuple[float, float],
) -> System:
    """Parameters from plain numbers: centres and widths for each input, a constant (L,) for each label, bounds.

    Raises:
        ValueError: centres that do not ascend, widths not above `NARROWEST`, or constants outside of the bounds.
    """
    y, (low, high) = np.asarray(consequents, float), bounds
    if any(np.diff(row).min(initial=1.0) <= 0 for row in centres):
        raise ValueError(f"centres must ascend, got {centres}")
    if min(min(row) for row in widths) <= NARROWEST:
        raise ValueError(f"widths must be above {NARROWEST}, got {widths}")
    if y.min() <= low or y.max() >= high:
        raise ValueError(f"consequents must be between {low} and {high}, got {y}")
    raw = [np.concatenate([row[:1], _unsoftplus(np.diff(row))]) for row in centres]
    share = (y - low) / (high - low)
    logit = np.zeros((y.size, 1 + len(centres)))
    logit[:, 0] = np.log(share) - np.log1p(-share)
    flat = np.concatenate([np.asarray(row, float) for row in widths])
    values = (np.concatenate(raw), _unsoftplus(flat - NARROWEST), logit, bounds)
    return System(*(jnp.asarray(v, float) for v in values))


def sets(theta: System, shape: tuple[int, ...]) -> list[tuple[jax.Array, jax.Array]]:
    """Centres and widths (s_i,) of each input, for a table of that shape."""
    stops = np.cumsum(shape)[:-1]
    centres = [
        jnp.cumsum(jnp.concatenate([raw[:1], jax.nn.softplus(raw[1:])])) for raw in jnp.split(theta.centres, stops)
    ]
    return list(zip(centres, jnp.split(NARROWEST + jax.nn.softplus(theta.widths), stops), strict=True))


def log_memberships(theta: System, shape: tuple[int, ...], x: jax.Array) -> list[jax.Array]:
    """Log mu (s_i,) of each input; ``x`` is (I,)."""
    x = jnp.clip(x, -_FAR, _FAR)
    return [-0.5 * ((x[i] - c) / s) ** 2 for i, (c, s) in enumerate(sets(theta, shape))]


def firing(theta: System, shape: tuple[int, ...], x: jax.Array, conjunction: Conjunction = product) -> jax.Array:
    """Share of each rule in the answer, of the table's shape; they add up to 1."""
    axes = np.eye(len(shape), dtype=int)
    spread = [jnp.reshape(mu, np.where(axes[i] == 1, -1, 1)) for i, mu in enumerate(log_memberships(theta, shape, x))]
    return jax.nn.softmax(reduce(conjunction, spread), axis=tuple(range(len(shape))))


def _check(theta: System, table: np.ndarray) -> None:
    total, labels = sum(table.shape), int(table.max()) + 1
    if theta.centres.shape[-1] != total or theta.widths.shape[-1] != total:
        raise ValueError(
            f"a table of {table.shape} needs {total} centres and widths, got {theta.centres.shape[-1]} "
            f"and {theta.widths.shape[-1]}"
        )
    if theta.consequents.shape[-1] != 1 + table.ndim or theta.consequents.shape[-2] < labels or table.min() < 0:
        raise ValueError(
            f"a table of {table.ndim} inputs and {labels} labels needs ({labels}, {1 + table.ndim}) "
            f"consequents, got {theta.consequents.shape}"
        )


def infer(theta: System, table: Any, x: jax.Array, conjunction: Conjunction = product) -> jax.Array:
    """Return the answer y, (), to inputs ``x`` (I,); ``table`` is static, integers below L, (s_1, ..., s_I).

    Raises:
        ValueError: parameters for another number of sets, inputs or labels (at trace time).
    """
    table = np.asarray(table)
    _check(theta, table)
    share = firing(theta, table.shape, x, conjunction)
    x = jnp.clip(x, -_FAR, _FAR)
    low, high = theta.bounds
    y = low + (high - low) * jax.nn.sigmoid(theta.consequents[:, 0] + theta.consequents[:, 1:] @ x)
    return jnp.sum(share * y[table])
