"""Which parameters are free, and the unconstrained numbers an optimiser moves instead of them.

A spec is a dict from the dotted name of a leaf of `Params` to a `Transform`; all other leaves are frozen:

    spec = {"noise.gyro": LOG, "mounting.time_offset": scaled(0.01)}
    raw = split(spec, params)            # dict of unconstrained arrays
    params = join(spec, raw, params)     # with the free leaves replaced

Axes that share a value, leaves that share one, and priors are part of a leaf's transform:

    spec = {
        "noise.gyro": with_prior(LOG, datasheet, math.log(3)),  # within a factor 3 of the datasheet, one sd
        "measurements.position.scale": tied(LOG, (0, 0, 1)),  # east and north alike
        "states.gyro_bias.tau": tied(LOG, also=("states.accel_bias.tau",)),
        "measurements.velocity.scale": factor(3),             # correlated between the axes
    }

A branch of any kind is free as it is, a module of equinox or parameters of flax, all its floating-point arrays:

    spec = {"net": TREE, "filter.noise.gyro": LOG}  # of params = {"net": module, "filter": Params}

A positive parameter moves in its logarithm:

    >>> import jaxnav
    >>> params = jaxnav.build("ekf15").params("consumer")
    >>> spec = {"measurements.position.scale": tied(LOG)}
    >>> raw = split(spec, params)
    >>> wider = join(spec, {name: number + jnp.log(2.0) for name, number in raw.items()}, params)
    >>> print(params.measurements["position"].scale, wider.measurements["position"].scale)
    [1. 1. 1.] [2. 2. 2.]
"""

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.filters.parameters import get, put
from jaxnav.types import Array, Tree

Spec = dict[str, "Transform"]
LINEAR_GAIN = 0.01  # of a gain of any sign: below it steps are even, above it they grow with the gain


class GaussianPrior(NamedTuple):
    """Prior of a parameter: Gaussian in the unconstrained space."""

    centre: tuple[float, ...]  # SI, one number or one an axis
    sd: float  # of the unconstrained number: log(2) with LOG says "within a factor 2"


class Transform(NamedTuple):
    """An invertible map from unconstrained numbers to a parameter, monotonic number by number unless it has axes."""

    forward: Callable[[jax.Array], jax.Array]
    inverse: Callable[[jax.Array], jax.Array]
    tie: tuple[int, ...] | None = None  # which free number each axis of the leaf takes; () is one for all axes
    also: tuple[str, ...] = ()  # other leaves that take the same value
    prior: GaussianPrior | None = None
    axes: int = 0  # n of a matrix (n, n) with n sd and n (n - 1) / 2 correlations; 0 is no matrix
    tree: bool = False  # of a branch, whose floating-point arrays are free as they are
    frozen: tuple[Any, ...] = ()  # of a branch: its structure and what is no such array, see `bound`


LOG = Transform(jnp.exp, jnp.log)
"""Positive: a step of 0.1 is 10 %."""
IDENTITY = Transform(lambda raw: raw, lambda value: value)


@cache
def scaled(unit: float) -> Transform:
    """Any sign; a raw step of 1 is worth ``unit``, so that one learning rate suits all leaves."""
    return Transform(partial(_times, unit), partial(_over, unit))


def _times(unit: float, raw: Tree) -> Any:
    return raw * unit


def _over(unit: float, value: Array) -> Any:
    return value / unit


@cache
def interval(low: float, high: float) -> Transform:
    """Strictly between two bounds, by a logistic function."""
    return Transform(partial(_inside, low, high), partial(_share, low, high))


def _inside(low: float, high: float, raw: Tree) -> jax.Array:
    return low + (high - low) * jax.nn.sigmoid(raw)


def _share(low: float, high: float, value: Array) -> jax.Array:
    share = (value - low) / (high - low)
    return jnp.log(share) - jnp.log1p(-share)


def tied(transform: Transform, tie: tuple[int, ...] | None = (), also: tuple[str, ...] = ()) -> Transform:
    """Axes that share a number, and other leaves that take the leaf's value.

    ``tie`` has the free number of each axis: (0, 0, 1) is two numbers for three axes, () one for them all.
    """
    if transform.tree:
        raise ValueError("a branch has no axes to tie")
    if tie is not None and transform.axes:
        raise ValueError("axes that are correlated have a number each and cannot be tied")
    return transform._replace(tie=tie, also=also)


def with_prior(transform: Transform, centre: Any, sd: float) -> Transform:
    """Add a Gaussian prior about ``centre`` (SI), sd in the unconstrained space: a fit is then a MAP estimate."""
    if not sd > 0:
        raise ValueError(f"the sd of a prior must be > 0, got {sd}")
    return transform._replace(prior=GaussianPrior(tuple(np.ravel(np.asarray(centre, float)).tolist()), float(sd)))


@cache
def factor(n: int) -> Transform:
    """Return a lower triangular root L (n, n) of a covariance or density L L'; may start from its diagonal () or (n,).

    By n (n + 1) / 2 numbers. First the logarithms of the axes' sd, the norms of the rows of L, as `LOG` has for each.
    Then the inverse hyperbolic tangents z of the partial correlations of axes i > j given those before j, which may be
    any numbers (Lewandowski, Kurowicka & Joe 2009): row i of L is its sd times

        tanh z_0,  tanh z_1 / cosh z_0,  ...,  1 / (cosh z_0 cosh z_1 ...)

    One learning rate suits both and other logarithms: neither depends on the axes' units, and N samples give them to
    1 / sqrt(2 N) and 1 / sqrt(N) at any values (Fisher 1915).
    """
    return Transform(partial(_root, n), partial(_numbers, n), axes=n)


def _root(n: int, raw: jax.Array) -> jax.Array:
    Z = jnp.zeros((n, n)).at[np.tril_indices(n, -1)].set(raw[n:])
    rest = jnp.cumprod(jnp.concatenate([jnp.ones((n, 1)), 1 / jnp.cosh(Z[:, :-1])], 1), 1)
    return jnp.exp(raw[:n, None]) * (jnp.tanh(Z) + jnp.eye(n)) * rest


def _numbers(n: int, value: Array) -> jax.Array:
    L, lower = _matrix(value, n), np.tril_indices(n, -1)
    square = jnp.cumsum(L[:, ::-1] ** 2, 1)[:, ::-1]  # of the rest of a row from each column on
    sinh = L[lower] / jnp.sqrt(square[lower[0], lower[1] + 1])
    return jnp.concatenate([0.5 * jnp.log(square[:, 0]), jnp.arcsinh(sinh)])


def _matrix(value: jax.Array, n: int) -> jax.Array:
    """(n, n) from itself, from its elements in a row, or from a diagonal (n,) or ()."""
    return value.reshape(n, n) if value.size == n * n else jnp.diag(jnp.broadcast_to(value, (n,)))


SIGNED = Transform(lambda raw: LINEAR_GAIN * jnp.sinh(raw), lambda value: jnp.arcsinh(value / LINEAR_GAIN))
"""A gain of any sign, zero included: a step of 0.1 is 10 % of a large gain, and 0.001 about zero."""
TREE = Transform(lambda raw: raw, lambda value: value, tree=True)
"""A branch, such as a network: its floating-point arrays as they are, `bound` by `tuning.fit.train.fit`."""
TRANSFORMS: dict[str, Transform] = {"log": LOG, "identity": IDENTITY, "signed": SIGNED}


def bound(spec: Spec, params: Tree) -> tuple[Spec, Any]:
    """Return a spec that knows the structure of its branches, and parameters without these: arrays alone.

    Functions and numbers of a branch are part of the program.

    Raises:
        ValueError: a branch without a floating-point array, or with an array of another kind.
    """
    for name, transform in spec.items():
        if not transform.tree:
            continue
        leaves_, structure = jax.tree.flatten(get(params, name))
        if not any(map(_is_free, leaves_)):
            raise ValueError(f"{name}: a branch without a floating-point array has nothing to fit")
        rest = tuple(None if _is_free(leaf) else leaf for leaf in leaves_)
        if kinds := [str(leaf.dtype) for leaf in leaves_ if hasattr(leaf, "dtype") and not _is_free(leaf)]:
            raise ValueError(f"{name}: arrays of {kinds[0]} cannot be fitted: make them static fields or numbers")
        spec = spec | {name: transform._replace(frozen=(structure, rest))}
        params = put(params, name, None)
    return spec, params


def _is_free(leaf: Any) -> bool:
    """Return whether a leaf of a branch is a floating-point array."""
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.inexact)


def _branch(transform: Transform, raw: Tree) -> Any:
    """Return a branch of the free arrays of ``raw`` and of what is frozen."""
    structure, rest = transform.frozen
    free = iter(jax.tree.leaves(raw))
    return jax.tree.unflatten(structure, [next(free) if leaf is None else leaf for leaf in rest])


def split(spec: Spec, params: Tree) -> dict[str, jax.Array]:
    """Return the free leaves as unconstrained float arrays; axes that are tied start at their mean.

    Raises:
        ValueError: a leaf is outside of its transform's range, such as a log of zero.
    """
    free = lambda branch: jax.tree.map(lambda leaf: jnp.asarray(leaf) if _is_free(leaf) else None, branch)
    raw = {
        name: free(get(params, name)) if transform.tree else _untie(transform, get(params, name))
        for name, transform in spec.items()
    }
    for name, value in raw.items():
        if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(value)):
            raise ValueError(f"{name} = {get(params, name)} cannot start there: its transform gives {value}")
    return raw


def _untie(transform: Transform, value: Array) -> jax.Array:
    raw = transform.inverse(jnp.asarray(value, float))
    if transform.tie is None:
        return raw
    if not transform.tie:
        return jnp.mean(raw)
    index = np.array(transform.tie)
    raw = jnp.broadcast_to(raw, index.shape)
    return jnp.stack([jnp.mean(raw[index == i]) for i in range(index.max() + 1)])


def join(spec: Spec, raw: dict[str, jax.Array], params: Tree) -> Any:
    """Return ``params`` with the free leaves replaced by the values of ``raw``; the rest is kept."""
    for name, transform in spec.items():
        if transform.tree:
            params = put(params, name, _branch(transform, raw[name]))
            continue
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
    """Minus the log density of the priors, without its constant: a MAP estimate adds it to the likelihood, ()."""
    total = jnp.zeros(())
    for name, transform in spec.items():
        if transform.prior is not None:
            centre = np.array(transform.prior.centre)
            middle = _untie(transform, centre if centre.size > 1 else centre[0])
            total += 0.5 * jnp.sum(((raw[name] - middle) / transform.prior.sd) ** 2)
    return total


def labels(spec: Spec, raw: dict[str, jax.Array]) -> list[str]:
    """Return the name of every free number in the order of `jax.flatten_util.ravel_pytree`: ``noise.gyro[2]``.

    ``noise.gyro[2,0]`` is of the correlation of the axes 2 and 0; the numbers of a table are counted row by row.
    """
    names = []
    for name in sorted(spec):
        if spec[name].tree:
            for path, leaf in jax.tree_util.tree_flatten_with_path(raw[name])[0]:
                names += [f"{name}{jax.tree_util.keystr(path)}[{i}]" for i in range(jnp.size(leaf))]
            continue
        n, shape = spec[name].axes, jnp.shape(raw[name])
        index = [f"{i}" for i in range(n or math.prod(shape))] + [f"{i},{j}" for i in range(n) for j in range(i)]
        names += [f"{name}[{i}]" for i in index] if shape else [name]
    return names


def reported(spec: Spec, raw: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Return the unconstrained numbers of a user's `values`, like ``raw``: full correlations, not partial ones."""

    def one(n: int, r: jax.Array) -> jax.Array:
        U = factor(n).forward(r.at[:n].set(0.0))
        corr = (U @ U.T)[np.tril_indices(n, -1)]
        return r.at[n:].set(jnp.arctanh(jnp.clip(corr, -1 + 1e-12, 1 - 1e-12)))

    return {name: one(spec[name].axes, r) if spec[name].axes else r for name, r in raw.items()}


def values(spec: Spec, reported: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Return the parameters, number by number, of `reported` numbers: of a matrix the axes' sd and the correlations."""
    both = lambda n, t: jnp.concatenate([jnp.exp(t[:n]), jnp.tanh(t[n:])])
    return {
        name: both(spec[name].axes, t) if spec[name].axes else spec[name].forward(t) for name, t in reported.items()
    }


def leaves(spec: Spec) -> tuple[str, ...]:
    """Every leaf that a spec moves, ties included."""
    return tuple(leaf for name, transform in spec.items() for leaf in (name, *transform.also))


def merged(params: Tree, into: Any, free: tuple[str, ...]) -> Any:
    """Return ``into`` with the leaves in ``free`` from ``params``."""
    for leaf in free:
        into = put(into, leaf, get(params, leaf))
    return into
