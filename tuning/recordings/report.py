"""Report of tuning: the table of its parameters, the verdict, its files."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.analysis.receiver_errors import whole
from jaxnav.filters.border import TABLES, in_user_units, name_of, nested, noise_leaves, override, unit_of, user_value
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import LaneRecord
from jaxnav.filters.parameters import get
from jaxnav.filters.scores import squares
from jaxnav.io import atomic_write
from jaxnav.io.json import to_json, write_json
from jaxnav.io.toml import to_toml
from jaxnav.io.weights import WEIGHTS, read_weights, write_weights
from jaxnav.measurements import MEASUREMENTS, Measurement
from jaxnav.states.table import BIASES
from jaxnav.types import DataError, Finding, Info, Json, Params
from tuning.fit.status import Status
from tuning.fit.transforms import LOG, Spec, Transform, reported, values
from tuning.recordings.export import sd_by_stream, stated_sd
from tuning.recordings.targets import write_exports
from tuning.recordings.validation import PairedGain, PairedRatio
from tuning.uncertainty import Covariance, intervals

if TYPE_CHECKING:
    from tuning.recordings.parts import Used
    from tuning.simulated import SimulatedRuns

MIN_WINDOWS = 8  # blocks of time, or runs, that an interval needs
MIN_LOG_M = 0.1  # m: smaller drifts count as this in mean logarithms


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


class Trial(NamedTuple):
    """A candidate, and how it does against the datasheet."""

    filter: Filter
    params: Params
    drift: np.ndarray  # (W,) m, horizontal, at the end of each window; RMS of runs without windows
    ratios: tuple[float, float, float, float]  # RMS, mean log: training and validation together, validation alone
    nll: float  # of the validation part


@dataclass(frozen=True)
class Tuned:
    """Result of tuning, and its verdict; prints as a table."""

    params: Params  # the winner's, the datasheet's where nothing beats it; with the prior that `tune` was given
    each: list[Params]  # of every recording or scenario
    filter: Filter  # that they are for: the winner may have a state more
    chosen: str  # of `trials`
    rows: list[Row]  # of the winner; where that is the datasheet, of the tuned candidate
    trials: dict[str, Trial]
    used: "Sequence[Used | SimulatedRuns]" = field(repr=False)  # the recordings, or the runs of each scenario
    parts: dict[str, np.ndarray]  # masks (W,) of the windows of all of them, one after the other
    blocks: int  # of time, or runs, in the test
    gain: PairedGain | None  # on the test, None where there are too few blocks
    test: dict[str, dict[str, float]]  # by candidate: rms_m, median_m, max_m
    nis: dict[str, dict[str, float]]  # by candidate: normalised innovations squared by channel, on the test
    spec: Spec
    findings: list[Finding]  # on the search and on undetermined parameters
    history: list[Json] = field(default_factory=list)
    status: Status = Status.CONVERGED
    effective: float = math.nan  # N of a tempered likelihood
    interval: PairedRatio | None = None  # the winner's drift over the datasheet's on the test

    @property
    def verdict(self) -> str:
        """The winner and its figures, in words."""
        return verdict(self)

    @property
    def counts(self) -> dict[str, int]:
        """Windows by part."""
        return {name: int(mask.sum()) for name, mask in self.parts.items()}

    def metrics(self) -> Json:
        """All figures, as metrics.json has them."""
        return metrics(self)

    def write(self, folder: str | Path, states: Sequence[str] = (), exports: bool = True) -> None:
        """Write tuned.toml, the same for other software, history.jsonl and metrics.json, see `write`.

        Args:
            folder: an existing folder, or one to make.
            states: states that the user added to the filter's, for tuned.toml.
            exports: write the formats of other software.
        """
        write(self, Path(folder), states, exports)

    def __str__(self) -> str:
        return text(self)


def reported_candidate(best: str) -> str:
    """Return the candidate whose parameters the table has: the winner, and the tuned one if the datasheet won."""
    return best if best != "datasheet" else "tuned"


def verdict(found: Tuned) -> str:
    """Return the winner, its ratio on the test, and the ratios of the others on the validation part."""
    best, trials, datasheet = found.chosen, found.trials, found.trials["datasheet"]
    words = lambda name, t: (
        f"{name}: log-likelihood {datasheet.nll - t.nll:+.2f} per fix, drift ratio {max(t.ratios[:2]):.2f} "
        f"(training and validation), {max(t.ratios[2:]):.2f} (validation)"
    )
    rivals = {name: t for name, t in trials.items() if name not in (best, "datasheet")}
    others = "; ".join(words(name, t) for name, t in rivals.items())
    if best == "datasheet":
        if rivals and all(np.array_equal(t.drift, datasheet.drift) for t in rivals.values()):
            return "no step was better than the start on the validation part"
        return (
            "the datasheet stays: no candidate predicts the validation part better (log-likelihood) and drifts less on "
            f"training and validation windows, on validation alone ({others})"
        )
    rms = {name: score["rms_m"] for name, score in found.test.items()}
    sure = "" if found.interval is None else f" (95 %: {found.interval.low:.2f} to {found.interval.high:.2f})"
    against = f" and {rms[best] / rms['auto']:.2f} of the noise scan's" if "auto" in rms and best != "auto" else ""
    return (
        f"{best}: {rms[best] / rms['datasheet']:.2f}{sure} of the datasheet's{against} RMS drift over "
        f"{int(found.parts['test'].sum())} test windows ({rms['datasheet']:.2f} to {rms[best]:.2f} m); "
        f"{words(best, trials[best])}" + (f"; {others}" if others else "")
    )


def text(found: Tuned) -> str:
    """Return the table of `Tuned`, for a terminal."""
    head = ["parameter", "datasheet", reported_candidate(found.chosen), "95 %", "unit", "prior (1 sd)", ""]
    rows = [
        [r.name, f"{r.datasheet:.4g}", f"{r.value:.4g}", f"{r.low:.3g} to {r.high:.3g}", r.unit, r.prior, r.remark]
        for r in found.rows
    ]
    width = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    line = lambda row: "  ".join(cell.ljust(w) for cell, w in zip(row, width, strict=True)).rstrip()
    lines = [line(head), line(["-" * w for w in width]), *map(line, rows), ""]
    if math.isfinite(found.effective):
        lines.append(f"the likelihood counts as {found.effective:.1f} observations (windows of the training part)")
    lines += [found.verdict]
    if found.gain is not None:
        g = found.gain
        lines.append(f"drift {g.gain:.2f} times smaller on the test (95 %: {g.low:.2f} to {g.high:.2f})")
    elif found.chosen != "datasheet":
        lines.append(
            f"no interval: {found.blocks} blocks of windows in the test, it takes {MIN_WINDOWS} "
            f"({found.used[0].needs(MIN_WINDOWS)})"
        )
    return "\n".join(lines)


def ratios(
    before: np.ndarray, after: np.ndarray, parts: Mapping[str, np.ndarray], groups: np.ndarray | int = 0
) -> tuple[float, float, float, float]:
    """Drift against the datasheet's, RMS and mean log: on training and validation windows, on validation windows.

    Args:
        before: (W,) m, the datasheet's drift.
        after: (W,) m, the other one's.
        parts: masks (W,) of the windows.
        groups: (W,) of windows of another kind, such as the satellites that they keep: the largest ratio of any counts.
    """
    log = lambda e: 0.5 * np.log(e**2 + MIN_LOG_M**2)
    groups, out = np.broadcast_to(groups, before.shape), []
    for mask in (parts["training"] | parts["validation"], parts["validation"]):
        each = [(before[mask & (groups == g)], after[mask & (groups == g)]) for g in np.unique(groups[mask])]
        out.append(max((float(np.sqrt(np.mean(b**2) / np.mean(a**2))) for a, b in each), default=np.nan))
        out.append(max((float(np.exp(np.mean(log(b) - log(a)))) for a, b in each), default=np.nan))
    return out[0], out[1], out[2], out[3]


def spread(off: np.ndarray) -> dict[str, float]:
    """Figures of drifts (W,) m."""
    return {"rms_m": float(np.sqrt(np.mean(off**2))), "median_m": float(np.median(off)), "max_m": float(off.max())}


def channels(
    infos: Sequence[Info | LaneRecord], part: Sequence[np.ndarray], measurements: Sequence[Measurement]
) -> dict[str, float]:
    """Return the normalised innovations squared by channel over all runs (B, E, ...), in the epochs (E,) of a part."""
    each = [squares(info)[:, mask] for info, mask in zip(infos, part, strict=True)]
    square = np.concatenate([a.reshape(-1, a.shape[-1]) for a in each])
    names = [f"{m.name} {axis}" for m in measurements for axis in m.channels]
    there = np.isfinite(square)
    return {n: float(square[there[:, i], i].mean()) for i, n in enumerate(names) if there[:, i].any()}


# ---------------------------------------------------------------------------- the table


def rows_of(spec: Spec, raw: Mapping[str, jax.Array], cov: Covariance, before: Mapping[str, jax.Array]) -> list[Row]:
    """Return every free number with its 95 % interval.

    Args:
        spec: the free parameters.
        raw: the unconstrained numbers.
        cov: their covariance.
        before: numbers of the datasheet.
    """
    numbers = lambda raw: np.asarray(ravel_pytree(values(spec, reported(spec, raw)))[0])
    rows = []
    for interval, start in zip(intervals(spec, dict(raw), cov), numbers(dict(before)), strict=True):
        leaf, _, index = interval.name.partition("[")
        unit = unit_of(leaf)
        factor, text = (1.0, "correlation") if "," in index else (unit.factor, unit.text)
        value, low, high, datasheet = (v / factor for v in (interval.value, interval.low, interval.high, float(start)))
        prior = describe_prior(spec[leaf], factor, text)
        rows.append(Row(short(interval.name), value, low, high, datasheet, text, prior, ""))
    return rows


def describe_prior(transform: Transform, unit: float, text: str) -> str:
    """Return a prior in words: how far one sd is."""
    if transform.prior is None:
        return "none"
    if transform.forward is LOG.forward:
        return f"within a factor {math.exp(transform.prior.sd):.3g}"
    return f"within {float(transform.forward(jnp.asarray(transform.prior.sd))) / unit:.3g} {text}".rstrip()


def short(label: str) -> str:
    """Return a label without the table of its parameter."""
    return label.removeprefix("measurements.").removeprefix("states.").removeprefix("mounting.")


# ---------------------------------------------------------------------------- files


def user_history(history: Sequence[Mapping[str, Any]]) -> list[Json]:
    """Return one row a step, its parameters in a user's units."""
    # of one shape in every step, whether axes happen to agree in it or not
    in_units = lambda params: {name_of(leaf): user_value(leaf, v, False) for leaf, v in params.items()}
    return [dict(row) | ({"params": in_units(row["params"])} if "params" in row else {}) for row in history]


def metrics(found: Tuned) -> Json:
    """All figures of a job, as metrics.json has them."""
    named = [u.name for u in found.used for _ in u.starts]
    return {
        "chosen": found.chosen, "verdict": found.verdict, "status": found.status.value, "n_eff": found.effective,
        "findings": [asdict(f) for f in found.findings],
        "parameters": {r.name: {k: v for k, v in r._asdict().items() if k != "name"} for r in found.rows},
        "windows": {name: found.counts[name] for name in ("training", "validation", "test")},
        "test": found.test, "nis_by_channel": found.nis,
        "drift_ratio": found.test[found.chosen]["rms_m"] / found.test["datasheet"]["rms_m"],
        "drift_ratio_95": None if found.interval is None else [found.interval.low, found.interval.high],
        "paired_gain": None if found.gain is None else found.gain._asdict(),
        "against_datasheet": {k: list(t.ratios) for k, t in found.trials.items()},
        "per_window": {"recording": named, "start_s": np.concatenate([u.starts for u in found.used]),
                       "test": found.parts["test"],
                       **{f"{k}_m": t.drift for k, t in found.trials.items()}},
    } | {key: {u.name: u.facts[key] for u in found.used} for key in found.used[0].facts}  # fmt: skip


def write(found: Tuned, folder: Path, states: Sequence[str] = (), exports: bool = True) -> None:
    """Write tuned.toml, the same for other software (``exports``), history.jsonl and metrics.json.

    A recording with separate parameters gets a tuned_N.toml, N its number. ``states`` that the user added to the
    filter's are written to tuned.toml where the winner has one more.
    """
    folder.mkdir(parents=True, exist_ok=True)
    about = f"{' and '.join(u.name for u in found.used)}: {found.verdict}"
    extra = [name for name in found.filter.model.states if name not in (*BIASES, *states)]
    prior = [f"states.{name}.sd" for name in extra]
    spec = found.filter.spec
    section = {} if spec is None else {"name": spec.name, "measurements": list(found.filter.model.measurements)}
    section |= {"states": [*states, *extra]} if extra else {}
    if jax.tree.leaves(found.params.adapter):
        part = "" if spec is None else spec.adapter
        write_weights(folder / f"tuned{WEIGHTS}", found.params.adapter, part if isinstance(part, str) else "")
        section |= {"adapter": f"tuned{WEIGHTS}"}
    params: Json = {"filter": section} if section else {}
    stated = lambda each: nested(in_user_units(each, dict.fromkeys([*noise_leaves(each), *prior, *found.spec])))
    head = f"# jaxnav tune: {about}\n# use: jaxnav filter --params tuned.toml\n"
    atomic_write(folder / "tuned.toml", head + to_toml(params | stated(found.params)))
    for number, (used, each) in enumerate(zip(found.used[1:], found.each[1:], strict=True), start=2):
        if any(
            np.any(np.asarray(get(each, leaf)) != np.asarray(get(found.params, leaf))) for leaf in (*found.spec, *prior)
        ):
            text = f"# jaxnav tune: {used.name}, which has separate parameters\n" + to_toml(params | stated(each))
            atomic_write(folder / f"tuned_{number}.toml", text)
    if exports:
        rows = tuple(MEASUREMENTS[name] for name in found.filter.model.measurements)
        by_stream = sd_by_stream(found.used[0].fix, rows)
        exported = whole(found.params, np.median(by_stream["position"], 0)) if "position" in by_stream else found.params
        write_exports(folder, f"jaxnav tune: {about}", exported, stated_sd(by_stream))
    atomic_write(folder / "history.jsonl", "".join(f"{to_json(row)}\n" for row in user_history(found.history)))
    write_json(folder / "metrics.json", metrics(found))


def load(path: str | Path, params: Params) -> Params:
    """Return parameters with the values of a tuned.toml, as ``load("out/tuned/tuned.toml", ekf.params("consumer"))``.

    Args:
        path: the file.
        params: parameters of the filter, for all that the file leaves out.

    Raises:
        DataError: no such file, or no TOML. ConfigError: unusable values.
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
    weights = stated.get("filter", {}).get("adapter", "")
    if isinstance(weights, str) and weights.endswith(WEIGHTS):
        params = params._replace(adapter=read_weights(path.parent / weights, params.adapter))
    return override(params, stated)
