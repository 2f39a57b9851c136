"""Tuned on one unit's drives, judged on another unit's other drives: results belong to the kind of IMU.

An RC car carries two IMUs of one kind. `tuning.tune` has the first one's drives h and i together, a consumer's
datasheet, and no truth; each drive was logged by another clock, and is shifted by the delay that `jaxnav check`
finds in it. The winner and all candidates then run through drives j and k with the second IMU's
readings: horizontal distance to the last hidden fix of windows of 10 s, every third part of the time hidden in turn.
"""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import PHASES, RECIPES, SETTLE
from jaxnav import build, initialize, read
from jaxnav.analysis.tables import table
from jaxnav.analysis.windows import drift, hidden_windows
from jaxnav.checkup import checkup
from jaxnav.filters import epochs as ep
from jaxnav.filters.core import Filter
from jaxnav.filters.run import prepare
from jaxnav.initialization.bank import most_probable
from jaxnav.initialization.initialize import Initialization
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import Params, Recording
from tuning.recordings.recorded import spread, tune

TUNED_ON, JUDGED_ON = ("h", "i"), ("j", "k")
WINDOW = 10.0


def drive(letter: str, unit: int) -> Recording:
    """A drive as one IMU read it, by the recipe of the first, its clock put right."""
    text = (RECIPES / "morpinet.toml").read_text().replace("IMU_h_1", f"IMU_{letter}_{unit}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"drive_{letter}_imu{unit}.toml"
        path.write_text(text.replace("ned_h", f"ned_{letter}"))
        rec = read(path)
    late = sum(found.value or 0.0 for found in checkup(rec) if found.code == "time.delay")
    print(f"{rec.name}: fixes {late:+.3f} s late", flush=True)
    fixes = rec.aiding["position"]
    return rec._replace(aiding={"position": fixes._replace(t=fixes.t - late)})


def judged(rec: Recording, begin: Initialization, filt: Filter, params: Params) -> np.ndarray:
    """Horizontal drift (W,) m over hidden windows of a whole recording, from one start for all parameters."""
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    packed = ep.pack_recording(rec, chosen, begin.t)
    windows = hidden_windows(packed, WINDOW, 3 * WINDOW, PHASES, SETTLE)
    epochs, params = prepare(filt, packed.epochs), begin.apply_to(params)
    nav = most_probable(filt, params, begin.navs, epochs)
    error, _ = drift(filt, params, nav, epochs, windows, chosen)
    return np.hypot(error[:, 0], error[:, 1])


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    args = common.options("across", __doc__.splitlines()[0]).parse_args(argv)
    ekf = build("ekf15", measurements=["position"], cov_stride=5)
    sheet = ekf.params("consumer")
    found = tune([drive(letter, 1) for letter in TUNED_ON], ekf, sheet, log=print)
    print(found)
    others = [(rec, initialize(rec, sheet)) for rec in (drive(letter, 2) for letter in JUDGED_ON)]
    print(*(begin.how for _, begin in others), sep="\n")
    results: dict[str, dict] = {}
    for name, trial in found.trials.items():
        off = np.concatenate([judged(rec, begin, trial.filter, trial.params) for rec, begin in others])
        results[name] = spread(off) | {"windows": off.size}
    sheet_rms = results["datasheet"]["rms_m"]
    rows = [[name, r["windows"], r["rms_m"], r["median_m"], r["rms_m"] / sheet_rms] for name, r in results.items()]
    print(table(["parameters", "windows", "RMS m", "median m", "of the datasheet's"], rows))
    print(f"chosen: {found.chosen}")
    ratio = results[found.chosen]["rms_m"] / sheet_rms
    common.write_json(args.json, {"trials": results, "chosen": found.chosen, "drift_ratio": ratio})
