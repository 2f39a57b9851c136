"""`jaxnav simulate` and `jaxnav filter`."""

import time
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxnav import data as io
from jaxnav.analysis import evaluate, usage
from jaxnav.analysis.dense import dense
from jaxnav.analysis.navigate import execute
from jaxnav.analysis.observability import states_in_words
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import interactive
from jaxnav.analysis.tables import table
from jaxnav.app.config import Config
from jaxnav.app.prepare import ReadyRun, grade_name, prepare
from jaxnav.app.results import FailedCheck, Outcome, picture
from jaxnav.app.sources import load, scenario_of
from jaxnav.data import gaps
from jaxnav.data.epochs import TICK, hide, in_windows, within
from jaxnav.data.json import write_json
from jaxnav.data.solution import FORMATS
from jaxnav.filters.run import first_failure
from jaxnav.filters.smoother import reach_of, smooth_jit
from jaxnav.types import ConfigError, Info, Track, nearest

EARLIEST, LATEST = 3e8, 4e9  # s since 1970 that are a date, about 1980 to 2096
ENOUGH = 0.98  # share of a run that its truth tells


def simulate(config: Config, folder: Path) -> Outcome:
    """Write a simulated run as a canonical recording with its truth.

    Raises:
        ConfigError: the source is no scenario.
    """
    if scenario_of(config) is None:
        raise ConfigError(f"data.source: simulate takes a scenario, got {config.data.source!r}")
    begin = time.perf_counter()
    rec, _ = load(config)
    io.write_recording(folder / "recording", rec)
    for file in (folder / "recording").iterdir():
        file.rename(folder / file.name)
    (folder / "recording").rmdir()
    about = describe(rec)
    return Outcome({"recording": about}, describe_text(about), {"simulate": time.perf_counter() - begin})


def describe(rec: Any) -> dict[str, Any]:
    """What a recording holds."""
    streams = {"imu": rec.imu.t, **{name: s.t for name, s in rec.aiding.items()}}
    if rec.truth is not None:
        streams["truth"] = rec.truth.t
    rows = {
        name: {"rows": t.size, "start_s": float(t[0]), "end_s": float(t[-1]),
               "rate_hz": float(1 / np.median(np.diff(t))) if t.size > 1 else float("nan")}
        for name, t in streams.items()
    }  # fmt: skip
    return {"name": rec.name, "streams": rows, "lever_arm_m": rec.lever_arm.tolist(), "notes": rec.notes}


def describe_text(about: dict[str, Any]) -> str:
    """`describe` as a table."""
    rows = [[name, s["rows"], s["start_s"], s["end_s"], s["rate_hz"]] for name, s in about["streams"].items()]
    return f"{about['name']}\n" + table(["stream", "rows", "start (s)", "end (s)", "rate (Hz)"], rows)


def filter(config: Config, folder: Path) -> Outcome:
    """Run the filter over the recording and write solution, metrics and figures.

    Raises:
        FailedCheck: the filter stopped being finite. ConfigError: an unknown format of the solution.
    """
    for kind in config.out.formats:  # before the work, not after it
        if kind not in FORMATS:
            raise ConfigError(f"out.formats: no format {kind!r}: {nearest(kind, FORMATS)}")
    seconds, begin = {}, time.perf_counter()
    case = prepare(config, scanned=True)
    hidden = in_windows(case.packed.t, config.filter.outages)
    seconds["prepare"], begin = time.perf_counter() - begin, time.perf_counter()
    info, taken = execute(case.filter, case.params, case.navs, hide(case.packed.epochs, hidden, case.measurements))
    jax.block_until_ready(info)
    seconds["filter"], begin = time.perf_counter() - begin, time.perf_counter()
    check(info, case.packed.t, case.recording.name)
    best, lag = jax.tree.map(lambda a: a[taken.best], case.navs), config.filter.lag_s
    if config.filter.smooth or lag:
        epochs = hide(case.packed.epochs, hidden, case.measurements)
        try:
            within = () if config.filter.smooth else reach_of(case.packed.t, lag)
            _, info = smooth_jit(case.filter, case.params, best, epochs, *within)
        except ValueError as error:
            raise ConfigError(f"filter.smooth: {config.filter.name}: {error}") from error
    sol = evaluate.trace(info, case.params)
    found = metrics_of(case, sol, hidden, config)
    if taken.words:
        found["heading_bank"] = {
            "start_heading_deg": taken.heading_deg, "start_heading_probability": taken.probability
        }  # fmt: skip
    uses = usage.usage(case.recording, case.packed, sol.info, case.measurements, hidden)
    order, names, _ = evaluate.channels(case.measurements)
    channels = usage.expected(sol.info, names, order)
    found |= usage.as_json(uses, channels)
    found["remarks"] = usage.consistency_in_words(sol.info, channels) + usage.usage_in_words(uses)
    found["remarks"] += usage.noise_in_words(case.recording.imu, case.params)
    found["remarks"] += states_in_words(case.filter, case.params, best, sol.info)
    if found.get("scored_share", 1.0) < ENOUGH:
        found["remarks"].append(f"truth tells {found['scored_share']:.0%} of the epochs: errors are of these alone")
    unused = sorted(set(case.recording.aiding) - {m.name for m in case.measurements})
    found |= {"unused_streams": unused} if unused else {}
    if case.noise is not None:
        scan = case.noise
        found["noise_scan"] = {
            "gyro": scan.gyro, "accel": scan.accel, "latency_s": scan.latency, "gain": scan.gain,
            "position": scan.position, "velocity": scan.velocity,
        }  # fmt: skip
    notes = [
        taken.words,
        case.noise.words if case.noise else "",
        *case.recording.notes.splitlines(),
        gaps.in_words(gaps.holes(case.recording.imu)),
    ]
    found |= {"start": case.begun.how, "notes": [note for note in notes if note]}
    whole = (sol.track, sol.sd)
    if config.out.imu_rate:
        epochs = hide(case.packed.epochs, hidden, case.measurements)
        whole = dense(case.filter, case.params, best, epochs, config.filter.smooth, lag)
    write_solution(config, folder, *whole, case)
    write_json(folder / "metrics.json", found)
    if config.out.figures:
        with picture("the run"):
            draw(config, folder, sol, case)
    seconds["write"] = time.perf_counter() - begin
    fixes, outages, states = case.recording.aiding["position"], shaded(config, case), case.filter.model.states
    layout = partial(interactive.run_layout, sol, case.recording.truth, fixes, case.measurements, outages, states)
    return Outcome(found, summary(found, config.filter.name, case.recording.name), seconds, "", layout, case.config)


def draw(config: Config, folder: Path, sol: evaluate.Trace, case: ReadyRun) -> None:
    """The figures of a run, each with what it is of."""
    rec, states = case.recording, case.filter.model.states
    found = evaluate.figures(
        sol, rec.truth, rec.aiding["position"], case.measurements, shaded(config, case), case.bias_truth, states
    )
    if case.noise is not None and case.noise.fixes:
        found["noise_scan"] = case.noise.figure()
    for name, fig in found.items():
        plots.name(fig, titled(config, case))
        plots.save(fig, folder / f"{name}.png")


def titled(config: Config, case: ReadyRun) -> str:
    """What a figure is of: filter, data, and when the data begin where their times are dates."""
    begin = float(case.packed.t[0])
    date = f", {datetime.fromtimestamp(begin, UTC):%Y-%m-%d %H:%M} UTC" if EARLIEST < begin < LATEST else ""
    how = ", smoothed" if config.filter.smooth else f", lag {config.filter.lag_s:g} s" if config.filter.lag_s else ""
    return f"{config.filter.name} on {case.recording.name}{how}{date}"


def check(info: Info, t: np.ndarray, name: str) -> None:
    """Raise FailedCheck where a run stopped being finite, with run and time."""
    failure = first_failure(info, t)
    if failure:
        raise FailedCheck(f"run {name}: {failure}")


def shaded(config: Config, case: ReadyRun) -> evaluate.Outages:
    """Outages for the figures: those of the configuration, and gaps of the position of over 5 intervals and 3 s.

    The end of the data is where a last gap ends.
    """
    t = case.recording.aiding["position"].t
    long = max(5 * float(np.median(np.diff(t))), 3.0)
    t = np.append(t, max(t[-1], case.packed.t[-1]))
    gaps = np.flatnonzero(np.diff(t) > long)
    return sorted([(float(t[i]), float(t[i + 1])) for i in gaps] + [(w[0], w[1]) for w in config.filter.outages])


def metrics_of(case: ReadyRun, sol: evaluate.Trace, hidden: np.ndarray, config: Config) -> dict[str, Any]:
    """Errors where there is a truth, innovations, and the error at the end of each outage."""
    found: dict[str, Any] = {"start_s": case.packed.start, "grade": grade_name(config, scenario_of(config))}
    truth = case.recording.truth
    if truth is not None:
        error, sd = evaluate.ned_errors(sol, truth)
        dark = hidden | within(case.packed.t, shaded(config, case))
        found["errors"] = evaluate.error_metrics(error, sd, dark)
        found["scored_share"] = float(np.isfinite(error[:, 0]).mean())
    found |= evaluate.innovation_metrics(sol.info, case.measurements)
    ends = [
        {"start_s": start, "end_s": end, "horizontal_m": at_end}
        for start, end in shaded(config, case)
        if np.isfinite(at_end := end_error(case, sol, start, end))
    ]
    return found | ({"outages": ends} if ends else {})


def end_error(case: ReadyRun, sol: evaluate.Trace, start: float, end: float) -> float:
    """Horizontal error (m) at the last epoch without a fix of an outage; nan where nothing tells it."""
    t, valid = case.packed.t, np.asarray(case.packed.epochs.fix.valid)[:, :2]
    used = np.asarray(sol.info.valid)[:, :2]
    lost = np.flatnonzero((t > start + TICK) & (t <= end + TICK) & ~used.all(axis=1))
    if not lost.size:
        return float("nan")
    i = int(lost[-1])
    if case.recording.truth is not None:
        return float(np.hypot(*evaluate.ned_errors(sol, case.recording.truth)[0][i, :2]))
    return float(np.hypot(*np.asarray(sol.info.residual)[i, :2])) if valid[i].all() else float("nan")


def write_solution(config: Config, folder: Path, track: Track, sd: np.ndarray, case: ReadyRun) -> None:
    """Write the solution in each of [out] formats."""
    for kind in config.out.formats:
        path = folder / f"solution.{kind}"
        if kind == "kml":
            io.write_kml(path, track, case.recording.aiding["position"], case.recording.name)
        else:
            io.write_solution(path, track, kind, sd)


def summary(found: dict[str, Any], name: str, run: str) -> str:
    """The table of a run for the terminal."""
    lines = [f"{name} on {run}, from t = {found['start_s']:.3f} s, IMU grade {found['grade']}"]
    errors = found.get("errors", {})
    rows = [
        [key, v["rms"], v["p95"], v["max"], f"{100 * v['inside_3sd']:.1f} %" if "inside_3sd" in v else ""]
        for key, v in errors.items()
    ]
    if rows:
        lines += [table(["error", "RMS", "95 %", "max", "inside 3 sd"], rows), ""]
    rows = [[key, value] for key, value in found["innovation_rms"].items()]
    if rows:
        lines.append(table(["innovation / its sd", "RMS"], rows))
    share = 100 * found["nis_share_inside_95"]
    if np.isfinite(share):
        lines.append(f"NIS / dof {found['nis_per_dof']:.2f}, {share:.1f} % of fixes inside the 95 % bounds")
    else:
        lines.append("no fix was used: the solution is the IMU's alone")
    lines += found["remarks"]
    for outage in found.get("outages", []):
        lines.append(
            f"outage {outage['start_s']:g} to {outage['end_s']:g} s: {outage['horizontal_m']:.2f} m at its end"
        )
    if "unused_streams" in found:
        lines.append(f"not used of the recording: {', '.join(found['unused_streams'])} (see filter.measurements)")
    lines += [found["start"], *found["notes"]]
    return "\n".join(lines)
