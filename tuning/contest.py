"""Filters tuned alike on the same simulated runs and scored on others.

Every filter starts from the datasheet and has the same steps of the same optimiser on the same runs. Free are factors
on the noise and the prior that each scenario's datasheet gives, so that one tuning serves scenarios with different
sensors, and the parameters of the filter's rule and feedback. The objective is the mean logarithm of the
position's RMS error over the runs: scenarios that are hard count no more than those that are easy.
"""

import sys
import time
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxnav.analysis import metrics, montecarlo
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import history_for, put
from jaxnav.filters.run import prepare, run
from jaxnav.maths import units
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import Scenario
from jaxnav.simulate.simulation import matched_params, simulate_runs
from jaxnav.types import ConfigError, Epoch, Json, Nav, Params, nearest
from tuning.fit.optimizers import adam
from tuning.fit.status import Status
from tuning.fit.train import fit
from tuning.fit.transforms import LOG, Spec, tied
from tuning.recordings.free import of_rule, step_of

REFERENCES = ("ekf9", "ekf15")  # always in: the Kalman filter without and with bias states
SCALES = ("measurements.position.scale", "measurements.velocity.scale")
CLIP = 1.0  # largest gradient norm of one run: a run of a chaotic filter must not drown the rest


class Kind(NamedTuple):
    """A type of scenario."""

    scenario: Scenario
    nominal: Params  # nominal parameters of every filter: datasheet, start, installation


class Plan(NamedTuple):
    """Budget of every filter."""

    trained: tuple[Kind, ...]
    unseen: tuple[Kind, ...]
    steps: int = 40  # updates of each filter
    rate: float = 0.1
    runs: tuple[int, int, int] = (8, 4, 8)  # training, validation, test
    seed: int = 0
    limit_m: float = 1000.0  # a horizontal error above this is a divergence, and counts as this
    cov_stride: int = 5


class ContestRuns(NamedTuple):
    """One run, or many with a leading axis."""

    nominal: Params
    start: Nav
    epochs: Epoch  # (E, ...)
    truth: Nav  # (E, ...)


class Scores(NamedTuple):
    """Results of a filter on the test: K kinds, training kinds first, of S runs each; the same for all filters."""

    rms: np.ndarray  # (K, S, 3) position m, velocity m/s, attitude deg; the limit where it diverged
    ok: np.ndarray  # (K, S) bool


class Entrant(NamedTuple):
    """One filter of the bake-off."""

    spec: Spec
    params: Params  # factors of noise and prior; rule and feedback as they are
    before: Scores
    after: Scores
    note: str  # why it was not tuned, or empty
    aside: tuple[Json, ...]  # runs that failed while tuning
    seconds: float


def filters(text: str) -> list[str]:
    """Return the filters that a list A,B,... names, or all of them; the references first.

    Raises:
        ConfigError: there is no such filter.
    """
    given = list(FILTERS) if text.strip() == "all" else [name.strip() for name in text.split(",")]
    for name in given:
        if name not in FILTERS:
            raise ConfigError(f"filter.name: no filter {name!r}: {nearest(name, FILTERS)}")
    return list(dict.fromkeys([*REFERENCES, *given]))


# ---------------------------------------------------------------------------- free parameters, and their effect


def spec_of(name: str) -> Spec:
    """Return the free parameters of a filter: its factors, and the leaves of its rule and feedback, dotted names."""
    entry = FILTERS[name]
    factors = ["noise.gyro", "noise.accel", "prior.attitude"]
    factors += [f"states.{state}.{leaf}" for leaf in ("driving_noise", "sd") for state in entry.states]
    spec = dict.fromkeys(factors, LOG)
    spec |= dict.fromkeys(SCALES, tied(LOG, (0, 0, 1)))  # level, vertical
    spec |= {leaf: step_of(leaf, name) for leaf in of_rule(name)}
    return spec | {f"feedback.{leaf}": LOG for leaf in getattr(entry.feedback_theta(), "_fields", ())}


def datasheet(name: str) -> Params:
    """Return the start: every factor one, rule and feedback as they come."""
    entry, one = FILTERS[name], jnp.ones(())
    nominal = matched_params(Scenario())
    params = jax.tree.map(lambda _: one, nominal)
    for leaf in SCALES:
        params = put(params, leaf, jnp.ones(3))
    return params._replace(rule=entry.theta(), feedback=entry.feedback_theta())


def applied(params: Params, nominal: Params) -> Params:
    """Return the parameters of a scenario's filter: the factors of ``params`` on the nominal ones."""
    times = partial(jax.tree.map, lambda factor, nominal: (factor * nominal.T).T)  # the rows of a root, if it is one
    scaled = {
        part: times(getattr(params, part), getattr(nominal, part))
        for part in ("noise", "prior", "states", "measurements")
    }
    return nominal._replace(**scaled, rule=params.rule, feedback=params.feedback)


@cache
def loss_of(filt: Filter) -> Callable[[Params, ContestRuns], jax.Array]:
    """Log of one run's RMS position error, inf where it stops being finite; one function for a filter."""
    return partial(_loss, filt)


def _loss(filt: Filter, params: Params, case: ContestRuns) -> jax.Array:
    info = run(filt, applied(params, case.nominal), case.start, case.epochs)
    error = jax.vmap(metrics.position_error)(info.nav, case.truth.pos)
    return jnp.where(info.ok.all(), 0.5 * jnp.log(jnp.mean(jnp.sum(error**2, axis=1)) + 1e-12), jnp.inf)


@partial(jax.jit, static_argnums=0)
def _runs(filt: Filter, params: Params, cases: ContestRuns, limit: jax.Array) -> montecarlo.Scores:
    """Return the scores (S, ...) of the runs of a case."""

    def one(case: ContestRuns) -> montecarlo.Scores:
        theta, none = applied(params, case.nominal), jnp.zeros((0, 2))
        return montecarlo.scored(filt, theta, case.start, case.epochs, case.truth, none, limit)[0]

    return jax.vmap(one)(cases)


# ---------------------------------------------------------------------------- the contest


def contest(
    names: Sequence[str], plan: Plan, progress: bool = False, mesh: Mesh | None = None
) -> tuple[dict[str, Entrant], str]:
    """Tune and score one filter after the other; also why it ended early, or an empty text.

    ``mesh``: devices that share the runs of each step of the tuning.

    Raises:
        KeyboardInterrupt: before the first filter was finished.
    """
    runs = draw(plan)
    found: dict[str, Entrant] = {}
    for i, name in enumerate(names):
        if progress:
            print(f"{name}, {i + 1} of {len(names)}", file=sys.stderr)
        try:
            entrant = _enter(name, plan, runs, progress, mesh)
        except KeyboardInterrupt:
            entrant = None
        if entrant is None:
            if not found:
                raise KeyboardInterrupt
            return found, f"after {len(found)} of {len(names)} filters"
        found[name] = entrant
    return found, ""


class Runs(NamedTuple):
    """Training, validation and test runs, a case with S runs for every kind."""

    train: list[ContestRuns]
    validation: list[ContestRuns]
    test: list[ContestRuns]  # of the kinds trained on first, then of the unseen


def draw(plan: Plan) -> Runs:
    """Simulate all runs; those of the same number share their random numbers over the kinds."""
    (train, validation, test), runs = plan.runs, Runs([], [], [])
    for i, kind in enumerate((*plan.trained, *plan.unseen)):
        counts = {Purpose.TRAIN: train, Purpose.VALIDATION: validation} if i < len(plan.trained) else {}
        counts[Purpose.TEST] = test
        keys = jnp.concatenate([run_keys(plan.seed, part, np.arange(n)) for part, n in counts.items()])
        sims = simulate_runs(keys, kind.scenario)  # all at once, since a scenario takes longer to compile than to run
        nominal = jax.tree.map(lambda a, n=len(keys): jnp.broadcast_to(a, (n, *jnp.shape(a))), kind.nominal)
        case, first = ContestRuns(nominal, sims.initial, sims.epochs, sims.truth), 0
        for part, n in counts.items():
            some = jax.tree.map(lambda a, first=first, n=n: a[first : first + n], case)
            {Purpose.TRAIN: runs.train, Purpose.VALIDATION: runs.validation, Purpose.TEST: runs.test}[part].append(some)
            first += n
    return runs


def _enter(name: str, plan: Plan, runs: Runs, progress: bool, mesh: Mesh | None) -> Entrant | None:
    """One filter tuned and scored; None where Ctrl-C cut its tuning short, which would not be the same budget."""
    clear_caches_if_needed()
    begin = time.perf_counter()
    filt, spec, start = filter_for(name, plan), spec_of(name), datasheet(name)
    before = scores_of(filt, start, runs.test, plan.limit_m)
    named = [f"{kind.scenario.name}, run {i}" for kind in plan.trained for i in range(plan.runs[0])]
    ready = lambda cases: [case._replace(epochs=prepare(filt, case.epochs)) for case in cases]
    groups, order = together(runs.train)
    tuned, note = start, ""
    aside: tuple[Json, ...] = ()
    try:
        done = fit(
            loss_of(filt), spec, start, plan.steps, adam(plan.steps, plan.rate, 10.0), validation=loss_of(filt),
            cases=ready(groups), validation_cases=ready(together(runs.validation)[0]), names=[named[i] for i in order],
            clip=CLIP, progress=progress, mesh=mesh,
        )  # fmt: skip
        if done.status is Status.INTERRUPTED:
            return None
        tuned, aside = done.params, done.aside
    except ValueError as error:  # every run of the start fails: it competes as it is
        note = f"not tuned: {error}"
    after = before if note else scores_of(filt, tuned, runs.test, plan.limit_m)
    return Entrant(spec, tuned, before, after, note, aside, time.perf_counter() - begin)


def filter_for(name: str, plan: Plan) -> Filter:
    """Return the filter that serves all scenarios of the plan: its history covers them."""
    kinds = (*plan.trained, *plan.unseen)
    history = max(history_for(k.nominal, k.scenario.imu_rate_hz, k.scenario.duration_s) for k in kinds)
    return build(name, cov_stride=plan.cov_stride, history=history)


def together(cases: list[ContestRuns]) -> tuple[list[ContestRuns], list[int]]:
    """Cases of equal shapes side by side, so that they share a program, and which run went where."""
    groups: dict[tuple[Any, ...], list[tuple[int, ContestRuns]]] = {}
    first = 0
    for case in cases:
        shapes = tuple(np.shape(a)[1:] for a in jax.tree.leaves(case))
        groups.setdefault(shapes, []).append((first, case))
        first += case.start.t.shape[0]
    order = [at + i for group in groups.values() for at, case in group for i in range(case.start.t.shape[0])]
    return [jax.tree.map(lambda *a: jnp.concatenate(a), *(c for _, c in group)) for group in groups.values()], order


def scores_of(filt: Filter, params: Params, test: list[ContestRuns], limit_m: float) -> Scores:
    """Return the errors of the test's runs; one that diverged counts as the limit."""
    found = [jax.device_get(_runs(filt, params, case, jnp.asarray(limit_m))) for case in test]
    size = lambda axes: np.linalg.norm(axes, axis=-1)
    rms = np.array([[size(s.position), size(s.velocity), np.hypot(s.tilt, s.yaw) / units.DEG] for s in found])
    rms, ok = np.moveaxis(rms, 1, -1), np.array([s.ok for s in found])
    ok &= np.isfinite(rms).all(-1)
    return Scores(np.where(ok[..., None], np.minimum(rms, limit_m), limit_m), ok)
