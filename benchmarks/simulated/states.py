"""Optional error states: is a filter that has them consistent, and one that lacks them not?

Simulated urban drives with sensors that have the errors; NEES of all states at the last epoch, over runs that are
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
from jaxnav.measurements import GNSS
from jaxnav.simulate.readings import with_sensor, with_states
from jaxnav.simulate.scenarios import SCENARIOS, Scenario
from jaxnav.simulate.simulation import matched_params, simulate
from jaxnav.states.grades import GRADES
from jaxnav.states.table import chosen
from jaxnav.types import Nav, Params

STRIDE, CHUNK = 10, 32
BAROMETER_SD, ERROR_KEY, SENSOR_KEY = 0.5, 8, 100  # m; folded into a run's key
LEAST_SPEED = 3.0  # m/s, of a course
DRIVE_S, REST_S = 150.0, 60.0  # s, of the drives of `ROWS`


class Final(NamedTuple):
    """The end of one run."""

    nees: jax.Array  # () of all states
    error: jax.Array  # (n,) estimate minus truth
    sd: jax.Array  # (n,)
    ok: jax.Array  # () bool


def knowing(params: Params, scenario: Scenario, filt: Filter, errors: Sequence[str] = ()) -> Params:
    """The parameters with the defaults of the rows of `STATES` for further states, the filter's and the truth's."""
    names = [name for name in dict.fromkeys((*filt.model.states, *errors)) if name not in params.states]
    return params._replace(states=params.states | datasheet_states(GRADES[scenario.imu.grade], names))


def final(filt: Filter, step: Step, truth: Nav) -> Final:
    """Of an epoch's record: error and consistency of every state of the filter."""
    info = step.info
    x = metrics.state_error(info.nav, truth, filt.model.states)
    return Final(metrics.nees(x, info.P), x, jnp.sqrt(jnp.diag(info.P)), info.ok)


@partial(jax.jit, static_argnums=(0, 1, 4, 5))
def runs_of(
    filt: Filter, scenario: Scenario, params: Params, keys: jax.Array, errors: tuple[str, ...], sensors: tuple
) -> Final:
    """The ends of the runs with these keys, their truth with ``errors``; ``sensors``: names and sd of further ones."""

    def one(key):
        sim = with_states(jax.random.fold_in(key, ERROR_KEY), simulate(key, scenario), params, errors)
        for i, (name, sd) in enumerate(sensors):
            least = LEAST_SPEED if name == "course" else 0.0
            sim = with_sensor(jax.random.fold_in(key, SENSOR_KEY + i), sim, params, name, sd, least)
        rows = run(filt, params, sim.initial, sim.epochs, partial(final, filt), sim.truth)
        return jax.tree.map(lambda a: a[-1], rows)

    return jax.vmap(one)(keys)


def scored(
    filt: Filter, scenario: Scenario, runs: int, seed: int, errors: tuple[str, ...] = (), **sensors: float
) -> Final:
    """All runs, some at a time."""
    params = knowing(matched_params(scenario), scenario, filt, errors)
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(np.arange(runs))
    own = tuple(sensors.items())
    parts = [jax.device_get(runs_of(filt, scenario, params, keys[i : i + CHUNK], errors, own))
             for i in range(0, runs, CHUNK)]  # fmt: skip
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
    """Share of errors inside their 95 % interval, pooled over runs and axes."""
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
    """A barometer with a walking bias: 16 states against 15 that take it for the height, and against none."""
    urban = SCENARIOS["urban"]
    scenario = urban._replace(duration_s=urban.gnss.outages_s[-1][1])  # ends where the last outage does
    channels, bias = (*GNSS, "barometer"), ("barometer_bias",)
    with_it = scored(build("ekf15", channels, STRIDE, states=bias), scenario, runs, seed, bias, barometer=BAROMETER_SD)
    without = scored(build("ekf15", channels, STRIDE), scenario, runs, seed, bias, barometer=BAROMETER_SD)
    blind = scored(build("ekf15", cov_stride=STRIDE), scenario, runs, seed, bias)
    return {
        "anees_16": anees(with_it), "anees_15": anees(without), "bounds": bounds(16, runs),
        "inside": inside(with_it, slice(15, 16)), "height_rms_m": float(metrics.rms(with_it.error[:, 2])),
        "height_rms_without_m": float(metrics.rms(blind.error[:, 2])),
        "per_run_16": with_it.nees, "per_run_15": without.nees,
    }  # fmt: skip


def receiver(runs: int, seed: int) -> dict[str, Any]:
    """Fixes with an error of minutes: 18 states against 15 that take it for the way, between and at their fixes."""
    urban, slow = SCENARIOS["urban"], ("gnss_position_error",)
    with_it = scored(build("ekf15", cov_stride=STRIDE, states=slow), urban, runs, seed, slow)
    without = scored(build("ekf15", cov_stride=STRIDE), urban, runs, seed, slow)
    level = lambda found: float(np.sqrt(np.mean(found.error[:, :2] ** 2)))
    return {
        "anees_18": anees(with_it), "anees_15": anees(without), "bounds": bounds(18, runs),
        "inside": inside(with_it, slice(15, 18)), "horizontal_rms_m": level(with_it),
        "horizontal_rms_without_m": level(without), "per_run_18": with_it.nees, "per_run_15": without.nees,
    }  # fmt: skip


class Row(NamedTuple):
    """A study of the table: states, and further sensors with the sd of their noise."""

    states: tuple[str, ...] = ()
    sensors: dict[str, float] = {}


WHEELS = {"nonholonomic": 1.0, "speed": 0.1}
ROWS = {
    "gyro_misalignment": Row(("gyro_misalignment",)), "accel_misalignment": Row(("accel_misalignment",)),
    "gyro_g_sensitivity": Row(("gyro_g_sensitivity",)), "lever_arm_error": Row(("lever_arm_error",)),
    "clock_offset": Row(("clock_offset",)), "odometer_scale": Row(("odometer_scale",), {"speed": 0.1}),
    "vehicle_axes": Row(("vehicle_axes",), WHEELS), "wheel_arm_error": Row(("wheel_arm_error",), {"wheels": 0.1}),
    "magnetometer_bias": Row(("magnetometer_bias",), {"magnetometer": 1.0}),
    "declination_error": Row(("declination_error",), {"magnetometer": 1.0}), "wind": Row(("wind",), {"airspeed": 0.5}),
    "heading": Row((), {"heading": 0.01}), "baseline": Row((), {"baseline": 0.01}), "course": Row((), {"course": 0.05}),
    "yaw_rate": Row((), {"yaw_rate": 0.01}), "wheels": Row((), {"wheels": 0.1}),
    "ground_height": Row(("ground_height",), {"rangefinder": 0.1}),
}  # fmt: skip
"""Further states and sensors, one study each."""


def row(name: str, runs: int, seed: int) -> dict[str, Any]:
    """Is the filter consistent with it; on a drive without fixes hidden, and how much of the prior is left at rest."""
    states, sensors = ROWS[name]
    urban = SCENARIOS["urban"]
    drive = urban._replace(duration_s=DRIVE_S, gnss=urban.gnss._replace(outages_s=()))
    filt = build("ekf15", (*GNSS, *sensors), STRIDE, states=states)
    found = scored(filt, drive, runs, seed, states, **sensors)
    n = found.error.shape[1]
    out: dict[str, Any] = {"anees": anees(found), "bounds": bounds(n, runs), "per_run": found.nees}
    if states:
        own, still = slice(15, n), drive._replace(duration_s=REST_S, motion=drive.motion._replace(standstill_s=REST_S))
        rest = scored(filt, still, min(runs, CHUNK), seed, states, **sensors)
        prior = np.concatenate([np.full(s.size, s.defaults.sd) for s in chosen(states)])
        share = lambda final: (np.median(final.sd[:, own], 0) / prior).tolist()
        out |= {"inside": inside(found, own), "left_of_the_prior": share(found), "left_at_rest": share(rest)}
    return out


STUDIES = {"scale": scale, "barometer": barometer, "receiver": receiver} | {n: partial(row, n) for n in ROWS}


def main(argv: Sequence[str] | None = None) -> int:
    """Every study, a line each."""
    parser = options("states", __doc__ or "")
    parser.add_argument("--runs", type=int, default=128, help="default 128")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    parser.add_argument("--only", default=",".join(STUDIES), metavar="A,B,...", help="some of them, default all")
    args: argparse.Namespace = parser.parse_args(argv)
    found = {}
    for name in args.only.split(","):
        found[name] = STUDIES[name](args.runs, args.seed)
        words = {k: np.round(v, 3).tolist() for k, v in found[name].items() if not k.startswith("per_run")}
        print(name, words, flush=True)
    write_json(args.json, {"runs": args.runs, "seed": args.seed} | found)
    return 0
