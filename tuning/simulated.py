"""Tuning over simulated runs of scenarios: training, validation and test runs share no random numbers."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis import metrics
from jaxnav.filters.catalogue import with_history
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import get, history_for
from jaxnav.filters.programs import stored
from jaxnav.filters.run import first_failure, prepare, require_params, run
from jaxnav.findings import finding
from jaxnav.maths import earth
from jaxnav.maths.units import TICK
from jaxnav.measurements import GNSS, clock_offset, counted_from
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import Simulated, simulate_runs
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError, Epoch, FilterError, Fix, Info, Json, Nav, Params
from tuning import likelihood
from tuning.fit import objectives
from tuning.fit.train import Fit
from tuning.fit.transforms import Spec, leaves, merged
from tuning.recordings.parts import MAX_ADDED_DELAY_S
from tuning.recordings.priors import spec_of
from tuning.recordings.report import MIN_WINDOWS, Trial, Tuned, channels, ratios, spread
from tuning.recordings.runs import Descent, Run, Truth, check_objective, descend, many
from tuning.recordings.validation import paired_gain

PARTS = {"training": Purpose.TRAIN, "validation": Purpose.VALIDATION, "test": Purpose.TEST}
"""The purposes of the runs, with separate keys."""


@partial(stored, static_argnums=(0,))
def runs_jit(filt: Filter, params: Params, nav: Nav, epochs: Epoch) -> Info:
    """Return the runs (B, E, ...) of parameters, starts and epochs with a leading axis each."""
    return jax.vmap(partial(run, filt))(params, nav, epochs)


class SimulatedRuns(NamedTuple):
    """The runs of a scenario."""

    name: str
    datasheet: Params  # that tuning starts from
    t: np.ndarray  # (E,) s, the end of each epoch
    runs: dict[str, Run]  # by part, each with a leading axis
    known: dict[str, float]  # simulated values, by leaf

    @property
    def fix(self) -> Fix:
        """Fixes of the test runs."""
        return self.runs["test"].epochs.fix

    @property
    def starts(self) -> np.ndarray:
        """(W,) end of each window, or of each run where there are none, s."""
        ends = [(np.asarray(r.ends), np.asarray(r.scored)) for r in self.runs.values()]
        of = [self.t[at][scored] if at.shape[1] else np.full(len(at), self.t[-1]) for at, scored in ends]
        return np.concatenate(of)

    @property
    def facts(self) -> Json:
        """Return the facts of the runs for metrics.json."""
        return {"runs": {part: int(r.keep.shape[0]) for part, r in self.runs.items()}}

    @property
    def windows_hidden(self) -> bool:
        """Are fixes hidden, so that drifts are scored?"""
        return self.runs["test"].ends.shape[1] > 0

    def needs(self, blocks: int) -> str:
        """Return the number of runs that an interval of so many blocks needs."""
        return f"{blocks} test runs: tune.test_runs"


def tune_simulated(
    scenarios: Sequence[Scenario],
    filt: Filter,
    params: Sequence[Params],
    how: Descent,
    *,
    free: Sequence[str] = ("noise", "timing", "rule"),
    prior_sd: Mapping[str, float] | None = None,
    priors: bool = True,
    counts: tuple[int, int, int] = (8, 4, 8),
    seed: int = 0,
    log: Callable[[str], None] = lambda line: None,
) -> Tuned:
    """Tune a filter's parameters by gradient over simulated runs, and judge them on others.

    Args:
        scenarios: the simulated cases; their runs count alike.
        filt: a filter of position and velocity.
        params: of each scenario; free parameters start at the first one's.
        how: objective and search; the method "scoring" maximises the innovations' likelihood.
        free: groups of `tuning.recordings.free.groups`, dotted leaves or their keys.
        prior_sd: priors by leaf, see `tuning.recordings.priors.spec_of`.
        priors: False leaves them out.
        counts: runs for training, validation and test, of each scenario.
        seed: of all runs.
        log: called with a line on each step.

    Raises:
        ConfigError: a name that is not known, or an objective that does not fit the scenarios.
        FilterError: the objective of the start is not finite, or a test run stops being finite.
    """
    for each in params:
        require_params(filt, each)
    reach = [
        history_for(p, s.imu_rate_hz, s.duration_s, MAX_ADDED_DELAY_S) for p, s in zip(params, scenarios, strict=True)
    ]
    filt = with_history(filt, max(reach))
    spec = spec_of(filt, params[0], free, prior_sd, priors)
    used = [_simulated(filt, s, p, counts, seed + i) for i, (s, p) in enumerate(zip(scenarios, params, strict=True))]
    windows = [u.windows_hidden for u in used]
    if any(windows) and not all(windows):
        raise ConfigError("tune.more: scenarios with outages and without: their errors are not of one kind")
    check_objective(how.objective, windows=all(windows))
    for u in used:
        log(f"simulated runs of {u.name}: " + ", ".join(f"{n} {part}" for part, n in u.facts["runs"].items()))
    log(f"free: {', '.join(spec)}")
    surface = likelihood.surface([_source(filt, u) for u in used], spec, params[0])
    ended = _search(filt, spec, used, surface, how, log)
    found = {"datasheet": params[0], "tuned": ended.params}
    scored = {name: [_scored(filt, merged(p, u.datasheet, leaves(spec)), u) for u in used] for name, p in found.items()}
    drift = {name: np.concatenate([e for s in rows for e in s.errors.values()]) for name, rows in scored.items()}
    parts = {
        part: np.concatenate([np.full(e.size, of == part) for s in scored["tuned"] for of, e in s.errors.items()])
        for part in PARTS
    }
    blocks = np.concatenate([1e6 * i + _blocks(r) for i, u in enumerate(used) for r in u.runs.values()])[parts["test"]]
    trials = {
        name: Trial(filt, p, drift[name], ratios(drift["datasheet"], drift[name], parts),
                    float(np.mean([s.nll for s in scored[name]])))
        for name, p in found.items()
    }  # fmt: skip
    moved = any(np.any(np.asarray(get(ended.params, leaf)) != np.asarray(get(params[0], leaf))) for leaf in spec)
    best, gain = "tuned" if moved else "datasheet", None
    if moved and np.unique(blocks).size >= MIN_WINDOWS:
        gain = paired_gain(drift["datasheet"][parts["test"]], drift["tuned"][parts["test"]], blocks)
    scores = {name: spread(off[parts["test"]]) for name, off in drift.items()}
    rows, findings = likelihood.rows(surface, spec, ended.params, params[0], used[0].known)
    findings += [finding("tune.aside", a["run"], step=a["step"], why=a["why"]) for a in ended.aside]
    nis = {name: channels([s.info for s in rows], [s.part for s in rows], GNSS) for name, rows in scored.items()}
    return Tuned(
        trials[best].params, [merged(trials[best].params, p, leaves(spec)) for p in params], filt, best,
        rows, trials, used, parts, int(np.unique(blocks).size), gain, scores, nis, spec, findings, ended.history,
        ended.status,
    )  # fmt: skip


# ---------------------------------------------------------------------------- the runs


def _simulated(filt: Filter, scenario: Scenario, params: Params, counts: tuple[int, ...], seed: int) -> SimulatedRuns:
    keys = [run_keys(seed, part, np.arange(n)) for part, n in zip(PARTS.values(), counts, strict=True)]
    sims = simulate_runs(jnp.concatenate(keys), scenario)  # at once: a scenario takes longer to compile than to run
    whole, edges = as_runs(filt, sims, params), np.cumsum((0, *counts))
    runs = {
        part: jax.tree.map(lambda x, a=a, b=b: x[a:b], whole)
        for part, a, b in zip(PARTS, edges[:-1], edges[1:], strict=True)
    }
    return SimulatedRuns(scenario.name, params, np.asarray(sims.truth.t[0]), runs, _known(scenario))


def as_runs(filt: Filter, sims: Simulated, params: Params) -> Run:
    """Return simulated runs (B, ...) with their outages as windows and their truth."""
    t = sims.truth.t[:, None]
    ends = jnp.sum(t <= sims.outages[:, :, 1:] + TICK, axis=-1) - 1
    keep = ~sims.hidden
    halfway = 0.5 * sims.truth.t[:, -1:]  # as of a recording, see `jaxnav.initialization.initialize.halfway`
    nav, true = counted_from(sims.initial, halfway[:, 0]), counted_from(sims.truth, halfway)
    whole, offset = jnp.ones_like(keep), clock_offset(params.mounting, true)[..., None]
    rate = jax.vmap(jax.vmap(lambda pos, vel: earth.move(pos, vel) - pos))(true.pos, true.vel)
    truth = Truth(true.pos + offset * rate, rate, whole)
    params = many(params, keep.shape[0])
    return Run(params, nav, prepare(filt, sims.epochs), ends, ends >= 0, keep, whole, truth)


def _known(scenario: Scenario) -> dict[str, float]:
    """Return the true values of parameters, by leaf."""
    late, grade, factor = scenario.gnss.latency_s, GRADES[scenario.imu.grade], scenario.imu.imu_noise_factor
    drive = factor * np.sqrt(2 / grade.tau)
    return {
        "noise.gyro": factor * grade.arw,
        "noise.accel": factor * grade.vrw,
        "states.gyro_bias.driving_noise": drive * grade.gyro_instability,
        "states.accel_bias.driving_noise": drive * grade.accel_instability,
        "measurements.position.latency": late,
        "measurements.velocity.latency": late,
    }


def _blocks(r: Run) -> np.ndarray:
    """Return the run of every window, or every run."""
    run_of = np.broadcast_to(np.arange(r.keep.shape[0])[:, None], r.ends.shape)
    return run_of[np.asarray(r.scored)] if r.ends.shape[1] else np.arange(r.keep.shape[0])


# ---------------------------------------------------------------------------- search and score


def _source(filt: Filter, u: SimulatedRuns) -> likelihood.Runs:
    """Return the likelihood's data of a scenario: its training runs, each a block."""
    r = u.runs["training"]
    block = np.broadcast_to(np.arange(r.keep.shape[0])[:, None], r.keep.shape)
    return likelihood.runs_of(filt, u.datasheet, r.nav, r.epochs, r.keep, block)


def _search(
    filt: Filter,
    spec: Spec,
    used: Sequence[SimulatedRuns],
    surface: likelihood.Surface,
    how: Descent,
    log: Callable[[str], None],
) -> Fit:
    start = used[0].datasheet
    if how.method == "scoring":
        note = lambda row: log(f"  {row['step']:3d}  {row['loss']:.6g}")
        return likelihood.maximise(surface, spec, start, how.steps, note)
    train, validation = ([u.runs[part] for u in used] for part in ("training", "validation"))
    names = [f"{u.name}, training run {i}" for u in used for i in range(u.facts["runs"]["training"])]
    return descend(filt, spec, start, train, validation, names, how, 1 / max(surface.epochs, 1))


class _Scored(NamedTuple):
    """A scenario's runs with some parameters."""

    errors: dict[str, np.ndarray]  # by part, m: horizontal, at the end of each window; RMS of runs without windows
    nll: float  # of an innovation of the validation runs
    info: Info  # (B, E, ...) of the test
    part: np.ndarray  # (E,) bool, epochs of the test


def _scored(filt: Filter, params: Params, u: SimulatedRuns) -> _Scored:
    """Run all parts of a scenario.

    Raises:
        FilterError: a run stopped being finite; names run and time.
    """
    errors, infos = {}, {}
    nav, epochs = jax.tree.map(lambda *a: jnp.concatenate(a), *((r.nav, r.epochs) for r in u.runs.values()))
    every = jax.device_get(runs_jit(filt, many(params, nav.t.shape[0]), nav, epochs))  # one program for all parts
    ends = np.cumsum([r.keep.shape[0] for r in u.runs.values()])
    for (part, r), end in zip(u.runs.items(), ends, strict=True):
        info = jax.tree.map(lambda a, end=end, n=r.keep.shape[0]: a[end - n : end], every)
        for i in range(r.keep.shape[0]):
            failure = first_failure(jax.tree.map(lambda a, i=i: a[i], info), info.nav.t[i])
            if failure:
                raise FilterError(f"{u.name}, {part} run {i}: {failure}")
        errors[part], infos[part] = errors_of(info, r), info
    validation = u.runs["validation"]
    nll = jax.vmap(objectives.innovation_nll)(infos["validation"], validation.keep)
    return _Scored(errors, float(np.mean(nll)), infos["test"], np.ones(u.runs["test"].keep.shape[1], bool))


def errors_of(info: Info, r: Run) -> np.ndarray:
    """Return horizontal errors (m) at the ends of the windows, or the RMS of every run where there are none."""
    if r.ends.shape[1]:
        return np.asarray(jax.vmap(objectives.outage_error)(info, r.ends))[np.asarray(r.scored)]
    assert r.truth is not None
    error = np.asarray(jax.vmap(jax.vmap(metrics.position_error))(info.nav, r.truth.lla))[..., :2]
    return np.sqrt(np.mean(np.sum(error**2, -1), -1))
