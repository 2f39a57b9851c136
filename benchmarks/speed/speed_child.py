"""Separate processes of the speed benchmark: first calls, peak memory, two devices.

``python -m benchmarks.speed.speed_child TASK [ARGUMENT...]`` prints one line of JSON; `ask` starts it.
"""

import gc
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

from jaxnav.filters.compiler import fast_flags

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false"
ROOT = Path(__file__).parents[2]
CPUS = "JAXNAV_SPEED_CPUS"  # those that the benchmark was given, before it kept to one


def pinned() -> dict[str, str]:
    """The environment of a process that works with one thread; set before jax and numpy start."""
    one = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}
    given = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    cpus = os.environ.get(CPUS) or ",".join(map(str, sorted(given)))
    # without a cache on disk: compile times are part of the tables
    own = {"XLA_FLAGS": fast_flags(ONE_THREAD), "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    return {**os.environ, **one, **own, CPUS: cpus}


def is_pinned() -> bool:
    """Is this process one with the environment of `pinned`?"""
    return CPUS in os.environ and ONE_THREAD in os.environ.get("XLA_FLAGS", "")


def cpus() -> list[int]:
    """The processors that the benchmark was given."""
    return [int(c) for c in os.environ[CPUS].split(",")]


def keep_to(some: list[int]) -> None:
    """Run on these processors only, where the system can do that."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, some)


def ask(*task: Any, **environment: str) -> Any:
    """Run a task in a new process, on one processor unless it takes more itself; with these variables set."""
    command = [sys.executable, "-m", "benchmarks.speed.speed_child", *map(str, task)]
    done = subprocess.run(command, env=pinned() | environment, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def compile_times(names: list[tuple[str, int, bool]]) -> dict[str, dict[str, float]]:
    """First calls without and with a persistent cache on disk, s; of (label, states, gradient).

    With it, medians of three processes: they take a few seconds each, in which a busy machine can be slow throughout.
    """
    with tempfile.TemporaryDirectory() as folder:
        task = partial(
            ask, "first_calls", json.dumps(names), JAX_COMPILATION_CACHE_DIR=folder,
            JAX_ENABLE_COMPILATION_CACHE="true", JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0",
            JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES="0",
        )  # fmt: skip
        cold, warm = task(), [task() for _ in range(3)]
    return {"cold": cold, "warm": {name: statistics.median(each[name] for each in warm) for name in cold}}


# ---------------------------------------------------------------------------- in the new process


def form_of(label: str):
    """Of the speed benchmark's forms the one of this name."""
    from benchmarks.speed import speed_work as work

    return {f.label: f for f in (work.NESTED, work.CHECKPOINT, *work.OURS)}[label]


def first_calls(names: str) -> dict[str, float]:
    """Processor seconds of the first call of each on 10 s of one run, as if nothing had been called before."""
    import jax

    from benchmarks.speed import speed_work as work

    result = {}
    for label, n, gradient in json.loads(names):
        form = form_of(label)
        arguments = work.inputs(form, n, *work.still(10, 1))
        jax.clear_caches()
        gc.collect()  # or garbage of the forms before is searched again and again while this one is traced
        function = jax.jit(work.slope(form.loss(n), 1) if gradient else form.forward(n))
        start = time.process_time()
        jax.block_until_ready(function(*arguments))
        result[title(label, n, gradient)] = time.process_time() - start
    return result


def title(label: str, n: int, gradient: bool) -> str:
    """A row's name."""
    return f"{n} states, {label}, {'gradient' if gradient else 'forward'}"


def resident(what: str) -> int:
    """Bytes of this process: ``VmRSS`` now, ``VmHWM`` at most since `memory` began to count."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(what))


def memory(label: str, n: str, seconds: str, runs: str) -> dict[str, float]:
    """Peak memory of a gradient over the memory before, compiling not counted; bytes per IMU sample and run."""
    import jax

    from benchmarks.speed import speed_work as work

    arguments = work.still(int(seconds), int(runs))
    call = jax.jit(work.slope(form_of(label).loss(int(n)), int(runs))).lower(*arguments).compile()
    Path("/proc/self/clear_refs").write_text("5")  # the peak restarts
    before = resident("VmRSS")
    start = time.process_time()
    jax.block_until_ready(call(*arguments))
    taken = time.process_time() - start
    peak = resident("VmHWM") - before
    steps = int(seconds) * work.RATE * int(runs)
    return {"bytes_per_step": peak / steps, "peak_bytes": peak, "us_per_step": 1e6 * taken / steps}


def devices(label: str, n: str, seconds: str, runs: str, repeats: str) -> dict[str, list[float]]:
    """Wall seconds of a batch on one device and shared between two, each with a processor; in turns, of each round."""
    keep_to(cpus()[:2])
    import jax
    from jax.sharding import PartitionSpec

    from benchmarks.speed import speed_work as work
    from tuning.fit import distributed
    from tuning.fit.batch import RUNS

    noise, nav, epochs = work.still(int(seconds), int(runs))
    mesh = distributed.mesh(2)
    one = work.over_runs(form_of(label).forward(int(n)), int(runs))
    spread = PartitionSpec(RUNS)
    shared = jax.shard_map(
        one, mesh=mesh, in_specs=(PartitionSpec(), spread, spread), out_specs=spread, check_vma=False
    )
    calls = {
        "1": (jax.jit(one), (noise, nav, epochs)),
        "2": (jax.jit(shared), (distributed.replicate(noise, mesh), *distributed.share((nav, epochs), mesh))),
    }
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(int(repeats) + 1):
        for name, (call, arguments) in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call(*arguments))
            taken[name].append(time.perf_counter() - start)
    return {name: each[1:] for name, each in taken.items()}


def main(task: str, *arguments: str) -> None:
    """Run one of the tasks."""
    keep_to(cpus()[-1:])
    from jaxnav.app.cli import COLLECT
    from jaxnav.filters.compiler import enable_x64, fast_compiler

    fast_compiler()
    enable_x64()
    gc.set_threshold(COLLECT)  # as the command line does
    print(json.dumps({"first_calls": first_calls, "memory": memory, "devices": devices}[task](*arguments)))


if __name__ == "__main__":
    main(*sys.argv[1:])
