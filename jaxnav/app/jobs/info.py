"""`jaxnav info` and `jaxnav data`."""

import shutil
from pathlib import Path

import jax

from jaxnav import io, reading
from jaxnav.analysis.tables import table
from jaxnav.app.jobs.filtering import describe, describe_text
from jaxnav.app.results import Outcome, git_hash, versions
from jaxnav.filters.adapters import ADAPTERS
from jaxnav.filters.catalogue import FILTERS
from jaxnav.filters.compiler import CACHE, cache_home
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError, DataError, Json


def info(clear: bool = False) -> Outcome:
    """Versions, devices, precision, data sets, filters, scenarios, grades; ``clear``: remove the compiled programs."""
    if clear:
        return Outcome({}, programs(True), {})
    found: Json = {
        "versions": versions(),
        "git": git_hash(),
        "devices": [f"{d.platform}: {d.device_kind}" for d in jax.devices()],
        "x64": bool(jax.config.read("jax_enable_x64")),
        "compilation_cache": None if cache_home() is None else str(cache_home()),
        "filters": {name: entry.citation for name, entry in FILTERS.items()},
        "adapters": {name: row.citation for name, row in ADAPTERS.items()},
        "scenarios": list(SCENARIOS),
        "grades": {name: grade.source for name, grade in GRADES.items()},
        "data_sets": where(),
    }
    lines = ["  ".join(f"{k} {v}" for k, v in found["versions"].items())]
    lines += [f"git {found['git'] or 'none: an installed package'}", f"devices {', '.join(found['devices'])}"]
    lines += [f"float64 {'on' if found['x64'] else 'off'}", programs(), ""]
    lines += [table(["filter", "of"], list(found["filters"].items())), ""]
    lines += [table(["adapter", "of"], list(found["adapters"].items())), ""]
    lines += [
        f"scenarios {', '.join(SCENARIOS)}",
        f"IMU grades {', '.join(GRADES)}",
        "",
        _data_table(found["data_sets"]),
    ]
    return Outcome(found, "\n".join(lines), {})


def programs(clear: bool = False) -> str:
    """Describe the cache of compiled programs, in a sentence; clear it on request."""
    home = cache_home()
    if home is None:
        return f"no compiled programs are kept: {CACHE} is empty"
    folders = [path for path in home.glob("jaxlib-*") if path.is_dir()]  # other files there are not from jaxnav
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    held = f"{len(files)} files, {sum(path.stat().st_size for path in files) / 2**20:.1f} MiB, in {home}"
    for folder in folders if clear else ():
        shutil.rmtree(folder, ignore_errors=True)
    return f"compiled programs{' removed' if clear else ''}: {held}"


def where() -> dict[str, str | None]:
    """Return the folder of each data set, None where it is not here."""
    found: dict[str, str | None] = {}
    for name in reading.DATASETS:
        try:
            found[name] = str(reading.locate(name))
        except DataError:
            found[name] = None
    return found


def _data_table(found: dict[str, str | None]) -> str:
    rows = [
        [
            name,
            f"{sum(f.size for f in reading.DATASETS[name].files) / 1e6:.1f} MB",
            reading.DATASETS[name].licence,
            path or "no",
        ]
        for name, path in found.items()
    ]
    return table(["data set", "size", "licence", "here"], rows)


def data(action: str, name: str | None) -> Outcome:
    """List the data sets, download one, or check one (or a recording at a path): hashes, then every row.

    Raises:
        DataError: absent, changed, or not usable.
    """
    if action != "list" and not name:
        raise ConfigError(f"data {action} needs the name of a data set")
    if action == "list":
        found = where()
        return Outcome({"data_sets": found}, _data_table(found), {})
    assert name is not None
    if action == "fetch":
        folder = reading.fetch(name)
        return Outcome({"folder": str(folder)}, f"{name}: {folder}", {})
    if name not in reading.DATASETS and Path(name).exists():
        about = describe(io.read_recording(name))
        return Outcome(about, f"{describe_text(about)}\nok", {})
    folder = reading.verify(name)
    if reading.DATASETS[name].fixes_only:
        return Outcome({"folder": str(folder)}, f"{name}: {folder}: every hash is right\nok", {})
    about = describe(reading.load(name))
    return Outcome(about | {"folder": str(folder)}, f"{folder}: every hash is right\n{describe_text(about)}\nok", {})
