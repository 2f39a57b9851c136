"""`jaxnav tune` and `jaxnav demo`: tune on some data by gradient, show the gain on data kept aside."""

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav import config as configuration
from jaxnav import metrics, plots, plots_stats
from jaxnav.config import Config
from jaxnav.errors import ConfigError
from jaxnav.filters.core import Filter
from jaxnav.io import atomic_write
from jaxnav.jobs import evaluate
from jaxnav.jobs.batches import Batch, Material, from_recording, from_scenario
from jaxnav.jobs.parameters import NAMES, UNITS, free_spec, in_user_units, user_value
from jaxnav.jobs.prepare import filter_name, measurements_of
from jaxnav.jobs.results import FailedCheck, Outcome, stderr, table, to_json, write_json
from jaxnav.jobs.sources import scenario_of
from jaxnav.run import first_failure, run, track
from jaxnav.types import Info, Params, Samples, Track
from tuning import objectives
from tuning.train import Fit, default_optimizer, fit
from tuning.transforms import Spec
from tuning.validation import PairedGain, paired_gain

runs_jit = jax.jit(jax.vmap(run, (None, None, 0, 0)), static_argnums=0)


class Scores(NamedTuple):
    """The test before and after."""

    errors: np.ndarray  # (windows,) m, horizontal, at the end of each window
    info: Info  # (B, E, ...) numpy
    summary: dict[str, float]


# ---------------------------------------------------------------------------- objectives


def _drift(infos: Info, batch: Batch) -> jax.Array:
    return 0.5 * jnp.log(objectives.masked_mean(_window_errors(infos, batch) ** 2, batch.scored) + 1e-6)


def _log_drift(infos: Info, batch: Batch) -> jax.Array:
    return objectives.masked_mean(0.5 * jnp.log(_window_errors(infos, batch) ** 2 + 1e-2), batch.scored)


def _window_errors(infos: Info, batch: Batch) -> jax.Array:
    return jax.vmap(objectives.outage_error)(infos, batch.ends)


def _nll(infos: Info, batch: Batch) -> jax.Array:
    return jnp.mean(jax.vmap(objectives.innovation_nll)(infos, batch.keep))


def _rmse(infos: Info, batch: Batch) -> jax.Array:
    assert batch.lla is not None  # `objective` saw to it
    error = jax.vmap(jax.vmap(metrics.position_error))(infos.nav, jnp.broadcast_to(batch.lla, infos.nav.pos.shape))
    return jnp.mean(jax.vmap(objectives.rmse)(error, jnp.ones_like(batch.keep)))


OBJECTIVES: dict[str, Callable[[Info, Batch], jax.Array]] = {
    "drift": _drift, "log_drift": _log_drift, "nll": _nll, "rmse": _rmse,
}  # fmt: skip
"""Log RMS and mean log of the error at the ends of hidden windows; innovation likelihood; position RMSE in m."""


def check_objective(weights: dict[str, float], truth: bool = True) -> None:
    """Raise ConfigError for an unknown objective, one that needs a truth that is not there, or none at all."""
    for name in weights:
        if name not in OBJECTIVES:
            raise ConfigError(f"tune.objective: no objective {name!r}: {configuration.nearest(name, OBJECTIVES)}")
    if not any(weights.values()):
        raise ConfigError("tune.objective: every weight is zero")
    if weights.get("rmse") and not truth:
        raise ConfigError("tune.objective: rmse needs a truth, and the recording has none")


@cache
def objective(filt: Filter, weights: tuple[tuple[str, float], ...]) -> Callable[[Params, Batch], jax.Array]:
    """The weighted sum of objectives of a batch; inf where a run stopped being finite. One function per setting."""

    def loss(params: Params, batch: Batch) -> jax.Array:
        infos = jax.vmap(run, (None, None, 0, 0))(filt, params, batch.nav, batch.epochs)
        total = sum((w * OBJECTIVES[name](infos, batch) for name, w in weights if w), jnp.zeros(()))
        return jnp.where(infos.ok.all(), total, jnp.inf)

    return loss


# ---------------------------------------------------------------------------- the job


def tune(config: Config, folder: Path, progress: bool = False) -> Outcome:
    """Tune, compare before and after on what was kept aside, write parameters, history and figures.

    Raises:
        FailedCheck: the starting filter stops being finite.
    """
    seconds, begin = {}, time.perf_counter()
    scenario, names = scenario_of(config), config.tune.objective
    check_objective(names)
    spec = free_spec(config.tune.free, filter_name(config), measurements_of(config))
    material = from_scenario(config, scenario) if scenario is not None else from_recording(config)
    check_objective(names, material.train.lla is not None)
    if progress:
        stderr(f"{material.about}\nfree: {', '.join(spec)}")
    seconds["prepare"], begin = time.perf_counter() - begin, time.perf_counter()
    before = score(material, material.params)
    seconds["before"], begin = time.perf_counter() - begin, time.perf_counter()
    found = search(config, material, spec, progress)
    seconds["tune"], begin = time.perf_counter() - begin, time.perf_counter()
    after = score(material, found.params)
    gain = compare(before, after, material, config.seed)
    seconds["after"], begin = time.perf_counter() - begin, time.perf_counter()
    result = report(material, found, list(spec), before, after, gain)
    write(config, folder, material, found, list(spec), result)
    if config.out.figures:
        draw(folder, material, found, before, after)
    seconds["write"] = time.perf_counter() - begin
    stopped = "" if found.stopped == "done" else found.stopped
    return Outcome(result, text(result, config), seconds, stopped)


def search(config: Config, material: Material, spec: Spec, progress: bool) -> Fit:
    """The best parameters by validation.

    Raises:
        FailedCheck: the objective of the start is not finite.
    """
    t = config.tune
    loss = objective(material.filter, tuple(sorted(t.objective.items())))
    optimizer = default_optimizer(t.steps, t.rate)
    try:
        return fit(
            loss, spec, material.params, t.steps, optimizer,
            (material.train,), loss, (material.validation,), progress,
        )  # fmt: skip
    except ValueError as error:
        raise FailedCheck(f"{material.about}: {error}") from error


def score(material: Material, params: Params) -> Scores:
    """The errors at the ends of the test's windows, and how the filter does outside of them.

    Raises:
        FailedCheck: a run stopped being finite; names run and time.
    """
    batch = material.test
    info = jax.tree.map(np.asarray, runs_jit(material.filter, params, batch.nav, batch.epochs))
    for i, name in enumerate(material.names):
        failure = first_failure(jax.tree.map(lambda a, i=i: a[i], info), material.t)
        if failure:
            raise FailedCheck(f"{name}: {failure}")
    errors = np.asarray(jax.vmap(objectives.outage_error)(info, batch.ends))[np.asarray(batch.scored)]
    flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), info)
    consistency = evaluate.innovation_metrics(flat, material.measurements)
    with_fix = np.asarray(batch.keep) & info.valid[..., :2].all(-1)
    summary = {
        "outage_rms_m": float(np.sqrt(np.mean(errors**2))),
        "outage_median_m": float(np.median(errors)),
        "outage_max_m": float(errors.max()),
        "nis_per_dof": consistency["nis_per_dof"],
        "nis_share_inside_95": consistency["nis_share_inside_95"],
        "innovation_horizontal_rms_m": float(np.sqrt(np.mean(np.sum(info.residual[with_fix][:, :2] ** 2, -1)))),
    }
    return Scores(errors, info, summary)


def compare(before: Scores, after: Scores, material: Material, seed: int) -> PairedGain | None:
    """The paired gain, or None where there are fewer than two blocks to draw."""
    if np.unique(material.blocks).size < 2:
        return None
    return paired_gain(before.errors, after.errors, material.blocks, seed)


def report(
    material: Material, found: Fit, leaves: list[str], before: Scores, after: Scores, gain: PairedGain | None
) -> dict[str, Any]:
    """The metrics of a tuning job."""
    return {
        "about": material.about,
        "before": before.summary,
        "after": after.summary,
        "paired_gain": None if gain is None else gain._asdict(),
        "per_window": {"before_m": before.errors.tolist(), "after_m": after.errors.tolist(),
                       "block": material.blocks.tolist()},
        "params_before": in_user_units(material.params, leaves),
        "params_after": in_user_units(found.params, leaves),
        "known": {NAMES[leaf]: user_value(leaf, v) for leaf, v in material.known.items() if leaf in leaves},
        "loss": found.loss,
        "steps": len(found.history),
        "stopped": found.stopped,
    }  # fmt: skip


def text(result: dict[str, Any], config: Config) -> str:
    """The tables before and after for the terminal."""
    before, after = result["before"], result["after"]
    labels = {
        "outage_rms_m": "horizontal error at the end of an outage, RMS (m)", "outage_median_m": "the same, median (m)",
        "outage_max_m": "the same, largest (m)", "innovation_horizontal_rms_m": "horizontal innovation, RMS (m)",
        "nis_per_dof": "NIS / dof (1 is consistent)",
    }  # fmt: skip
    rows = [[label, before[key], after[key]] for key, label in labels.items()]
    lines = [result["about"], "", table([f"{config.filter.name} on data kept aside", "before", "after"], rows)]
    gain = result["paired_gain"]
    if gain is None:
        lines.append("too few windows kept aside for an interval of the gain")
    else:
        verdict = "better" if gain["low"] > 1 else "worse" if gain["high"] < 1 else "not proven"
        lines.append(
            f"RMS {gain['gain']:.2f} times smaller, 95 % interval {gain['low']:.2f} to {gain['high']:.2f}: {verdict}"
        )
    names = result["params_before"]
    known = result["known"]
    rows = [[n, _short(v), _short(result["params_after"][n]), _short(known.get(n, ""))] for n, v in names.items()]
    head = ["parameter", "before", "after", "simulated"]
    lines += ["", table(head if known else head[:3], [row if known else row[:3] for row in rows])]
    return "\n".join(lines)


def _short(value: Any) -> Any:
    if isinstance(value, list):
        return "[" + ", ".join(f"{v:.3g}" for v in np.ravel(value)) + "]"
    return value


# ---------------------------------------------------------------------------- files


def write(
    config: Config, folder: Path, material: Material, found: Fit, leaves: list[str], result: dict[str, Any]
) -> None:
    """Write tuned.toml, history.jsonl and metrics.json."""
    noise = [leaf for leaf in (u.leaf for u in UNITS.values()) if leaf.startswith("noise.") or leaf in leaves]
    params = {"params": in_user_units(found.params, noise)}
    head = f"# jaxnav tune: {material.about}\n# use: jaxnav filter --params tuned.toml\n"
    atomic_write(folder / "tuned.toml", head + configuration.to_toml(params))
    rows = [to_json(row) for row in user_history(found.history)]
    atomic_write(folder / "history.jsonl", "\n".join(rows) + "\n" if rows else "")
    write_json(folder / "metrics.json", result)


def user_history(history: list[dict]) -> list[dict]:
    """One row a step with the parameters in a user's units."""
    name = {leaf: NAMES[leaf] for leaf in (history[0]["params"] if history else {})}
    return [row | {"params": {name[leaf]: user_value(leaf, v) for leaf, v in row["params"].items()}} for row in history]


def draw(folder: Path, material: Material, found: Fit, before: Scores, after: Scores) -> None:
    """Write the figures: drift before and after, tuning curves, and the first test run with the tuned filter."""
    drift = {"datasheet": before.errors, "tuned": after.errors}
    plots.save(plots_stats.outage_drift(drift), folder / "outage_drift.png")
    if found.history:
        known = {NAMES[leaf]: user_value(leaf, v) for leaf, v in material.known.items()}
        plots.save(plots_stats.tuning(user_history(found.history), known), folder / "tuning.png")
    sol = evaluate.solution(jax.tree.map(lambda a: a[0], after.info), found.params)
    truth, fixes, biases = truth_of(material)
    figures = evaluate.figures(sol, truth, fixes, material.measurements, material.outages, biases)
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
    return track(nav), fixes, (material.t, np.asarray(nav.b_g), np.asarray(nav.b_a))
