"""What the benchmarks share: options, output, and the environment that a figure was made in."""

import argparse
import json
import platform
from pathlib import Path

import jax
import numpy as np

from jaxnav.io import atomic_write


def options(name: str, description: str, seed: int = 0) -> argparse.ArgumentParser:
    """The options that every benchmark has."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks {name}", description=description)
    parser.add_argument("--quick", action="store_true", help="a short form of the study")
    parser.add_argument("--seed", type=int, default=seed, help=f"default {seed}")
    parser.add_argument("--json", type=Path, metavar="F", help="write every figure, and what it came from, to F")
    return parser


def environment() -> dict:
    """Versions and device, for the JSON."""
    return {
        "python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
    }  # fmt: skip


def write_json(path: Path | None, result: dict) -> None:
    """Write the result with the environment beside it; nothing without a path."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(result | {"environment": environment()}, indent=1, default=plain) + "\n"
        atomic_write(path, text)
        print(f"wrote {path}")


def plain(value):
    """Arrays and numpy numbers for json."""
    return np.asarray(value).tolist()
