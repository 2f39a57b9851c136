"""Filters tuned alike on the three papers' scenarios, ranked on other runs and on types that no tuning has seen.

Each paper's scenarios are a contest of their own, all of 400 fixes with ten IMU samples each: its sensors, motion and
faults, three types to train on and three unseen. A filter is configured with the sensors' datasheet, the start and the
installation of the paper's plain scenario, in every type: without faults, wrong starts, correlated and late fixes.
Every filter starts there, with its rule's default values, and has the same steps on the same runs.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import common
from jaxnav.analysis.tables import table
from jaxnav.simulate.scenarios import CIRCLE, FWEKF, GIPKF, READINGS, SCENARIOS, Scenario
from jaxnav.simulate.simulation import matched_params
from jaxnav.simulate.trajectories import Urban
from tuning import contest_report
from tuning.contest import Kind, Plan, contest, filters

FIXES = 400  # of every run
SHORT = 0.1  # of the hour on the circle, and of its faults
NAMES = (
    "kf9_simple", "gpid", "gpid15", "gpid15_gate", "gpid_literal", "gipkf", "gipkf_learning", "gipkf_mix", "fwekf",
    "fwekf15", "fwekf_combined", "ekf15_gate",
)  # fmt: skip
QUICK = ("gpid",)
FULL_BUDGET: dict[str, Any] = {"steps": 20, "rate": 0.2, "runs": (3, 3, 16)}
QUICK_BUDGET: dict[str, Any] = {"steps": 2, "rate": 0.2, "runs": (1, 1, 2)}


class Contest(NamedTuple):
    """The types of one paper."""

    plain: Scenario  # of the filters' configuration
    trained: tuple[Scenario, ...]
    unseen: tuple[Scenario, ...]


def circle(reading: str) -> Scenario:
    """The GPID paper's circle with a fault, in a tenth of its time."""
    faults = tuple(f._replace(start_s=SHORT * f.start_s, stop_s=SHORT * f.stop_s) for f in READINGS[reading])
    return CIRCLE._replace(name=f"gpid_circle_{reading}", duration_s=float(FIXES), faults=faults)


def town(base: str, **changes: Any) -> Scenario:
    """The GIP-KF paper's drive with something else about it."""
    return SCENARIOS[base]._replace(duration_s=FIXES + GIPKF.start.alignment_s, **changes)


_PLAIN = town("gipkf_urban")
CONTESTS = {
    "gpid": Contest(
        circle("no_fault"),
        (circle("no_fault"), circle("constant"), circle("white")),
        (circle("velocity"), circle("gauss_markov"), circle("ramp")),
    ),
    "gipkf": Contest(
        _PLAIN,
        (_PLAIN, town("gipkf_urban_uncalibrated"), town("gipkf_urban", name="gipkf_urban_no_outage",
                                                        gnss=GIPKF.gnss._replace(outages_s=()))),
        (town("gipkf_urban_stress"),
         town("gipkf_urban", name="gipkf_urban_traffic", motion=Urban(standstill_s=45.0, traffic=0.6)),
         town("gipkf_urban", name="gipkf_urban_long",
              gnss=GIPKF.gnss._replace(outages_s=((150.0, 190.0), (280.0, 340.0))))),
    ),
    "fwekf": Contest(
        FWEKF,
        (FWEKF, SCENARIOS["fwekf_jump"], SCENARIOS["fwekf_bias_10"]),
        (SCENARIOS["fwekf_step"], SCENARIOS["fwekf_attitude"], SCENARIOS["fwekf_burst"]),
    ),
}  # fmt: skip


def plan(which: Contest, budget: Mapping[str, Any], seed: int) -> Plan:
    """Return the contest with the filters' configuration: in every type that of the plain one."""
    told = matched_params(which.plain)
    trained, unseen = (tuple(Kind(each, told) for each in group) for group in (which.trained, which.unseen))
    return Plan(trained, unseen, **budget, seed=seed, cov_stride=10)


def summary(results: Mapping[str, dict]) -> str:
    """One table: every filter's error over that of the tuned 15-state Kalman filter, by contest and group."""
    names = {name for result in results.values() for name in result["filters"]}
    head, columns = ["filter"], []
    for contest_name, result in results.items():
        for group in contest_report.GROUPS:
            head += [f"{contest_name}, {group}"]
            columns.append({name: about[group] for name, about in result["filters"].items()})
    mean = {
        name: float(np.exp(np.mean([np.log(c[name]["against"]["ekf15"]["ratio"]) for c in columns]))) for name in names
    }
    rows = []
    for name in sorted(names, key=lambda n: mean[n]):
        cells = [contest_report.ratio(c[name]["against"]["ekf15"]) if name != "ekf15" else "1" for c in columns]
        rows.append([name, *cells, mean[name]])
    metres = [f"{c['ekf15']['position_m']:.2f} m" for c in columns]
    return table([*head, "mean"], [*rows, ["(ekf15 itself)", *metres, ""]])


def main(argv: list[str]) -> int:
    """Print the tables, write the JSON, and a figure for each contest; 130 if Ctrl-C cut it short."""
    parser = common.options("bakeoff", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one paper's filter and the references, 2 steps")
    parser.add_argument("--seed", type=int, default=0, help="of all runs, default 0")
    parser.add_argument("--contest", choices=tuple(CONTESTS), action="append", help="only this one; may be repeated")
    parser.add_argument(
        "--filter", default=",".join(NAMES), help="A,B,... or all; default: the papers' and robust ones"
    )
    args = parser.parse_args(argv)
    names = filters(",".join(QUICK) if args.quick else args.filter)
    budget = QUICK_BUDGET if args.quick else FULL_BUDGET
    results: dict[str, dict] = {}
    for name in args.contest or (["gpid"] if args.quick else CONTESTS):
        this = plan(CONTESTS[name], budget, args.seed)
        found, stopped = contest(names, this, progress=True)
        results[name] = contest_report.verdict(found, this)
        print(f"\n{name}: {contest_report.text(results[name])}", flush=True)
        if args.json:
            contest_report.draw(results[name], Path(args.json).with_name(f"bakeoff_{name}.png"))
        common.write_json(args.json, {"seed": args.seed, "contests": results})
        if stopped:
            print(f"stopped {stopped}")
            return 130
    print("\nposition RMS over that of the tuned ekf15, 95 % intervals; below 1 is better\n" + summary(results))
    return 0
