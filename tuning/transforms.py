"""Which parameters are free, and the unconstrained numbers an optimiser moves instead of them.

A spec is a dict from the dotted name of a leaf of `Params` to a `Transform`; what it does not name is frozen:

    spec = {"noise.gyro": LOG, "mounting.time_offset": scaled(0.01)}
    raw = split(spec, params)            # dict of unconstrained arrays
    params = join(spec, raw, params)     # with the free leaves replaced

Axes that share a value, leaves that share one, and beliefs are part of a leaf's transform:

    spec = {
        "noise.gyro": believed(LOG, datasheet, math.log(3)),  # within a factor 3 of the datasheet, one sd
        "noise.position_scale": tied(LOG, (0, 0, 1)),         # east and north alike
        "noise.gyro_tau": tied(LOG, also=("noise.accel_tau",)),
    }
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Spec = dict[str, "Transform"]


class Belief(NamedTuple):
    """What is known of a parameter before any data: Gaussian in the unconstrained space."""

    centre: tuple[float, ...]  # SI, one number or one an axis
    sd: float  # of the unconstrained number: log(2) with LOG says "within a factor 2"


class Transform(NamedTuple):
    """A monotonic map from an unconstrained number to a parameter, and back."""

    forward: Callable[[jax.Array], jax.Array]
    inverse: Callable[[jax.Array], jax.Array]
    tie: tuple[int, ...] | None = None  # which free number each axis of the leaf takes; () is one for all axes
    also: tuple[str, ...] = ()  # other leaves that take the same value
    belief: Belief | None = None


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


def tied(transform: Transform, tie: tuple[int, ...] | None = (), also: tuple[str, ...] = ()) -> Transform:
    """Axes that share a number, and other leaves that take the leaf's value.

    ``tie`` has the free number of each axis: (0, 0, 1) is two numbers for three axes, () one for them all.
    """
    return transform._replace(tie=tie, also=also)


def believed(transform: Transform, centre: Any, sd: float) -> Transform:
    """With a Gaussian prior about ``centre`` (SI), sd in the unconstrained space: what makes a fit a MAP estimate."""
    if not sd > 0:
        raise ValueError(f"the sd of a belief must be > 0, got {sd}")
    return transform._replace(belief=Belief(tuple(np.ravel(np.asarray(centre, float)).tolist()), float(sd)))


@cache
def cholesky(n: int) -> Transform:
    """A covariance (n, n) by the n (n + 1) / 2 numbers of its factor; the diagonal's logarithms come first."""
    rows, columns = np.tril_indices(n, -1)

    def forward(raw):
        L = jnp.diag(jnp.exp(raw[:n])).at[rows, columns].set(raw[n:])
        return L @ L.T

    def inverse(value):
        L = jnp.linalg.cholesky(value)
        return jnp.concatenate([jnp.log(jnp.diag(L)), L[rows, columns]])

    return Transform(forward, inverse)


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
    """The free leaves as unconstrained float arrays; axes that are tied start at their mean.

    Raises:
        ValueError: a leaf is outside of its transform's range, such as a log of zero.
    """
    raw = {name: _untie(transform, get(params, name)) for name, transform in spec.items()}
    for name, value in raw.items():
        if not bool(jnp.all(jnp.isfinite(value))):
            raise ValueError(f"{name} = {get(params, name)} cannot start there: its transform gives {value}")
    return raw


def _untie(transform: Transform, value: Any) -> jax.Array:
    raw = transform.inverse(jnp.asarray(value, float))
    if transform.tie is None:
        return raw
    if not transform.tie:
        return jnp.mean(raw)
    index = np.array(transform.tie)
    raw = jnp.broadcast_to(raw, index.shape)
    return jnp.stack([jnp.mean(raw[index == i]) for i in range(index.max() + 1)])


def join(spec: Spec, raw: dict[str, jax.Array], params: Any) -> Any:
    """``params`` with the free leaves replaced by what ``raw`` stands for; the rest is kept."""
    for name, transform in spec.items():
        value = transform.forward(raw[name])
        if transform.tie is not None:
            value = (
                value[np.array(transform.tie)]
                if transform.tie
                else jnp.broadcast_to(value, jnp.shape(get(params, name)))
            )
        for leaf in (name, *transform.also):
            params = put(params, leaf, value)
    return params


def penalty(spec: Spec, raw: dict[str, jax.Array]) -> jax.Array:
    """Minus the log of the beliefs' density, without its constant: what a MAP estimate adds to the likelihood, ()."""
    total = jnp.zeros(())
    for name, transform in spec.items():
        if transform.belief is not None:
            centre = np.array(transform.belief.centre)
            middle = _untie(transform, centre if centre.size > 1 else centre[0])
            total += 0.5 * jnp.sum(((raw[name] - middle) / transform.belief.sd) ** 2)
    return total


def labels(spec: Spec, raw: dict[str, jax.Array]) -> list[str]:
    """The name of every free number in the order of `jax.flatten_util.ravel_pytree`: ``noise.gyro[2]``."""
    names = []
    for name in sorted(spec):
        shape = jnp.shape(raw[name])
        names += [f"{name}[{i}]" for i in range(shape[0])] if shape else [name]
    return names
