"""Long jobs: their checkpoints, devices and processes, and the fingerprint of a job."""

import hashlib
import json
from pathlib import Path
from typing import NamedTuple

from jaxnav.app.config import Config, as_dict
from jaxnav.app.results import versions


class Long(NamedTuple):
    """How a long job is kept and shared."""

    keep: Path | None = None  # folder of checkpoints
    resume: bool = False
    devices: int = 1  # 0: all


def identity(config: Config) -> str:
    """Return a short name of everything that a checkpoint depends on."""
    tree = as_dict(config)
    tree = {k: v for k, v in tree.items() if k != "out"} | {"versions": versions()}
    return hashlib.sha256(json.dumps(tree, sort_keys=True, default=str).encode()).hexdigest()[:16]
