"""The real drive tuned without truth: drift of hidden windows, normalised innovations and their whiteness together.

The drive is cut into four blocks; each is scored by parameters that saw only the stretches outside of it. Drift is the
horizontal error at the end of the 15 s windows of `drive.py`; innovations are of the same block with nothing
hidden, so that consistency, which a larger R alone could buy, is shown with its cost.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks.recordings import drive
from jaxnav.analysis import metrics
from jaxnav.analysis.evaluate import channel_names
from jaxnav.analysis.tables import table
from jaxnav.filters.border import component
from jaxnav.filters.parameters import UNITS, prior, put
from jaxnav.filters.run import prepare, run_jit
from jaxnav.maths import units
from jaxnav.maths.units import Unit
from jaxnav.measurements import GNSS
from jaxnav.types import Params
from tuning import uncertainty
from tuning.fit.transforms import LOG, Spec, join, scaled, split, tied
from tuning.likelihood import information, runs_of, taken_runs
from tuning.recordings import scoring
from tuning.recordings.validation import paired_gain
from tuning.uncertainty import Information

SPEC: Spec = {
    "noise.gyro": tied(LOG), "noise.accel": tied(LOG),
    "states.gyro_bias.driving_noise": tied(LOG), "states.accel_bias.driving_noise": tied(LOG),
    "measurements.position.scale": LOG, "measurements.velocity.scale": LOG,  # by axis
    "mounting.time_offset": scaled(0.1), "mounting.clock_drift": scaled(300 * units.PPM),
    "measurements.velocity.latency": scaled(0.05),
}  # fmt: skip
CHUNK = 5.0  # s that are drawn together in the sandwich
LAGS = 5  # fixes


def start() -> Params:
    """The datasheet and the author's timing, with one factor for every axis of the fixes."""
    params = drive.parameters()
    for name in ("measurements.position.scale", "measurements.velocity.scale"):
        params = put(params, name, jnp.ones(3))
    return params


def tune(rec) -> tuple[dict[int, Params], list[list[uncertainty.Interval]]]:
    """By the likelihood of the innovations: parameters for each block from the stretches outside of it, intervals."""
    filt, (nav, data, _, _, settled) = drive.training_stretches(rec, False)
    params, E = start(), settled.shape[1]
    moving = prior((2.0, 2.0, 2.0), 0.3, np.array([3.0, 3.0, 15.0]) * units.DEG)
    params = params._replace(prior=moving)  # stretches start on the road, the drive itself at rest
    flat, back = ravel_pytree(split(SPEC, params))
    per = max(1, round(CHUNK * E / drive.PIECE))
    blocks, every = range(drive.PIECES.size), np.arange(E) // per
    block = every + (every[-1] + 1) * np.arange(settled.shape[0])[:, None]
    whole = runs_of(filt, params, nav, prepare(filt, data), settled, block)
    without = {b: taken_runs(whole, np.array([i for i in blocks if i != b])) for b in blocks}

    def inform(raws: jax.Array) -> Information:
        """Of every block's parameters (4, P), from the stretches outside of it."""
        rows = [information(without[b], SPEC, params, raws[b]) for b in blocks]
        return Information(*map(np.stack, zip(*rows, strict=True)))

    def report(i: int, search: scoring.Search) -> None:
        print(f"  evaluation {i:2d}: still promised {np.max(search.expected):.3g}", flush=True)

    found = scoring.maximise(inform, jnp.tile(flat, (drive.PIECES.size, 1)), 25, 0.05, report)
    tuned = {b: join(SPEC, back(found.raw[b]), params)._replace(prior=start().prior) for b in blocks}
    rows = []
    for b in blocks:
        cov = uncertainty.covariance(np.asarray(found.best.fisher[b]), np.asarray(found.best.blocks[b]))
        rows.append(uncertainty.intervals(SPEC, back(found.raw[b]), cov))
    return tuned, rows


def innovations(data: drive.Data, by_block: dict[int, Params]) -> dict[str, dict]:
    """NIS of each GNSS channel over all blocks, each with its parameters, and autocorrelations; nothing hidden."""
    order, names, _ = channel_names(drive.measurements(False))
    block = np.searchsorted(drive.BLOCKS, data.t)
    z = np.full((data.t.size, len(names)), np.nan)
    for b in np.unique(block):
        params = by_block[b] if b in by_block else by_block[0]
        mine = block == b
        z[mine] = metrics.normalized_innovations(run_jit(data.filt, params, data.nav, data.epochs))[mine][:, order]
    z = z[data.t > drive.FIRST]
    out = {}
    for j in range(sum(m.size for m in GNSS)):
        own = z[:, j]
        nis = float(np.nanmean(own**2))
        acf = [float(np.nanmean(own[d:] * own[:-d])) / nis for d in range(1, LAGS + 1)]
        out[names[j]] = {"nis": nis, "autocorrelation": acf, "fixes": int(np.isfinite(own).sum())}
    return out


def recover(steps: int, seed: int) -> dict:
    """The table: datasheet, tuned by innovations, tuned by drift; and the estimates of the timing."""
    rec = drive.recording()
    last_fix, data = float(rec.aiding["position"].t[-1]), drive.cut(rec, False, drive.START)
    likely, intervals = tune(rec)
    methods = {"datasheet": {0: drive.parameters()}, "tuned by innovations": likely}
    if steps:
        methods["tuned by drift"] = drive.tune(rec, False, steps, list(range(drive.PIECES.size)), "drift")
    result: dict = {"methods": {}, "steps": steps}
    rows = []
    for name, by_block in methods.items():
        scores = drive.evaluate(data, False, by_block, last_fix) | {"channels": innovations(data, by_block)}
        result["methods"][name] = scores
        errors = np.array([w["horizontal_m"] for w in scores["per_window"]])
        if name == "datasheet":
            before = errors
            cycle = np.array([int((w["start_s"] - drive.FIRST) // drive.EVERY) for w in scores["per_window"]])
            gain = "1"
        else:
            scores["gain"] = paired_gain(before, errors, cycle, seed)._asdict()
            gain = "{gain:.2f} ({low:.2f}-{high:.2f})".format(**scores["gain"])
        found = scores["channels"].values()
        rows.append([name, scores["horizontal_rms_m"], scores["horizontal_median_m"], gain,
                     " ".join(f"{c['nis']:.2f}" for c in found),
                     " ".join(f"{c['autocorrelation'][0]:.2f}" for c in found)])  # fmt: skip
    seen = next(iter(result["methods"].values()))["channels"]
    print(f"every block held out; channels: {', '.join(seen)}")
    print(
        table(
            ["", "RMS m", "median m", "times smaller", "NIS by channel (1)", "autocorrelation at the next fix (0)"],
            rows,
        )
    )
    result["parameters"] = {
        component(first.name): {"unit": unit_of(first).text, "without_each_block": [told(of[j]) for of in intervals]}
        for j, first in enumerate(intervals[0])
    }
    for name in ("mounting.time_offset_s", "mounting.clock_drift_ppm", "measurements.velocity.latency_s"):
        each = result["parameters"][name]["without_each_block"]
        said = ", ".join(f"{p['value']:#.4g} ({p['low']:#.4g} to {p['high']:#.4g})" for p in each)
        print(f"{name}, without each block in turn: {said}")
    print(f"(the log is read {-drive.EARLY:g} s early: the offset, of half-time, is less by that)")
    return result


def unit_of(i: uncertainty.Interval) -> Unit:
    """The user's parameter of an interval."""
    return UNITS[i.name.partition("[")[0]]


def told(i: uncertainty.Interval) -> dict:
    """An interval in the user's unit."""
    factor = unit_of(i).factor
    return {key: getattr(i, key) / factor for key in ("value", "low", "high")} | {"identified": i.identified}
