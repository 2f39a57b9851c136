"""Consistency of the 15-state filter in matched simulations: ANEES and ANIS per degree of freedom.

The filter's parameters are those of the simulation, so both ratios are 1 for a consistent filter. Cells: IMU grade, sd
of the fixes, latency, initial attitude sd, vehicle.
"""

import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import options, write_json
from jaxnav.analysis import metrics
from jaxnav.analysis.progress import bar
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.parameters import history_for
from jaxnav.filters.run import run
from jaxnav.maths.units import DEG
from jaxnav.simulate.gnss import Receiver
from jaxnav.simulate.imu import ImuErrors
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import InitialErrors, Scenario
from jaxnav.simulate.simulation import matched_params, perturb, simulate
from jaxnav.simulate.trajectories import SShape, Urban
from jaxnav.types import Nav, Prior

GRADES = ("consumer", "adis16465", "adis16488")
FIXES = {"2cm": (0.02, 0.02), "2m": (2.0, 0.1)}
"""sd of position (m) and velocity (m/s) on each axis."""
LATENCIES = (0.0, 0.2, 0.5)  # s
ATTITUDES = ((0.1, 0.5), (1.0, 5.0), (3.0, 20.0))
"""Initial sd of tilt and heading, deg."""
VEHICLES = {
    "car": Urban(standstill_s=0.0),
    "aircraft": SShape(speed_mps=60.0, period_s=40.0, swing_deg=100.0, banked=True),  # turns of up to 45 deg of bank
}
RUNS, CHUNK, SECONDS, RATE_HZ, STRIDE = 96, 48, 60.0, 50.0, 5
SHORT = (
    "consumer 2cm 0.0s 1/5 car", "consumer 2cm 0.5s 1/5 car", "consumer 2m 0.5s 1/5 car",
    "adis16465 2m 0.2s 3/20 aircraft", "adis16488 2cm 0.2s 3/20 car", "adis16488 2m 0.5s 0.1/0.5 aircraft",
)  # fmt: skip
ANEES_BAR, ANIS_BAR, WORST, WORST_LARGE = (0.9, 1.15), (0.97, 1.04), 1.5, 2.0


class Cell(NamedTuple):
    """One case of the study."""

    grade: str
    fixes: str
    latency: float  # s
    attitude: tuple[float, float]  # deg, sd of tilt and heading
    vehicle: str

    @property
    def name(self) -> str:
        """The cell in the output."""
        tilt, heading = self.attitude
        return f"{self.grade} {self.fixes} {self.latency:.1f}s {tilt:g}/{heading:g} {self.vehicle}"

    @property
    def worst_allowed(self) -> float:
        """The largest ANEES that the bar allows."""
        return WORST_LARGE if self.attitude[0] >= 3.0 and self.fixes == "2cm" else WORST


def cells() -> list[Cell]:
    """All cases; those that differ in the initial attitude alone share a program and follow each other."""
    every = itertools.product(GRADES, FIXES, LATENCIES, VEHICLES, ATTITUDES)
    return [Cell(grade, fixes, late, attitude, vehicle) for grade, fixes, late, vehicle, attitude in every]


def scenario_of(cell: Cell) -> Scenario:
    """The simulation of a cell, but for its initial attitude."""
    position, velocity = FIXES[cell.fixes]
    return Scenario(
        name="consistency", duration_s=SECONDS, imu_rate_hz=RATE_HZ, motion=VEHICLES[cell.vehicle],
        imu=ImuErrors(cell.grade),
        gnss=Receiver((position,) * 3, (velocity,) * 3, latency_s=cell.latency, lever_arm_m=(0.3, -0.2, -1.2)),
        start=InitialErrors((max(position, 0.1),) * 3, (max(velocity, 0.1),) * 3),
    )  # fmt: skip


class Row(NamedTuple):
    """One epoch."""

    nees: jax.Array  # () of 15 states
    nis: jax.Array  # ()
    dof: jax.Array  # () channels of the fix
    heading: jax.Array  # () rad, estimate minus truth
    ok: jax.Array  # () bool


def row(filt: Filter, step: Step, truth: Nav) -> Row:
    """Consistency of an epoch."""
    info = step.info
    x = metrics.state_error(info.nav, truth, filt.model.states)
    return Row(metrics.nees(x, info.P), info.nis, info.valid.sum(), x[8], info.ok)


@partial(jax.jit, static_argnums=(0, 1))
def rows(filt: Filter, scenario: Scenario, params: Any, attitude: jax.Array, keys: jax.Array) -> Row:
    """Rows (runs, E) of the runs with these keys; ``attitude`` (2,) rad: initial sd of tilt and heading."""
    sd = attitude[np.array([0, 0, 1])]
    params = params._replace(prior=Prior(params.prior.position, params.prior.velocity, sd))
    start = scenario.start._replace(prior_tilt_sd_deg=attitude[0] / DEG, prior_heading_sd_deg=attitude[1] / DEG)

    def one(key):
        sim = simulate(key, scenario)
        initial = perturb(jax.random.fold_in(key, 1), sim.start, start)
        return run(filt, params, initial, sim.epochs, partial(row, filt), sim.truth)

    return jax.vmap(one)(keys)


def study(cell: Cell, runs: int, seed: int) -> dict[str, Any]:
    """ANEES and ANIS per degree of freedom over all epochs, ANEES of each run and their median, rms of the heading."""
    scenario = scenario_of(cell)
    params = matched_params(scenario)
    filt = build("ekf15", cov_stride=STRIDE, history=history_for(params, RATE_HZ, SECONDS))
    keys = run_keys(seed, Purpose.STUDY, np.arange(runs))
    attitude = jnp.asarray(cell.attitude) * DEG
    size = min(CHUNK, runs)
    if runs % size:
        raise SystemExit(f"--runs must be a multiple of {size}, got {runs}")
    parts = [jax.device_get(rows(filt, scenario, params, attitude, keys[i : i + size])) for i in range(0, runs, size)]
    found = jax.tree.map(lambda *a: np.concatenate(a), *parts)
    if not found.ok.all():
        raise SystemExit(f"{cell.name}: {(~found.ok.all(1)).sum()} of {runs} runs stopped being finite")
    by_run = found.nees.mean(1) / 15
    return {
        "anees": float(by_run.mean()), "anees_median": float(np.median(by_run)), "anees_by_run": by_run,
        "anis": float(found.nis.sum() / found.dof.sum()), "heading_deg": float(metrics.rms(found.heading, None) / DEG),
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Every cell, a line each, and the bars."""
    parser = options("consistency", __doc__ or "")
    parser.add_argument("--runs", type=int, default=RUNS, help=f"default {RUNS}")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    parser.add_argument("--quick", action="store_true", help="six cells")
    parser.add_argument("--only", default="", metavar="TEXT", help="cells with all of these words in their name")
    args = parser.parse_args(argv)
    chosen = [c for c in cells() if all(word in c.name.split() for word in args.only.split())]
    if args.quick:
        chosen = [c for c in chosen if c.name in SHORT]
    if not chosen:
        raise SystemExit(f"no cell has all of {args.only!r}: a name is {cells()[0].name!r}")
    found: dict[str, dict[str, Any]] = {}
    progress = bar(len(chosen), "cell", True)
    for cell in chosen:
        found[cell.name] = study(cell, args.runs, args.seed)
        progress.update(1)
    progress.close()
    good = []
    for cell in chosen:
        f = found[cell.name]
        good.append(ANEES_BAR[0] <= f["anees"] <= ANEES_BAR[1] and ANIS_BAR[0] <= f["anis"] <= ANIS_BAR[1])
        print(
            f"{cell.name:36} ANEES {f['anees']:7.3f} (median {f['anees_median']:.3f})  ANIS {f['anis']:6.3f}  "
            f"heading {f['heading_deg']:6.2f} deg" + (" above the limit" if f["anees"] > cell.worst_allowed else "")
        )
    worst = max(chosen, key=lambda c: found[c.name]["anees"] / c.worst_allowed)
    share = float(np.mean(good))
    print(f"inside {share:.0%}, worst {worst.name}: {found[worst.name]['anees']:.2f} (limit {worst.worst_allowed})")
    result = {"cells": found, "share_inside": share, "worst": {"cell": worst.name, "anees": found[worst.name]["anees"]}}
    write_json(args.json, {"runs": args.runs, "seed": args.seed} | result)
    return 0
