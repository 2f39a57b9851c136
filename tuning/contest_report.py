"""Report of a bake-off: a table, a figure, and JSON with every error and its summary."""

import textwrap
from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import stats as plots_stats
from jaxnav.analysis.tables import cell, table
from jaxnav.filters.parameters import get
from jaxnav.io.json import write_json
from jaxnav.types import Json
from tuning.contest import REFERENCES, Entrant, Plan, Scores
from tuning.fit.transforms import labels, split
from tuning.recordings.validation import paired_ratio

GROUPS = ("trained", "unseen")
COLUMNS = ("position_m", "velocity_mps", "attitude_deg")


def verdict(found: Mapping[str, Entrant], plan: Plan) -> Json:
    """Rank, geometric mean of the RMS errors and paired ratios for every filter; best on the trained kinds first."""
    K, (train, validation, test) = len(plan.trained), plan.runs
    parts = {"trained": slice(0, K), "unseen": slice(K, None)}
    parts = parts if plan.unseen else {"trained": parts["trained"]}
    filters: dict[str, Json] = {}
    for name, entrant in found.items():
        raw = split(entrant.spec, entrant.params)
        about = {"free": len(labels(entrant.spec, raw)), "note": entrant.note, "seconds": entrant.seconds}
        about["parameters"] = {leaf: np.asarray(get(entrant.params, leaf)).tolist() for leaf in entrant.spec}
        about["aside"] = [{k: entry[k] for k in ("run", "step")} for entry in entrant.aside]
        for group, part in parts.items():
            about[group] = _group(found, entrant, part, [r for r in REFERENCES if r in found], plan.seed)
        filters[name] = about
    for group in parts:
        for i, row in enumerate(sorted((f[group] for f in filters.values()), key=itemgetter("position_m")), start=1):
            row["rank"] = i
    return {
        **{group: [kind.scenario.name for kind in getattr(plan, group)] for group in GROUPS},
        "budget": {"steps": plan.steps, "rate": plan.rate, "gradients_of_a_run": (plan.steps + 1) * train * K,
                   "runs": train, "validation_runs": validation, "test_runs": test, "seed": plan.seed},
        "limit_m": plan.limit_m,
        "filters": dict(sorted(filters.items(), key=lambda item: item[1]["trained"]["rank"])),
    }  # fmt: skip


def _group(found: Mapping[str, Entrant], entrant: Entrant, part: slice, references: list[str], seed: int) -> Json:
    """One filter on the kinds of ``part``."""

    def position(marks: Scores) -> np.ndarray:
        return marks.rms[part, :, 0]

    def mean(a: np.ndarray) -> np.ndarray:
        return np.exp(np.mean(np.log(np.maximum(a, 1e-12)), axis=(0, 1)))

    after = position(entrant.after)
    out: Json = dict(zip(COLUMNS, mean(entrant.after.rms[part]).tolist(), strict=True))
    out["untuned_position_m"] = float(mean(position(entrant.before)))
    out["diverged"] = int((~entrant.after.ok[part]).sum())
    out["untuned_diverged"] = int((~entrant.before.ok[part]).sum())
    out["against"] = {r: paired_ratio(after, position(found[r].after), seed)._asdict() for r in references}
    out["against"]["untuned"] = paired_ratio(after, position(entrant.before), seed)._asdict()
    out["runs_position_m"] = after.tolist()
    out["untuned_runs_position_m"] = position(entrant.before).tolist()
    return out


def text(result: Mapping[str, Any]) -> str:
    """Return the table for the terminal."""
    filters, groups = result["filters"], [g for g in GROUPS if result[g]]
    references = [r for r in next(iter(filters.values()))["trained"]["against"] if r != "untuned"]
    head = ["filter", "free"]
    for group in groups:
        head += ["rank", f"{group}, m", "untuned", *(f"/ {r}" for r in references), "failed"]
    rows = []
    for name, about in filters.items():
        row: list[Any] = [name + ("*" if about["note"] else ""), about["free"]]
        for g in (about[group] for group in groups):
            row += [g["rank"], g["position_m"], g["untuned_position_m"]]
            row += [ratio(g["against"][r]) if r != name else "1" for r in references]
            row.append(g["diverged"])
        rows.append(row)
    b = result["budget"]
    lines = [
        "; ".join(f"{group}: {', '.join(result[group])}" for group in groups),
        f"each filter: {b['steps']} steps, {b['gradients_of_a_run']} gradients of a run; ranked on {b['test_runs']} "
        "other runs of each scenario",
        "geometric mean of the RMS position error; ratios are paired, with 95 % intervals; below 1 is better",
        "",
        table(head, rows),
    ]
    notes = [f"* {name}: {about['note']}" for name, about in filters.items() if about["note"]]
    return "\n".join([*lines, *notes])


def ratio(r: Mapping[str, float]) -> str:
    """Return a ratio with its interval."""
    return f"{cell(r['ratio'])} ({cell(r['low'])}-{cell(r['high'])})"


def write(folder: Path, result: Mapping[str, Any]) -> None:
    """Write bakeoff.json and bakeoff.txt."""
    write_json(folder / "bakeoff.json", result)
    (folder / "bakeoff.txt").write_text(text(result) + "\n", encoding="utf-8")


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Every filter's error over the tuned Kalman filter's, with its interval, on trained and on unseen kinds."""
    filters, groups = result["filters"], [g for g in GROUPS if result[g]]
    names = list(filters)[::-1]
    first = next(iter(filters.values()))["trained"]["against"]
    reference = [r for r in first if r != "untuned"][-1]
    fig = plots.figure(4.2 * len(groups) + 1.6, 1.4 + 0.27 * len(names))
    for i, (ax, group) in enumerate(zip(fig.subplots(1, len(groups), squeeze=False)[0], groups, strict=True)):
        titled = f"{group.capitalize()} scenarios: {', '.join(result[group])}"
        plots.dress(ax, textwrap.fill(titled, 62), f"Position RMS over that of {reference}, tuned")
        rows = [filters[name][group] for name in names]
        unit = filters[reference][group]["position_m"]
        for y, row in enumerate(rows):
            r = row["against"][reference]
            ax.plot([r["low"], r["high"]], [y, y], color=plots.COLORS[0], linewidth=2.5, label="95 % interval")
            ax.plot(r["ratio"], y, "o", color=plots.COLORS[0], markersize=5, label="tuned")
            before = row["untuned_position_m"] / unit
            ax.plot(before, y, "x", color=plots.COLORS[1], markersize=5, label="from the datasheet")
        ax.axvline(1.0, color=plots.BLACK, linewidth=0.9)
        ax.set_yticks(range(len(names)), names if not i else [""] * len(names))
        seen = [line.get_xdata() for line in ax.lines]
        plots_stats._log(ax, "x", np.concatenate(seen).astype(float), 1.5)
    plots.legend(fig)
    plots.save(fig, path)
