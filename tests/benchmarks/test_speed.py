"""The speed benchmark's forms do the same work, and its arithmetic is right; nothing here is timed."""

import json
import os
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed import parallel, speed_child, speed_floor, speed_gate, speed_peers, speed_plain, speed_tables
from benchmarks.speed.speed_work import PARAMS, SIDE, distance, exponent, forward, over_runs, table, turn
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import make_filter
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import reset
from jaxnav.filters.rules.kalman import kalman
from jaxnav.maths import earth
from jaxnav.states.table import BIASES
from jaxnav.strapdown.frames import FRAMES
from tests import reference
from tuning.fit.objectives import innovation_nll


@pytest.fixture(scope="module")
def given(case):
    """Noise, start and epochs of one run."""
    return speed_plain.noise_of(PARAMS()), case.nav, case.packed.epochs


@pytest.fixture(scope="module")
def ours(given):
    """Without the second-order noise of large attitude errors, which nobody else has."""
    frame, found = FRAMES["local_level"], {}
    for n, states in ((9, ()), (15, BIASES)):
        model = error_model(states=states)._replace(second_order=None)
        filt = make_filter(frame.fast, model, kalman(), reset)
        found[n] = jax.jit(forward(filt._replace(params=build(f"ekf{n}").params)))(*given)
    return found


@pytest.mark.full
@pytest.mark.parametrize("n", [9, 15])
def test_the_floor_goes_where_we_go(given, ours, n):
    noise, nav, epochs = given
    eight = jax.tree.map(lambda a: jnp.broadcast_to(a, (8, *a.shape)), (nav, epochs))
    away = jnp.arange(8.0)[:, None] * jnp.array([1.0, -2.0, 0.5])  # every lane starts elsewhere, the first at nav
    eight = eight[0]._replace(pos=jax.vmap(earth.move)(eight[0].pos, away)), eight[1]
    one, lanes = (speed_floor.floor(n, wide, PARAMS(), *eight) for wide in (1, 8))
    if one is None or lanes is None:
        pytest.skip("no C++ compiler")
    found = one()
    assert distance(found[0, :, :3], ours[n].nav.pos) < 1e-3
    assert distance(found[1, :1, :3], found[0, :1, :3]) > 0.1
    np.testing.assert_allclose(lanes(), found, rtol=0, atol=1e-10)


def test_no_compiler_is_told_and_leaves_the_floor_out(given, monkeypatch, capsys):
    monkeypatch.setattr(speed_floor.shutil, "which", lambda name: None)
    assert speed_floor.library.__wrapped__(1) is None
    assert "no C++ compiler" in capsys.readouterr().out


@pytest.mark.full
@pytest.mark.parametrize("n", [9, 15])
def test_plain_forms_go_where_we_go_with_our_likelihood(given, ours, n):
    nested = jax.jit(speed_plain.nested(n, PARAMS()))(*given)
    assert distance(nested.lla, ours[n].nav.pos) < 2e-4
    own = innovation_nll(ours[n], jnp.ones(nested.nu.shape[0], bool))
    assert float(speed_plain.nll(nested)) == pytest.approx(float(own), rel=1e-5)
    loop = speed_peers.numpy_loop(n, PARAMS(), *given[1:])()
    assert distance(loop, nested.lla) < 1e-6
    if n == 9:
        naive = jax.jit(speed_plain.naive(n, PARAMS()))(*given)
        k = given[2].imu.dt.shape[1]
        assert distance(naive[k - 1 :: k], nested.lla) < 1e-9


def test_plain_dynamics_are_the_derivatives_of_the_equations():
    lla, v, f = np.array([0.8, 0.2, 300.0]), np.array([20.0, -30.0, 2.0]), np.array([1.0, -2.0, 9.6])
    C = reference.rotation(np.array([0.3, -0.2, 2.0]))
    full = reference.full_dynamics(lla, v, C, f, 15)
    F = speed_peers.error_dynamics(lla, v, C, f, 15)
    assert abs(full[5, 1] - F[5, 1]) < 1e-8  # how gravity changes to the north is left out
    full[5, 1] = F[5, 1]
    np.testing.assert_allclose(F, full, rtol=5e-3, atol=1e-14)  # and how the radii do


def test_exponent_of_exact_powers():
    size = np.array([60.0, 600.0, 3600.0])
    assert exponent(size, 3e-4 * size) == pytest.approx(1.0, abs=1e-12)
    assert exponent(size, 7.0 * size**1.37) == pytest.approx(1.37, abs=1e-12)


def test_rows_are_per_sample_and_relative():
    rows = table({"a": [2.0], "b": [6.0]}, {"a": 1000, "b": 2000}, "a")
    assert rows["b"] == {"us_per_step": 3000.0, "ratio_to": "a", "ratio": 1.5}
    assert rows["a"]["ratio"] == 1.0


def test_a_ratio_is_of_the_same_round():
    """A machine that runs two of five rounds at half its speed, and one call once beside something else."""
    slow = np.array([1.0, 2.0, 1.0, 2.0, 1.0])
    a, b = 3 * slow, 6 * slow * [1, 1, 1, 1, 5]
    assert table({"a": list(a), "b": list(b)}, 1000, "a")["b"]["ratio"] == 2.0
    assert np.median(b) / np.median(a) > 2.0


def empty() -> dict:
    return {name: {} for name in (*speed_gate.TABLES, "accuracy")} | {"versions": {}}


def test_gate_fails_where_a_ratio_of_ours_is_worse(tmp_path, capsys):
    path, result = tmp_path / "baseline.json", empty()
    row = lambda ratio: {"us_per_step": 1.0, "ratio_to": "nested scan, 9 states", "ratio": ratio}
    result["single"] = {"stride 1, 9 states": row(0.4), "floor, 9 states": row(0.05)}
    assert speed_gate.gate(result, "quick", path) == 1  # no baseline yet
    speed_gate.keep(result, "quick", path)
    assert "floor, 9 states" not in json.loads(path.read_text())["quick"]["single"]
    result["single"] = {"stride 1, 9 states": row(0.59), "floor, 9 states": row(5.0)}
    assert speed_gate.gate(result, "quick", path) == 0
    result["single"]["stride 1, 9 states"] = row(0.61)
    assert speed_gate.gate(result, "quick", path) == 1
    assert speed_gate.gate(empty(), "quick", path) == 1
    assert "was not measured" in capsys.readouterr().err


def test_bars_leave_out_what_was_not_measured():
    result = empty()
    result["single"] = {
        name: {"ratio": ratio} | beside
        for name, ratio, beside in (
            ("floor, 9 states", 0.2, {}),
            ("stride 1, 9 states", 1.0, {"by_floor": 5.5}),
        )
    }
    (row,) = speed_gate.bars(result)
    assert row["value"] == 5.5 and row["met"]


def test_a_floor_is_compared_with_our_rows_turn_by_turn():
    """Where the machine's speed halves for a turn, and for the two of them alike, the ratio stays."""
    taken = {"floor, 9 states": [1.0, 2.0, 1.0], "stride 1, 9 states": [5.0, 10.0, 5.5], "nested": [9.0, 9.0, 9.0]}
    rows = {name: {} for name in taken}
    speed_tables.beside_floor(rows, taken, "floor, 9 states")
    assert rows == {"floor, 9 states": {}, "stride 1, 9 states": {"by_floor": 5.0}, "nested": {}}


def test_more_runs_than_go_side_by_side_give_the_same():
    """A number of runs that `TURNS` does not divide."""
    runs = SIDE + 3
    a, b = np.arange(runs, dtype=float), np.arange(2.0 * runs).reshape(runs, 2)
    found = over_runs(lambda noise, a, b: noise * a + b.sum(), runs)(2.0, a, b)
    np.testing.assert_array_equal(found, 2 * a + b.sum(1))


def test_a_turn_pays_for_what_its_call_leaves_behind():
    """Work of 50 ms that goes on in the background after each call has returned, and not that of a call before.

    Of five tries the best: on a busy machine a thread may get no time for so long that the process seems to rest.
    """

    def work(seconds):
        start = time.thread_time()
        while time.thread_time() - start < seconds:
            pass

    def after_another():
        leave = threading.Thread(target=work, args=(0.2,))
        leave.start()
        spent = turn(lambda: work(0.005))
        leave.join()
        return spent

    assert min(after_another() for _ in range(5)) == pytest.approx(0.005, abs=0.004)
    assert max(turn(lambda: threading.Thread(target=work, args=(0.05,)).start()) for _ in range(5)) > 0.045


def test_a_benchmark_starts_itself_anew_but_once():
    """In the environment that it sets it knows itself, whatever `python -m benchmarks` adds to XLA's flags."""
    code = "from jaxnav import fast_compiler; from benchmarks.speed import speed_child as c; fast_compiler(); "
    for environment, known in ((speed_child.pinned(), True), (dict(os.environ), False)):
        environment = {k: v for k, v in environment.items() if known or k != speed_child.CPUS}
        done = subprocess.run([sys.executable, "-c", code + "raise SystemExit(not c.is_pinned())"], env=environment)
        assert (done.returncode == 0) == known


def test_more_states_have_a_bar_and_fifteen_have_none():
    result = empty()
    result["states"] = {
        "stride 10, 15 states, 256 runs": {"ratio": 1.0},
        "stride 10, 24 states, 256 runs": {"ratio": 2.6},
    }
    (row,) = speed_gate.bars(result)
    assert row["value"] == 2.6 and not row["met"]


def test_covariances_parallel_in_time_are_the_sequential_ones():
    """Nine states, a fix of two channels in every third epoch."""
    rng = np.random.default_rng(0)
    E, n, m = 40, 9, 2
    Phi = np.eye(n) + 0.1 * rng.normal(size=(E, n, n))
    root = 0.1 * rng.normal(size=(E, n, n))
    H = rng.normal(size=(E, m, n)) * (np.arange(E) % 3 == 0)[:, None, None]
    steps = parallel.Chain(*map(jnp.asarray, (Phi, root @ root.transpose(0, 2, 1), H, np.tile(np.eye(m), (E, 1, 1)))))
    one, other = parallel.sequential(jnp.eye(n), steps), parallel.parallel(jnp.eye(n), steps)
    np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-9 * np.abs(one).max())
