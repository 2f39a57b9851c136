"""Monte Carlo: many simulated runs of a filter, in chunks of bounded memory, and their statistics.

A run is simulated, filtered and scored inside the compiled function from its key, so that only a few are in memory at a
time, and its result depends on nothing else: not on how many others there are, nor on their order.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxnav.analysis import metrics
from jaxnav.analysis.progress import bar as progress_bar
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.run import require_params, run
from jaxnav.maths.units import TICK
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import simulate, sizes
from jaxnav.states.motion import A, P, V
from jaxnav.types import Array, Epoch, Json, Nav, Params

QUANTITIES = ("horizontal", "vertical", "velocity", "tilt", "yaw")
"""Absolute errors kept over time: m, m, m/s, rad, rad; tilt is about both level axes."""
BINS = np.logspace(-8, 6, 14 * 24 + 1)  # of their histogram: 10 % wide


class Row(NamedTuple):
    """One epoch of one run."""

    position: jax.Array  # (3,) m, ENU, estimate minus truth
    velocity: jax.Array  # (3,) m/s, ENU
    attitude: jax.Array  # (3,) rad, rotation about E, N (tilts) and U (yaw)
    nees: jax.Array  # () of these nine
    nis: jax.Array  # ()
    dof: jax.Array  # () channels of the fix
    ok: jax.Array  # () bool


class Scores(NamedTuple):
    """Results of each run: arrays, leading axes (runs,) or (candidates, runs); errors over its finite epochs."""

    position: Array  # (..., 3) m RMS, ENU
    horizontal: Array  # (...,) m RMS
    vertical: Array  # (...,) m RMS
    velocity: Array  # (..., 3) m/s RMS, ENU
    tilt: Array  # (...,) rad RMS, about both level axes together
    yaw: Array  # (...,) rad RMS
    outage_ends: Array  # (..., outages) m, horizontal error at the end of each outage
    nees: Array  # (...,) mean over the epochs, of 9 degrees of freedom
    nis: Array  # (...,) mean over the fixes
    dof: Array  # (...,) channels in all fixes together
    nis_sum: Array  # (...,) NIS of all fixes together
    ok: Array  # (...,) bool: finite to the end, and never farther off than the limit
    failed: Array  # (...,) s, when it was not first; inf where never


class Course(NamedTuple):
    """Over the runs at each epoch, leading axes (E,) or (candidates, E); of finite runs."""

    t: np.ndarray  # (E,) s
    runs: np.ndarray  # (..., E) finite ones
    mean: np.ndarray  # (..., E, 5) of `QUANTITIES`
    sd: np.ndarray  # (..., E, 5)
    counts: np.ndarray  # (..., E, 5, bins) histogram over `BINS`, values outside counted in the outermost
    nees: np.ndarray  # (..., E) mean
    nis: np.ndarray  # (..., E) mean over the runs with a fix
    dof: np.ndarray  # (..., E) mean of those
    fixes: np.ndarray  # (..., E) how many they are


class MonteCarlo(NamedTuple):
    """Result of `monte_carlo`."""

    runs: np.ndarray  # (N,) numbers of the finished runs
    scores: Scores
    course: Course
    stopped: bool  # by Ctrl-C, before all were finished


# ---------------------------------------------------------------------------- one run, compiled


def _row(step: Step, truth: Nav) -> Row:
    info = step.info
    x = metrics.state_error(info.nav, truth)
    return Row(x[P], x[V], x[A], metrics.nees(x, info.P[:9, :9]), info.nis, info.valid.sum(), info.ok)


def _magnitudes(rows: Row) -> jax.Array:
    """Return the `QUANTITIES` (..., 5)."""
    p, v, a = rows.position, rows.velocity, rows.attitude
    level = [jnp.linalg.norm(x[..., :2], axis=-1) for x in (p, a)]
    return jnp.stack([level[0], abs(p[..., 2]), jnp.linalg.norm(v, axis=-1), level[1], abs(a[..., 2])], axis=-1)


def scored(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, truth: Nav, outages: jax.Array, limit: jax.Array
) -> tuple[Scores, Row]:
    """Run a filter against the truth, and return the scores of the run and its rows (E, ...).

    Args:
        filt: the filter.
        params: its parameters.
        nav: its start.
        epochs: (E, ...).
        truth: (E, ...) at the end of each epoch.
        outages: (W, 2) s.
        limit: m, horizontal error beyond which it has diverged.
    """
    rows = run(filt, params, nav, epochs, _row, truth)
    t, size, ok = truth.t, _magnitudes(rows), rows.ok
    count = jnp.maximum(ok.sum(), 1)
    mean = lambda a: jnp.where(ok.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0).sum(0) / count
    root = lambda a: jnp.sqrt(mean(a**2))
    ends = jnp.maximum(jnp.sum(t[:, None] <= outages[:, 1] + TICK, axis=0) - 1, 0)
    bad = ~ok | (size[:, 0] > limit)
    fixes, nis, dof = jnp.sum(rows.dof > 0), rows.nis.sum(), rows.dof.sum()
    overall = root(size)
    scores = Scores(
        root(rows.position), overall[0], overall[1], root(rows.velocity), overall[3], overall[4], size[ends, 0],
        mean(rows.nees), nis / jnp.maximum(fixes, 1), dof, nis, ~bad.any(),
        jnp.where(bad.any(), t[jnp.argmax(bad)], jnp.inf),
    )  # fmt: skip
    return scores, rows


@partial(jax.jit, static_argnums=(0, 1, 2))
def _chunk(filt: Filter, scenario: Scenario, many: bool, params: Params, limit: jax.Array, keys: jax.Array) -> Any:
    """Return scores, statistics over time, and times, of the runs with these keys (chunk,)."""

    def one(key: jax.Array) -> Any:
        sim = simulate(key, scenario)

        def candidate(params: Params) -> Any:
            scores, rows = scored(filt, params, sim.initial, sim.epochs, sim.truth, sim.outages, limit)
            return scores, (_magnitudes(rows), rows.nees, rows.nis, rows.dof, rows.ok)

        return *(jax.vmap(candidate)(params) if many else candidate(params)), sim.truth.t

    return jax.vmap(one)(keys)


# ---------------------------------------------------------------------------- all runs, on the host


class Sums(NamedTuple):
    """Sums over the runs, (C, E, ...)."""

    runs: np.ndarray
    first: np.ndarray  # (C, E, 5)
    second: np.ndarray
    counts: np.ndarray  # (C, E, 5, bins)
    nees: np.ndarray
    nis: np.ndarray
    dof: np.ndarray
    fixes: np.ndarray


class Progress(NamedTuple):
    """Results of the finished runs, on the host."""

    done: int  # runs
    t: np.ndarray  # (E,) s
    scores: Scores  # (N, C, ...)
    sums: Sums


def _sums(rows: tuple[np.ndarray, ...]) -> Sums:
    """Return sums over rows (N, C, E, ...)."""
    size, nees, nis, dof, ok = rows
    N, C, E, _ = size.shape
    kept = np.where(ok[..., None], size, 0.0)
    cell = np.clip(np.searchsorted(BINS, size, side="right") - 1, 0, BINS.size - 2)
    place = np.arange(C * E * 5).reshape(C, E, 5) * (BINS.size - 1) + cell
    shape = (C, E, 5, BINS.size - 1)
    counts = np.bincount(place[ok].ravel(), minlength=int(np.prod(shape))).reshape(shape).astype(np.int32)
    return Sums(
        ok.sum(0), kept.sum(0), (kept**2).sum(0), counts, np.where(ok, nees, 0.0).sum(0), nis.sum(0), dof.sum(0),
        (dof > 0).sum(0),
    )  # fmt: skip


def _shared(keys: jax.Array, mesh: Mesh | None) -> jax.Array:
    """Return the keys of a chunk among the devices."""
    if mesh is None:
        return keys
    raw = np.asarray(jax.random.key_data(keys))  # every process has all of them
    where = NamedSharding(mesh, PartitionSpec(*mesh.axis_names))
    placed = jax.make_array_from_callback(raw.shape, where, lambda i: raw[i])
    return jax.random.wrap_key_data(placed, impl=jax.random.key_impl(keys))


def _gathered(out: Any) -> Any:
    """On the host, of all processes."""
    if jax.process_count() == 1:
        return jax.device_get(out)
    return jax.tree.map(np.asarray, multihost_utils.process_allgather(out, tiled=True))


def _course(t: np.ndarray, s: Sums) -> Course:
    count, fixes = np.maximum(s.runs, 1), np.maximum(s.fixes, 1)
    mean = s.first / count[..., None]
    variance = s.second / count[..., None] - mean**2
    sd = np.sqrt(np.maximum(variance, 0.0) * (count / np.maximum(count - 1, 1))[..., None])
    return Course(t, s.runs, mean, sd, s.counts, s.nees / count, s.nis / fixes, s.dof / fixes, s.fixes)


def monte_carlo(
    filt: Filter,
    scenario: Scenario,
    params: Params,
    runs: int | Iterable[int],
    seed: int = 0,
    *,
    candidates: bool = False,
    chunk: int = 16,
    limit_m: float = np.inf,
    progress: bool = False,
    mesh: Mesh | None = None,
    resume: Progress | None = None,
    keep: Callable[[Progress], None] | None = None,
) -> MonteCarlo:
    """Simulate, filter and score runs of a scenario (for the channels of `jaxnav.measurements.GNSS`).

    ``runs``: how many, or their numbers; run i has `run_key` (seed, STUDY, i). ``candidates``: every leaf of
    ``params`` has a leading axis of candidates, which all see the same runs. ``chunk`` runs live at a time, side by
    side; the last chunk is padded. A run whose horizontal error exceeds ``limit_m`` counts as diverged. Ctrl-C keeps
    the chunks that are finished.

    ``mesh``: devices of one automatic axis, of one process or several, that share each chunk, as of
    `tuning.fit.distributed.mesh`; all processes end with the same.
    ``keep`` gets the results after each chunk, ``resume`` continues from them, bit for bit.

    Memory for an hour of IMU at 10 Hz and GNSS at 1 Hz: about 25 MB a run of the chunk, 1 MB more for each candidate,
    and 100 MB a candidate for the histograms.

    Raises:
        ValueError: no runs, params that are not the filter's, or a scenario that does not fit together.
        KeyboardInterrupt: before the first chunk was finished.
    """
    numbers = np.arange(runs) if isinstance(runs, int) else np.asarray(list(runs), int)
    if not numbers.size or chunk < 1:
        raise ValueError(f"runs and chunk must be at least 1, got {numbers.size} and {chunk}")
    if mesh is not None and chunk % mesh.size:
        raise ValueError(f"a chunk of {chunk} runs cannot be shared among {mesh.size} devices")
    require_params(filt, jax.tree.map(lambda a: a[0], params) if candidates else params)
    sizes(scenario)
    clear_caches_if_needed()
    keys = run_keys(seed, Purpose.STUDY, np.resize(numbers, -(-numbers.size // chunk) * chunk))
    limit, stopped = jnp.asarray(limit_m, float), False
    bar = progress_bar(numbers.size, "run", progress, resume.done if resume else 0)
    try:
        for begin in range(resume.done if resume else 0, numbers.size, chunk):
            part = _shared(keys[begin : begin + chunk], mesh)
            out = _gathered(_chunk(filt, scenario, candidates, params, limit, part))
            score, rows, (t, *_) = jax.tree.map(lambda a: a[: numbers.size - begin], out)  # noqa: B023
            if not candidates:
                score, rows = jax.tree.map(lambda a: a[:, None], (score, rows))
            more = _sums(rows)
            sums = more if resume is None else Sums(*map(np.add, resume.sums, more))
            scores = score if resume is None else jax.tree.map(lambda *a: np.concatenate(a), resume.scores, score)
            resume = Progress(begin + len(score.ok), t, scores, sums)
            if keep is not None:
                keep(resume)
            bar.update(len(score.ok))
    except KeyboardInterrupt:
        if resume is None:
            raise
        stopped = True
    bar.close()
    assert resume is not None  # at least one chunk is finished
    found = jax.tree.map(lambda a: np.moveaxis(a, 0, 1), resume.scores)
    course = _course(resume.t, resume.sums)
    if not candidates:
        found = jax.tree.map(lambda a: a[0], found)
        course = Course(course.t, *(a[0] for a in course[1:]))
    return MonteCarlo(numbers[: found.ok.shape[-1]], found, course, stopped)


# ---------------------------------------------------------------------------- statistics over all runs


def percentile(course: Course, q: float) -> np.ndarray:
    """Percentile q of each of `QUANTITIES` at each epoch, (..., E, 5), within a bin of the histogram (10 %)."""
    share = np.cumsum(course.counts, axis=-1)
    rank = q / 100 * share[..., -1:]
    cell = np.argmax(share >= np.maximum(rank, 1e-9), axis=-1)[..., None]
    inside = np.take_along_axis(course.counts, cell, -1)
    part = 1 - (np.take_along_axis(share, cell, -1) - rank) / np.maximum(inside, 1)
    return (BINS[cell] * (BINS[cell + 1] / BINS[cell]) ** part)[..., 0]


def summary(found: MonteCarlo, probability: float = 0.95) -> Json:
    """Plain numbers of one candidate: each score over the runs, who diverged, and consistency with chi-square bounds.

    Statistics are over the runs that did not diverge, percentiles of them exact. Angles in degrees. ``anees`` is per
    degree of freedom, at the last epoch and as the share of epochs with a mean over the runs inside its bounds: in
    time NEES is correlated, so that its mean over time has none. ``anis`` is of all fixes, white if all is consistent.
    """
    s, c = found.scores, found.course
    good = s.ok
    columns = {
        "horizontal_m": s.horizontal,
        "vertical_m": s.vertical,
        "velocity_mps": np.linalg.norm(s.velocity, axis=-1),
        "tilt_deg": np.degrees(s.tilt),
        "yaw_deg": np.degrees(s.yaw),
        **{f"outage_{i}_end_m": a for i, a in enumerate(s.outage_ends.T)},
    }
    diverged = [{"run": int(r), "t_s": float(t)} for r, t in zip(found.runs[~good], s.failed[~good], strict=True)]
    N, dof = int(good.sum()), int(s.dof[good].sum())
    about: Json = {"runs": int(good.size), "diverged": diverged}
    if not N:
        return about
    about["scores"] = {name: _statistics(a[good]) for name, a in columns.items()}
    all_of = lambda n: np.array(metrics.chi2_bounds(9 * n, 1, probability)) / (9 * n)
    bounds = {n: all_of(int(n)) for n in np.unique(c.runs[c.runs > 0])}
    inside = [bounds[n][0] <= m / 9 <= bounds[n][1] for n, m in zip(c.runs, c.nees) if n]
    about["anees"] = {
        "last": float(c.nees[-1] / 9),
        "bounds": bounds[c.runs[-1]].tolist() if c.runs[-1] else None,
        "mean": float(s.nees[good].mean() / 9),
        "share_inside": float(np.mean(inside)),
    }
    if dof:
        low, high = metrics.chi2_bounds(dof, 1, probability)
        about["anis"] = {"mean": float(s.nis_sum[good].sum() / dof), "bounds": [low / dof, high / dof]}
    return about


def _statistics(a: np.ndarray) -> dict[str, float]:
    q = np.percentile(a, [5, 50, 95])
    sd = float(a.std(ddof=1)) if a.size > 1 else float("nan")
    return {"mean": float(a.mean()), "sd": sd, "p5": float(q[0]), "median": float(q[1]), "p95": float(q[2])}
