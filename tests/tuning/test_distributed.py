"""Runs shared among devices and processes give what one process gives, with one collective outside of every loop."""

import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.types import ConfigError
from tuning.fit import distributed

JOB = """
import json, sys
import jax
jax.config.update("jax_enable_x64", True)
from tuning.fit import distributed
port, processes, index, devices, folder = sys.argv[1:]
if int(devices) > 1:
    distributed.use_cpu_devices(int(devices))
if int(processes) > 1:
    distributed.start(f"127.0.0.1:{port}", int(processes), int(index))
import numpy as np
from tests.tuning.test_distributed import collectives, filter_problem, local_level, naive, problem
from tuning.fit.train import _step, fit
import optax
mesh = distributed.mesh()
spec, start, cases = problem()
found = fit(local_level, spec, start, 20, optax.adam(0.1), cases=cases, validation=local_level, validation_cases=cases,
            mesh=mesh, folder=None if folder in ("", "filter") else folder)
out = {"loss": [row["loss"] for row in found.history], "params": np.asarray(found.params.log).tolist(),
       "devices": jax.device_count(), "rows": len(found.history)}
if mesh is not None and int(processes) == 1:
    even = [c[:4] for c in cases]
    out["collectives"] = collectives(mesh, local_level, spec, start, even)
    out["control"] = naive(mesh, local_level, start, even[0])
if folder == "filter":
    out["collectives"] = collectives(mesh, *filter_problem())
if distributed.writes():
    print(json.dumps(out))
"""


def local_level(params, y):
    """Negative log-likelihood of a random walk seen through noise, by a scan as long as a filter's."""
    q, v = jnp.exp(2 * params.log)

    def step(xP, yi):
        x, P = xP
        S = P + q + v
        nu = yi - x
        return (x + (P + q) / S * nu, (P + q) * v / S), 0.5 * (nu**2 / S + jnp.log(S))

    return jnp.mean(jax.lax.scan(step, (jnp.zeros(()), jnp.zeros(())), y)[1])


def problem():
    from typing import NamedTuple

    from tuning.fit.transforms import IDENTITY

    class Params(NamedTuple):
        log: jax.Array

    rng = np.random.default_rng(0)
    group = lambda n, e: jnp.asarray(rng.normal(size=(n, e)).cumsum(1))
    return {"log": IDENTITY}, Params(jnp.array([1.0, -1.0])), [group(5, 30), group(4, 20)]  # 5 does not divide by 2


def filter_problem():
    """Two runs of four epochs through a real filter, and its likelihood."""
    from jaxnav.filters.catalogue import build
    from jaxnav.filters.parameters import datasheet_params
    from jaxnav.filters.run import initial_nav, run
    from jaxnav.states.grades import GRADES
    from jaxnav.types import Epoch, Fix, Imu
    from tuning.fit import objectives
    from tuning.fit.transforms import LOG

    nav, many = initial_nav((0.8, 0.2, 100.0)), lambda a: jnp.broadcast_to(jnp.asarray(a, float), (2, 4, *np.shape(a)))
    imu = Imu(many(np.full(3, 0.1)), many(np.zeros((3, 3))), many(np.tile([0.0, 0.0, -9.8], (3, 1))))
    fix = Fix(many([0.8, 0.2, 100.0, 0, 0, 0]), many(np.ones(6)), many(np.zeros(6)), jnp.ones((2, 4, 6), bool))
    filt = build("ekf15", cov_stride=3)

    def loss(params, case):
        return objectives.innovation_nll(run(filt, params, *case), jnp.ones(4, bool))

    cases = jax.tree.map(lambda a: jnp.stack([a, a]), nav), Epoch(imu, fix)
    return loss, {"noise.gyro": LOG}, datasheet_params(GRADES["consumer"]), [cases]


def collectives(mesh, loss, spec, start, cases) -> dict[str, int]:
    """How many collectives the compiled step has, and how many inside of a loop's body."""
    from tuning.fit import train
    from tuning.fit.optimizers import adam
    from tuning.fit.transforms import split

    optimizer, raw = adam(5), split(spec, start)
    job, data = train._job(loss, spec, start, (), cases, train.mean, None, 1.0, mesh)
    place = lambda tree: distributed.replicate(tree, mesh)
    text = train._step.jitted.lower(job, optimizer, place(raw), place(optimizer.init(raw)), data).compile().as_text()
    return count(text)


def naive(mesh, loss, start, case) -> dict[str, int]:
    """The same of a mean over runs that are only placed apart, as a compiler makes it."""
    mean = jax.jit(jax.value_and_grad(lambda p, case: jnp.mean(jax.vmap(lambda c: loss(p, c))(case))))
    return count(mean.lower(distributed.replicate(start, mesh), distributed.share(case, mesh)).compile().as_text())


def count(text: str) -> dict[str, int]:
    names = r"(all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter)(-start)?\("
    bodies = set(re.findall(r"body=%?([\w.\-]+)", text))
    inside = total = 0
    for block in re.split(r"\n(?=(?:ENTRY |%)?[\w%.\-]+ \(.*\) -> )", text):
        found = len(re.findall(names, block))
        total += found
        inside += found if re.match(r"\s*(?:ENTRY )?%?([\w.\-]+)", block)[1] in bodies else 0
    return {"all": total, "inside": inside, "loops": len(bodies)}


def launch(processes: int, devices: int, folder: Path | str = "") -> dict:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "JAX_PLATFORMS": "cpu"}
    env.pop("XLA_FLAGS", None)
    started = [
        subprocess.Popen([sys.executable, "-c", JOB, str(port), str(processes), str(i), str(devices), str(folder)],
                         stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)
        for i in range(processes)
    ]  # fmt: skip
    out = [process.communicate(timeout=300) for process in started]
    assert all(process.returncode == 0 for process in started), out[0][1][-3000:]
    results = [line for text, _ in out for line in text.splitlines() if line.startswith("{")]  # gloo prints its own
    assert len(results) == 1  # only process 0 speaks
    return json.loads(results[0])


@pytest.mark.full
def test_processes_and_devices_change_nothing(tmp_path):
    one = launch(1, 1)
    two = launch(2, 1, tmp_path)
    shared = launch(1, 2)
    assert (one["devices"], two["devices"], shared["devices"]) == (1, 2, 2)
    for other in (two, shared):
        np.testing.assert_allclose(other["loss"], one["loss"], rtol=0, atol=1e-12)
        np.testing.assert_allclose(other["params"], one["params"], rtol=0, atol=1e-12)
    assert len((tmp_path / "history.jsonl").read_text().splitlines()) == 21  # written once
    assert shared["collectives"]["loops"] >= 2  # forward and backward in time
    assert shared["collectives"]["inside"] == 0 and shared["collectives"]["all"] == 1
    assert shared["control"]["inside"] > 0  # what the compiler makes of runs that are only placed apart


@pytest.mark.slow
def test_a_filters_step_has_one_collective_outside_of_every_loop():
    found = launch(1, 2, "filter")["collectives"]
    assert found["loops"] >= 2 and found["inside"] == 0 and found["all"] == 1


def test_mesh_and_flags_are_checked():
    assert distributed.mesh(1) is None and distributed.writes()
    with pytest.raises(ConfigError, match="devices asked for"):
        distributed.mesh(10_000)
    with pytest.raises(ConfigError, match="all of --coordinator"):
        distributed.start("127.0.0.1:1", 2)
    tree = {"a": np.arange(3)}
    assert distributed.share(tree, None) is tree and distributed.replicate(tree, None) is tree


@pytest.mark.slow
def test_monte_carlo_on_devices_and_processes_is_that_of_one(tmp_path):
    """Every figure of `jaxnav mc` to rounding; two devices of one process and of two to the bit."""
    code = "import sys; from jaxnav.app.console import console; sys.exit(console())"
    job = "mc --data urban_short --runs 6 --set mc.chunk=4 --set out.figures=none --set filter.cov_stride=25 --quiet"

    def start(name, *more):
        return subprocess.Popen([sys.executable, "-c", code, *job.split(), "--out", str(tmp_path / name), *more])

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    each = ["--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process"]
    for jobs in ([start("one")], [start("two", "--devices", "2")], [start("both", *each, i) for i in ("0", "1")]):
        assert all(process.wait(timeout=240) == 0 for process in jobs)
    runs = {name: np.load(tmp_path / name / "runs.npz") for name in ("one", "two", "both")}
    for key in runs["one"].files:
        np.testing.assert_allclose(runs["two"][key], runs["one"][key], rtol=1e-11, atol=1e-14)
        np.testing.assert_array_equal(runs["both"][key], runs["two"][key])
