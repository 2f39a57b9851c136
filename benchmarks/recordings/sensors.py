"""Value of further sensors on recordings: drift in hidden windows with them and without.

A consumer's datasheet, the sd that the recordings state or their rows assume, the same windows; nothing is
tuned. Barometers are judged by height, all others by the horizontal.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import drifts, sources
from jaxnav import read
from jaxnav.analysis.tables import table
from jaxnav.measurements import MEASUREMENTS


class Trial(NamedTuple):
    """A recording, additions to its position and velocity, and its score."""

    recording: str
    sensors: tuple[str, ...]
    states: tuple[str, ...]
    window: float  # s
    up: bool = False  # judged by height


TRIALS = (
    Trial("px4_quad106", ("barometer",), ("barometer_bias",), 20.0, up=True),
    Trial("px4_quad123", ("barometer",), ("barometer_bias",), 20.0, up=True),
    Trial("px4_fixed_wing", ("barometer",), ("barometer_bias",), 20.0, up=True),
    Trial("px4_quad106", ("magnetometer",), ("magnetometer_bias",), 20.0),
    Trial("px4_quad123", ("magnetometer",), ("magnetometer_bias",), 20.0),
    Trial("px4_fixed_wing", ("airspeed", "sideslip"), ("wind",), 10.0),
    Trial("comma2k19", ("nonholonomic", "speed"), (), 15.0),
    Trial("comma2k19", ("nonholonomic", "speed"), ("odometer_scale", "vehicle_axes"), 15.0),
    Trial("kth", ("nonholonomic", "speed"), (), 15.0),
    Trial("kth", ("nonholonomic", "speed"), ("odometer_scale", "vehicle_axes"), 15.0),
    Trial("husky", ("nonholonomic", "speed"), (), 15.0),
    Trial("husky", ("nonholonomic", "speed"), ("odometer_scale", "vehicle_axes"), 15.0),
)


def one(trial: Trial, path: Path) -> dict:
    """A trial's figures."""
    rec = read(path)
    missing = [name for name in trial.sensors if MEASUREMENTS[name].has_data and name not in rec.aiding]
    if missing:
        return {"ran": False, "why": f"{trial.recording} has no {missing[0]}"}
    size = (lambda e: np.abs(e[:, 2])) if trial.up else (lambda e: np.hypot(e[:, 0], e[:, 1]))
    without, with_it = (size(drifts(rec, s, x, trial.window)) for s, x in (((), ()), (trial.sensors, trial.states)))
    rms = lambda e: float(np.sqrt(np.mean(e**2)))
    return {
        "ran": True, "windows": int(with_it.size), "window_s": trial.window, "up": trial.up,
        "without_rms_m": rms(without), "with_rms_m": rms(with_it), "ratio": rms(with_it) / rms(without),
        "without_median_m": float(np.median(without)), "with_median_m": float(np.median(with_it)),
    }  # fmt: skip


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    args = common.options("sensors", __doc__.splitlines()[0]).parse_args(argv)
    known, results = sources(), {}
    for trial in TRIALS:
        name = f"{trial.recording}: {' + '.join((*trial.sensors, *trial.states))}"
        results[name] = r = one(trial, known[trial.recording])
        print(f"{name}: {r['ratio']:.2f}" if r["ran"] else f"{name}: {r['why']}", flush=True)
    head = ["", "s", "windows", "without RMS m", "with RMS m", "ratio", "without median m", "with median m"]
    keys = ("window_s", "windows", "without_rms_m", "with_rms_m", "ratio", "without_median_m", "with_median_m")
    print(table(head, [[name, *(r[k] for k in keys)] for name, r in results.items() if r["ran"]]))
    common.write_json(args.json, results)
