"""Long jobs: their checkpoints, devices and processes, and the fingerprint of a job."""

import hashlib
import importlib.util
import json
from pathlib import Path
from typing import NamedTuple

from jaxnav.app.config import Config, as_dict
from jaxnav.app.results import versions


def _stamps(path: Path) -> list[tuple[str, int, int]]:
    """Return name, size and time of change of a file, or of all below a folder."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    return [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]


def _code(objective: str) -> str:
    """Return a digest of the module of a user's objective, empty where it is not found: importing it says so."""
    try:
        found = importlib.util.find_spec(objective.partition(":")[0])
    except (ImportError, ValueError):
        found = None
    return "" if found is None or not found.origin else hashlib.sha256(Path(found.origin).read_bytes()).hexdigest()


class Long(NamedTuple):
    """How a long job is kept and shared."""

    keep: Path | None = None  # folder of checkpoints
    resume: bool = False
    devices: int = 1  # 0: all


def identity(config: Config) -> str:
    """Return a short name of everything that a checkpoint depends on: settings, versions, recordings, objectives."""
    tree = as_dict(config)
    tree = {k: v for k, v in tree.items() if k != "out"} | {"versions": versions()}
    named = [config.data.source, *config.tune.more, config.filter.adapter]
    tree["files"] = [_stamps(Path(name)) for name in named if name and Path(name).exists()]
    tree["code"] = [_code(name) for name in config.tune.objective if ":" in name]
    return hashlib.sha256(json.dumps(tree, sort_keys=True, default=str).encode()).hexdigest()[:16]
