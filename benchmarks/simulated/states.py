"""Optional error states: is a filter that has them consistent, and one that lacks them not?

Simulated urban drives whose sensors have the errors; NEES of all states at the last epoch, over runs that are
independent, so that the mean has chi-square bounds. Errors of a state are pooled over runs and axes.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri

from benchmarks.common import options, write_json
from jaxnav.analysis import metrics
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.parameters import datasheet_states
from jaxnav.filters.run import run
from jaxnav.maths import earth
from jaxnav.measurements import GNSS
from jaxnav.simulate.processes import gauss_markov
from jaxnav.simulate.scenarios import SCENARIOS, Scenario
from jaxnav.simulate.simulation import Simulated, matched_params, simulate
from jaxnav.states.grades import GRADES
from jaxnav.states.table import STATES
from jaxnav.types import Fix, Nav, Params

STRIDE, CHUNK = 10, 32
BAROMETER_SD, BAROMETER_KEY, SLOW_KEY = 0.5, 7, 8  # m; folded into a run's key


class Final(NamedTuple):
    """The end of one run."""

    nees: jax.Array  # () of all states
    error: jax.Array  # (n,) estimate minus truth
    sd: jax.Array  # (n,)
    ok: jax.Array  # () bool


def knowing(params: Params, scenario: Scenario, filt: Filter) -> Params:
    """The parameters with what the rows of `STATES` believe of the filter's further states."""
    names = [name for name in filt.model.states if name not in params.states]
    return params._replace(states=params.states | datasheet_states(GRADES[scenario.imu.grade], names))


def final(filt: Filter, step: Step, truth: Nav) -> Final:
    """Of an epoch's record: error and consistency of every state of the filter."""
    info = step.info
    x = metrics.state_error(info.nav, truth, filt.model.states)
    return Final(metrics.nees(x, info.P), x, jnp.sqrt(jnp.diag(info.P)), info.ok)


def with_barometer(sim: Simulated, key: jax.Array) -> Simulated:
    """The run with a barometer at every epoch, its bias as the row of `STATES` believes; outages do not hide it."""
    first, walk, noise = (jax.random.normal(k, sim.truth.t.shape, float) for k in jax.random.split(key, 3))
    believed, interval = STATES["barometer_bias"].defaults, sim.truth.t[1] - sim.truth.t[0]
    bias = believed.sd * first[0] + believed.drive * jnp.sqrt(interval) * jnp.cumsum(walk)
    value = sim.truth.pos[:, 2] + bias + BAROMETER_SD * noise
    column = lambda a, fill: jnp.concatenate([a, jnp.full_like(a[:, :1], fill)], 1)
    f = sim.epochs.fix
    fix = Fix(jnp.concatenate([f.value, value[:, None]], 1), column(f.sd, BAROMETER_SD), column(f.corr, 0.0),
              column(f.valid, True))  # fmt: skip
    truth = sim.truth._replace(errors=sim.truth.errors | {"barometer_bias": bias[:, None]})
    return sim._replace(epochs=sim.epochs._replace(fix=fix), truth=truth)


def with_slow_fixes(sim: Simulated, key: jax.Array) -> Simulated:
    """The run with an error of its fixes as the row of `STATES` believes, minutes long."""
    believed, interval = STATES["gnss_position_error"].defaults, sim.truth.t[1] - sim.truth.t[0]
    error = believed.sd * gauss_markov(jax.random.normal(key, (sim.truth.t.size, 3), float), interval, believed.tau)
    f = sim.epochs.fix
    moved = jax.vmap(earth.move)(f.value[:, :3], error)
    fix = f._replace(value=jnp.concatenate([moved, f.value[:, 3:]], 1))
    truth = sim.truth._replace(errors=sim.truth.errors | {"gnss_position_error": error})
    return sim._replace(epochs=sim.epochs._replace(fix=fix), truth=truth)


@partial(jax.jit, static_argnums=(0, 1, 4))
def runs_of(filt: Filter, scenario: Scenario, params: Params, keys: jax.Array, slow: bool) -> Final:
    """The ends of the runs with these keys."""

    def one(key):
        sim = simulate(scenario, key)
        if "barometer" in filt.model.measurements:
            sim = with_barometer(sim, jax.random.fold_in(key, BAROMETER_KEY))
        if slow:
            sim = with_slow_fixes(sim, jax.random.fold_in(key, SLOW_KEY))
        rows = run(filt, params, sim.initial, sim.epochs, partial(final, filt), sim.truth)
        return jax.tree.map(lambda a: a[-1], rows)

    return jax.vmap(one)(keys)


def scored(filt: Filter, scenario: Scenario, runs: int, seed: int, slow: bool = False) -> Final:
    """All runs, some at a time."""
    params = knowing(matched_params(scenario), scenario, filt)
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(np.arange(runs))
    parts = [jax.device_get(runs_of(filt, scenario, params, keys[i : i + CHUNK], slow)) for i in range(0, runs, CHUNK)]
    found = jax.tree.map(lambda *a: np.concatenate(a), *parts)
    if not found.ok.all():
        raise SystemExit(f"{(~found.ok).sum()} of {runs} runs stopped being finite")
    return found


def anees(found: Final) -> float:
    """Mean NEES per degree of freedom."""
    return float(found.nees.mean() / found.error.shape[1])


def bounds(n: int, runs: int) -> list[float]:
    """95 % bounds of `anees`."""
    return (np.array(metrics.chi2_bounds(n, runs)) / n).tolist()


def inside(found: Final, columns: slice) -> float:
    """Share of errors inside their own 95 % interval, pooled over runs and axes."""
    return float(np.mean(np.abs(found.error[:, columns]) <= ndtri(0.975) * found.sd[:, columns]))


def scale(runs: int, seed: int) -> dict[str, Any]:
    """Scale errors of 3,000 ppm: 21 states against 15."""
    urban = SCENARIOS["urban"]
    scenario = urban._replace(imu=urban.imu._replace(gyro_scale_sd_ppm=3000.0, accel_scale_sd_ppm=3000.0))
    with_them = scored(build("ekf15", cov_stride=STRIDE, states=("gyro_scale", "accel_scale")), scenario, runs, seed)
    without = scored(build("ekf15", cov_stride=STRIDE), scenario, runs, seed)
    return {
        "anees_21": anees(with_them), "anees_15": anees(without), "bounds": bounds(21, runs),
        "inside": inside(with_them, slice(15, 21)), "per_run_21": with_them.nees, "per_run_15": without.nees,
    }  # fmt: skip


def barometer(runs: int, seed: int) -> dict[str, Any]:
    """A barometer whose bias walks: 16 states against 15 that take it for the height, and against none."""
    urban = SCENARIOS["urban"]
    scenario = urban._replace(duration_s=urban.gnss.outages_s[-1][1])  # ends where the last outage does
    channels = (*GNSS, "barometer")
    with_it = scored(build("ekf15", channels, STRIDE, states=("barometer_bias",)), scenario, runs, seed)
    without = scored(build("ekf15", channels, STRIDE), scenario, runs, seed)
    blind = scored(build("ekf15", cov_stride=STRIDE), scenario, runs, seed)
    return {
        "anees_16": anees(with_it), "anees_15": anees(without), "bounds": bounds(16, runs),
        "inside": inside(with_it, slice(15, 16)), "height_rms_m": float(metrics.rms(with_it.error[:, 2])),
        "height_rms_without_m": float(metrics.rms(blind.error[:, 2])),
        "per_run_16": with_it.nees, "per_run_15": without.nees,
    }  # fmt: skip


def receiver(runs: int, seed: int) -> dict[str, Any]:
    """Fixes with an error of minutes: 18 states against 15 that take it for the way, between and at their fixes."""
    urban = SCENARIOS["urban"]
    with_it = scored(build("ekf15", cov_stride=STRIDE, states=("gnss_position_error",)), urban, runs, seed, True)
    without = scored(build("ekf15", cov_stride=STRIDE), urban, runs, seed, True)
    level = lambda found: float(np.sqrt(np.mean(found.error[:, :2] ** 2)))
    return {
        "anees_18": anees(with_it), "anees_15": anees(without), "bounds": bounds(18, runs),
        "inside": inside(with_it, slice(15, 18)), "horizontal_rms_m": level(with_it),
        "horizontal_rms_without_m": level(without), "per_run_18": with_it.nees, "per_run_15": without.nees,
    }  # fmt: skip


STUDIES = {"scale": scale, "barometer": barometer, "receiver": receiver}


def main(argv: Sequence[str] | None = None) -> int:
    """Every study, a line each."""
    parser = options("states", __doc__ or "")
    parser.add_argument("--runs", type=int, default=128, help="default 128")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    args: argparse.Namespace = parser.parse_args(argv)
    found = {name: study(args.runs, args.seed) for name, study in STUDIES.items()}
    for name, row in found.items():
        print(name, {k: np.round(v, 3).tolist() for k, v in row.items() if not k.startswith("per_run")})
    write_json(args.json, {"runs": args.runs, "seed": args.seed} | found)
    return 0
