"""What `tuning.tune` says and leaves: how a recording is used, the table of its parameters, the verdict, its files."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxnav.data import atomic_write
from jaxnav.data.json import to_json, write_json
from jaxnav.data.toml import to_toml
from jaxnav.filters.border import TABLES, in_user_units, nested, noise_leaves, override
from jaxnav.filters.parameters import get
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import DataError, Params
from tuning.export import sd_by_stream, stated_sd, write_exports

if TYPE_CHECKING:
    from jaxnav.data.epochs import Packed
    from tuning.parts import Layout
    from tuning.recorded import Trial, Tuned

LEAST_WINDOWS = 8  # blocks of time that an interval needs


class Row(NamedTuple):
    """A free number, in a user's units."""

    name: str
    value: float
    low: float  # 95 % of the tempered posterior
    high: float
    datasheet: float
    unit: str
    prior: str
    remark: str


def in_words_of(layout: "Layout", parts: Mapping[str, np.ndarray], packed: "Packed") -> str:
    """The split, in a sentence."""
    counts = ", ".join(f"{int(mask.sum())} {name}" for name, mask in parts.items())
    return (
        f"training to {layout.train:.0f} s, validation to {layout.validation:.0f} s, test to {packed.t[-1]:.0f} s; "
        f"hidden windows of {layout.window:g} s: {counts}"
    )


def shown(best: str, trials: "Mapping[str, Any]") -> str:
    """The candidate whose parameters are told: the winner's, where the datasheet wins of what was tuned."""
    return best if best != "datasheet" else "tuned"


def verdict(
    best: str, trials: "Mapping[str, Trial]", scores: Mapping[str, dict[str, float]], parts: Mapping[str, np.ndarray]
) -> str:
    """Return which candidate won, what it is worth on the test, and how the others did on the validation part."""
    sheet = trials["datasheet"]
    words = lambda name, t: (
        f"{name} predicts by {sheet.nll - t.nll:+.2f}, drifts {max(t.ratios[:2]):.2f}, {max(t.ratios[2:]):.2f}"
    )
    others = "; ".join(words(name, t) for name, t in trials.items() if name not in (best, "datasheet"))
    if best == "datasheet":
        return (
            "the datasheet stays: no candidate predicts the validation part better (log-likelihood) and drifts less on "
            f"training and validation windows, on validation alone ({others})"
        )
    rms = {name: score["rms_m"] for name, score in scores.items()}
    against = f" and {rms[best] / rms['auto']:.2f} of the noise scan's" if "auto" in rms and best != "auto" else ""
    return (
        f"{best}: {rms[best] / rms['datasheet']:.2f} of the datasheet's{against} RMS drift over "
        f"{int(parts['test'].sum())} test windows ({rms['datasheet']:.2f} to {rms[best]:.2f} m); "
        f"{words(best, trials[best])}" + (f"; {others}" if others else "")
    )


def text(found: "Tuned") -> str:
    """The table of `Tuned`, for a terminal."""
    head = ["parameter", "datasheet", shown(found.chosen, found.trials), "95 %", "unit", "prior (1 sd)", ""]
    rows = [
        [r.name, f"{r.datasheet:.4g}", f"{r.value:.4g}", f"{r.low:.3g} to {r.high:.3g}", r.unit, r.prior, r.remark]
        for r in found.rows
    ]
    width = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    line = lambda row: "  ".join(cell.ljust(w) for cell, w in zip(row, width, strict=True)).rstrip()
    lines = [line(head), line(["-" * w for w in width]), *map(line, rows), ""]
    lines.append(
        f"the likelihood counts as {found.effective:.1f} observations (windows that fit into the training part)"
    )
    lines.append(found.verdict)
    if found.gain is not None:
        g = found.gain
        lines.append(f"drift {g.gain:.2f} times smaller on the test (95 %: {g.low:.2f} to {g.high:.2f})")
    elif found.chosen != "datasheet":
        lines.append(
            f"no interval: {found.blocks} blocks of windows in the test, it takes {LEAST_WINDOWS} "
            f"({LEAST_WINDOWS * found.used[0].layout.every / 0.35:.0f} s of recording)"
        )
    return "\n".join(lines)


# ---------------------------------------------------------------------------- files


def metrics(found: "Tuned") -> dict[str, Any]:
    """All figures of a job, as metrics.json has them."""
    named = [u.name for u in found.used for _ in u.windows.start]
    return {
        "chosen": found.chosen, "verdict": found.verdict, "n_eff": found.effective,
        "parameters": {r.name: {k: v for k, v in r._asdict().items() if k != "name"} for r in found.rows},
        "windows": {name: found.counts[name] for name in ("training", "validation", "test")},
        "layout_s": {u.name: u.layout._asdict() for u in found.used},
        "test": found.test, "nis_by_channel": found.nis,
        "drift_ratio": found.test[found.chosen]["rms_m"] / found.test["datasheet"]["rms_m"],
        "paired_gain": None if found.gain is None else found.gain._asdict(),
        "against_datasheet": {k: list(t.ratios) for k, t in found.trials.items()},
        "per_window": {"recording": named, "start_s": np.concatenate([u.windows.start for u in found.used]),
                       "test": found.parts["test"],
                       **{f"{k}_m": t.drift for k, t in found.trials.items()}},
        "start": {u.name: u.begin.how for u in found.used},
    }  # fmt: skip


def write(found: "Tuned", folder: Path, states: Sequence[str] = (), exports: bool = True) -> None:
    """Write tuned.toml, the same for other software (``exports``), history.jsonl and metrics.json.

    A recording that has some of its own has a tuned_N.toml beside, N its number. ``states`` that the filter was given
    beside its own are told in tuned.toml where the winner has one more.
    """
    folder.mkdir(parents=True, exist_ok=True)
    about = f"{' and '.join(u.name for u in found.used)}: {found.verdict}"
    extra = [name for name in found.filter.model.states if name not in found.used[0].sheet.states]
    params: dict[str, Any] = {"filter": {"states": [*states, *extra]}} if extra else {}
    stated = lambda each: nested(in_user_units(each, dict.fromkeys([*noise_leaves(each), *found.spec])))
    head = f"# jaxnav tune: {about}\n# use: jaxnav filter --params tuned.toml\n"
    atomic_write(folder / "tuned.toml", head + to_toml(params | stated(found.params)))
    for number, (used, own) in enumerate(zip(found.used[1:], found.each[1:], strict=True), start=2):
        if any(np.any(np.asarray(get(own, leaf)) != np.asarray(get(found.params, leaf))) for leaf in found.spec):
            text = f"# jaxnav tune: {used.name}, which has some of its own\n" + to_toml(params | stated(own))
            atomic_write(folder / f"tuned_{number}.toml", text)
    if exports:
        rows = tuple(MEASUREMENTS[name] for name in found.filter.model.measurements)
        sd = stated_sd(sd_by_stream(found.used[0].packed.epochs.fix, rows))
        write_exports(folder, f"jaxnav tune: {about}", found.params, sd)
    atomic_write(folder / "history.jsonl", "\n".join(to_json(row) for row in found.history) + "\n")
    write_json(folder / "metrics.json", metrics(found))


def load(path: str | Path, params: Params) -> Params:
    """``params`` with what a tuned.toml says of them, such as ``load("out/tuned/tuned.toml", ekf.params("consumer"))``.

    Raises:
        DataError: no such file, or no TOML. ConfigError: values that cannot be meant.
    """
    path = Path(path)
    try:
        stated = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: is not TOML: {error}") from error
    if not any(isinstance(stated.get(table), dict) for table in TABLES):
        raise DataError(f"{path}: has none of {', '.join(f'[{table}]' for table in TABLES)}, as tuned.toml has")
    return override(params, stated)
