"""Few numbers are differentiated forwards, many backwards: with the same result, whichever way an objective allows."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from tuning.fit import batch
from tuning.fit.train import fit
from tuning.fit.transforms import LOG

START = {name: jnp.asarray(1.0 + 0.3 * i) for i, name in enumerate("abcde")}
CASES = [jnp.linspace(0.5, 2.0, 3)]


def loss(p, case):
    far = [(jnp.log(p[name]) - 0.1 * i * case) ** 2 for i, name in enumerate("abcde")]
    return sum(f * (1 + jnp.sin(case * p[name])) for f, name in zip(far, "abcde", strict=True))


def history(names, monkeypatch, forwards):
    monkeypatch.setattr(batch, "FORWARDS", forwards)
    jax.clear_caches()
    found = fit(loss, {name: LOG for name in names}, START, 6, optax.adam(0.1), cases=CASES)
    return [(row["loss"], row["grad_norm"]) for row in found.history]


def test_both_ways_are_one(monkeypatch):
    for names in ("a", "abc"):
        np.testing.assert_allclose(history(names, monkeypatch, 4), history(names, monkeypatch, 0), rtol=1e-10)


def test_few_numbers_go_forwards_and_many_do_not(monkeypatch):
    ways = []
    real_jvp, real_grad = jax.jvp, jax.value_and_grad
    monkeypatch.setattr(batch.jax, "jvp", lambda *a, **k: ways.append("forwards") or real_jvp(*a, **k))
    monkeypatch.setattr(batch.jax, "value_and_grad", lambda f, **k: ways.append("backwards") or real_grad(f, **k))
    for count, way in ((2, "forwards"), (5, "backwards")):
        ways.clear()
        fit(loss, {name: LOG for name in "abcde"[:count]}, START, 1, optax.adam(0.1), cases=CASES)
        assert ("forwards" in ways) == (way == "forwards")


def test_an_objective_that_only_goes_backwards_does():
    @jax.custom_vjp
    def square(x):
        return x**2

    square.defvjp(lambda x: (x**2, x), lambda x, g: (2 * x * g,))
    found = fit(lambda p: square(jnp.log(p["a"])), {"a": LOG}, {"a": jnp.asarray(2.0)}, 60, optax.adam(0.1))
    assert float(found.params["a"]) == np.float64(found.params["a"]) and abs(float(found.params["a"]) - 1) < 0.1
