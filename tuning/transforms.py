"""Which parameters are free, and the unconstrained numbers an optimiser moves instead of them.

A spec is a dict from the dotted name of a leaf of `Params` to a `Transform`; what it does not name is frozen:

    spec = {"noise.gyro": LOG, "mounting.time_offset": scaled(0.01)}
    raw = split(spec, params)            # dict of unconstrained arrays
    params = join(spec, raw, params)     # with the free leaves replaced
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Spec = dict[str, "Transform"]


class Transform(NamedTuple):
    """A monotonic map from an unconstrained number to a parameter, and back."""

    forward: Callable[[jax.Array], jax.Array]
    inverse: Callable[[jax.Array], jax.Array]


LOG = Transform(jnp.exp, jnp.log)
"""Positive: a step of 0.1 is 10 %."""
IDENTITY = Transform(lambda raw: raw, lambda value: value)


@cache
def scaled(unit: float) -> Transform:
    """Any sign; a raw step of 1 is worth ``unit``, so that one learning rate suits all leaves."""
    return Transform(lambda raw: raw * unit, lambda value: value / unit)


@cache
def interval(low: float, high: float) -> Transform:
    """Strictly between two bounds, by a logistic function."""

    def inverse(value):
        share = (value - low) / (high - low)
        return jnp.log(share) - jnp.log1p(-share)

    return Transform(lambda raw: low + (high - low) * jax.nn.sigmoid(raw), inverse)


TRANSFORMS: dict[str, Transform] = {"log": LOG, "identity": IDENTITY}


def get(tree: Any, name: str) -> Any:
    """The leaf at a dotted name.

    Raises:
        ValueError: no such name; the message lists what there is.
    """
    for part in name.split("."):
        fields = getattr(tree, "_fields", ())
        if part not in fields:
            known = ", ".join(fields) or "nothing"
            raise ValueError(f"no parameter {name!r}: {part!r} is not one of {known}")
        tree = getattr(tree, part)
    return tree


def put(tree: Any, name: str, value: Any) -> Any:
    """The tree with the leaf at a dotted name replaced."""
    first, _, rest = name.partition(".")
    get(tree, first)
    return tree._replace(**{first: put(getattr(tree, first), rest, value) if rest else value})


def split(spec: Spec, params: Any) -> dict[str, jax.Array]:
    """The free leaves as unconstrained float arrays.

    Raises:
        ValueError: a leaf is outside of its transform's range, such as a log of zero.
    """
    raw = {name: transform.inverse(jnp.asarray(get(params, name), float)) for name, transform in spec.items()}
    for name, value in raw.items():
        if not bool(jnp.all(jnp.isfinite(value))):
            raise ValueError(f"{name} = {get(params, name)} cannot start there: its transform gives {value}")
    return raw


def join(spec: Spec, raw: dict[str, jax.Array], params: Any) -> Any:
    """``params`` with the free leaves replaced by what ``raw`` stands for; the rest is kept."""
    for name, transform in spec.items():
        params = put(params, name, transform.forward(raw[name]))
    return params
