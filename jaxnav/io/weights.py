"""Weights of an adapter in a file: an .npz with an array for each dotted name, and what they are for."""

import io
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.io.files import FilePath, atomic_write, read_bytes
from jaxnav.maths.trees import named, structure
from jaxnav.types import DataError

WEIGHTS = ".npz"  # of such a file
ABOUT = "about"


def write_weights(path: FilePath, tree: Any, adapter: str = "") -> None:
    """Write the weights of an adapter, `Params.adapter`.

    Args:
        path: the file, ``.npz``.
        tree: any tree of arrays.
        adapter: its name in `jaxnav.ADAPTERS`; "" where it is another one, which the reader has to know.
    """
    out, about = io.BytesIO(), {"adapter": adapter, "structure": structure(tree)}
    np.savez(out, allow_pickle=False, **{ABOUT: np.frombuffer(json.dumps(about).encode(), np.uint8)}, **named(tree))
    atomic_write(path, out.getvalue())


def adapter_of(path: FilePath) -> str:
    """Return the name of the adapter that weights are for.

    Raises:
        DataError: no file of weights.
    """
    return str(_opened(path)[0]["adapter"])


def read_weights(path: FilePath, like: Any) -> Any:
    """Return the weights of a file.

    Args:
        path: the file, of `write_weights`.
        like: a tree of the same names and shapes, such as ``filt.params("consumer").adapter``.

    Raises:
        DataError: no file of weights, or one for another adapter: names the first array that does not fit.
    """
    about, arrays = _opened(path)
    expected = named(like)
    if about["structure"] != structure(like):
        for name in dict.fromkeys([*expected, *arrays]):
            found, wanted = (rows[name].shape if name in rows else "none" for rows in (arrays, expected))
            if found != wanted:
                raise DataError(
                    f"{path}: weights of {about['adapter'] or 'an adapter'} do not fit the filter's: {name} is "
                    f"{found}, expected {wanted}: another adapter, or other measurements of the filter"
                )
    leaves = [jnp.asarray(arrays[name], float) for name in expected]
    for name, leaf in zip(expected, leaves):
        if not bool(jnp.isfinite(leaf).all()):
            raise DataError(f"{path}: {name}: not finite")
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _opened(path: FilePath) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Return what a file of weights is for, and its arrays."""
    data = read_bytes(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            about = json.loads(bytes(found[ABOUT]))
            arrays = {name: found[name] for name in found.files if name != ABOUT}
        if set(about) != {"adapter", "structure"} or about["structure"] != structure(arrays):
            raise ValueError("its digest is that of other arrays")
        return about, arrays
    except Exception as error:  # any error of a damaged archive
        raise DataError(f"{path}: is no file of weights: {error}") from error
