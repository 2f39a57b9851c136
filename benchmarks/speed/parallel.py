"""Parallel in time: the covariances of a run as an associative scan, against the sequential scan.

Elements and their product as in Särkkä and García-Fernández, "Temporal Parallelization of Bayesian Smoothers", IEEE
Transactions on Automatic Control 66 (2021), eqs. 10 to 15, without the means: mechanization has been done, and the
transitions are those along it. Both forms get the same matrices, and end at the same covariances.
"""

import statistics
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from jaxnav.analysis.tables import table
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter, Step, masked
from jaxnav.filters.run import prepare, run
from jaxnav.maths import linalg
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params, simulate_jit
from jaxnav.types import Epoch, Nav, Params

LENGTHS = (600, 3600)  # epochs
FILTERS = ("ekf9", "ekf15")
TURNS = 5


class Chain(NamedTuple):
    """What a filter's covariance goes through: E epochs."""

    Phi: jax.Array  # (E, n, n)
    Q: jax.Array  # (E, n, n)
    H: jax.Array  # (E, m, n), zero rows where nothing is measured
    R: jax.Array  # (E, m, m)


class Element(NamedTuple):
    """The epochs from one to another as one: x given the state before, and what their fixes say of that."""

    A: jax.Array  # (n, n)
    C: jax.Array  # (n, n)
    J: jax.Array  # (n, n)


def chain(filt: Filter, params: Params, nav: Nav, epochs: Epoch) -> tuple[jax.Array, Chain]:
    """Return the covariance (n, n) at the start of a run, and its matrices."""

    def record(step: Step, epoch: Epoch) -> Chain:
        _, H, R = masked(*filt.model.observe(params, step.predicted.past, epoch.fix), epoch.fix.valid)
        return Chain(step.transition.Phi, step.transition.Q, H, R)

    return filt.init(params, nav).P, run(filt, params, nav, epochs, record, epochs)


def sequential(P: jax.Array, steps: Chain) -> jax.Array:
    """Return the covariances (E, n, n) after each fix, one after the other."""

    def one(P: jax.Array, step: Chain) -> tuple[jax.Array, jax.Array]:
        _, P = linalg.update(linalg.sandwich(step.Phi, P) + step.Q, step.H, step.R)
        return P, P

    return jax.lax.scan(one, P, steps)[1]


def element(step: Chain) -> Element:
    """Return one epoch, eqs. 10 to 12."""
    Si = linalg.inverse(step.H @ step.Q @ step.H.T + step.R)
    rest = jnp.eye(step.Q.shape[0]) - step.Q @ step.H.T @ Si @ step.H
    seen = step.H @ step.Phi
    return Element(rest @ step.Phi, rest @ step.Q, seen.T @ Si @ seen)


def inverse(M: jax.Array) -> jax.Array:
    """Return M^-1 (n, n) by Gauss-Jordan elimination: parallel LAPACK calls can deadlock on two cores (jaxlib 0.10)."""

    def step(k: jax.Array, M: jax.Array) -> jax.Array:
        pivot = jnp.arange(M.shape[0]) == k
        row = jnp.where(pivot, 1.0, M[k]) / M[k, k]
        column = jnp.where(pivot, 0.0, M[:, k])
        return jnp.where(pivot[:, None], row, jnp.where(pivot, 0.0, M) - column[:, None] * row)

    return jax.lax.fori_loop(0, M.shape[0], step, M)


@jax.vmap
def product(i: Element, j: Element) -> Element:
    """Return ``j`` after ``i``, eq. 15."""
    D = inverse(jnp.eye(i.A.shape[0]) + i.C @ j.J)
    AD = j.A @ D
    return Element(AD @ i.A, AD @ i.C @ j.A.T + j.C, i.A.T @ D.T @ j.J @ i.A + i.J)


def parallel(P: jax.Array, steps: Chain) -> jax.Array:
    """Return the covariances (E, n, n) after each fix, by an associative scan."""
    first = jax.tree.map(lambda a: a[0], steps)
    _, begin = linalg.update(linalg.sandwich(first.Phi, P) + first.Q, first.H, first.R)
    every = jax.vmap(element)(steps)
    every = Element(every.A.at[0].set(0.0), every.C.at[0].set(begin), every.J.at[0].set(0.0))
    return jax.lax.associative_scan(product, every).C


def longer(steps: Chain, count: int) -> Chain:
    """Return ``count`` epochs, the same again and again."""
    return jax.tree.map(lambda a: jnp.tile(a, (-(-count // a.shape[0]), 1, 1))[:count], steps)


def case(name: str) -> tuple[jax.Array, Chain]:
    """Return start and matrices of a simulated drive."""
    scenario = SCENARIOS["urban_short"]
    sim, filt = simulate_jit(jax.random.key(0), scenario), build(name, cov_stride=10)
    params = matched_params(scenario)
    nav = jax.tree.map(lambda a: a[0], sim.truth)._replace(errors={})
    later = jax.tree.map(lambda a: a[1:], sim.epochs)
    return jax.jit(lambda p: chain(filt, p, nav, prepare(filt, later)))(params)


def seconds(call: Any, *args: Any) -> float:
    """Return the median wall time of a compiled call."""
    jax.block_until_ready(call(*args))
    found = []
    for _ in range(TURNS):
        begin = time.perf_counter()
        jax.block_until_ready(call(*args))
        found.append(time.perf_counter() - begin)
    return statistics.median(found)


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("parallel", __doc__ or "")
    args = parser.parse_args(argv)
    rows, found = [], {}
    for name in FILTERS:
        P, steps = case(name)
        for count in LENGTHS:
            whole = longer(steps, count)
            one, other = jax.jit(sequential), jax.jit(parallel)
            off = np.abs(np.asarray(one(P, whole)) - np.asarray(other(P, whole))).max() / float(jnp.abs(P).max())
            times = seconds(one, P, whole), seconds(other, P, whole)
            rows.append([P.shape[0], count, *(1e3 * t for t in times), times[1] / times[0]])
            found[f"{name}_{count}"] = {"sequential_s": times[0], "parallel_s": times[1], "difference": float(off)}
    device = jax.devices()[0].device_kind
    print(table(["states", "epochs", "sequential, ms", "associative, ms", f"ratio on {device}"], rows))
    common.write_json(args.json, found)
