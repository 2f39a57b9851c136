"""Training finds a known minimum, keeps the best, compiles once, and survives what goes wrong."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tuning.fit import optimizers
from tuning.fit.optimizers import adam
from tuning.fit.status import Status
from tuning.fit.train import fit
from tuning.fit.transforms import LOG, scaled, with_prior


class Two(NamedTuple):
    width: jax.Array
    shift: jax.Array
    frozen: jax.Array


START = Two(jnp.array(5.0), jnp.array(0.3), jnp.array(7.0))
SPEC = {"width": LOG, "shift": scaled(0.1)}


@chex.assert_max_traces(n=1)
def bowl(p, centre):
    return jnp.log(p.width / centre) ** 2 + (p.shift + 0.2) ** 2 * 10


def test_finds_the_minimum_and_one_compilation_serves_other_data():
    optimizer = adam(150, 0.1, 10.0)
    for centre in (2.0, 0.5):
        result = fit(bowl, SPEC, START, 150, optimizer, arguments=(jnp.array(centre),))
        assert float(result.params.width) == pytest.approx(centre, rel=2e-2)
        assert float(result.params.shift) == pytest.approx(-0.2, abs=2e-2)
        assert float(result.params.frozen) == 7.0
        assert result.status is Status.ITERATION_LIMIT and len(result.history) == 151


def test_keeps_the_best_by_validation_and_counts_the_start():
    worse = fit(lambda p: -p.shift, SPEC, START, 5, optax.sgd(1.0), validation=lambda p: p.shift)
    assert float(worse.params.shift) == pytest.approx(0.3)  # descent raised it, validation wanted it low
    assert worse.history[0]["validation"] == pytest.approx(0.3) and worse.history[-1]["validation"] > 0.3


def test_a_gradient_that_is_not_finite_skips_its_step():
    def cliff(p):
        return jnp.where(p.shift > 0.25, p.shift, p.shift / 0.0)

    result = fit(cliff, SPEC, START, 4, adam(4, 1.0, 1e9))
    assert np.isfinite(float(result.params.shift)) and result.loss == pytest.approx(0.3)


def test_start_that_is_not_finite_is_an_error():
    with pytest.raises(ValueError, match="starting parameters"):
        fit(lambda p: p.width / 0.0, SPEC, START, 2)


def test_ctrl_c_returns_the_best_so_far(monkeypatch):
    import tuning.fit.train

    real, calls = tuning.fit.train._step, []

    def step(*args):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(tuning.fit.train, "_step", step)
    result = fit(bowl, SPEC, START, 150, adam(150, 0.1, 10.0), arguments=(jnp.array(2.0),))
    assert result.status is Status.INTERRUPTED and len(result.history) == 3
    assert result.loss == min(row["loss"] for row in result.history)


# ------------------------------------------------------------------------------------------------ runs


def of_run(p, centre):
    return jnp.log(p.width / centre) ** 2 + (p.shift + 0.2) ** 2 * 10


RUNS = jnp.array([1.5, 2.0, 3.0])


def test_a_run_that_fails_is_named_and_changes_no_other():
    bad = jnp.array([1.5, jnp.nan, 2.0, 3.0])
    explain = lambda p, i: f"stopped at t = {i} s, width {float(p.width):.1f}"
    alone = fit(of_run, SPEC, START, 20, optax.adam(0.1), cases=[RUNS])
    found = fit(of_run, SPEC, START, 20, optax.adam(0.1), cases=[bad], names=["a", "b", "c", "d"], explain=explain)
    assert found.loss == alone.loss and found.params == alone.params
    assert found.aside == ({"index": 1, "run": "b", "step": 0, "why": "stopped at t = 1 s, width 5.0"},)
    assert all(row["failed"] == 1 for row in found.history) and alone.aside == ()


def test_a_run_that_fails_later_is_left_out_and_no_better_for_it():
    def edge(p, centre):  # the third run fails where the mean would be least
        return jnp.where((centre > 2.5) & (p.width < 3.5), jnp.nan, of_run(p, centre))

    found = fit(edge, SPEC, START, 40, optax.adam(0.1), cases=[RUNS])
    assert float(found.params.width) >= 3.5 and len(found.aside) == 1 and found.aside[0]["run"] == "run 2"
    assert np.isfinite(found.loss)


def test_runs_of_several_groups_and_their_clip():
    wide = lambda p, case: jnp.log(p.width / case[0]) ** 2 + 0 * case[1]
    both = fit([of_run, wide], SPEC, START, 60, optax.adam(0.1), cases=[RUNS, (jnp.array([8.0]), jnp.zeros(1))])
    assert float(both.params.width) == pytest.approx((1.5 * 2 * 3 * 8) ** 0.25, rel=2e-2)
    steep = lambda p, a: a * p.shift
    row = fit(steep, {"shift": scaled(1.0)}, START, 0, cases=[jnp.array([1e6, 0.5])], clip=1.0).history[0]
    assert row["grad_norm"] == pytest.approx((1.0 + 0.5) / 2)


def test_a_chaotic_run_is_clipped_by_itself():
    """Beside a gradient 10^12 times as large the other runs still say where the minimum is."""
    noisy = lambda p, case: case[0] * (p.shift - 2.0) ** 2 + 0.01 * jax.random.normal(case[1])
    draw = lambda step: [(jnp.array([1e12, 1.0, 2.0]), jax.random.split(jax.random.key(step), 3))]
    found = fit(noisy, {"shift": scaled(1.0)}, START, 100, cases=draw, clip=1.0)
    assert float(found.params.shift) == pytest.approx(2.0, abs=0.05)


def test_validation_now_and_then():
    """Every third step and the last one are judged, and only those can be the best."""
    spec, far = {"shift": scaled(1.0)}, lambda p: jnp.abs(p.shift - 1.9)
    found = fit(lambda p: -p.shift, spec, START, 7, optax.sgd(0.4), validation=far, every=3)
    judged = [row["step"] for row in found.history if "validation" in row]
    assert judged == [0, 3, 6, 7] and len(found.history) == 8
    assert float(found.params.shift) == pytest.approx(0.3 + 3 * 0.4)  # the fourth step is nearer, and was not judged
    with pytest.raises(ValueError, match="every must be 1"):
        fit(far, spec, START, 1, every=0)


def test_new_runs_at_every_step_and_the_same_after_a_stop(tmp_path):
    draw = lambda step: [2.0 + jax.random.normal(jax.random.key(step), (4,), float) ** 2]
    whole = fit(of_run, SPEC, START, 8, optax.adam(0.1), cases=draw)
    fit(of_run, SPEC, START, 3, optax.adam(0.1), cases=draw, folder=tmp_path)
    again = fit(of_run, SPEC, START, 8, optax.adam(0.1), cases=draw, folder=tmp_path, resume=True)
    assert again.history == whole.history
    assert len({row["loss"] for row in whole.history}) == 9


def test_lbfgs_needs_few_steps_and_keeps_out_of_what_fails():
    def rosenbrock(p, shift):
        return (1 - p.shift) ** 2 + 100 * (jnp.log(p.width) - p.shift**2) ** 2 + shift

    spec = {"width": LOG, "shift": scaled(1.0)}
    found = fit(rosenbrock, spec, START, 40, optimizers.lbfgs(40), cases=[jnp.zeros(2)])
    assert found.loss < 1e-8
    fenced = lambda p, s: jnp.where(p.shift > 0.9, jnp.nan, rosenbrock(p, s))
    inside = fit(fenced, spec, START, 40, optimizers.lbfgs(40), cases=[jnp.zeros(2)])
    assert np.isfinite(inside.loss) and inside.loss < 0.05


def test_a_prior_pulls_towards_its_centre():
    spec = {"width": with_prior(LOG, 4.0, 0.5)}
    found = fit(lambda p: 2.0 * jnp.log(p.width) ** 2, spec, START, 100, optax.adam(0.1), prior_weight=1.0)
    # 2 r^2 + (r - log 4)^2 / 0.5 is least at a half of log 4
    assert float(found.params.width) == pytest.approx(2.0, rel=1e-2)


def test_new_cases_are_drawn_once_a_step():
    steps = []

    def draw_state(step):
        steps.append(step)
        return [jnp.array([1.0, 2.0]) + 0.1 * step]

    fit(lambda p, centre: (jnp.log(p.width / centre)) ** 2, SPEC, START, 3, optax.adam(0.1), cases=draw_state)
    assert steps == [0, 1, 2, 3]
