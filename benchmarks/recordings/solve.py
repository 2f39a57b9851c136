"""`solve` on every recording, without a setting: verdict, drift against the datasheet, calibration, time.

Bars: every recording ends in a solution or a refusal; "consistent" only where NIS/dof of the test part is within 0.7 to
1.4 and 90 to 99 % of its hidden fixes are inside their stated 95 %; drift at most 0.5 of the datasheet's in the median
and never above 1.02, against the noise scan's 0.9 and 1.05; error over stated sd within 0.7 to 1.4 in 90 % of them.
"""

import time

import jax
import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import sources
from jaxnav.analysis.tables import table
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.reading.read import read
from jaxnav.types import DataError, FilterError
from tuning.solving.solve import NIS_LIMITS, solve

QUICK = ("px4_fixed_wing", "kth", "navego_synthetic", "phone")
ERROR_LIMITS = (0.7, 1.4)  # of the error over the stated sd
NUMBERS = {
    "test_nis": "NIS", "hidden_inside_95": "inside 95 %", "error_over_sd": "error / sd", "factor": "factor",
    "drift_ratio": "ratio", "against_auto": "of auto",
}  # fmt: skip


def one(name: str, fast: bool) -> dict:
    """One recording from its file to its figures."""
    clear_caches_if_needed()
    begin = time.perf_counter()
    try:
        found = solve(read(sources()[name]), fast=fast)
    except (DataError, FilterError) as error:
        return {"verdict": "refused", "why": str(error), "wall_s": time.perf_counter() - begin}
    metrics, calibration = found.metrics(), found.calibration
    return {
        "verdict": found.verdict, "why": found.why, "test_nis": found.test_nis,
        "hidden_inside_95": None if calibration is None else calibration.after.inside_95,
        "error_over_sd": None if calibration is None else calibration.after.error_over_sd,
        "factor": None if calibration is None else calibration.factor,
        "drift_ratio": metrics["drift_ratio"], "against_auto": metrics["against_auto"], "drift_m": found.drift_m,
        "measurements": [name for row in found.tried if row.taken for name in row.option.names],
        "tuning": "" if found.tuned is None else found.tuned.chosen, "settings": found.settings,
        "wall_s": time.perf_counter() - begin,
    }  # fmt: skip


def unit() -> float:
    """Seconds of a first compilation, which times are multiples of."""
    begin = time.perf_counter()
    jax.block_until_ready(jax.jit(lambda x: x + 1.0)(1.0))
    return time.perf_counter() - begin


def bars(found: dict[str, dict]) -> list[str]:
    """Return each bar with its figure."""
    tested = [r for r in found.values() if r.get("hidden_inside_95") is not None]
    within = lambda x, limits: limits[0] <= x <= limits[1]
    wrong = [
        r for r in tested if r["verdict"] == "consistent"
        and not (within(r["test_nis"], NIS_LIMITS) and r["error_over_sd"] <= ERROR_LIMITS[1])
    ]  # fmt: skip
    if not tested:
        return ["no recording was long enough for a test part"]
    ratio = np.array([r["drift_ratio"] for r in tested])
    auto = np.array([r["against_auto"] for r in tested if r["against_auto"] is not None])
    right = [within(r["error_over_sd"], ERROR_LIMITS) for r in tested]
    refused = sum(r["verdict"] == "refused" for r in found.values())
    return [
        f"{len(found) - refused} of {len(found)} solved, {refused} refused; {len(tested)} with a test part, "
        f"{sum(r['verdict'] == 'consistent' for r in tested)} consistent, {len(wrong)} of them wrongly (0)",
        f"drift over the datasheet's: median {np.median(ratio):.2f} (0.5), largest {ratio.max():.2f} (1.02)",
        f"drift over the noise scan's: median {np.median(auto):.2f} (0.9), largest {auto.max():.2f} (1.05)",
        f"error over stated sd within 0.7 to 1.4: {np.mean(right):.0%} of {len(right)} (90 %)",
    ]


def show(found: dict[str, dict]) -> str:
    """Return the table."""
    number = lambda v: "" if v is None else f"{v:.2f}"
    rows = [
        [name, r["verdict"], *(number(r.get(key)) for key in NUMBERS),
         ", ".join(r.get("measurements", ())), r.get("tuning", ""), f"{r['wall_s']:.0f}"]
        for name, r in found.items()
    ]  # fmt: skip
    return table(["recording", "verdict", *NUMBERS.values(), "added", "chosen", "s"], rows)


def main(argv: list[str]) -> None:
    """Solve every recording."""
    parser = common.options("solve", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help=", ".join(QUICK))
    parser.add_argument("--only", default="", help="recordings, comma-separated")
    parser.add_argument("--fast", action="store_true", help="do not tune")
    args = parser.parse_args(argv)
    names = args.only.split(",") if args.only else QUICK if args.quick else tuple(sources())
    second, found = unit(), {}
    for name in names:
        found[name] = one(name, args.fast)
        print(show({name: found[name]}), flush=True)
        common.write_json(args.json, {"recordings": found, "unit_s": second})
    print("\n" + show(found) + "\n\n" + "\n".join(bars(found)))
