"""Recordings as their users have them: each from its files to a solution by one command, no setting about its start.

Every recipe of docs/recipes, and recordings that need none, through `jaxnav.navigate` with a consumer's datasheet
and the streams of position and velocity that it has. The drift is the horizontal distance to the last hidden fix of
windows all along the recording (10 s, of recordings shorter than two minutes 5 s; every third part of the time).
"""

import os
import time
from pathlib import Path

import numpy as np

from benchmarks import common
from jaxnav import build, navigate, read
from jaxnav.analysis import evaluate
from jaxnav.analysis.noise_scan import scan_noise
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.tables import table
from jaxnav.analysis.windows import Windows, drift, hidden_windows
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import rows, with_history
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import LaneRecord
from jaxnav.filters.parameters import change, history_for, installed
from jaxnav.filters.scores import position_noise
from jaxnav.initialization.bank import most_probable
from jaxnav.initialization.initialize import Initialization, initialize
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.reading.datasets import RECORDINGS
from jaxnav.types import DataError, Params, Recording
from tuning.recordings.recorded import tune

RECIPES = Path(__file__).parents[2] / "docs" / "recipes"
PINNED = {"kth": "kth_gnss_ins", "rtkexplorer": "rtkexplorer_drive", "umn": "umn_thor75"}  # maps of data sets
PLAIN = {  # recordings without a recipe, below the folder of the data sets
    "navego_synthetic": "navego_synthetic",
    "px4_sitl": "ulog_samples/sample_px4_events.ulg",
    "px4_sitl_truth": "ulog_samples/sample_logging_tagged_and_default_params.ulg",
    "dataflash": "dataflash_sample/test.BIN",
}
PHASES, SETTLE = 3, 10.0
SHORT = ("ekf2_replay", "px4_sitl", "px4_sitl_truth", "dataflash", "phone")  # below 60 s, or an IMU below 10 Hz
SET_ON = ("px4_quad106", "rtkexplorer", "morpinet", "umn")  # that the recipe of tuning was made with


def sources() -> dict[str, Path]:
    """Every recording by name."""
    data = Path(os.environ.get("JAXNAV_DATA_DIR", "."))
    found = {path.stem: path for path in RECIPES.glob("*.toml")}
    found = dict(sorted((found | {name: RECORDINGS / f"{stem}.toml" for name, stem in PINNED.items()}).items()))
    return found | {name: data / path for name, path in PLAIN.items() if (data / path).exists()}


def lines_of(path: Path) -> int:
    """Lines of configuration that a user writes: a map's, without remarks."""
    if path.suffix != ".toml":
        return 0
    return sum(bool(line.split("#")[0].strip()) for line in path.read_text().splitlines())


def window_of(rec: Recording) -> float:
    """Length of the hidden windows, s."""
    return 10.0 if np.ptp(rec.aiding["position"].t) >= 120.0 else 5.0


def one(name: str, path: Path, tracks: dict | None) -> dict:
    """One recording from its file to its figures."""
    clear_caches_if_needed()
    begin = time.perf_counter()
    try:
        rec = read(path)
        streams = [key for key in ("position", "velocity") if key in rec.aiding]
        ekf = build("ekf15", measurements=streams)
        sol = navigate(rec, ekf, ekf.params("consumer"))
    except (DataError, ValueError) as error:
        return {"ran": False, "lines": lines_of(path), "why": str(error)}
    seconds = time.perf_counter() - begin
    start, length = sol.initialization, window_of(rec)
    found = evaluate.innovation_metrics(sol.trace.info, sol.measurements)
    packed = sol.packed
    windows = hidden_windows(packed, length, 3 * length, PHASES, SETTLE)
    out = {
        "ran": True, "lines": lines_of(path), "seconds": seconds, "windows": int(windows.end.size), "window_s": length,
        "nis": {key: value**2 for key, value in found["innovation_rms"].items()},
        "start": {"how": start.how, "heading_sd_deg": float(start.prior.attitude[2]) / DEG, "t_s": start.t,
                  "delay_s": None if start.alignment is None else start.alignment.delay},
        "notes": sol.notes,
    }  # fmt: skip
    if windows.end.size:
        error, _ = drift(sol.filter, sol.params, sol.nav, packed.epochs, windows, sol.measurements)
        off = np.hypot(error[:, 0], error[:, 1])
        out |= {"drift_median_m": float(np.median(off)), "drift_rms_m": float(np.sqrt(np.mean(off**2)))}
        out |= {"drift_m": off.tolist()}
    if tracks is not None:
        tracks[name] = tuple(earth.enu_path(a, sol.lla[0])[:, :2] for a in (sol.lla, rec.aiding["position"].value))
    return out


def hidden_drift(
    rec: Recording, filt: Filter, params: Params, begin: Initialization, length: float, every: float
) -> tuple[ep.Packed, Windows, np.ndarray, LaneRecord]:
    """Return epochs, windows of ``length`` s each ``every`` s, predicted minus measured fix (W, 3) m, and runs."""
    params, chosen = begin.apply_to(params), rows(filt.model.measurements)
    filt = with_history(filt, history_for(params, 1 / float(np.median(rec.imu.dt)), float(np.ptp(rec.imu.t))))
    packed = ep.pack_recording(rec, chosen, begin.t)
    windows = hidden_windows(packed, length, every, PHASES, SETTLE)
    nav = most_probable(filt, params, begin.navs, packed.epochs)
    return packed, windows, *drift(filt, params, nav, packed.epochs, windows, chosen)


def drifts(rec: Recording, sensors: tuple[str, ...], states: tuple[str, ...], window: float) -> np.ndarray:
    """Predicted minus measured fix at the ends of the windows, (W, 3) m ENU."""
    clear_caches_if_needed()
    streams = [key for key in ("position", "velocity") if key in rec.aiding]
    filt = build("ekf15", (*streams, *sensors), cov_stride=5, states=states)
    params = filt.params("consumer")
    return hidden_drift(rec, filt, params, initialize(rec, params), window, 2 * window)[2]


def tuned(name: str, path: Path) -> dict:
    """One recording tuned without truth on its first part and judged on its last."""
    clear_caches_if_needed()
    begin = time.perf_counter()
    try:
        rec = read(path)
        ekf = build("ekf15", measurements=[key for key in ("position", "velocity") if key in rec.aiding], cov_stride=5)
        found = tune(rec, ekf, ekf.params("consumer"))
        seconds = time.perf_counter() - begin
    except (DataError, ValueError) as error:
        return {"ran": False, "why": str(error)}
    before, after = found.test["datasheet"]["rms_m"], found.test[found.chosen]["rms_m"]
    split, honest = found.used[0].layout.validation, {}
    for key in dict.fromkeys(k for k in ("datasheet", "auto", found.chosen) if k in found.trials):
        trial = found.trials[key]
        honest[key] = judged(rec, trial.filter, trial.params, found.used[0].initialization, split)
    clock = next((r for r in found.rows if r.name == "clock_drift"), None)
    return {
        "ran": True, "drift_ratio": after / before, "datasheet_m": before, "tuned_m": after,
        "interval": None if found.interval is None else [found.interval.low, found.interval.high],
        "nis": found.nis[found.chosen], "chosen": found.chosen, "n_eff": found.effective,
        "far": [r.name for r in found.rows if "sd from the datasheet" in r.remark],
        "windows": found.counts, "set_on": name in SET_ON,
        "clock_ppm": None if clock is None else [clock.value, clock.low, clock.high],
        "candidates": {k: v["rms_m"] / before for k, v in found.test.items()}, "verdict": found.verdict,
        "validation": {k: [*t.ratios, t.nll] for k, t in found.trials.items()},
        "honest": honest, "evaluations": len(found.history), "seconds": seconds,
    }  # fmt: skip


def tuning_table(results: dict[str, dict]) -> str:
    """The ratios of all recordings."""
    rows = [
        [name, r["chosen"], r["datasheet_m"], r["tuned_m"],
         "{:.2f} ({:.2f} to {:.2f})".format(r["drift_ratio"], *r["interval"]),
         " ".join(f"{v:.2f}" for v in r["candidates"].values()), r["windows"]["test"], f"{r['n_eff']:.0f}",
         "" if r["clock_ppm"] is None else f"{r['clock_ppm'][0]:.0f}", r["evaluations"], f"{r['seconds']:.0f}",
         *(" ".join(f"{h[k]:.2f}" for h in r["honest"].values()) for k in ("error_over_sd", "inside_95", "nis"))]
        for name, r in results.items() if r["ran"]
    ]  # fmt: skip
    head = "recording,chosen,datasheet m,chosen m,ratio,candidates,windows,N,clock ppm,evaluations,s".split(",")
    head += ["error / sd", "in 95 %", "NIS"]
    all_of = np.array([r["drift_ratio"] for r in results.values() if r["ran"]])
    return table(head, rows) + f"\nlargest ratio {all_of.max():.2f}, median {np.median(all_of):.2f}"


JUDGED = 0.6  # share of a recording that the noise scan may see; the rest judges it
CHI2_2 = 5.99  # 95 % of chi-square with two degrees of freedom


def judged(rec: Recording, filt: Filter, params: Params, begin: Initialization, split: float) -> dict:
    """Hidden windows after ``split`` s by these parameters: RMS m, error / stated sd, share inside 95 %, NIS / dof.

    RMS is of the predicted fix; the stated sd is of a fix and its prediction, which has the receiver's error.
    """
    length = window_of(rec)
    packed, windows, error, info = hidden_drift(rec, filt, params, begin, length, 3 * length)
    late, after = windows.start > split, packed.t > split
    at = windows.end[late]
    noise = position_noise(params, np.asarray(packed.epochs.fix.sd)[at, :3])
    S = (info.P[windows.phase[late], at] + noise)[:, :2, :2]
    error, residual = error[late, :2], info.residual[windows.phase[late], at, :2]
    z2 = np.einsum("wi,wij,wj->w", residual, np.linalg.inv(S), residual)
    valid, nis = info.valid[:, : packed.t.size][:, after].sum(-1), info.nis[:, : packed.t.size][:, after]
    return {
        "windows": int(late.sum()), "rms_m": float(np.sqrt(np.mean(np.sum(error**2, 1)))),
        "error_over_sd": float(np.sqrt(np.mean(np.sum(residual**2, 1) / np.trace(S, axis1=1, axis2=2)))),
        "inside_95": float(np.mean(z2 < CHI2_2)), "nis": float(nis[valid > 0].sum() / valid.sum()),
    }  # fmt: skip


def scanned(path: Path) -> dict:
    """One recording by a consumer's white noise, by its datasheet, and by the scan of its first part, on the rest."""
    clear_caches_if_needed()
    try:
        rec = read(path)
        filt = build("ekf15", [key for key in ("position", "velocity") if key in rec.aiding], cov_stride=5)
        params = installed(filt.params("consumer"), rec.lever_arm)
        begin = initialize(rec, params)
        split = begin.t + JUDGED * (float(rec.aiding["position"].t[-1]) - begin.t)
        watch = time.perf_counter()
        found = scan_noise(rec, params, initialization=begin, stop=split)
        seconds = time.perf_counter() - watch
        before = judged(rec, filt, change(params, {"noise.scale": 0.0}), begin, split)
        stated = judged(rec, filt, params, begin, split)
        filt, wide = found.extended(filt, params)
        after = judged(rec, filt, found.applied(wide), begin, split)
    except (DataError, ValueError) as error:
        return {"ran": False, "why": str(error)}
    return {
        "ran": True, "factors": [found.gyro, found.accel, found.receiver.position, found.receiver.velocity],
        "slow": [*found.receiver.share.tolist(), *found.receiver.tau.tolist()],
        "scale": found.scale, "latency_s": found.latency, "gain": found.gain,
        "drift_ratio": after["rms_m"] / before["rms_m"], "seconds": seconds, "datasheet": before,
        "with_scale_errors": stated, **after,
    }  # fmt: skip


def scan_table(results: dict[str, dict]) -> str:
    """Return the ratios of all recordings, and the bars."""
    ran = {name: r for name, r in results.items() if r["ran"]}
    lines = [
        [name, *(f"{f:.3g}" for f in (*r["factors"][:2], r["scale"], *r["factors"][2:])), f"{r['latency_s']:.2f}",
         r["windows"], r["datasheet"]["rms_m"], r["with_scale_errors"]["rms_m"], r["rms_m"], f"{r['drift_ratio']:.2f}",
         f"{r['slow'][0]:.2g}, {r['slow'][2]:.0f} s",
         *(f"{r['datasheet'][k]:.2f} -> {r[k]:.2f}" for k in ("error_over_sd", "inside_95", "nis"))]
        for name, r in ran.items()
    ]  # fmt: skip
    head = [
        "recording",
        "gyro",
        "accel",
        "scale",
        "position",
        "velocity",
        "s",
        "windows",
        "white noise m",
        "datasheet m",
        "auto m",
        "ratio",
        "slow",
        "error / sd",
        "in 95 %",
        "NIS",
    ]
    ratio = np.array([r["drift_ratio"] for r in ran.values()])
    within = {k: np.mean([0.5 <= r[k] <= 2.0 for r in ran.values()]) for k in ("error_over_sd", "nis")}
    return (
        f"{table(head, lines)}\nratio: median {np.median(ratio):.2f}, largest {ratio.max():.2f}; within 0.5 to 2: "
        f"error / sd {within['error_over_sd']:.0%}, NIS {within['nis']:.0%} of the recordings"
    )


def draw(tracks: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Every track, small, with its fixes."""
    fig = plots.figure(11, 2.4 * -(-len(tracks) // 5))
    for ax, (name, (track, fixes)) in zip(fig.subplots(-(-len(tracks) // 5), 5).ravel(), tracks.items(), strict=False):
        plots.dress(ax, name)
        ax.plot(*fixes.T, ".", ms=2, color="0.7")
        ax.plot(*track.T, lw=0.8, color=plots.BLUE)
        ax.set_aspect("equal", adjustable="datalim")
        ax.tick_params(labelsize=6)
    for ax in fig.axes[len(tracks) :]:
        ax.remove()
    fig.suptitle("Recordings as their users have them: solution (line) and fixes, m east and north", fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    plots.save(fig, path)


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("wild", __doc__.splitlines()[0])
    parser.add_argument("--only", metavar="A,B", help="these recordings")
    parser.add_argument("--figure", metavar="F", type=Path, help="draw every track into F, a .png")
    parser.add_argument("--tune", action="store_true", help="tune each without truth instead, and judge it")
    parser.add_argument(
        "--auto", action="store_true", help="the noise scan of the first part, judged on the rest, instead"
    )
    args = parser.parse_args(argv)
    chosen = sources()
    if args.only:
        chosen = {name: chosen[name] for name in args.only.split(",")}
    results: dict[str, dict] = {}
    if args.tune:
        for name, path in chosen.items():
            if name in SHORT:
                continue
            results[name] = r = tuned(name, path)
            print(f"{name}: {r['verdict'] if r['ran'] else r['why']}", flush=True)
            common.write_json(args.json, results)
        print(tuning_table(results))
        return
    if args.auto:
        for name, path in chosen.items():
            if name not in SHORT:
                results[name] = r = scanned(path)
                print(f"{name}: {r['drift_ratio'] if r['ran'] else r['why']}", flush=True)
                common.write_json(args.json, results)
        print(scan_table(results))
        return
    tracks: dict | None = {} if args.figure else None
    for name, path in chosen.items():
        results[name] = r = one(name, path, tracks)
        print(f"{name}: {r['start']['how'] if r['ran'] else r['why']}", flush=True)
    rows = [
        [name, r["lines"], r.get("windows", 0), r.get("window_s", ""), r.get("drift_median_m", ""),
         r.get("drift_rms_m", ""), " ".join(f"{v:.2g}" for v in r.get("nis", {}).values()), r.get("seconds", "")]
        for name, r in results.items()
    ]  # fmt: skip
    print(table(["recording", "lines", "windows", "s", "median m", "RMS m", "nu^2 / S by channel", "s"], rows))
    if tracks:
        draw(tracks, args.figure)
    common.write_json(args.json, results)
