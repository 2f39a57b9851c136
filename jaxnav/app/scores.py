"""How a filter does on what a tuning job kept aside: drift at the ends of hidden windows, consistency outside.

Where nothing is hidden, a scenario without outages, every run counts by the RMS of its true horizontal error.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxnav.analysis import evaluate, metrics
from jaxnav.app.batches import Batch, Material
from jaxnav.filters.run import first_failure, run
from jaxnav.types import FilterError, Info, Params
from tuning import objectives
from tuning.transforms import merged
from tuning.validation import PairedGain, paired_gain

runs_jit = jax.jit(jax.vmap(run, (None, None, 0, 0)), static_argnums=0)


class JobScores(NamedTuple):
    """The test before and after, of all materials."""

    errors: np.ndarray  # (windows,) m, horizontal, at the end of each window; of runs without windows the RMS of each
    blocks: np.ndarray  # (windows,) what is drawn together
    info: Info  # (B, E, ...) numpy, of the first material
    summary: dict[str, Any]


def score(materials: list[Material], params: Params, free: tuple[str, ...]) -> JobScores:
    """The errors at the ends of the tests' windows, and how the filter does outside of them.

    Raises:
        FilterError: a run stopped being finite; names run and time.
    """
    errors, blocks, infos, consistent, inside = [], [], [], [], []
    for k, m in enumerate(materials):
        batch = m.test
        info = runs_jit(m.filter, merged(params, m.params, free), batch.nav, batch.epochs)
        info = jax.tree.map(np.asarray, info)
        for i, name in enumerate(m.names):
            failure = first_failure(jax.tree.map(lambda a, i=i: a[i], info), m.t)
            if failure:
                raise FilterError(f"{name}: {failure}")
        errors.append(judged_by(info, batch))
        blocks.append(m.blocks + 1e6 * k)  # of different sources, never drawn as one
        judged = info._replace(valid=info.valid & np.asarray(batch.part)[..., None])  # nothing that tuning has seen
        flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), judged)
        consistent.append(evaluate.innovation_metrics(flat, m.measurements))
        with_fix = judged.valid[..., :2].all(-1)
        inside.append(np.sum(info.residual[with_fix][:, :2] ** 2, -1))
        infos.append((info, judged))
    all_errors, what = np.concatenate(errors), "outage" if has_windows(materials) else "run"
    summary = {
        f"{what}_rms_m": float(np.sqrt(np.mean(all_errors**2))),
        f"{what}_median_m": float(np.median(all_errors)),
        f"{what}_max_m": float(all_errors.max()),
        "nis_per_dof": float(np.mean([c["nis_per_dof"] for c in consistent])),
        "nis_share_inside_95": float(np.mean([c["nis_share_inside_95"] for c in consistent])),
        "innovation_horizontal_rms_m": float(np.sqrt(np.mean(np.concatenate(inside)))),
    } | channels(materials[0], infos[0][1])
    return JobScores(all_errors, np.concatenate(blocks), infos[0][0], summary)


def has_windows(materials: list[Material]) -> bool:
    """Whether anything is hidden in all of them."""
    return all(m.windows for m in materials)


def judged_by(info: Info, batch: Batch) -> np.ndarray:
    """Errors at the ends of the windows that count, or the RMS of every run's horizontal error where there are none."""
    if batch.ends.shape[1]:
        return np.asarray(jax.vmap(objectives.outage_error)(info, batch.ends))[np.asarray(batch.scored)]
    assert batch.truth is not None  # only a simulated run has no windows
    error = np.asarray(jax.vmap(jax.vmap(metrics.position_error))(info.nav, batch.truth.lla))[..., :2]
    return np.sqrt(np.mean(np.sum(error**2, -1), -1))


def channels(material: Material, info: Info) -> dict[str, dict[str, float]]:
    """Mean normalised innovation squared of every channel, 1 if consistent, and its autocorrelation at the next fix."""
    order, names, _ = evaluate.channels(material.measurements)
    runs = [jax.tree.map(lambda a, i=i: a[i], info) for i in range(len(material.names))]
    z = np.stack([metrics.normalized_innovations(each)[:, order] for each in runs])
    pairs = z[:, 1:] * z[:, :-1]
    seen = [j for j in range(len(names)) if np.isfinite(pairs[..., j]).any()]
    nis = {names[j]: float(np.nanmean(z[..., j] ** 2)) for j in seen}
    lag = {names[j]: float(np.nanmean(pairs[..., j])) / nis[names[j]] for j in seen}
    return {"nis_by_channel": nis, "autocorrelation": lag}


def compare(before: JobScores, after: JobScores, seed: int) -> PairedGain | None:
    """The paired gain, or None where there are fewer than two blocks to draw."""
    if np.unique(before.blocks).size < 2:
        return None
    return paired_gain(before.errors, after.errors, before.blocks, seed)
