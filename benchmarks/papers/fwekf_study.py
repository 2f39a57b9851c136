"""The launch of the FWEKF paper in twelve cases: configuration of each filter, scores, tuning."""

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks.papers.learned import FREE as LEARNED
from benchmarks.papers.learned import learned, learned_params
from jaxnav.filters.core import Filter, make_filter
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import observer, poles
from jaxnav.filters.papers.fuzzy_combined import combined_params, fuzzy_combined
from jaxnav.filters.papers.fwekf import Fwekf, fwekf, fwekf_params, limits, printed_inputs
from jaxnav.filters.parameters import change
from jaxnav.filters.rule import Rule
from jaxnav.filters.rules import adaptive, fuzzy, robust
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.run import run
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import Simulated, matched_params, simulate
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Params
from tuning.fit.train import fit
from tuning.fit.transforms import IDENTITY, Spec

PRINTED = math.sqrt(0.001)  # "R in all sensors was selected as 0.001", read as a variance


class Case(NamedTuple):
    """A scenario, and the filter's assumed standard deviations."""

    scenario: str
    position_sd_m: float
    velocity_sd_mps: float
    what: str


CASES = {
    "C1": Case("fwekf_noise_free", PRINTED, PRINTED, "the paper's first: no noise, R = 0.001"),
    "C2": Case("fwekf", PRINTED, PRINTED, "the paper's second: noise, R = 0.001"),
    "C2m": Case("fwekf", 10.0, 0.2, "noise, R matched"),
    "C3": Case("fwekf", 100.0, 2.0, "R a hundred times too large"),
    "C4": Case("fwekf_jump", 10.0, 0.2, "fixes 30 m off east and north for 3 s"),
    "C4b": Case("fwekf_jump", PRINTED, PRINTED, "the same, R = 0.001"),
    "C4c": Case("fwekf_step", 10.0, 0.2, "fixes 30 m off from 30 s on"),
    "C5": Case("fwekf_attitude", 10.0, 0.2, "start 5 deg off, assumed 1 deg"),
    "C5b": Case("fwekf_attitude", PRINTED, PRINTED, "the same, R = 0.001"),
    "C6": Case("fwekf_bias", 10.0, 0.2, "IMU biases of 3e-4 rad/s and 3e-3 m/s^2"),
    "C6b": Case("fwekf_bias_10", 10.0, 0.2, "ten times these"),
    "C7": Case("fwekf_burst", 10.0, 0.2, "noise of the fixes times five for 7 s"),
}
TRAIN = ("C2", "C2m", "C3", "C4", "C6b", "C7")
UNSEEN = ("C4b", "C4c", "C5", "C5b", "C6")  # case types that no tuning saw
QUICK = ("C1", "C2", "C2m", "C3", "C4", "C4b")
ONE = ((0,),)  # the table of a constant weight


class Runs(NamedTuple):
    """One case: data of a filter and truth, (S, ...), and the assumed sd."""

    sim: Simulated
    position_sd: jax.Array  # ()
    velocity_sd: jax.Array  # ()


class Errors(NamedTuple):
    """Of the corrected INS unless it says filter; ENU, (E, 3)."""

    position: jax.Array  # m
    velocity: jax.Array  # m/s
    attitude: jax.Array  # rad
    filter_position: jax.Array  # m


@cache
def _simulator(scenario: str):
    return jax.jit(jax.vmap(partial(simulate, scenario=SCENARIOS[scenario])))


def draw(names: tuple[str, ...], key: jax.Array, runs: int) -> dict[str, Runs]:
    """``runs`` runs of each case; cases of one scenario share them, and all scenarios share their noise."""
    keys = jax.random.split(key, runs)
    made = {s: _simulator(s)(keys) for s in {CASES[name].scenario for name in names}}
    told = lambda name: (jnp.asarray(sd, float) for sd in CASES[name][1:3])
    return {name: Runs(made[CASES[name].scenario], *told(name)) for name in names}


@cache
def navigator(rule: Rule, states: tuple[str, ...] = ()) -> Filter:
    """The paper's strapdown and observer around a rule."""
    return make_filter(FRAMES["inertial"].propagate, error_model("inertial", states), rule, observer, 10)


def parameters(theta: Any) -> Params:
    """Noise and prior are those of the launch without faults, in every case; the observer's poles are at 1 s."""
    return matched_params(SCENARIOS["fwekf"], theta, poles())


def told(params: Params, runs: Runs) -> Params:
    """Return the parameters with the assumed sd of the fixes."""
    true = SCENARIOS["fwekf"].gnss
    scales = runs.position_sd / true.position_sd_m[0], runs.velocity_sd / true.velocity_sd_mps[0]
    names = ("measurements.position.scale", "measurements.velocity.scale")
    return change(params, dict(zip(names, scales, strict=True)))


def navigate(filt: Filter, params: Params, sim: Simulated) -> tuple[Errors, jax.Array]:
    """Errors of one run and its innovations (E, 6)."""
    info = run(filt, params, sim.initial, sim.epochs)
    left = info.x
    filter_position = jax.vmap(earth.enu_difference)(info.nav.pos, sim.truth.pos)
    q = jax.vmap(
        lambda x, q, true: rotations.multiply(rotations.multiply(rotations.exp(x), q), rotations.conjugate(true))
    )(left[:, 6:9], info.nav.q, sim.truth.q)
    velocity = info.nav.vel + left[:, 3:6] - sim.truth.vel
    return Errors(filter_position + left[:, :3], velocity, jax.vmap(rotations.log)(q), filter_position), info.nu


def moving(error: jax.Array) -> jax.Array:
    """The epochs of the motion, which is the second half of a run."""
    return error[error.shape[0] // 2 :]


def rms(error: jax.Array) -> jax.Array:
    """Root mean square of the length of an error (E, 3) over the motion."""
    return jnp.sqrt(jnp.mean(jnp.sum(moving(error) ** 2, axis=1)))


class Scores(NamedTuple):
    """Of each run, (S, ...); of the corrected INS over the motion unless it says otherwise."""

    position: jax.Array  # m, RMS
    velocity: jax.Array  # m/s, RMS
    attitude: jax.Array  # rad, RMS
    filter_position: jax.Array  # m, RMS of the filter's position
    axes: jax.Array  # (S, 3, 3) RMS of position, velocity and attitude by E, N and U
    aligned: jax.Array  # (S, 3) m, error at the end of the alignment
    end: jax.Array  # (S, 3) m, and of the motion


@partial(jax.jit, static_argnums=0)
def scores(filt: Filter, params: Params, runs: Runs) -> Scores:
    """Return the scores of each run."""

    def one(sim):
        e = navigate(filt, told(params, runs), sim)[0]
        axes = jnp.stack([jnp.sqrt(jnp.mean(moving(each) ** 2, 0)) for each in e[:3]])
        aligned = e.position[e.position.shape[0] // 2 - 1]
        return Scores(*(rms(each) for each in e), axes, aligned, e.position[-1])

    return jax.vmap(one)(runs.sim)


navigate_jit = jax.jit(navigate, static_argnums=0)


@cache
def objective(filt: Filter, runs: int, judged: tuple[str, ...] = ("position",)):
    """Mean over ``runs`` runs, chosen by the key, of the log RMS of these errors."""

    def loss(params: Params, chance: tuple[Runs, jax.Array]) -> jax.Array:
        case, key = chance
        count = case.sim.hidden.shape[0]
        chosen = jax.random.choice(key, count, (min(runs, count),), replace=False)
        some = jax.tree.map(lambda a: a[chosen], case.sim)

        def one(sim):
            errors = navigate(filt, told(params, case), sim)[0]
            return jnp.mean(jnp.log(jnp.stack([rms(getattr(errors, name)) for name in judged])))

        return jnp.mean(jax.vmap(one)(some))

    return loss


@cache
def printed() -> Rule:
    """Inputs of eqs. 31 and 32 in metres, and the smaller membership for "and", as the text has it."""
    return fwekf(conjunction=fuzzy.minimum, seen=printed_inputs)


def printed_params() -> Fwekf:
    """Table 1 with NS = 0.98; sets by the launch's fixes: means of 2 m and more, squares of 40 m^2 and more.

    The paper's Figure 3 has no figures on its axes. With R matched and all well the mean of 50 residuals is 0.8 m and
    their mean square 50 m^2, over the six channels.
    """
    answers, bounds = fwekf_params(0.9).system[2:]
    sets = fuzzy.system(
        ((0.0, 3.0, 10.0), (0.0, 100.0, 1000.0)), ((1.5, 2.0, 4.0), (50.0, 50.0, 500.0)), (1.0,), (0.9, 1.2)
    )
    return Fwekf(fuzzy.System(sets.centres, sets.widths, answers, bounds), limits())


def leaves(*systems: str) -> Spec:
    """The spec that frees the memberships and consequents of these systems."""
    return {f"rule.{s}.{leaf}": IDENTITY for s in systems for leaf in ("centres", "widths", "consequents")}


class Recipe(NamedTuple):
    """How a tuned rule comes about."""

    rule: Callable[[], Rule]
    start: Callable[[], Any]  # its parameters to start from
    free: Spec  # of it
    judged: tuple[str, ...] = ("position",)  # errors in the loss


RECIPES = {
    "fwekf_0.9_tuned": Recipe(fwekf, lambda: fwekf_params(0.9), leaves("system")),
    "fwekf_1.0_tuned": Recipe(fwekf, lambda: fwekf_params(1.0), leaves("system")),
    "fuzzy_combined_tuned": Recipe(fuzzy_combined, combined_params, leaves("fade", "adapt")),
    "fwekf_0.9_all_tuned": Recipe(
        fwekf, lambda: fwekf_params(0.9), leaves("system"), ("position", "velocity", "attitude")
    ),
    "learned": Recipe(learned, learned_params, LEARNED),
    "fwekf_printed_tuned": Recipe(printed, printed_params, leaves("system")),
}  # fmt: skip


def tune(recipe: Recipe, train: dict[str, Runs], key, steps: int, progress: bool):
    """The rule's parameters after ``steps`` steps on the training cases, and the history of the loss.

    One chaotic case can have a gradient of 1e14 where others are of order one: each is clipped by itself.
    """
    cases = jax.tree.map(lambda *a: jnp.stack(a), *train.values())
    training, held = jax.random.split(key)
    filt = navigator(recipe.rule())
    chances = lambda key: [(cases, jax.random.split(key, len(train)))]  # other runs of every case for another key
    found = fit(
        objective(filt, 8, recipe.judged), recipe.free, parameters(recipe.start()), steps,
        validation=objective(filt, 16, recipe.judged),
        cases=lambda step: chances(jax.random.fold_in(training, step)), validation_cases=chances(held),
        clip=1.0, every=20, progress=progress,
    )  # fmt: skip
    return found.params.rule, [row["loss"] for row in found.history]


def constant(a: float) -> Fwekf:
    """A weight that never changes."""
    system = fuzzy.system(((0.0,), (0.0,)), ((1.0,), (1.0,)), (1.5,), (1.0, 2.0))
    return Fwekf(system._replace(bounds=jnp.asarray((a, a), float)), limits())


def methods(tuned: dict[str, Any], quick: bool) -> dict[str, tuple[Filter, Any]]:
    """Name -> filter and the parameters of its rule."""
    weighted, plain = navigator(fwekf()), kalman()
    table = {
        "ekf": (navigator(plain), ()),
        "fwekf_hand": (weighted, fwekf_params()),
        "fwekf_0.9_hand": (weighted, fwekf_params(0.9)),
        "fwekf_min_hand": (navigator(fwekf(conjunction=fuzzy.minimum)), fwekf_params(0.9)),
        "fwekf_printed_hand": (navigator(printed()), printed_params()),
        "fwekf_printed_tuned": (navigator(printed()), tuned["fwekf_printed_tuned"]),
        "fwekf_0.9_all_tuned": (weighted, tuned["fwekf_0.9_all_tuned"]),
        "fwekf_0.9_tuned": (weighted, tuned["fwekf_0.9_tuned"]),
        "fwekf_1.0_tuned": (weighted, tuned["fwekf_1.0_tuned"]),
        "fuzzy_combined_hand": (navigator(fuzzy_combined()), combined_params()),
        "fuzzy_combined_tuned": (navigator(fuzzy_combined()), tuned["fuzzy_combined_tuned"]),
        "learned": (navigator(learned()), tuned["learned"]),
    }
    if quick:
        return table
    best = tuned["fwekf_1.0_tuned"]
    return table | {
        "fixed_1.02": (navigator(fwekf(50, ONE)), constant(1.02)),
        "fixed_1.005": (navigator(fwekf(50, ONE)), constant(1.005)),
        "sage_husa": (navigator(adaptive.sage_husa(plain)), adaptive.sage_husa_params(floor=1e-3)),
        "iae": (navigator(adaptive.iae(plain)), adaptive.iae_params(floor=1e-3)),
        "gate": (navigator(robust.gate(plain)), robust.gate_params(timeout=5.0)),
        "huber": (navigator(robust.huber(plain)), robust.huber_params()),
        "sage_husa+fwekf": (navigator(adaptive.sage_husa(fwekf())), adaptive.sage_husa_params(floor=1e-3, rule=best)),
        "iae+fwekf": (navigator(adaptive.iae(fwekf())), adaptive.iae_params(floor=1e-3, rule=best)),
        "gate+fwekf": (navigator(robust.gate(fwekf())), robust.gate_params(timeout=5.0, rule=best)),
    }


def navigate_first(runs: Runs, filt: Filter, theta: Any) -> tuple[Errors, jax.Array]:
    """`navigate` the first run of a case."""
    return navigate_jit(filt, told(parameters(theta), runs), jax.tree.map(lambda a: a[0], runs.sim))


RATES = (10, 50, 100)  # Hz, of the fixes; the paper names none


def by_rate(rate: int, key: jax.Array, runs: int) -> dict[str, dict[str, dict]]:
    """The paper's second case with fixes at this rate: claims of its text and figures, by the assumed R."""
    scenario = SCENARIOS["fwekf"]._replace(gnss_rate_hz=float(rate))
    sim = jax.jit(jax.vmap(partial(simulate, scenario=scenario)))(jax.random.split(key, runs))
    found: dict[str, dict[str, dict]] = {}
    for told_as, sd in (("printed", (PRINTED, PRINTED)), ("matched", (10.0, 0.2))):
        case = Runs(sim, *(jnp.asarray(s) for s in sd))
        table = {"ekf": (kalman(), ()), "fwekf_hand": (fwekf(), fwekf_params())}
        judged = {m: scores(navigator(rule), parameters(theta), case) for m, (rule, theta) in table.items()}
        rows: dict[str, dict] = {}
        for name, each in judged.items():
            at_20, at_40 = (np.linalg.norm(np.asarray(e), axis=1) for e in (each.aligned, each.end))
            rows[name] = {
                "median_m": float(np.median(at_20)), "below_half_metre": float(np.mean(at_20 < 0.5)),
                "end_median_m": float(np.median(at_40)), "end_below_half_metre": float(np.mean(at_40 < 0.5)),
                **in_units(jax.tree.map(np.asarray, each)),
            }  # fmt: skip
        rows["fwekf_hand"]["times_better"] = {
            key: rows["ekf"][key] / rows["fwekf_hand"][key] for key in ("position_m", "velocity_mps", "attitude_deg")
        }
        found[told_as] = rows
    return found


def in_units(each: Scores) -> dict:
    """Means over the runs."""
    by_axis = np.mean(each.axes, 0) / np.array([[1.0], [1.0], [DEG]])
    return {
        "position_m": float(np.mean(each.position)), "velocity_mps": float(np.mean(each.velocity)),
        "attitude_deg": float(np.mean(each.attitude)) / DEG, "filter_position_m": float(np.mean(each.filter_position)),
        "axes": dict(zip(("position_m", "velocity_mps", "attitude_deg"), by_axis.tolist(), strict=True)),
    }  # fmt: skip


STEPS = (2e-2, 1e-2, 5e-3, 2e-3, 1e-3, 1e-4, 1e-5)  # of differences: positions resolve 1e-9 m, C2 is chaotic
CENTRAL = np.array([4 / 5, -1 / 5, 4 / 105, -1 / 280])  # derivative from 1 to 4 steps on each side, eighth order


def _of_system(filt: Filter, params: Params, one: Runs, raw: jax.Array) -> jax.Array:
    """RMS of one run as a function of memberships and consequents (N,)."""
    system = params.rule.system
    centres, widths, consequents = ravel_pytree(system[:3])[1](raw)
    mine = fuzzy.System(centres, widths, consequents, system.bounds)
    params = params._replace(rule=params.rule._replace(system=mine))
    return rms(navigate(filt, told(params, one), one.sim)[0].position)


# two programs: as one they take five minutes to compile
_slope = jax.jit(jax.grad(_of_system, 3), static_argnums=0)
_values = jax.jit(jax.vmap(_of_system, (None, None, None, 0)), static_argnums=0)


def gradient_errors(test: dict[str, Runs]) -> dict[str, dict]:
    """Relative error of the whole gradient of each case's first run against differences, by their step."""
    filt, params, result = navigator(fwekf()), parameters(fwekf_params(0.9)), {}
    raw = np.asarray(ravel_pytree(params.rule.system[:3])[0])
    steps_of = np.concatenate([np.arange(1, 5), -np.arange(1, 5)])[:, None, None] * np.eye(raw.size)
    for name, runs in test.items():
        one = runs._replace(sim=jax.tree.map(lambda a: a[0], runs.sim))
        exact = np.asarray(_slope(filt, params, one, raw))
        size, by_step = np.linalg.norm(exact), []
        for h in STEPS:
            values = _values(filt, params, one, (raw + h * steps_of).reshape(-1, raw.size))
            up, down = np.asarray(values).reshape(2, 4, raw.size)
            by_step.append(float(np.linalg.norm(CENTRAL @ (up - down) / h - exact) / size))
        result[name] = {"norm": float(size), "best": min(by_step), "steps": STEPS, "by_step": by_step}
    return result
