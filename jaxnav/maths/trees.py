"""Trees of arrays by name."""

import hashlib
import json

import jax
import numpy as np

from jaxnav.types import Tree


def named(tree: Tree) -> dict[str, np.ndarray]:
    """Return the arrays of a tree by their dotted names: ``hidden.weights``."""
    rows = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in rows}


def structure(tree: Tree) -> str:
    """Return a digest of the names and shapes of a tree, 16 hexadecimal digits."""
    shapes = sorted((name, list(a.shape)) for name, a in named(tree).items())
    return hashlib.sha256(json.dumps(shapes).encode()).hexdigest()[:16]
