"""Training finds a known minimum, keeps the best, compiles once, and survives what goes wrong."""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tuning.train import default_optimizer, fit
from tuning.transforms import LOG, scaled


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
    optimizer = default_optimizer(150, 0.1, 10.0)
    for centre in (2.0, 0.5):
        result = fit(bowl, SPEC, START, 150, optimizer, arguments=(jnp.array(centre),))
        assert float(result.params.width) == pytest.approx(centre, rel=2e-2)
        assert float(result.params.shift) == pytest.approx(-0.2, abs=2e-2)
        assert float(result.params.frozen) == 7.0
        assert result.stopped == "done" and len(result.history) == 151


def test_keeps_the_best_by_validation_and_counts_the_start():
    worse = fit(lambda p: -p.shift, SPEC, START, 5, optax.sgd(1.0), validation=lambda p: p.shift)
    assert float(worse.params.shift) == pytest.approx(0.3)  # descent raised it, validation wanted it low
    assert worse.history[0]["validation"] == pytest.approx(0.3) and worse.history[-1]["validation"] > 0.3


def test_a_gradient_that_is_not_finite_skips_its_step():
    def cliff(p):
        return jnp.where(p.shift > 0.25, p.shift, p.shift / 0.0)

    result = fit(cliff, SPEC, START, 4, default_optimizer(4, 1.0, 1e9))
    assert np.isfinite(float(result.params.shift)) and result.loss == pytest.approx(0.3)


def test_start_that_is_not_finite_is_an_error():
    with pytest.raises(ValueError, match="starting parameters"):
        fit(lambda p: p.width / 0.0, SPEC, START, 2)


def test_ctrl_c_returns_the_best_so_far(monkeypatch):
    import tuning.train

    real, calls = tuning.train._step, []

    def step(*args):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(tuning.train, "_step", step)
    result = fit(bowl, SPEC, START, 150, default_optimizer(150, 0.1, 10.0), arguments=(jnp.array(2.0),))
    assert result.stopped == "interrupted at step 3" and len(result.history) == 3
    assert result.loss == min(row["loss"] for row in result.history)
