"""A long job may end at any moment: what it left is whole, and it goes on bit for bit."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tuning.fit import checkpoint, optimizers
from tuning.fit.checkpoint import CheckpointError
from tuning.fit.train import fit
from tuning.fit.transforms import LOG, scaled


class Two(NamedTuple):
    width: jax.Array
    shift: jax.Array


START, SPEC = Two(jnp.array(5.0), jnp.array([0.3, 0.1])), {"width": LOG, "shift": scaled(0.1)}
RUNS = [jnp.linspace(1.0, 2.0, 5)]


def valley(p, centre):
    return jnp.log(p.width / centre) ** 2 + 10 * jnp.sum((p.shift - 0.1 * jnp.sin(p.width)) ** 2)


def tree():
    return {"a": np.arange(5.0), "b": (np.array(3), np.array(True))}


def test_a_checkpoint_restores_to_the_bit(tmp_path):
    head = {"score": 0.1 + 0.2, "best": float("inf"), "step": 7}
    checkpoint.save(tmp_path / "c.npz", tree(), head, "job")
    found = checkpoint.load(tmp_path / "c.npz", tree(), "job")
    assert found.head == head
    jax.tree.map(np.testing.assert_array_equal, found.tree, tree())
    assert [p.name for p in tmp_path.iterdir()] == ["c.npz"]


def test_another_job_and_no_file_are_refused(tmp_path):
    checkpoint.save(tmp_path / "c.npz", tree(), {}, "job")
    for like, identity, words in ((tree(), "other", "another job"), ({"a": np.arange(4.0)}, "job", "other parameters"),
                                  (tree() | {"a": np.arange(5)}, "job", "other parameters")):  # fmt: skip
        with pytest.raises(CheckpointError, match=words):
            checkpoint.load(tmp_path / "c.npz", like, identity)
    with pytest.raises(CheckpointError, match="cannot be read"):
        checkpoint.load(tmp_path / "absent.npz", tree(), "job")


def test_400_damaged_files_are_refused(tmp_path):
    good = tmp_path / "good.npz"
    checkpoint.save(good, tree(), {"step": 3}, "job")
    data, rng = good.read_bytes(), np.random.default_rng(0)
    for i in range(400):
        bad = bytearray(data)
        if i % 4 == 0:
            bad = bad[: rng.integers(len(bad))]
        elif i % 4 == 1:
            at = rng.integers(len(bad) - 8)
            bad[at : at + 8] = rng.bytes(8)
        else:
            bad[rng.integers(len(bad))] ^= 1 << rng.integers(8)
        path = tmp_path / "bad.npz"
        path.write_bytes(bytes(bad))
        with pytest.raises(CheckpointError, match="bad.npz: damaged"):
            checkpoint.load(path, tree(), "job")


def test_objects_are_never_unpickled(tmp_path):
    np.savez(tmp_path / "c.npz", about=np.array([{"a": 1}], object))
    data = (tmp_path / "c.npz").read_bytes()
    (tmp_path / "c.npz").write_bytes(data + hashlib.sha256(data).digest())
    with pytest.raises(CheckpointError, match="damaged.*allow_pickle"):
        checkpoint.load(tmp_path / "c.npz", tree(), "job")


@pytest.mark.parametrize("optimizer", [optimizers.adam(40, 0.1), optimizers.lbfgs(40)], ids=["adam", "lbfgs"])
def test_20_and_20_steps_are_40(tmp_path, optimizer):
    def go(steps, **how):
        return fit(valley, SPEC, START, steps, optimizer, cases=RUNS, validation=valley, validation_cases=RUNS, **how)

    whole = go(40)
    half = go(20, folder=tmp_path)
    again = go(40, folder=tmp_path, resume=True)
    assert len(half.history) == 21 and again.history == whole.history and again.loss == whole.loss
    jax.tree.map(np.testing.assert_array_equal, again.params, whole.params)
    lines = (tmp_path / "history.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == whole.history


def test_history_that_ran_ahead_is_cut_back(tmp_path):
    """A kill between the line and the checkpoint loses the step, not the file."""
    fit(valley, SPEC, START, 5, optax.adam(0.1), cases=RUNS, folder=tmp_path)
    with open(tmp_path / "history.jsonl", "a") as file:
        file.write('{"step": 6, "lo')
    again = fit(valley, SPEC, START, 8, optax.adam(0.1), cases=RUNS, folder=tmp_path, resume=True)
    assert [row["step"] for row in again.history] == list(range(9))


def test_a_damaged_history_is_refused(tmp_path):
    """Cut, emptied, a bit turned, a row changed that still is JSON: none resumes, all say so in a line."""
    fit(valley, SPEC, START, 5, optax.adam(0.1), cases=RUNS, folder=tmp_path)
    path, rng = tmp_path / "history.jsonl", np.random.default_rng(0)
    whole = path.read_bytes()
    turned = [bytearray(whole) for _ in range(20)]
    for each in turned:
        each[rng.integers(len(each))] ^= 1 << rng.integers(8)
    changed = whole.replace(b'"loss": ', b'"loss": 1')
    for damaged in (b"", whole[:-3], whole[: len(whole) // 2], changed, b"[]\n" * 6, *map(bytes, turned)):
        assert damaged != whole
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match="does not have the 6 steps"):
            fit(valley, SPEC, START, 8, optax.adam(0.1), cases=RUNS, folder=tmp_path, resume=True)
    path.write_bytes(whole)
    assert len(fit(valley, SPEC, START, 8, optax.adam(0.1), cases=RUNS, folder=tmp_path, resume=True).history) == 9


JOB = """
import sys, time, jax, jax.numpy as jnp, optax
jax.config.update("jax_enable_x64", True)
from tests.tuning.test_checkpoint import RUNS, SPEC, START, valley
from tuning.fit.train import fit
print("ready", flush=True)
def explain(p, i): pass
fit(valley, SPEC, START, 400, optax.adam(0.05), cases=RUNS, folder=sys.argv[1], resume=len(sys.argv) > 2)
print("done", flush=True)
"""


def killed(folder: Path, times: int, rng) -> list[int]:
    """The job, killed so often at random moments; the step that each checkpoint was at."""
    steps = []
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "JAX_PLATFORMS": "cpu"}
    for i in range(times):
        argv = [sys.executable, "-c", JOB, str(folder), *(["resume"] if (folder / "last.npz").exists() else [])]
        process = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, env=env)
        assert process.stdout.readline() == "ready\n"
        begin = time.monotonic()
        while time.monotonic() - begin < 20 and not (folder / "last.npz").exists():
            time.sleep(0.02)
        time.sleep(float(rng.uniform(0.0, 0.4)) + (0.3 if i else 0.0))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        rows = (folder / "history.jsonl").read_text().splitlines()
        like = checkpoint._read(folder / "last.npz")[0]["head"]["step"]
        assert like <= len(rows) <= like + 1 or process.returncode == 0  # a row is written before its checkpoint
        steps.append(like)
    return steps


def kill_and_compare(folder: Path, times: int) -> None:
    steps = killed(folder, times, np.random.default_rng(1))
    assert steps == sorted(steps) and steps[-1] > 0
    last = fit(valley, SPEC, START, 400, optax.adam(0.05), cases=RUNS, folder=folder, resume=True)
    whole = fit(valley, SPEC, START, 400, optax.adam(0.05), cases=RUNS)
    assert [r["step"] for r in last.history] == list(range(401))
    # another process compiles anew and may differ in the last bit; within one it is equal to the bit (see above)
    assert last.loss == pytest.approx(whole.loss, rel=1e-8)
    np.testing.assert_allclose(last.params.width, whole.params.width, rtol=1e-7)


@pytest.mark.full
def test_kill_at_a_random_moment_loses_at_most_a_step(tmp_path):
    kill_and_compare(tmp_path, 1)


@pytest.mark.slow
def test_kill_20_times(tmp_path):
    kill_and_compare(tmp_path, 20)
