"""Fuzzy weighted filter: the paper's launch, and twelve cases with right and wrong noise of a Kalman filter.

Every case is a 40 s run, 20 s of alignment and 20 s of motion, with fixes ten times a second. Its score is the RMS over
the motion of the 3-D position error of the corrected INS, as the paper plots it: navigation that the observer
steers, before the filter's remaining estimate is taken off (that one is in the JSON too). A case's figure is
the mean of its runs. The parameters of the tuned rules come from gradients on six cases, with runs of other keys; of
the other cases they have seen nothing.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.papers import fwekf_figures, fwekf_recorded
from benchmarks.papers.fwekf_study import (
    CASES,
    QUICK,
    RATES,
    RECIPES,
    TRAIN,
    UNSEEN,
    Runs,
    Scores,
    by_rate,
    draw,
    gradient_errors,
    in_units,
    methods,
    navigate_first,
    parameters,
    scores,
    tune,
)  # fmt: skip
from jaxnav.analysis.tables import table
from jaxnav.filters.core import Filter
from jaxnav.types import DataError

TUNED = Path(__file__).with_name("fwekf_tuned.json")  # result of tuning: "tuned" of its JSON
PAPER = {"position_below_0.005_m_s": 10.0, "velocity_below_0.02_mps_s": 10.0, "position_with_noise_after_20_s_m": 0.5}
SHOWN = ("ekf", "fwekf_hand", "fwekf_1.0_tuned")  # in the figures


def geomean(cases: dict[str, dict[str, float]], names: tuple[str, ...]) -> dict[str, float]:
    """Geometric mean over the named cases that were run, for each method."""
    chosen = [cases[name] for name in names if name in cases]
    return {m: float(np.exp(np.mean([np.log(row[m]) for row in chosen]))) for m in chosen[0]}


def paired(per_seed: dict[str, dict[str, list[float]]], to: str = "ekf") -> dict:
    """For each case and method the geometric mean factor by which it beats ``to``, and its standard error."""

    def factor(row, method):
        d = np.log(row[to]) - np.log(row[method])
        return {"factor": float(np.exp(d.mean())), "se": float(np.exp(d.mean()) * d.std(ddof=1) / math.sqrt(d.size))}

    return {case: {m: factor(row, m) for m in row if m != to} for case, row in per_seed.items()}


def settles(size: np.ndarray, t: np.ndarray, bound: float) -> float:
    """Time from which on the error stays below a bound, s; inf if never."""
    above = np.flatnonzero(size >= bound)
    if above.size == 0:
        return float(t[0])
    return float(t[above[-1] + 1]) if above[-1] + 1 < t.size else math.inf


def convergence(test: dict[str, Runs], found: dict[str, tuple[Filter, Any]], judged: dict) -> dict:
    """Check the paper's text on convergence: the noise-free case, and those with noise after 20 and 40 s.

    Heading is unobserved before the vehicle moves; the rest of its error then shows once more in position.
    """
    result: dict = {"paper": PAPER}
    for method in ("ekf", "fwekf_hand"):
        e, _ = navigate_first(test["C1"], *found[method])
        t = np.asarray(test["C1"].sim.truth.t[0])
        position, velocity = (np.linalg.norm(v, axis=1) for v in (e.position, e.velocity))
        still = t <= 20.0
        result[method] = {
            "velocity_below_0.02_mps_from_s": settles(velocity[still], t[still], 0.02),
            "position_below_0.005_m_from_s": settles(position[still], t[still], 0.005),
            "position_at_10_s_m": float(position[99]), "velocity_at_10_s_mps": float(velocity[99]),
            "position_max_in_motion_m": float(position[~still].max()),
        }  # fmt: skip
        for case in ("C2", "C2m"):
            for name, e in (("after_20_s", judged[case][method].aligned), ("after_40_s", judged[case][method].end)):
                distance = np.linalg.norm(e, axis=1)
                result[method][f"{case}_{name}"] = {
                    "rms_of_an_axis_m": float(np.sqrt(np.mean(np.square(e)))), "median_m": float(np.median(distance)),
                    "share_below_0.5_m": float(np.mean(distance < 0.5)),
                }  # fmt: skip
    return result


def tune_all(
    key: jax.Array, runs: int, steps: int, progress: bool, chosen: tuple[str, ...] = tuple(RECIPES)
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """The tuned rules and the histories of their losses, on ``runs`` runs of each training case."""
    train = draw(TRAIN, jax.random.fold_in(key, 0), runs)
    tuned, losses = {}, {}
    for i, (name, recipe) in enumerate(RECIPES.items()):
        if name in chosen:
            tuned[name], losses[name] = tune(recipe, train, jax.random.fold_in(key, i + 2), steps, progress)
    return tuned, losses


def stored() -> dict[str, Any]:
    """Return the tuned rules of a full run, from the file in this folder."""
    raw = json.loads(TUNED.read_text())
    return {name: plain_tree(recipe.start(), raw[name]) for name, recipe in RECIPES.items()}


def plain_tree(like: Any, raw: Any) -> Any:
    """A tree like ``like`` from nested dicts of numbers."""
    if hasattr(like, "_fields"):
        return type(like)(*(plain_tree(getattr(like, f), raw[f]) for f in like._fields))
    return jnp.asarray(raw, float)


def as_dict(theta: Any) -> Any:
    """The reverse."""
    if hasattr(theta, "_fields"):
        return {f: as_dict(getattr(theta, f)) for f in theta._fields}
    return np.asarray(theta).tolist()


def evaluate(test: dict[str, Runs], compared: dict[str, tuple[Filter, Any]]) -> dict[str, dict[str, Scores]]:
    """Scores of every run, by case and method."""
    return {
        case: {
            m: jax.tree.map(np.asarray, scores(filt, parameters(theta), runs)) for m, (filt, theta) in compared.items()
        }
        for case, runs in test.items()
    }


def show(cases: dict[str, dict[str, float]], extra: dict[str, dict[str, float]]) -> None:
    """The table of methods by cases."""
    names = list(cases)
    print(f"{'':22}" + "".join(f"{n:>10}" for n in [*names, *(k.removeprefix("geomean_") for k in extra)]))
    for method in cases[names[0]]:
        row = [cases[n][method] for n in names] + [v[method] for v in extra.values()]
        print(f"{method:22}" + "".join(f"{v:10.4g}" for v in row))


def show_paired(factors: dict[str, dict[str, dict[str, float]]]) -> None:
    """The table of factors."""
    print("\nTimes better than the EKF, paired over runs, geometric mean and its standard error in per cent")
    print(f"{'':22}" + "".join(f"{n:>14}" for n in factors))
    for method in next(iter(factors.values())):
        cells = (row[method] for row in factors.values())
        print(f"{method:22}" + "".join(f"{c['factor']:9.3g} {100 * c['se'] / c['factor']:4.1f}" for c in cells))


def show_scores(found: dict[str, dict[str, dict]]) -> None:
    """Everything that a run is judged by."""
    keys = ("position_m", "velocity_mps", "attitude_deg", "filter_position_m")
    print("\nRMS over the motion: position m, velocity m/s, attitude deg of the corrected INS, the filter's position m")
    print(table(["", *found], [
        [method, *(" ".join(f"{found[case][method][key]:.3g}" for key in keys) for case in found)]
        for method in next(iter(found.values()))
    ]))  # fmt: skip


def show_rates(found: dict[int, dict[str, dict[str, dict]]]) -> None:
    """By the rate of the fixes."""
    print("\nby the rate of the fixes: position after 20 s; times that the FWEKF by hand is better in the motion")
    print(table(
        ["Hz", "R", "EKF median m", "below 0.5 m", "FWEKF median m", "below 0.5 m", "better in position", "velocity",
         "attitude"],
        [[rate, told, *(row[m][k] for m in ("ekf", "fwekf_hand") for k in ("median_m", "below_half_metre")),
          *row["fwekf_hand"]["times_better"].values()] for rate, each in found.items() for told, row in each.items()],
    ))  # fmt: skip


def recorded(tuned: dict[str, Any]) -> dict:
    """The table of recorded data, printed; empty without the data, which are no reason to lose the rest."""
    try:
        found = fwekf_recorded.table(tuned)
    except DataError as error:
        print(f"recorded data left out: {error}")
        return {}
    fwekf_recorded.show(found)
    return found


def options() -> argparse.ArgumentParser:
    """The options of this benchmark."""
    parser = common.options("fwekf", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="6 cases, 8 runs each, nothing recorded")
    parser.add_argument("--seed", type=int, default=0, help="of all runs (default: %(default)s)")
    help = "tune the rules again in N steps (the stored ones took up to 140); without it the stored ones are judged"
    parser.add_argument("--steps", type=int, default=0, metavar="N", help=help)
    parser.add_argument("--tune", metavar="A,B", help=f"with --steps, of {', '.join(RECIPES)} these (default: all)")
    parser.add_argument("--progress", action="store_true", help="show the tuning's progress")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="folder for figures (default: that of the JSON)")
    return parser


def main(argv: list[str]) -> None:
    """Print the table, write the JSON and the figures."""
    args = options().parse_args(argv)
    chosen = tuple(args.tune.split(",")) if args.tune else tuple(RECIPES)
    if args.tune and (not args.steps or set(chosen) - set(RECIPES)):
        options().error(f"--tune takes some of {', '.join(RECIPES)}, and goes with --steps")
    key, count = jax.random.key(args.seed), 8 if args.quick else 64
    if args.steps:
        print(f"rules tuned again: {args.steps} steps, 64 runs of {', '.join(TRAIN)}", flush=True)
        tuned, losses = tune_all(key, 64, args.steps, args.progress, chosen)
        tuned = stored() | tuned
    else:
        print(f"rules tuned before, from benchmarks/{TUNED.name}; --steps N tunes again", flush=True)
        tuned, losses = stored(), {}
    test = draw(QUICK if args.quick else tuple(CASES), jax.random.fold_in(key, 1), count)
    compared = methods(tuned, args.quick)
    judged = evaluate(test, compared)
    of = lambda part: {c: {m: getattr(v, part).tolist() for m, v in row.items()} for c, row in judged.items()}
    mean = lambda runs: {c: {m: float(np.mean(v)) for m, v in row.items()} for c, row in runs.items()}
    per_seed, per_seed_filter = of("position"), of("filter_position")
    cases, factors = mean(per_seed), paired(per_seed)
    groups = {"geomean_train": geomean(cases, TRAIN), "geomean_unseen": geomean(cases, UNSEEN)}
    print("RMS of position over the motion, corrected INS, m; geometric means over cases tuned on and unseen")
    show(cases, groups)
    show_paired(factors)
    result = {"seed": args.seed, "quick": args.quick, "steps": args.steps}
    result |= {"description": {n: CASES[n]._asdict() for n in test}, "cases": cases, **groups, "paired_to_ekf": factors}
    result |= {"cases_filter": mean(per_seed_filter), "per_seed": per_seed, "per_seed_filter": per_seed_filter}
    result |= {"loss": losses, "tuned": {name: as_dict(theta) for name, theta in tuned.items()}}
    result["scores"] = {case: {m: in_units(v) for m, v in row.items()} for case, row in judged.items()}
    show_scores(result["scores"])
    rates = {rate: by_rate(rate, jax.random.fold_in(key, 3), count) for rate in RATES}
    result["rates"] = {str(rate): {**row["matched"]["ekf"], **row} for rate, row in rates.items()}
    show_rates(rates)
    result["convergence"] = convergence(test, compared, judged)
    check = gradient_errors({"C2m": test["C2m"]} if args.quick else test)
    result |= {"gradient_rel_error": {c: row["best"] for c, row in check.items()}, "gradient_check": check}
    for name in ("convergence", "gradient_rel_error"):
        print(name, json.dumps(result[name], indent=1))
    if not args.quick:
        result["recorded"] = recorded(tuned)
    folder = args.figures or (args.json.with_suffix("") if args.json else None)
    if folder:
        data = {c: {m: navigate_first(test[c], *compared[m]) for m in SHOWN} for c in ("C1", "C2", "C2m")}
        result["figures"] = fwekf_figures.draw(folder, test["C1"].sim, data, tuned, cases)
    common.write_json(args.json, result)
