"""A batch of runs evaluated run by run: one value and one gradient each, so that a run that fails spoils no other.

The matrix of all runs' values and gradients is small, and everything else follows from it: means or tails over runs,
clipping of single runs, which of them failed, the sandwich of `tuning.uncertainty`. Over several devices each has a
share of the runs and the matrix is gathered, which is the only collective of a step and outside of every loop; the
reduction that follows is the same everywhere, so results do not depend on the number of devices or processes.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, PartitionSpec

from jaxnav.types import Tree
from tuning.fit.transforms import Transform, join, penalty

RUNS = "runs"  # name of the mesh's axis
FORWARDS = 4  # free numbers up to which a derivative is taken forwards: it compiles in two thirds of the time

Aggregate = Callable[[jax.Array, jax.Array], jax.Array]


def mean(values: jax.Array, weight: jax.Array) -> jax.Array:
    """Return the weighted mean over runs (B,); runs of weight zero do not enter."""
    return jnp.sum(values * weight) / jnp.sum(weight)


class Problem(NamedTuple):
    """The minimisation problem; static, so everything in it is hashable."""

    losses: tuple[Callable[..., jax.Array], ...]  # of a group: (params, case, *arguments) -> ()
    free: tuple[tuple[str, Transform], ...]  # the items of the spec
    counts: tuple[int, ...] = ()  # runs of every group; empty: one loss (params, *arguments) -> () without runs
    aggregate: Aggregate = mean
    clip: float | None = None  # largest norm of one run's gradient
    prior_weight: float = 1.0  # weight of the priors: 1 / (epochs) with a likelihood per epoch
    mesh: Mesh | None = None  # devices that share the runs


class Data(NamedTuple):
    """The data of the problem; arrays."""

    params: Tree
    arguments: tuple[Any, ...]
    cases: tuple[Any, ...]  # of every group a tree with a leading axis of runs, padded to a multiple of the devices
    weight: jax.Array  # (B,) of the runs of all groups


class Evaluated(NamedTuple):
    """One point; B runs, one of them where there are none."""

    value: jax.Array  # () over the finite runs, and the priors
    grad: Any  # like raw
    values: jax.Array  # (B,) of the runs
    slopes: jax.Array  # (B, P) gradients of the runs before clipping, flat; (B, 0) where none was asked for
    good: jax.Array  # (B,) bool: value and gradient finite


def evaluate(problem: Problem, raw: Tree, data: Data, slopes: bool = True) -> Evaluated:
    """Return value and gradient, and both of each run; runs that are not finite are left out.

    Where all of them fail, value and gradient are nan.
    """
    spec, (flat, back) = dict(problem.free), ravel_pytree(raw)
    rows = _rows(problem, slopes, raw, data)
    values, G = rows[:, 0], rows[:, 1:]
    prior, slope = jax.value_and_grad(lambda r: problem.prior_weight * penalty(spec, r))(raw)
    add = lambda grad: jax.tree.map(jnp.add, back(grad), slope)
    zero = jnp.zeros_like(flat)
    if not problem.counts:  # one loss without runs: its value is passed on as it is
        return Evaluated(values[0] + prior, add(G[0] if slopes else zero), values, G, jnp.isfinite(values))
    good = jnp.isfinite(rows).all(1)
    weight = jnp.where(good, data.weight, 0.0)
    share, value = _weights(problem.aggregate, jnp.where(good, values, 0.0), weight)
    if not slopes:
        return Evaluated(value + prior, add(zero), values, G, good)
    used = jnp.where(good[:, None], G, 0.0)
    if problem.clip is not None:
        square = jnp.sum(used**2, axis=1)
        long = square > problem.clip**2
        used = used * jnp.where(long, problem.clip / jnp.sqrt(jnp.where(long, square, 1.0)), 1.0)[:, None]
    grad = jnp.where(good.any(), share @ used, jnp.nan)
    return Evaluated(value + prior, add(grad), values, G, good)


def _weights(aggregate: Aggregate, values: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return each run's weight, (B,), and the aggregate, ()."""
    value, share = jax.value_and_grad(aggregate)(values, weight)
    return jnp.where(weight > 0, share, 0.0), value


def _rows(problem: Problem, slopes: bool, raw: Tree, data: Data) -> jax.Array:
    """Value and gradient of every run, (B, 1 + P), or (B, 1) without gradients."""
    if not problem.counts:
        call = lambda r: problem.losses[0](join(dict(problem.free), r, data.params), *data.arguments)
        return _row(call, slopes, raw)[None]
    if problem.mesh is None:
        return jnp.concatenate(_local(problem, slopes, raw, data))
    spread = Data(PartitionSpec(), PartitionSpec(), PartitionSpec(RUNS), PartitionSpec())  # type: ignore[arg-type]
    n = problem.mesh.shape[RUNS]

    @partial(
        jax.shard_map, mesh=problem.mesh, in_specs=(PartitionSpec(), spread), out_specs=PartitionSpec(), check_vma=False
    )
    def gathered(raw: Tree, data: Data) -> Any:
        return lax.all_gather(jnp.concatenate(_local(problem, slopes, raw, data)), RUNS)

    rows, at, parts = gathered(raw, data), 0, []
    for count in problem.counts:  # each device had its share of every group
        share = -(-count // n)
        parts.append(rows[:, at : at + share].reshape(n * share, -1)[:count])
        at += share
    return jnp.concatenate(parts)


def _local(problem: Problem, slopes: bool, raw: Tree, data: Data) -> list[jax.Array]:
    """Return the rows of this device's runs, by group."""

    def one(loss: Any, case: Any) -> Any:
        return _row(lambda r: loss(join(dict(problem.free), r, data.params), case, *data.arguments), slopes, raw)

    return [jax.vmap(partial(one, f))(cases) for f, cases in zip(problem.losses, data.cases, strict=True)]


def _row(call: Callable[[Any], jax.Array], slopes: bool, raw: Tree) -> jax.Array:
    """Value, and gradient if asked for: forwards of few numbers, which compiles to less, else backwards."""
    if not slopes:
        return call(raw)[None]
    flat, back = ravel_pytree(raw)
    if flat.size <= FORWARDS:
        push = lambda v: jax.jvp(lambda r: call(back(r)), (flat,), (v,))
        with suppress(TypeError):  # an objective with a reverse derivative alone
            value, grad = jax.vmap(push, out_axes=(None, 0))(jnp.eye(flat.size, dtype=flat.dtype))
            return jnp.concatenate([value[None], grad])
    value, slope = jax.value_and_grad(call)(raw)
    return jnp.concatenate([value[None], ravel_pytree(slope)[0]])


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def strict(problem: Problem, raw: Tree, data: Data) -> jax.Array:
    """Return the value, inf where a run of positive weight fails, for a line search; its gradient is `evaluate`'s."""
    e = evaluate(problem, raw, data, slopes=False)
    return jnp.where((e.good | (data.weight == 0)).all(), e.value, jnp.inf)


def _forth(problem: Problem, raw: Tree, data: Data) -> Any:
    e = evaluate(problem, raw, data)
    return jnp.where((e.good | (data.weight == 0)).all(), e.value, jnp.inf), e.grad


def _back(problem: Problem, grad: Any, by: jax.Array) -> Any:
    return jax.tree.map(lambda g: by * g, grad), None


strict.defvjp(_forth, _back)
