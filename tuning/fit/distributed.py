"""Runs shared among the devices of one machine, or of several processes and machines, on jax's runtime.

Every process makes the same data and keeps its share of it; after each step all hold the same numbers, and process 0
writes. Ports of the runtime are not authenticated: use it inside a private network only.
"""

import os
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxnav.types import ConfigError, Tree
from tuning.fit.batch import RUNS


def use_cpu_devices(count: int) -> None:
    """Let one machine's processor count as so many devices; before anything else of jax."""
    jax.config.update("jax_num_cpu_devices", count)


def start(coordinator: str | None = None, processes: int | None = None, index: int | None = None) -> None:
    """Join the other processes, by three flags, or by the variables of Slurm or Open MPI where there is none.

    Before anything else of jax. A process that dies stops all within the heartbeat's timeout (100 s).

    Raises:
        ConfigError: some flags but not all.
    """
    given = [flag is not None for flag in (coordinator, processes, index)]
    if any(given) and not all(given):
        raise ConfigError("give all of --coordinator HOST:PORT, --processes N and --process I, or none of them")
    if any(given) or any(name in os.environ for name in ("SLURM_JOB_ID", "OMPI_MCA_orte_hnp_uri", "PMIX_NAMESPACE")):
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(coordinator, processes, index)


def mesh(devices: int = 0) -> Mesh | None:
    """All devices of all processes, or the first ``devices`` of one; None where that is a single one.

    Raises:
        ConfigError: fewer devices than asked for.
    """
    there = jax.device_count()
    if devices > there:
        raise ConfigError(f"{devices} devices asked for, {there} there")
    count = devices or there
    if count == 1:
        return None
    # explicit axes, the default, cannot run scans that start from constants
    return jax.make_mesh((count,), (RUNS,), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.devices()[:count])


def writes() -> bool:
    """Is this the process that writes files and prints?"""
    return jax.process_index() == 0


def replicate(tree: Tree, where: Mesh | None) -> Any:
    """Return the tree on every device."""
    return tree if where is None else jax.tree.map(lambda a: _place(np.asarray(a), where, PartitionSpec()), tree)


def share(tree: Tree, where: Mesh | None) -> Any:
    """Split runs (B, ...) among the devices; copies of the last run fill up the remainder."""
    if where is None:
        return tree
    n = where.shape[RUNS]

    def cut(a: Any) -> Any:
        a = np.asarray(a)
        a = np.concatenate([a, np.repeat(a[-1:], -len(a) % n, axis=0)])
        return _place(a, where, PartitionSpec(RUNS))

    return jax.tree.map(cut, tree)


def _place(a: np.ndarray, where: Mesh, spec: PartitionSpec) -> jax.Array:
    return jax.make_array_from_callback(a.shape, NamedSharding(where, spec), lambda i: a[i])
