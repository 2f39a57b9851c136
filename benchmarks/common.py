"""Shared parts of the benchmarks: options, output, and the environment of a figure."""

import argparse
import json
import platform
from pathlib import Path

import jax
import numpy as np

from jaxnav.io import atomic_write


def options(name: str, description: str) -> argparse.ArgumentParser:
    """The option that every benchmark has; those that draw random numbers or have a short form add theirs."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks {name}", description=description)
    parser.add_argument("--json", type=Path, metavar="F", help="write every figure, and its environment, to F")
    return parser


def environment() -> dict:
    """Versions and device, for the JSON."""
    return {
        "python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
    }  # fmt: skip


def write_json(path: Path | None, result: dict) -> None:
    """Write the result with its environment; nothing without a path."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps(result | {"environment": environment()}, indent=1, default=plain) + "\n"
        atomic_write(path, text)
        print(f"wrote {path}")


def plain(value):
    """Arrays and numpy numbers for json."""
    return np.asarray(value).tolist()
