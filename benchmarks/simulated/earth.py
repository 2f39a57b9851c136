"""The stated sd against the truth: receivers with white and slow errors on ten vehicles, by the default filter.

Each drive of 240 s goes through `jaxnav.navigate` with the noise scan. The receiver states the sd of all of its error,
or half or twice of it. Compared are the filtered position, velocity and attitude with the truth, from 60 s on.
"""

import math
from typing import Any

import numpy as np

from benchmarks.common import options, write_json
from benchmarks.simulated.vehicles import simulated
from jaxnav.analysis.evaluate import ned_errors
from jaxnav.analysis.tables import table
from jaxnav.filters.catalogue import build
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.maths import earth
from jaxnav.navigation import Solution, navigate
from jaxnav.types import DataError, FilterError, Recording

SECONDS, FIX_HZ, SETTLED_S = 240.0, 1.0, 60.0
VEHICLES = ("car", "aircraft", "walk", "robot", "ship", "train", "bus", "mower", "quadrotor", "helicopter")
RECEIVERS = {
    "white": (0.4, 0.0, 1.0), "slow": (0.4, 0.8, 120.0), "far": (0.4, 2.0, 400.0), "fast": (0.4, 3.0, 60.0),
    "rtk": (0.02, 0.0, 1.0),
}  # fmt: skip
"""White sd (m), slow sd (m) and its correlation time (s)."""
TOTALS = (1.0, 0.5, 2.0)  # stated sd over the right one
RATIOS = ("error_over_sd", "velocity", "tilt", "heading")
CHI2_95 = 5.991  # of 2 degrees of freedom
BARS = {"ratio": (0.7, 1.4), "share": 0.85, "worst": 2.0, "inside": 0.85, "attitude": (0.7, 1.5), "factor": 2.0}


def drive(vehicle: str, receiver: str, total: float, seed: int) -> Recording:
    """Return a recording whose positions have the errors of a receiver, and ``total`` times the right sd."""
    white, slow, tau = RECEIVERS[receiver]
    names = (*VEHICLES, "steep").index(vehicle), list(RECEIVERS).index(receiver)  # the same errors, whatever is stated
    rng = np.random.default_rng([seed, *names])
    rec, _ = simulated(vehicle, "consumer", True, rng, sd=1e-3, span=SECONDS, fix_hz=FIX_HZ, late=0.0)
    position = rec.aiding["position"]
    error, keep = slow * rng.normal(size=(position.t.size, 3)), math.exp(-1 / (FIX_HZ * tau))
    for k in range(1, len(error)):
        error[k] = keep * error[k - 1] + math.sqrt(1 - keep**2) * error[k]
    error += white * rng.normal(size=error.shape)
    metres = np.asarray(earth.metres_per_radian(position.value[0]))
    sd = np.full(error.shape, total * math.hypot(white, slow))
    moved = position._replace(value=position.value + error[:, [1, 0, 2]] / metres, sd=sd)
    return rec._replace(aiding=rec.aiding | {"position": moved})


def score(sol: Solution) -> dict[str, float]:
    """Return errors over stated sd against the truth, and what the scan says of the receiver."""
    assert sol.recording.truth is not None and sol.noise is not None
    error, sd = ned_errors(sol.trace, sol.recording.truth)
    late = (sol.t > sol.t[0] + SETTLED_S) & np.isfinite(error).all(1)
    square = (error[late] / sd[late]) ** 2
    rms = lambda *axes: float(np.sqrt(square[:, axes].mean()))
    errors = sol.noise.receiver
    return {
        "error_over_sd": rms(0, 1), "inside_95": float((square[:, :2].sum(1) < CHI2_95).mean()),
        "velocity": rms(3, 4), "tilt": rms(6, 7), "heading": rms(8),
        "error_m": float(np.sqrt((error[late, :2] ** 2).sum(1).mean())),
        "sd_m": float(np.sqrt((sd[late, :2] ** 2).sum(1).mean())),
        "share": float(errors.share[0]), "tau_s": float(errors.tau[0]),
    }  # fmt: skip


def one(vehicle: str, receiver: str, total: float, seeds: range) -> dict[str, Any]:
    """Navigate the drives of a cell: RMS of errors over sd, means of all else."""
    clear_caches_if_needed()
    try:
        each = [score(navigate(drive(vehicle, receiver, total, s), build("ekf15", cov_stride=5))) for s in seeds]
    except (DataError, FilterError) as failure:
        return {"total": total, "failed": str(failure)}
    mean = {key: float(np.mean([row[key] for row in each])) for key in each[0]}
    ratios = {key: float(np.sqrt(np.mean([row[key] ** 2 for row in each]))) for key in RATIOS}
    return mean | ratios | {"total": total, "receiver": receiver}


def summary(cells: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the bars of the cells whose stated total is right, or of all where there is none.

    Share and time are those of receivers whose slow errors change three times in a drive.
    """
    right = [c for c in cells.values() if c["total"] == 1.0] or list(cells.values())
    done = [c for c in right if "failed" not in c]
    within = lambda key, low, high: float(np.mean([low <= c[key] <= high for c in done]))
    long = {name: of for name, of in RECEIVERS.items() if of[1] and 3 * of[2] < SECONDS}
    near = lambda a, b: 1 / BARS["factor"] <= a / b <= BARS["factor"]
    found = [
        near(c["share"], slow**2 / (white**2 + slow**2)) and near(c["tau_s"], tau)
        for name, (white, slow, tau) in long.items()
        for c in done
        if c["receiver"] == name
    ]
    return {
        "cells": len(right), "failed": len(right) - len(done),
        "within": within("error_over_sd", *BARS["ratio"]), "worst": max(c["error_over_sd"] for c in done),
        "inside_95": float(np.mean([c["inside_95"] for c in done])),
        **{name: within(name, *BARS["attitude"]) for name in ("tilt", "heading", "velocity")},
        "share_and_tau": float(np.mean(found)) if found else math.nan,
    }  # fmt: skip


def main(argv: list[str]) -> None:
    """Print a line for each cell, write the JSON."""
    parser = options("earth", __doc__.splitlines()[0])
    parser.add_argument("--short", action="store_true", help="the right total, every third cell")
    parser.add_argument("--receivers", nargs="*", default=list(RECEIVERS), help="of them, default all")
    parser.add_argument("--vehicles", nargs="*", default=list(VEHICLES), help="of them, default all")
    parser.add_argument("--totals", nargs="*", type=float, default=list(TOTALS), help="of the stated sd")
    parser.add_argument("--seed", type=int, default=0, help="of the first drive, default 0")
    parser.add_argument("--drives", type=int, default=1, help="in a cell, default 1")
    args = parser.parse_args(argv)
    every = [(v, r, t) for t in args.totals for v in args.vehicles for r in args.receivers]
    if args.short:
        every = [each for each in every if each[2] == 1.0][::3]
    cells = {}
    for v, r, t in every:
        cells[f"{v} {r} {t:g}"] = found = one(v, r, t, range(args.seed, args.seed + args.drives))
        print(f"{v} {r} {t:g}", {k: x if isinstance(x, str) else round(x, 2) for k, x in found.items()}, flush=True)
    found = summary(cells)
    print(table(["", ""], [[name, value] for name, value in found.items()]))
    write_json(args.json, {"cells": cells, "summary": found, "bars": BARS})
