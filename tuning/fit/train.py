"""Minimise an objective over the free parameters with optax; keep the best; go on where it stopped."""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from jaxnav.analysis.progress import bar as progress_bar
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.programs import stored
from jaxnav.types import Json, Tree
from tuning.fit import checkpoint, distributed
from tuning.fit.batch import Aggregate, Data, Problem, evaluate, mean, strict
from tuning.fit.optimizers import Method, Optimizer, made
from tuning.fit.status import Status
from tuning.fit.transforms import Spec, bound, join, split

LAST, HISTORY = "last.npz", "history.jsonl"


class Fit(NamedTuple):
    """Result of training."""

    params: Tree  # the best parameters met
    loss: float  # their loss, or their validation score
    history: list[Json]  # one row a step: step, loss, grad_norm, validation, params {name: value}
    status: Status  # iteration_limit or interrupted
    aside: tuple[Json, ...] = ()  # runs that failed: run, the first step at which it did, why


class TrainState(NamedTuple):
    """Where training stands before a step: all that a checkpoint holds."""

    raw: Tree  # unconstrained parameters
    state: Tree  # of the optimiser
    best: Any  # like raw
    score: float  # of the best
    failed: int  # runs that failed with the best: fewer is better than any score
    step: int  # the next one


@partial(stored, static_argnums=(0, 1))
def _step(problem: Problem, optimizer: Optimizer, raw: Tree, state: Tree, data: Data) -> Any:
    """Return new raw, new state, and loss, gradient norm and good runs at the old raw."""
    e = evaluate(problem, raw, data)
    # a line search takes the runs that are good here, and refuses points where one of those fails
    line = data._replace(weight=jnp.where(e.good, data.weight, 0.0))
    updates, new = optax.with_extra_args_support(made(optimizer)).update(
        e.grad, state, raw, value=e.value, grad=e.grad, value_fn=lambda r: strict(problem, r, line)
    )
    return optax.apply_updates(raw, updates), new, e.value, optax.tree.norm(e.grad), e.good


@partial(stored, static_argnums=(0,))
def _score(problem: Problem, raw: Tree, data: Data) -> Any:
    """Return value and good runs."""
    e = evaluate(problem, raw, data, slopes=False)
    return e.value, e.good


def fit(
    loss: Callable[..., jax.Array] | Sequence[Callable[..., jax.Array]],
    spec: Spec,
    params: Tree,
    steps: int,
    optimizer: Optimizer | None = None,
    arguments: tuple[Any, ...] = (),
    validation: Callable[..., jax.Array] | Sequence[Callable[..., jax.Array]] | None = None,
    validation_arguments: tuple[Any, ...] = (),
    progress: bool = False,
    *,
    cases: Sequence[Any] | Callable[[int], Sequence[Any]] | None = None,
    validation_cases: Sequence[Any] | None = None,
    names: Sequence[str] = (),
    explain: Callable[[Any, int], str] | None = None,
    aggregate: Aggregate = mean,
    clip: float | None = None,
    prior_weight: float = 1.0,
    every: int = 1,
    patience: int = 0,
    folder: str | Path | None = None,
    resume: bool = False,
    identity: str = "",
    mesh: Mesh | None = None,
) -> Fit:
    """Minimise ``loss(params, *arguments) -> ()`` over the leaves that ``spec`` frees.

    Data belong into ``arguments``: fits of one loss to other data of the same shapes then compile once. The best point
    is that of the validation if there is one, else of the loss, and the start counts. Ctrl-C ends the run with the best
    so far. A run of ``cases`` that is not finite is left out of the step and named in `Fit.aside`; parameters that fail
    fewer runs are better than any that fail more.

    Args:
        loss: objective; with ``cases`` of one run, ``loss(params, case, *arguments)``, one for all groups or one per
            group.
        spec: transforms of the free leaves, by dotted name.
        params: the start.
        steps: number of updates.
        optimizer: of optax, or a `tuning.fit.optimizers.Method`, whose steps another process does not trace again; None
            is Adam (`tuning.fit.optimizers.adam`).
        arguments: further arguments of the loss.
        validation: ``validation(params, *validation_arguments)``, of one run with ``validation_cases``.
        validation_arguments: its further arguments.
        progress: show a bar.
        cases: groups of runs, each with a leading axis; or a function of the step that makes such a list of the same
            shapes (new runs, noise or windows), of the step's number alone, so that a resumed job sees the same.
        validation_cases: groups of runs of the validation.
        names: of the runs of all groups, for messages.
        explain: ``explain(params, run)`` says why a run failed.
        aggregate: objective of all runs from those of each.
        clip: largest gradient norm of one run.
        prior_weight: weight of the spec's priors, 1 / (epochs) with a likelihood per epoch.
        every: steps between two validations; the last step has one, too.
        patience: validations without a better score after which the search ends; 0: it goes on.
        folder: for history.jsonl and a checkpoint after every step.
        resume: continue from the checkpoint, bit for bit.
        identity: of the job; a checkpoint of another one is refused.
        mesh: devices that share the runs.

    Returns:
        The best parameters with the history of the search.

    Raises:
        ValueError: the loss of the start is not finite, fewer than 0 steps, or less than one step between validations.
        CheckpointError: nothing usable to resume from.
    """
    if steps < 0:
        raise ValueError(f"steps must be 0 or more, got {steps}")
    if every < 1:
        raise ValueError(f"every must be 1 or more steps, got {every}")
    clear_caches_if_needed()
    optimizer = Method("adam", steps) if optimizer is None else optimizer
    raw = split(spec, params)
    spec, params = bound(spec, params)
    draw_state = cases if callable(cases) else None
    first = draw_state(0) if draw_state is not None else cases
    train = _job(loss, spec, params, arguments, first, aggregate, clip, prior_weight, mesh)
    judge = train
    if validation is not None:
        judge = _job(
            validation, spec, params, validation_arguments, validation_cases, aggregate, None, prior_weight, mesh
        )
    at = TrainState(raw, made(optimizer).init(raw), raw, math.inf, np.iinfo(int).max, 0)
    history = _History(folder, identity, list(names), explain, spec, params)
    if resume:
        at = history.reopen(at)
    at = at._replace(raw=distributed.replicate(at.raw, mesh), state=distributed.replicate(at.state, mesh))
    status = Status.ITERATION_LIMIT
    waited = 0
    bar = progress_bar(steps + 1, "step", progress, at.step)
    try:
        while at.step <= steps:
            if draw_state is not None and at.step:
                groups = tuple(distributed.share(group, mesh) for group in draw_state(at.step))
                train = (train[0], train[1]._replace(cases=groups))
                judge = judge if validation is not None else train
            due = validation is None or at.step % every == 0 or at.step == steps
            before = at.score
            at = _advance(at, train, judge if due else None, validation is not None, optimizer, history, bar)
            waited = 0 if at.score < before else waited + due
            if patience and waited >= patience:
                status = Status.STOPPED_EARLY
                break
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    finally:
        bar.close()
    return Fit(join(spec, at.best, params), at.score, history.rows, status, tuple(history.aside))


def _job(
    loss: Any,
    spec: Spec,
    params: Tree,
    arguments: Any,
    cases: Any,
    aggregate: Any,
    clip: Any,
    prior_weight: float,
    mesh: Any,
) -> tuple[Problem, Data]:
    """Return the static part and the arrays of a loss."""
    losses = (loss,) if callable(loss) else tuple(loss)
    items = tuple(spec.items())
    if cases is None:
        return Problem(losses, items, (), aggregate, clip, prior_weight), Data(params, arguments, (), jnp.ones(1))
    counts = tuple(len(jax.tree.leaves(group)[0]) for group in cases)
    losses = losses * len(counts) if len(losses) == 1 else losses
    if len(losses) != len(counts):
        raise ValueError(f"{len(losses)} losses for {len(counts)} groups of runs")
    problem = Problem(losses, items, counts, aggregate, clip, prior_weight, mesh)
    shared = tuple(distributed.share(group, mesh) for group in cases)
    params, arguments, weight = distributed.replicate((params, arguments, jnp.ones(sum(counts))), mesh)
    return problem, Data(params, arguments, shared, weight)


def _advance(
    at: TrainState,
    train: tuple[Problem, Data],
    judge: tuple[Problem, Data] | None,
    separate: bool,
    optimizer: Optimizer,
    history: "_History",
    bar: Any,
) -> TrainState:
    """One step: evaluate, note, keep the best where there is a ``judge``, update, save."""
    raw, state, value, norm, good = _step(train[0], optimizer, at.raw, at.state, train[1])
    score, fine = value, good
    if separate and judge is not None:
        score, fine = _score(judge[0], at.raw, judge[1])
    value, norm, score = (float(a) for a in (value, norm, score))
    good, fine = (np.atleast_1d(a) for a in (good, fine))
    if at.step == 0 and not np.isfinite(value):
        raise ValueError(f"the loss of the starting parameters is {value}")
    failed = int((~good).sum() + ((~fine).sum() if separate else 0))
    ranked = score if np.isfinite(score) and np.isfinite(value) else math.inf
    best = jax.tree.map(np.asarray, at.raw)
    row = {"step": at.step, "loss": value, "grad_norm": norm}
    if separate and judge is not None:
        row["validation"] = score
    if judge is not None and (at.step == 0 or (failed, ranked) < (at.failed, at.score)):
        at = at._replace(best=best, score=ranked, failed=failed)
    history.note(row, best, good)
    bar.set_postfix(loss=f"{value:.4g}", grad=f"{norm:.3g}", failed=failed, refresh=False)
    bar.update()
    at = at._replace(raw=raw, state=state, step=at.step + 1)
    history.save(at)
    return at


class _History:
    """The history in memory and on disk, the checkpoint, and which runs failed."""

    def __init__(self, folder: Any, identity: str, names: list[str], explain: Any, spec: Spec, params: Tree) -> None:
        self.folder = None if folder is None else Path(folder)
        self.identity, self.names, self.explain, self.spec, self.params = identity, names, explain, spec, params
        self.rows: list[Json] = []
        self.digest = hashlib.sha256()  # of the lines written so far
        self.aside: list[Json] = []

    def note(self, row: Json, raw: Tree, good: np.ndarray) -> None:
        """Complete the row of a step and write it."""
        known = {entry["index"] for entry in self.aside}
        for i in np.flatnonzero(~good).tolist() if good.size > 1 else []:
            if i not in known:
                name = self.names[i] if i < len(self.names) else f"run {i}"
                why = self.explain(join(self.spec, raw, self.params), i) if self.explain else "not finite"
                self.aside.append({"index": i, "run": name, "step": row["step"], "why": why})
        if good.size > 1 and not good.all():
            row["failed"] = int((~good).sum())
        row["params"] = {
            name: float(optax.tree.norm(raw[name]))
            if t.tree
            else np.asarray(t.forward(jnp.asarray(raw[name]))).tolist()
            for name, t in self.spec.items()
        }  # of a branch its norm
        self.rows.append(row)
        if self.folder is not None and distributed.writes():
            self.folder.mkdir(parents=True, exist_ok=True)
            line = json.dumps(row) + "\n"
            with open(self.folder / HISTORY, "a" if row["step"] else "w", encoding="utf-8") as file:
                file.write(line)
            self.digest.update(line.encode())

    def save(self, at: TrainState) -> None:
        """Write the checkpoint after a step."""
        if self.folder is not None and distributed.writes():
            head = {"score": at.score, "failed": at.failed, "step": at.step, "aside": self.aside,
                    "history": self.digest.hexdigest()}  # fmt: skip
            checkpoint.save(self.folder / LAST, (at.raw, at.state, at.best), head, self.identity)

    def reopen(self, at: TrainState) -> TrainState:
        """Return to the saved state; rows of the history that are later than it are dropped."""
        if self.folder is None:
            raise ValueError("resume needs a folder")
        found = checkpoint.load(self.folder / LAST, (at.raw, at.state, at.best), self.identity)
        head, step = found.head, found.head["step"]
        path = self.folder / HISTORY
        lines = path.read_bytes().splitlines(keepends=True)[:step] if path.exists() else []
        self.digest = hashlib.sha256(b"".join(lines))
        if len(lines) < step or self.digest.hexdigest() != head["history"]:
            raise checkpoint.CheckpointError(
                f"{path}: does not have the {step} steps of {LAST} as they were written; start without --resume"
            )
        self.rows = [json.loads(line) for line in lines]
        if distributed.writes():
            path.write_bytes(b"".join(lines))
        self.aside = head["aside"]
        raw, state, best = found.tree
        return TrainState(raw, state, best, head["score"], head["failed"], step)
