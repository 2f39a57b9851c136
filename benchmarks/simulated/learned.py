"""Learned parts: the sd of fixes by a network against rules made by hand; constraints of recorded drives.

Simulated: a receiver is up to eight times worse in turns, which it does not state, and six times worse between
buildings, with slow errors, where it states half more. `mlp_noise` learns that from 32 runs; rules of the catalogue get
the same runs, the same loss and the same number of steps for their own parameters and both scales of the stated sd.
Judged are 64 runs that none has seen.
"""

import time
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import bootstrap

from benchmarks.common import options, write_json
from benchmarks.recordings import dead_reckoning
from jaxnav.analysis import metrics
from jaxnav.analysis.tables import table
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run
from jaxnav.maths import earth
from jaxnav.maths.interpolation import columns_at
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.processes import gauss_markov
from jaxnav.simulate.scenarios import URBAN_SHORT, Scenario
from jaxnav.simulate.simulation import Simulated, matched_params, simulate_runs, to_recording
from jaxnav.types import Params
from tuning.fit.optimizers import adam
from tuning.fit.train import fit
from tuning.fit.transforms import LOG, TRANSFORMS, TREE
from tuning.solving.solve import Solved, solve

SCENARIO: Scenario = URBAN_SHORT._replace(
    name="doubtful", duration_s=120.0, gnss=URBAN_SHORT.gnss._replace(outages_s=())
)
RULES = ("ekf15", "ekf15_student", "ekf15_huber", "ekf15_gate", "ekf15_iae", "ekf15_sage_husa", "fwekf15",
         "ekf15_receiver")  # fmt: skip
QUICK = ("ekf15", "ekf15_student", "ekf15_gate", "fwekf15")
FIXED = ("ekf15_receiver",)  # as it is: a gradient through its fourteen filters takes minutes to compile
LEARNED = "mlp_noise"
TURN, MOST_IN_TURNS = (0.12, 0.03), 8.0  # rad/s where it becomes worse, and how fast; times of the stated sd
BUILDINGS, IN_THEM, STATED, TAU_S = 3, 6.0, 1.5, 4.0  # intervals of 10 to 20 s; times of the sd; what is stated of it
SETTLED_S = 20.0  # s, before which errors are those of the start


@partial(jax.jit, static_argnums=0)
def doubtful(scenario: Scenario, keys: jax.Array, sims: Simulated) -> Simulated:
    """Return the runs with fixes that are worse in turns and between buildings."""

    def one(key: jax.Array, sim: Simulated) -> Simulated:
        fix, t = sim.epochs.fix, sim.truth.t
        first, length, white, slow = jax.random.split(key, 4)
        rate = jnp.abs(sim.epochs.imu.gyro[..., 2].mean(1))
        in_turns = 1 + (MOST_IN_TURNS - 1) * jax.nn.sigmoid((rate - TURN[0]) / TURN[1])
        begin = jax.random.uniform(first, (BUILDINGS,), minval=SETTLED_S, maxval=scenario.duration_s - 20.0)
        end = begin + jax.random.uniform(length, (BUILDINGS,), minval=10.0, maxval=20.0)
        between = ((t[:, None] > begin) & (t[:, None] <= end)).any(1)
        step = 1 / scenario.gnss_rate_hz
        drawn = jnp.sqrt(in_turns**2 - 1)[:, None] * jax.random.normal(white, (t.size, 6))
        drawn += jnp.where(between, jnp.sqrt(IN_THEM**2 - 1), 0.0)[:, None] * gauss_markov(
            jax.random.normal(slow, (t.size, 6)), step, TAU_S
        )
        off = drawn * fix.sd
        value = jnp.concatenate([jax.vmap(earth.move)(fix.value[:, :3], off[:, :3]), fix.value[:, 3:] + off[:, 3:]], 1)
        sd = fix.sd * jnp.where(between, STATED, 1.0)[:, None]
        return sim._replace(epochs=sim.epochs._replace(fix=fix._replace(value=value, sd=sd)))

    return jax.vmap(one)(keys, sims)


def drawn(purpose: Purpose, runs: int, seed: int) -> Simulated:
    """Return runs (B, ...) of the scenario."""
    keys = run_keys(seed, purpose, np.arange(runs))
    return doubtful(SCENARIO, keys, simulate_runs(keys, SCENARIO))


def error(filt: Filter, params: Params, sim: Simulated) -> jax.Array:
    """Return the RMS horizontal error of one run, m, ()."""
    info = run(filt, params, sim.initial, sim.epochs)
    off = jax.vmap(metrics.position_error)(info.nav, sim.truth.pos)[:, :2]
    keep = sim.truth.t > SETTLED_S
    mean = jnp.where(keep[:, None], off**2, 0.0).sum() / keep.sum()
    return jnp.where(info.ok.all(), jnp.sqrt(mean + 1e-12), jnp.inf)


@cache
def errors(filt: Filter):
    """Return `error` of many runs, jitted."""
    return jax.jit(jax.vmap(partial(error, filt), (None, 0)))


def trained(name: str, train: Simulated, validation: Simulated, steps: int) -> tuple[Filter, Params]:
    """Return a filter with the parameters of its best step on the validation's runs."""
    learned = name == LEARNED
    filt = build("ekf15" if learned else name, cov_stride=5, adapter=LEARNED if learned else "")
    own = filt.params("consumer")
    params = matched_params(SCENARIO)._replace(rule=own.rule, feedback=own.feedback, adapter=own.adapter)
    if name in FIXED:
        return filt, params
    scales = {f"measurements.{stream}.scale": LOG for stream in ("position", "velocity")}
    free = {"adapter": TREE} if learned else {f"rule.{k}": TRANSFORMS[v] for k, v in FILTERS[name].tunable.items()}
    loss = partial(error, filt)
    found = fit(
        loss, scales | free, params, steps, adam(steps, 0.03), cases=[train], validation=loss,
        validation_cases=[validation], every=5, progress=True,
    )  # fmt: skip
    return filt, found.params


def interval(learned: np.ndarray, rule: np.ndarray, seed: int) -> tuple[float, tuple[float, float]]:
    """Return the ratio of medians of paired runs and its 95 % interval by 2,000 draws of runs."""
    ratio = lambda a, b, axis=-1: np.median(a, axis) / np.median(b, axis)
    found = bootstrap(
        (learned, rule), ratio, n_resamples=2000, paired=True, method="percentile", rng=np.random.default_rng(seed)
    )
    return float(ratio(learned, rule)), tuple(map(float, found.confidence_interval))


def simulated(rules: tuple[str, ...], runs: int, steps: int, seed: int) -> tuple[dict, Any]:
    """Return median errors on unseen runs with the ratio of the network's to the best rule's, and its weights."""
    train, validation = (drawn(p, runs, seed) for p in (Purpose.TRAIN, Purpose.VALIDATION))
    test, found = drawn(Purpose.TEST, 64, seed), {}
    for name in (*rules, LEARNED):
        begin = time.perf_counter()
        filt, params = trained(name, train, validation, steps)
        found[name] = np.asarray(errors(filt)(params, test))
        print(f"{name:16} {np.median(found[name]):6.3f} m, {time.perf_counter() - begin:.0f} s", flush=True)
    best = min(rules, key=lambda name: float(np.median(found[name])))
    ratio, bounds = interval(found[LEARNED], found[best], seed)
    medians = {name: float(np.median(e)) for name, e in found.items()}
    about = {"ratio": ratio, "interval": bounds, "best": best, "median_m": medians, "runs": runs, "steps": steps}
    return about, params.adapter


def solving(weights, count: int, seed: int) -> dict:
    """Return RMS horizontal errors of `solve` on unseen runs of five minutes, without the network and with it, m."""
    scenario = SCENARIO._replace(duration_s=300.0)
    keys = run_keys(seed, Purpose.SINGLE, np.arange(count))
    sims, found = doubtful(scenario, keys, simulate_runs(keys, scenario)), {}
    for adapter in ("", LEARNED):
        datasheet = lambda filt, own=adapter: filt.params("consumer")._replace(adapter=weights if own else ())
        found[adapter or "without"] = [
            _delivered(solve(to_recording(jax.tree.map(lambda a, i=i: a[i], sims), scenario), datasheet,
                             adapter=adapter, fast=True))
            for i in range(count)
        ]  # fmt: skip
    ratios = np.array(found[LEARNED]) / np.array(found["without"])
    return {"m": found, "median_ratio": float(np.median(ratios))}


def _delivered(found: Solved) -> float:
    """Return the RMS horizontal error of a delivered solution, m."""
    sol, truth = found.solution, found.solution.recording.truth
    there = columns_at(sol.t, truth.t, truth.lla)
    off = np.asarray(jax.vmap(earth.enu_difference)(jnp.asarray(sol.lla), jnp.asarray(there)))
    return float(np.sqrt(np.mean((off[sol.t > SETTLED_S, :2] ** 2).sum(1))))


def cost(runs: int, seed: int) -> float:
    """Return the time of a batch with the network over that without it, the median of pairs by turns."""
    sims = drawn(Purpose.TEST, runs, seed)
    taken: list[list[float]] = [[], []]
    filters = [build("ekf15", cov_stride=5, adapter=adapter) for adapter in ("", LEARNED)]
    all_params = [matched_params(SCENARIO)._replace(adapter=filt.params("consumer").adapter) for filt in filters]
    for _ in range(8):
        for k, (filt, params) in enumerate(zip(filters, all_params, strict=True)):
            begin = time.perf_counter()
            errors(filt)(params, sims).block_until_ready()
            taken[k].append(time.perf_counter() - begin)
    plain, learned = (np.array(each[1:]) for each in taken)
    return float(np.median(learned / plain))


def main(argv: list[str]) -> None:
    """Run the studies; ``--quick`` has fewer rules, runs, steps and recordings."""
    parser = options("learned", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="four rules, 16 runs, 40 steps, two recordings")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=("simulated", "recorded", "cost"), help="one of the studies")
    args = parser.parse_args(argv)
    result: dict = {"seed": args.seed}
    if args.only in (None, "simulated"):
        runs, steps = (16, 40) if args.quick else (32, 80)
        of, weights = simulated(QUICK if args.quick else RULES, runs, steps, args.seed)
        result["simulated"] = of
        print(table(["filter", "median error, m"], [[n, f"{m:.3f}"] for n, m in of["median_m"].items()]))
        low, high = of["interval"]
        print(f"network over {of['best']}: {of['ratio']:.2f} ({low:.2f} to {high:.2f}, 95 %)")
        result["solve"] = solving(weights, 2 if args.quick else 6, args.seed)
        print(f"solve with the network over without it: {result['solve']['median_ratio']:.2f} in the median")
    if args.only in (None, "cost"):
        result["cost"] = cost(64 if args.quick else 256, args.seed)
        print(f"a batch with the network takes {result['cost']:.2f} times as long")
    if args.only in (None, "recorded"):
        result["recorded"] = dead_reckoning.study(args.quick)
        print(f"drift at 60 s over that of a constant sd: {result['recorded']['median_ratio']:.2f} in the median")
    write_json(args.json, result)
