"""Searches of `tune`: J by the method of scoring, with checkpoints, or an objective by gradient."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths.units import TICK
from jaxnav.types import Json
from tuning.fit import checkpoint
from tuning.fit.status import Status
from tuning.recordings import scoring
from tuning.recordings.evidence import Evidence
from tuning.recordings.parts import runs_of
from tuning.recordings.runs import Descent, check_objective, descend

MAX_EVALUATIONS, MIN_GAIN = 25, 0.02  # evaluations of one search; gain in J that is worth another


class Checkpoints(NamedTuple):
    """Folder of the searches' checkpoints, and whether they resume from there."""

    folder: Path
    resume: bool = False
    identity: str = ""  # of the job, so that another job's checkpoint is refused


def search(
    name: str,
    job: Evidence,
    first: jax.Array,
    history: list[Json],
    log: Callable[[str], None],
    checkpoints: Checkpoints | None = None,
) -> tuple[jax.Array, Status]:
    """Minimise J from a point, with a line and a row of the history for each evaluation.

    Raises:
        CheckpointError: nothing usable to resume from.
    """
    path = None if checkpoints is None else checkpoints.folder / f"{name.replace(' ', '_')}.npz"

    def keep(at: jax.Array, status: Status | None) -> None:
        if path is not None and checkpoints is not None:
            checkpoint.save(path, at, {"status": None if status is None else status.value}, checkpoints.identity)

    def report(i: int, at: scoring.Search) -> None:
        row = {"search": name, "step": i, "loss": float(at.best.nll)}
        history.append(row)
        keep(at.raw, None)
        log(f"  {name}, evaluation {i}: J {row['loss']:.4f}")

    log(f"{name}: {len(job.flat)} numbers free")
    if path is not None and checkpoints is not None and checkpoints.resume and (name == "tuned" or path.exists()):
        stored = checkpoint.load(path, first, checkpoints.identity)
        first, ended = jnp.asarray(stored.tree), stored.head["status"]
        log(f"  {name}: goes on from {path}" if ended is None else f"  {name}: finished in {path}")
        if ended in (Status.CONVERGED, Status.ITERATION_LIMIT):
            return first, Status(ended)
    found = scoring.maximise(job.inform, first, MAX_EVALUATIONS, MIN_GAIN, report, job.values)
    status = scoring.status(found, MIN_GAIN)
    keep(found.raw, status)
    return found.raw, status


def descent(
    name: str, job: Evidence, first: jax.Array, history: list[Json], log: Callable[[str], None], how: Descent
) -> tuple[jax.Array, Status]:
    """Minimise an objective over the training windows from a point by gradient; the best by the validation windows."""
    size = lambda end: max(int(np.searchsorted(u.packed.t, getattr(u.layout, end) + TICK)) for u in job.used)
    train = [runs_of(u, job.filt, "training", size("train")) for u in job.used]
    validation = [runs_of(u, job.filt, "validation", size("validation")) for u in job.used]
    check_objective(how.objective, all(r.truth is not None for r in (*train, *validation)))
    log(f"{name}: {how.method} on " + ", ".join(f"{w:g} {key}" for key, w in how.objective.items()))
    names = [f"{u.name}, phase {p}" for u in job.used for p in range(len(u.windows.hidden))]
    count = sum(int((r.keep & r.epochs.fix.valid.any(-1)).sum()) for r in train)
    ended = descend(job.filt, job.spec, job.params(first), train, validation, names, how, 1 / max(count, 1))
    history.extend(ended.history)
    return job.numbers([ended.params] * len(job.used)), ended.status
