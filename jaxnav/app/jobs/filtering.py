"""`jaxnav simulate` and `jaxnav filter`."""

import time
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav import io
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.tables import table
from jaxnav.app.config import Config
from jaxnav.app.prepare import (
    AUTO,
    base_params,
    filter_of,
    grade_name,
    grade_of,
    initialization_of,
    measurements_of,
    standing_of,
    states_noise,
    with_noise,
)
from jaxnav.app.results import Outcome, draws, picture
from jaxnav.app.sources import load, scenario_of
from jaxnav.app.verb import Job
from jaxnav.io.json import write_json
from jaxnav.io.solution import FORMATS
from jaxnav.maths.units import PPM
from jaxnav.navigation import BASES, Solution, navigate
from jaxnav.types import ConfigError, Json, nearest

CLOCKS = {"imu": "IMU", "fixes": "fixes"}
SHOWN_S = 1e-3  # s between the clocks, from which on it is said
EARLIEST, LATEST = 3e8, 4e9  # s since 1970 that are a date, about 1980 to 2096


def simulate(config: Config, folder: Path) -> Outcome:
    """Write a simulated run as a canonical recording with its truth.

    Raises:
        ConfigError: the source is no scenario.
    """
    if scenario_of(config) is None:
        raise ConfigError(f"data.source: simulate takes a scenario, got {config.data.source!r}")
    begin = time.perf_counter()
    rec = load(config)
    io.write_recording(folder / "recording", rec)
    for file in (folder / "recording").iterdir():
        file.rename(folder / file.name)
    (folder / "recording").rmdir()
    about = describe(rec)
    return Outcome({"recording": about}, describe_text(about), {"simulate": time.perf_counter() - begin})


def describe(rec: Any) -> Json:
    """Return the streams of a recording."""
    streams = {"imu": rec.imu.t, **{name: s.t for name, s in rec.aiding.items()}}
    if rec.truth is not None:
        streams["truth"] = rec.truth.t
    rows = {
        name: {
            "rows": t.size,
            "start_s": float(t[0]),
            "end_s": float(t[-1]),
            "rate_hz": float(1 / np.median(np.diff(t))) if t.size > 1 else float("nan"),
        }
        for name, t in streams.items()
    }
    return {"name": rec.name, "streams": rows, "lever_arm_m": rec.lever_arm.tolist(), "notes": rec.notes}


def describe_text(about: Json) -> str:
    """`describe` as a table."""
    rows = [[name, s["rows"], s["start_s"], s["end_s"], s["rate_hz"]] for name, s in about["streams"].items()]
    return f"{about['name']}\n" + table(["stream", "rows", "start (s)", "end (s)", "rate (Hz)"], rows)


def run(job: Job) -> Outcome:
    """Run the filter; of a run that is for its programs alone, say which are kept."""
    from jaxnav.app.jobs import info

    outcome = filter(job.config, job.folder)
    return outcome._replace(text=info.programs()) if job.args.warm else outcome


def filter(config: Config, folder: Path) -> Outcome:
    """Run the filter over the recording and write solution, metrics and figures.

    Raises:
        FilterError: the filter stopped being finite. ConfigError: an unknown format of the solution, or a filter that
            cannot be smoothed.
    """
    require_formats(config)
    seconds, begin, f = {}, time.perf_counter(), config.filter
    rec, scenario = load(config), scenario_of(config)
    filt = filter_of(config, measurements_of(config))
    if (f.smooth or f.lag_s) and not filt.supports_smoothing:
        raise ConfigError(f"filter.smooth: {f.name}: its rule corrects by more than the covariance says")
    params = base_params(config, grade_of(config, scenario), rec.lever_arm)
    seconds["read"], begin = time.perf_counter() - begin, time.perf_counter()
    sol = navigate(
        rec, filt, params, scan=grade_name(config, scenario) == AUTO and not states_noise(config),
        initialization=partial(initialization_of, config), stop=config.data.stop, outages=f.outages,
        interval=f.interval_s, standing=standing_of(config), smooth=f.smooth, lag=f.lag_s,
        sd_factor=f.sd_factor, velocity_sd_factor=f.velocity_sd_factor, delay_sd=f.delay_sd_s,
        clock_rate_sd=f.clock_rate_sd_ppm * PPM,
    )  # fmt: skip
    seconds["filter"], begin = time.perf_counter() - begin, time.perf_counter()
    found = sol.metrics() | {"grade": grade_name(config, scenario), "time": time_of(config, sol)}
    for kind in config.out.formats:
        sol.write(folder / f"solution.{kind}", imu_rate=config.out.imu_rate, base=config.time.base)
    write_json(folder / "metrics.json", found)
    if draws(config, interactive=True):
        draw(folder, config, sol)
    seconds["write"] = time.perf_counter() - begin
    ran = with_noise(config, sol.stated_params, sol.filter, sol.delay_sd) if sol.noise is not None else config
    verdict = f"consistent: NIS/dof {found['nis_per_dof']:.2f}" if np.isfinite(found["nis_per_dof"]) else ""
    return Outcome(
        found, summary(found, f.name, rec.name), seconds, "", sol.layout, ran, findings=sol.findings, verdict=verdict
    )


def time_of(config: Config, sol: Solution) -> Json:
    """Return the clock of the written times, and how far the fixes' stamps are from the IMU's halfway, s."""
    return {"base": config.time.base, "fixes_late_s": float(sol.stated_params.mounting.time_offset)}


def require_formats(config: Config) -> None:
    """Raise ConfigError for an unknown format or clock of the solution, before the work and not after it."""
    if config.time.base not in BASES:
        raise ConfigError(f"time.base: no clock {config.time.base!r}: {nearest(config.time.base, BASES)}")
    for kind in config.out.formats:
        if kind not in FORMATS:
            raise ConfigError(f"out.formats: no format {kind!r}: {nearest(kind, FORMATS)}")


def draw(folder: Path, config: Config, sol: Solution) -> None:
    """Draw the figures of a run."""
    with picture("the run"):
        for name, fig in sol.plot().items():
            plots.name(fig, name, titled(config, sol))
            plots.save(fig, folder / f"{name}.png")


def titled(config: Config, sol: Solution) -> str:
    """Return the caption of a run's figures: filter, data, and when the data begin where their times are dates."""
    begin = float(sol.packed.t[0])
    date = f", {datetime.fromtimestamp(begin, UTC):%Y-%m-%d %H:%M} UTC" if EARLIEST < begin < LATEST else ""
    how = ", smoothed" if sol.smoothed else f", lag {sol.lag:g} s" if sol.lag else ""
    return f"{config.filter.name} on {sol.recording.name}{how}{date}"


def summary(found: Json, name: str, run: str) -> str:
    """Return the table of a run for the terminal."""
    lines = [f"{name} on {run}, from t = {found['start_s']:.3f} s, IMU grade {found['grade']}"]
    errors = found.get("errors", {})
    rows = [
        [key, v["rms"], v["p95"], v["max"], f"{100 * v['inside_3sd']:.1f} %" if "inside_3sd" in v else ""]
        for key, v in errors.items()
    ]
    if rows:
        lines += [table(["error", "RMS", "95 %", "max", "inside 3 sd"], rows), ""]
    good = found["accuracy"]
    if np.isfinite(good["earth_m"]):
        split = not np.isclose(good["earth_m"], good["relative_m"])
        words = (
            f" on the Earth, {good['relative_m']:.2f} m from second to second" if split else ", errors taken as white"
        )
        lines.append(f"stated horizontal sd, median: {good['earth_m']:.2f} m{words}")
    rows = [[key, value] for key, value in found["innovation_rms"].items()]
    if rows:
        lines.append(table(["innovation / its sd", "RMS"], rows))
    share = 100 * found["nis_share_inside_95"]
    if np.isfinite(share):
        lines.append(f"NIS / dof {found['nis_per_dof']:.2f}, {share:.1f} % of fixes inside the 95 % bounds")
    else:
        lines.append("no fix was used: the solution is the IMU's alone")
    for outage in found.get("outages", []):
        lines.append(
            f"outage {outage['start_s']:g} to {outage['end_s']:g} s: {outage['horizontal_m']:.2f} m at its end"
        )
    if abs(found["time"]["fixes_late_s"]) >= SHOWN_S:
        other = "fixes" if found["time"]["base"] == "imu" else "imu"
        lines.append(
            f"times of the solution are those of the {CLOCKS[found['time']['base']]}; fixes are stamped "
            f'{found["time"]["fixes_late_s"]:+.3f} s from the IMU: time.base = "{other}" takes the other clock'
        )
    lines += [found["initialization"], *found["notes"]]
    return "\n".join(lines)
