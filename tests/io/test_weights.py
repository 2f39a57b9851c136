"""Weights of an adapter: written, read, and refused where they do not fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import build
from jaxnav.io.weights import adapter_of, read_weights, write_weights
from jaxnav.maths.trees import structure
from jaxnav.types import DataError
from tests.filters.test_adapters import moved
from tuning import load

TREE = {"b": {"weights": jnp.arange(6.0).reshape(2, 3)}, "a": [jnp.zeros(3), jnp.ones(())]}


def test_they_come_back_as_they_were(tmp_path):
    write_weights(tmp_path / "net.npz", TREE, "mlp_noise")
    found = read_weights(tmp_path / "net.npz", jax.tree.map(jnp.zeros_like, TREE))
    assert jax.tree.structure(found) == jax.tree.structure(TREE)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(TREE), strict=True):
        np.testing.assert_array_equal(a, b)
    assert adapter_of(tmp_path / "net.npz") == "mlp_noise"
    with np.load(tmp_path / "net.npz") as arrays:  # by name, for other software
        np.testing.assert_array_equal(arrays["b.weights"], TREE["b"]["weights"])


@pytest.mark.parametrize(
    ("like", "words"),
    [
        (TREE | {"c": jnp.zeros(2)}, r"c is none, expected \(2,\)"),
        (TREE | {"a": [jnp.zeros(4), jnp.ones(())]}, r"a.0 is \(3,\), expected \(4,\)"),
        ({"b": TREE["b"]}, r"a.0 is \(3,\), expected none"),
    ],
)
def test_those_of_another_network_are_refused(tmp_path, like, words):
    write_weights(tmp_path / "net.npz", TREE, "mlp_noise")
    with pytest.raises(DataError, match=f"net.npz: weights of mlp_noise do not fit.*{words}"):
        read_weights(tmp_path / "net.npz", like)
    assert structure(like) != structure(TREE)


def test_damaged_files_and_weights_that_are_not_finite_are_refused(tmp_path):
    file = tmp_path / "net.npz"
    write_weights(file, jax.tree.map(lambda a: a * np.nan, TREE))
    with pytest.raises(DataError, match=r"a.0: not finite|b.weights: not finite"):
        read_weights(file, TREE)
    write_weights(file, TREE)
    whole = file.read_bytes()
    for data in (b"", b"text", whole[:-40], whole[: len(whole) // 2]):
        file.write_bytes(data)
        with pytest.raises(DataError, match=r"net.npz"):
            read_weights(file, TREE)
    write_weights(file, TREE)
    with np.load(file) as found:
        changed = dict(found) | {"b.weights": np.zeros((2, 2))}
    np.savez(file, **changed)
    with pytest.raises(DataError, match="its digest is that of other arrays"):
        read_weights(file, TREE)
    np.savez(file, a=np.zeros(2))
    with pytest.raises(DataError, match="no file of weights"):
        read_weights(file, TREE)


def test_a_tuned_toml_brings_its_weights(tmp_path):
    params = build("ekf15", adapter="mlp_noise").params("consumer")
    weights = moved(params.adapter)
    write_weights(tmp_path / "tuned.npz", weights, "mlp_noise")
    text = '[filter]\nadapter = "tuned.npz"\n[noise]\ngyro_deg_per_sqrt_hour = 0.5\n'
    (tmp_path / "tuned.toml").write_text(text)
    found = load(tmp_path / "tuned.toml", params)
    np.testing.assert_array_equal(found.adapter["out"]["biases"], weights["out"]["biases"])
    assert float(found.noise.gyro) == pytest.approx(np.deg2rad(0.5) / 60)
