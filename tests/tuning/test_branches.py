"""Branches of any kind that are fitted as they are: modules of equinox, parameters of flax, with named leaves."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxnav.filters.parameters import get, put
from tuning.fit.status import Status
from tuning.fit.train import fit
from tuning.fit.transforms import LOG, TREE, bound, join, labels, split, tied

X = np.linspace(-1.0, 1.0, 64)[:, None]
Y = np.sin(3.0 * X[:, 0])


class Model(NamedTuple):
    """A network and a gain."""

    net: Any
    gain: Any


def plain(key: Any) -> dict[str, Any]:
    """A network as a dict of arrays, as flax has its parameters."""
    keys = jax.random.split(key, 2)
    return {"a": {"w": jax.random.normal(keys[0], (1, 8)), "b": jnp.zeros(8)}, "c": jax.random.normal(keys[1], (8,))}


def loss_plain(model: Model) -> jax.Array:
    hidden = jnp.tanh(X @ model.net["a"]["w"] + model.net["a"]["b"])
    return jnp.mean((model.gain * (hidden @ model.net["c"]) - Y) ** 2)


def test_a_dict_of_arrays_beside_a_gain(tmp_path):
    """As plain optax: the same steps on the same numbers, the gain in its logarithm."""
    model = Model(plain(jax.random.key(0)), jnp.asarray(1.0))
    found = fit(loss_plain, {"net": TREE, "gain": LOG}, model, 5, optax.adam(0.01), folder=tmp_path)
    raw, optimizer = {"net": model.net, "gain": jnp.zeros(())}, optax.adam(0.01)
    state = optimizer.init(raw)
    for _ in range(5):
        grad = jax.grad(lambda r: loss_plain(Model(r["net"], jnp.exp(r["gain"]))))(raw)
        updates, state = optimizer.update(grad, state, raw)
        raw = optax.apply_updates(raw, updates)
    chex.assert_trees_all_close(found.params.net, raw["net"], rtol=1e-6)
    assert found.loss == pytest.approx(float(loss_plain(Model(raw["net"], jnp.exp(raw["gain"])))))
    assert isinstance(found.history[0]["params"]["net"], float)  # its norm
    again = fit(loss_plain, {"net": TREE, "gain": LOG}, model, 9, optax.adam(0.01), folder=tmp_path, resume=True)
    whole = fit(loss_plain, {"net": TREE, "gain": LOG}, model, 9, optax.adam(0.01))
    chex.assert_trees_all_equal(again.params, whole.params)


def test_groups_have_optimisers_of_their_own():
    model = Model(plain(jax.random.key(0)), jnp.asarray(1.0))
    groups = optax.multi_transform({"moves": optax.sgd(0.1), "stays": optax.set_to_zero()},
                                   {"net": "moves", "gain": "stays"})  # fmt: skip
    found = fit(loss_plain, {"net": TREE, "gain": LOG}, model, 3, groups)
    assert float(found.params.gain) == 1.0 and not np.allclose(found.params.net["c"], model.net["c"])


def test_a_module_of_equinox_with_its_functions():
    equinox = pytest.importorskip("equinox")
    net = equinox.nn.MLP(1, "scalar", 16, 1, activation=jnp.tanh, key=jax.random.key(1))

    def loss(theta: dict[str, Any]) -> jax.Array:
        return jnp.mean((theta["scale"] * jax.vmap(theta["net"])(jnp.asarray(X)) - Y) ** 2)

    theta = {"net": net, "scale": jnp.asarray(0.5)}
    found = fit(loss, {"net": TREE, "scale": LOG}, theta, 200, optax.adam(0.03))
    assert found.loss < 0.1 * float(loss(theta))
    assert found.params["net"].activation is net.activation and isinstance(found.params["net"], equinox.nn.MLP)
    assert float(loss(found.params)) == pytest.approx(found.loss, rel=1e-6)


def test_parameters_of_flax():
    nn = pytest.importorskip("flax.linen")
    net = nn.Dense(3)
    theta = {"net": net.init(jax.random.key(0), X), "sd": jnp.asarray(2.0)}
    loss = lambda theta: jnp.mean((net.apply(theta["net"], X).sum(1) - Y) ** 2) / theta["sd"] + jnp.log(theta["sd"])
    assert fit(loss, {"net": TREE, "sd": LOG}, theta, 50, optax.adam(0.05)).loss < loss(theta)


def test_one_program_for_all_steps_and_data():
    model, traced = Model(plain(jax.random.key(0)), jnp.asarray(1.0)), []

    def loss(model: Model, y: jax.Array) -> jax.Array:
        traced.append(1)
        return loss_plain(model) + 0.0 * y.sum()

    optimizer = optax.adam(0.01)
    fit(loss, {"net": TREE}, model, 2, optimizer, (jnp.asarray(Y),))
    before = len(traced)
    fit(loss, {"net": TREE}, Model(plain(jax.random.key(3)), jnp.asarray(2.0)), 4, optimizer, (jnp.asarray(Y) + 1.0,))
    assert len(traced) == before


def test_new_batches_and_an_end_where_the_validation_is_no_better():
    model = Model(plain(jax.random.key(0)), jnp.asarray(1.0))
    one = lambda model, case: (
        (model.gain * (jnp.tanh(case[0] * model.net["a"]["w"][0]) @ model.net["c"]) - case[1]) ** 2
    )
    rows = lambda seed: np.random.default_rng(seed).integers(0, 64, 8)
    batch = lambda step: [(jnp.asarray(X[rows(step), 0]), jnp.asarray(Y[rows(step)]))]
    held = [(jnp.asarray(X[:16, 0]), jnp.asarray(Y[:16]))]
    found = fit(one, {"net": TREE}, model, 400, optax.sgd(3.0), validation=one, cases=batch, validation_cases=held,
                patience=5)  # fmt: skip
    assert found.status is Status.STOPPED_EARLY and len(found.history) < 400
    best = min(range(len(found.history)), key=lambda k: found.history[k]["validation"])
    assert len(found.history) - 1 - best == 5 and found.loss == found.history[best]["validation"]


def test_refusals_and_names():
    with pytest.raises(ValueError, match="net: arrays of int64 cannot be fitted"):
        bound({"net": TREE}, Model({"w": jnp.ones(2), "n": jnp.arange(3)}, 1.0))
    with pytest.raises(ValueError, match="net: a branch without a floating-point array"):
        bound({"net": TREE}, Model({"n": 3}, 1.0))
    with pytest.raises(ValueError, match="net = .* cannot start there"):
        split({"net": TREE}, Model({"w": jnp.array([1.0, np.nan])}, 1.0))
    with pytest.raises(ValueError, match="a branch has no axes to tie"):
        tied(TREE)
    model = Model({"w": jnp.ones(2), "f": jnp.tanh, "k": 3}, jnp.asarray(2.0))
    raw = split({"net": TREE}, model)
    assert labels({"net": TREE}, raw) == ["net['w'][0]", "net['w'][1]"]
    spec, arrays = bound({"net": TREE}, model)
    back = join(spec, raw, arrays)
    assert back.net["f"] is jnp.tanh and back.net["k"] == 3 and back.gain is model.gain


def test_dotted_names_reach_into_dataclasses():
    @dataclass(frozen=True)
    class Layer:
        w: Any
        size: int = 3

        def __post_init__(self) -> None:
            assert self.size == 3

    tree = {"layer": Layer(jnp.ones(2))}
    changed = put(tree, "layer.w", jnp.zeros(2))
    assert float(get(changed, "layer.w").sum()) == 0.0 and float(tree["layer"].w.sum()) == 2.0
    assert changed["layer"].size == 3
