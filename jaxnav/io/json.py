"""Strict JSON: arrays as lists, nan as null, infinities as text; files that are whole or not there."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.io.files import atomic_write


def write_json(path: Path, tree: Any) -> None:
    """Write strict JSON."""
    atomic_write(path, to_json(tree, indent=1) + "\n")


def to_json(tree: Any, indent: int | None = None) -> str:
    """Strict JSON as text."""
    return json.dumps(plain(tree), indent=indent, allow_nan=False)


def plain(tree: Any) -> Any:
    """Return a tree of JSON types."""
    if isinstance(tree, Mapping):
        return {str(k): plain(v) for k, v in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [plain(v) for v in tree]
    if hasattr(tree, "tolist"):
        return plain(np.asarray(tree).tolist())
    if isinstance(tree, float) and not math.isfinite(tree):
        return None if math.isnan(tree) else ("inf" if tree > 0 else "-inf")
    return tree
