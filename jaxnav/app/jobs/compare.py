"""`jaxnav compare`: finished runs again, one alone or several side by side."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.tables import table
from jaxnav.app.results import Outcome, picture
from jaxnav.app.verb import Job
from jaxnav.io.json import plain
from jaxnav.io.sheet import numbers, open_sheet
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Json

LEFT_OUT = ("per_window", "per_run", "low", "high", "correlation", "samples", "p95")  # too many for a table
DRAWN = {"horizontal_m": "distance, m", "height_m": "height difference, m", "heading_deg": "heading, deg"}  # over time


class WrittenRun(NamedTuple):
    """A finished run, read from its folder."""

    name: str
    about: Json  # run.json
    t: np.ndarray  # (E,) s of the solution, empty where there is none
    lla: np.ndarray  # (E, 3) rad, m
    heading: np.ndarray  # (E,) deg


def load(folder: str | Path) -> WrittenRun:
    """Return a run by its folder.

    Raises:
        DataError: it holds no run of jaxnav, or one that cannot be read.
    """
    folder = Path(folder)
    try:
        about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        if not {"verb", "metrics"} <= set(about):
            raise KeyError("verb, metrics")
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DataError(f"{folder}: holds no run of jaxnav that can be read (run.json)") from error
    t, lla, heading = np.empty(0), np.empty((0, 3)), np.empty(0)
    if (folder / "solution.csv").exists():
        sheet = open_sheet(folder / "solution.csv")
        t, heading = numbers(sheet, "t_s"), numbers(sheet, "heading_deg")
        lla = np.column_stack([numbers(sheet, "lat_deg") * DEG, numbers(sheet, "lon_deg") * DEG, numbers(sheet, "h_m")])
    return WrittenRun(folder.name, about, t, lla, heading)


def run(job: Job) -> Outcome:
    """Compare runs; a single one is printed once more."""
    if len(job.args.paths) == 1:
        return show(job.args.paths[0])
    return compare(job.args.paths, job.folder, job.config.out.figures != "none")


def show(folder: str) -> Outcome:
    """Return the text of a finished run, and its configuration and versions."""
    run = load(folder)
    about = run.about
    made = ", ".join(f"{k} {v}" for k, v in about.get("versions", {}).items())
    lines = [about.get("text", ""), "", f"jaxnav {about['verb']}, seed {about.get('seed')}; {made}"]
    lines.append(f"files: {', '.join(about.get('files', []))}")
    return Outcome(about["metrics"], "\n".join(lines), about.get("seconds", {}), about.get("stopped") or "")


def compare(folders: Sequence[str], out: Path, figures: bool = True) -> Outcome:
    """Compare runs: figures that differ, settings that differ, tracks over one another.

    Raises:
        DataError: runs of different verbs.
    """
    runs = [load(folder) for folder in folders]
    verbs = {run.about["verb"] for run in runs}
    if len(verbs) > 1:
        raise DataError(f"compare takes runs of one verb, got {', '.join(sorted(verbs))}")
    names = [run.name if [r.name for r in runs].count(run.name) == 1 else str(f) for run, f in zip(runs, folders)]
    figured = [flat(run.about["metrics"]) for run in runs]
    keys = [key for key in figured[0] if all(key in other for other in figured)]
    rows = [[key, *values, _ratio(values)] for key in keys if len({*(values := [n[key] for n in figured])}) > 1]
    settings = [flat(run.about.get("config", {})) for run in runs]
    every = list(dict.fromkeys(key for tree in settings for key in tree))
    changed = [
        [key, *(str(tree.get(key, "")) for tree in settings)]
        for key in every
        if len({str(tree.get(key)) for tree in settings}) > 1
    ]
    text = []
    if changed:
        text += [table(["setting", *names], changed), ""]
    text.append(table(["figure", *names, "last / first"], rows) if rows else "no figure differs")
    differences = [difference_from(runs[0], other) for other in runs[1:]]
    for name, difference in zip(names[1:], differences, strict=True):
        if difference is not None:
            off = difference["horizontal_m"]
            rms = float(np.sqrt(np.mean(off**2)))
            text.append(f"{name} from {names[0]}: horizontally {rms:.3g} m RMS, at most {off.max():.3g} m")
    if figures and any(difference is not None for difference in differences):
        with picture("the runs together"):
            plots.save(draw(runs, names, differences), out / "compare.png")
    found = {"runs": names, "figures": {row[0]: row[1:-1] for row in rows}, "settings": {r[0]: r[1:] for r in changed}}
    return Outcome(found, "\n".join(text), {})


def flat(tree: Mapping[str, Any], prefix: str = "") -> Json:
    """Numbers, words and short lists of a tree by dotted name."""
    found: Json = {}
    for key, value in plain(tree).items():
        name = f"{prefix}{key}"
        if key in LEFT_OUT:
            continue
        if isinstance(value, Mapping):
            found |= flat(value, f"{name}.")
        elif isinstance(value, list) and len(str(value)) < 40:
            found[name] = str(value)
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            found[name] = float(value)
        elif isinstance(value, (str, bool)) and len(str(value)) < 40:
            found[name] = value
    return found


def _ratio(values: Sequence[Any]) -> float:
    first, last = values[0], values[-1]
    number = isinstance(first, float) and isinstance(last, float) and first != 0
    return last / first if number else math.nan


def difference_from(first: WrittenRun, other: WrittenRun) -> dict[str, np.ndarray] | None:
    """Return the second solution minus the first, at the first's times that both have; None for no common times."""
    if not first.t.size or not other.t.size:
        return None
    both = (first.t >= other.t[0]) & (first.t <= other.t[-1])
    if not both.any():
        return None
    t, origin = first.t[both], first.lla[0]
    at = lambda a: np.column_stack([np.interp(t, other.t, column) for column in a.T])
    a, b = earth.enu_path(first.lla[both], origin), at(earth.enu_path(other.lla, origin))
    heading = np.interp(t, other.t, np.unwrap(other.heading, period=360.0)) - first.heading[both]
    off = b - a
    return {
        "t": t,
        "horizontal_m": np.hypot(off[:, 0], off[:, 1]),
        "height_m": off[:, 2],
        "heading_deg": (heading + 180.0) % 360.0 - 180.0,
    }


def draw(runs: Sequence[WrittenRun], names: Sequence[str], differences: Sequence[dict[str, np.ndarray] | None]) -> Any:
    """Draw the tracks over one another, and the distance of each from the first."""
    fig = plots.figure(9.5, 9.5)
    parts: Any = fig.subfigures(2, 1, height_ratios=[1.2, 1.0])
    top, bottom = parts
    ax = top.subplots()
    plots.dress(ax, "Tracks, m east and north of the first one's start")
    origin = next(run for run in runs if run.t.size).lla[0]
    for i, (run, name) in enumerate(zip(runs, names, strict=True)):
        if run.t.size:
            where = earth.enu_path(run.lla, origin)
            ax.plot(where[:, 0], where[:, 1], color=plots.COLORS[i % 7], lw=1.3, ls="-" if i == 0 else "--", label=name)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(fontsize=8)
    for ax, key in zip(plots.panels(bottom, len(DRAWN), 1, "t (s)"), DRAWN, strict=True):
        ax.set_ylabel(DRAWN[key], fontsize=8)
        for i, difference in enumerate(differences):
            if difference is not None:
                ax.plot(difference["t"], difference[key], color=plots.COLORS[(i + 1) % 7], lw=1, label=names[i + 1])
    return fig
