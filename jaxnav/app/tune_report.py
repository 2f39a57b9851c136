"""What a tuning job prints and writes: tables before and after, parameters, history, figures."""

import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxnav.analysis import evaluate
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import stats as plots_stats
from jaxnav.analysis.tables import cell, table
from jaxnav.app.batches import Material
from jaxnav.app.config import Config
from jaxnav.app.scores import JobScores
from jaxnav.data import atomic_write
from jaxnav.data.json import to_json, write_json
from jaxnav.data.toml import to_toml
from jaxnav.filters.border import in_user_units, name_of, nested, noise_leaves, user_value
from jaxnav.filters.run import track
from jaxnav.states.table import BIASES
from jaxnav.types import Samples, Track
from tuning.export import sd_by_stream, stated_sd, write_exports
from tuning.train import Fit
from tuning.validation import PairedGain

RUNS = ("runs", "Horizontal error of a run, RMS (m)")  # what a figure of errors shows where no window is hidden


def report(
    materials: list[Material],
    found: Fit,
    leaves: list[str],
    before: JobScores,
    after: JobScores,
    gain: PairedGain | None,
    about: dict[str, Any],
) -> dict[str, Any]:
    """The metrics of a tuning job; ``about`` is what the innovations say of the parameters."""
    material = materials[0]
    return {
        "about": "; ".join(m.about for m in materials),
        "before": before.summary,
        "after": after.summary,
        "paired_gain": None if gain is None else gain._asdict(),
        "per_window": {"before_m": before.errors.tolist(), "after_m": after.errors.tolist(),
                       "block": before.blocks.tolist()},
        "params_before": in_user_units(material.params, leaves),
        "params_after": in_user_units(found.params, leaves),
        "known": {name_of(leaf): user_value(leaf, v) for leaf, v in material.known.items() if leaf in leaves},
        "loss": found.loss,
        "steps": len(found.history),
        "stopped": found.stopped,
        "aside": [{k: entry[k] for k in ("run", "step", "why")} for entry in found.aside],
    } | about  # fmt: skip


def text(result: dict[str, Any], config: Config) -> str:
    """The tables before and after for the terminal."""
    before, after = result["before"], result["after"]
    labels = {
        "outage_rms_m": "horizontal error at the end of an outage, RMS (m)", "outage_median_m": "the same, median (m)",
        "outage_max_m": "the same, largest (m)", "run_rms_m": "horizontal error, RMS (m)",
        "run_median_m": "the same of a run, median (m)", "run_max_m": "the same, largest (m)",
        "innovation_horizontal_rms_m": "horizontal innovation, RMS (m)",
        "nis_per_dof": "NIS / dof (1 is consistent)",
    }  # fmt: skip
    rows = [[label, before[key], after[key]] for key, label in labels.items() if key in before]
    lines = [result["about"], "", table([f"{config.filter.name} on data kept aside", "before", "after"], rows)]
    rows = [
        [name, before["nis_by_channel"].get(name, math.nan), value, before["autocorrelation"].get(name, math.nan),
         after["autocorrelation"][name]]
        for name, value in after["nis_by_channel"].items()
    ]  # fmt: skip
    head = ["channel", "NIS before", "after (1)", "autocorrelation before", "after (0)"]
    lines += ["", table(head, rows), ""]
    gain = result["paired_gain"]
    if gain is None:
        lines.append("too few windows or runs kept aside for an interval of the gain")
    else:
        verdict = "better" if gain["low"] > 1 else "worse" if gain["high"] < 1 else "not proven"
        span = f"95 % interval {gain['low']:.2f} to {gain['high']:.2f}"
        lines.append(f"RMS before / RMS after {gain['gain']:.2f}, {span}: {verdict}")
    if result["params_after"] == result["params_before"]:
        lines.append("no step was better than the start on the validation data: the start is kept")
    names, after, known = result["params_before"], result["params_after"], result["known"]
    rows = [[n, _short(v), _short(after[n]), _short(known.get(n, ""))] for n, v in names.items()]
    head = ["parameter", "before", "after", "simulated"]
    lines += ["", table(head if known else head[:3], [row if known else row[:3] for row in rows])]
    if result.get("parameters"):
        rows = [
            [name, p["value"], f"{cell(p['low'])} to {cell(p['high'])}" if p["identified"] else "not determined",
             p["unit"], p["ratio"] if p["ratio"] is not None else ""]
            for name, p in result["parameters"].items()
        ]  # fmt: skip
        head = ["as the innovations see it", "value", "95 % interval", "unit", "of datasheet"]
        lines += ["", table(head, rows), *result["identifiability"]]
    if result["stopped"].startswith("not converged"):
        lines.append(result["stopped"])
    for entry in result["aside"]:
        lines.append(f"set aside from step {entry['step']}: {entry['run']}: {entry['why']}")
    return "\n".join(lines)


def _short(value: Any) -> Any:
    if isinstance(value, list) and isinstance(value[0], list):
        root = not np.triu(value, 1).any()  # without its zeros
        rows = [row[: i + 1] if root else row for i, row in enumerate(value)]
        return "[" + "; ".join(", ".join(f"{v:.3g}" for v in row) for row in rows) + "]"
    if isinstance(value, list):
        return "[" + ", ".join(f"{v:.3g}" for v in np.ravel(value)) + "]"
    return value


# ---------------------------------------------------------------------------- files


def write(folder: Path, material: Material, found: Fit, leaves: list[str], result: dict[str, Any]) -> None:
    """Write tuned.toml, the same for other software, history.jsonl and metrics.json."""
    params = nested(in_user_units(found.params, dict.fromkeys([*noise_leaves(found.params), *leaves])))
    head = f"# jaxnav tune: {material.about}\n# use: jaxnav filter --params tuned.toml\n"
    vague = [name for name, p in result.get("parameters", {}).items() if not p["identified"]]
    doubt = f"# not determined by the data, any value near it will do: {', '.join(vague)}\n" if vague else ""
    atomic_write(folder / "tuned.toml", head + doubt + to_toml(params))
    stated = stated_sd(sd_by_stream(material.test.epochs.fix, material.measurements))
    write_exports(folder, f"jaxnav tune: {material.about}", found.params, stated)
    rows = [to_json(row) for row in user_history(found.history)]
    atomic_write(folder / "history.jsonl", "\n".join(rows) + "\n" if rows else "")
    write_json(folder / "metrics.json", result)


def user_history(history: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row a step with the parameters in a user's units."""
    # of one shape in every step, whether axes happen to agree in it or not
    in_units = lambda row: {name_of(leaf): user_value(leaf, v, False) for leaf, v in row["params"].items()}
    return [row | {"params": in_units(row)} for row in history]


def draw(folder: Path, material: Material, found: Fit, before: JobScores, after: JobScores) -> None:
    """Write the figures: drift before and after, tuning curves, and the first test run with the tuned filter."""
    drift = {"datasheet": before.errors, "tuned": after.errors}
    if material.windows:
        plots.save(plots_stats.outage_drift(drift), folder / "outage_drift.png")
    else:
        plots.save(plots_stats.outage_drift(drift, what=RUNS), folder / "run_error.png")
    if found.history:
        known = {name_of(leaf): user_value(leaf, v) for leaf, v in material.known.items()}
        plots.save(plots_stats.tuning(user_history(found.history), known), folder / "tuning.png")
    sol = evaluate.trace(jax.tree.map(lambda a: a[0], after.info), found.params)
    truth, fixes, biases = truth_of(material)
    figures = evaluate.figures(
        sol, truth, fixes, material.measurements, material.outages, biases, material.filter.model.states
    )
    for name, fig in figures.items():
        plots.save(fig, folder / f"{name}.png")


def truth_of(material: Material) -> tuple[Track | None, Any, Any]:
    """Truth, position fixes and true biases of the first test run, as far as they are known."""
    if material.recording is not None:
        return material.recording.truth, material.recording.aiding["position"], None
    nav = jax.tree.map(lambda a: a[0], material.truth)
    fix = jax.tree.map(lambda a: np.asarray(a[0]), material.test.epochs.fix)
    seen = fix.valid[:, :3].all(1)
    fixes = Samples(material.t[seen], *(a[seen, :3] for a in (fix.value, fix.sd, fix.corr)))
    return track(nav), fixes, (material.t, *(np.asarray(nav.errors[name]) for name in BIASES))
