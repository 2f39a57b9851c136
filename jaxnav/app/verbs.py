"""VERBS: the verbs of the command line, a row each: ``jaxnav VERB``. A verb's work is a module of `jaxnav.app.jobs`."""

import argparse
import importlib
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from jaxnav.app.config import Config, Initialization
from jaxnav.app.verb import DATA, DEVICES, FILTER, MAP, PARAMS, PATH, RESUME, Argument, Job, Verb, no_effect
from jaxnav.filters.border import TABLES
from jaxnav.types import Json

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome

RUN = ("data", "filter", "initialization", *TABLES)
"""Sections of a run over a recording."""
SHELLS = ("bash", "zsh", "tcsh")  # that shtab writes completions for
Settings = Json


def later(name: str, call: Callable[[Any, Job], "Outcome"]) -> Callable[[Job], "Outcome"]:
    """Return the work of a verb by a module of `jaxnav.app.jobs`, which other verbs do not wait for."""
    return lambda job: call(importlib.import_module(f"jaxnav.app.jobs.{name}"), job)


def strings(text: str) -> list[str]:
    """Return the parts of A,B,..."""
    return [name.strip() for name in text.split(",")]


# ---------------------------------------------------------------------------- settings if nothing else is said

# ten minutes at usual rates: recordings of similar ones share its programs (`jaxnav.filters.epochs.pad_to_bucket`)
WARM: Settings = {"data": {"source": "urban", "options": {"duration_s": 600.0, "imu_rate_hz": 100.0}}}
DEMO: Settings = {
    "data": {"source": "urban", "imu_worse_by": 3.0, "gnss_latency_s": 0.1},
    "filter": {"cov_stride": 10},
    "tune": {
        "method": "scoring",
        "objective": {"nll": 1.0},
        "steps": 24,
        "runs": 6,
        "validation_runs": 8,
        "test_runs": 12,
        "free": ["noise", "latency"],
    },
}
"""An IMU three times noisier than its datasheet, and fixes 0.1 s late; the parameters state neither."""
BAKEOFF: Settings = {
    "data": {"source": "gipkf_urban"},
    "filter": {"name": "gpid,gpid15,gipkf,fwekf,fwekf15,ekf15_gate,ekf15_huber", "cov_stride": 10},
    "bakeoff": {"unseen": ["gipkf_urban_uncalibrated", "gipkf_urban_stress"]},
    "tune": {"steps": 20, "rate": 0.2, "runs": 6, "validation_runs": 4, "test_runs": 16},
}
"""The papers' filters in outages."""


def warm(args: argparse.Namespace) -> Settings:
    """Return the recording to compile for where none is named."""
    return WARM if args.warm and not (args.source or args.data or args.config) else {}


# ---------------------------------------------------------------------------- settings without effect, and why


def read_whole(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where a recording is read whole."""
    return no_effect("the whole recording is read", "data.start", "data.stop")


def start_found(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where the motion shows the start."""
    if config.initialization.heading != "motion":
        return {}
    found = ("initialization.course_speed_mps", "initialization.tilt_sd_deg", "initialization.heading_sd_deg")
    return no_effect('initialization.heading = "motion" finds it by itself', *found)


def all_found(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings that are found from the recording."""
    chosen = (
        "name", "grade", "states", "measurements", "cov_stride", "interval_s", "smooth", "lag_s", "sd_factor",
        "velocity_sd_factor", "delay_sd_s", "clock_rate_sd_ppm", "outages", "standing_window_s",
        "standing_accel_sd_mps2", "standing_gyro_sd_deg_per_s",
    )  # fmt: skip
    return no_effect("is found from the recording", *(f"filter.{key}" for key in chosen))


def tuned(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where fixes are hidden by the tuner, and by the method."""
    found = no_effect("tuning hides fixes by itself", "filter.outages")
    found |= no_effect("only `jaxnav filter` uses it", "filter.smooth", "filter.lag_s")
    if simulated:
        found |= no_effect("a simulated run is used whole", "data.start", "data.stop")
        found |= no_effect("simulated runs have the scenario's outages", "tune.outage_s")
    else:
        found |= start_found(config, simulated)
        found |= no_effect("applies to simulated runs only", "tune.runs", "tune.validation_runs", "tune.test_runs")
    if config.tune.method in ("lbfgs", "scoring"):
        found |= no_effect(f"{config.tune.method} chooses its steps", "tune.rate")
    return found


def scenarios(config: Config, simulated: bool) -> dict[str, str]:
    """Return settings without effect where scenarios are run whole and hide fixes by themselves."""
    starts = (f"initialization.{field.name}" for field in fields(Initialization))
    return {
        **no_effect("scenarios hide fixes by themselves", "filter.outages"),
        **no_effect("only `jaxnav filter` uses it", "filter.smooth", "filter.lag_s"),
        **no_effect("a simulated run is used whole", "data.start", "data.stop"),
        **no_effect("filters start as the scenario says", *starts),
    }


# ---------------------------------------------------------------------------- the table


def never(args: argparse.Namespace) -> bool:
    """Write nothing into --out."""
    return False


tune = later("tune", lambda jobs, job: jobs.tune(job.config, job.folder, job.progress, job.long))
ROWS = (
    Verb(
        "demo", "simulate, tune by likelihood and draw the figures: no data, no network, a minute the first time",
        tune, (FILTER, PARAMS), (*RUN, "tune", "out"), report=True, defaults=lambda args: DEMO, unused=tuned,
    ),
    Verb(
        "solve", "the best trajectory of a recording, without settings: check, tune, smooth, and a verdict",
        later("solve", lambda jobs, job: jobs.run(job, job.args.fast, job.args.time)),
        (PATH, MAP, Argument("--fast", "do not tune"),
         Argument("--time", "end within S seconds, with the best that they allow", value="S", type=float)),
        (*RUN, "time", "out"), report=True, unused=all_found,
    ),
    Verb(
        "check", "find faults of data, units, axes and clocks; write a configuration that runs the recording",
        later("check", lambda jobs, job: jobs.check(job.config, job.folder)),
        (PATH, MAP), ("data", "out"), unused=read_whole,
    ),
    Verb(
        "map", "draft a column map of tables from names and numbers of their columns",
        later("check", lambda jobs, job: jobs.drafted(job.args.files)),
        (Argument("files", "tables with names in a header, or their folder", value="FILE", reads=True,
                  more={"nargs": "+"}),),
        writes=never,
    ),
    Verb(
        "convert", "write a recording of any format as CSV files",
        later("check", lambda jobs, job: jobs.convert(job.config, job.folder)),
        (PATH, MAP), ("data",), unused=read_whole,
    ),
    Verb(
        "simulate", "write a simulated recording and its truth",
        later("filtering", lambda jobs, job: jobs.simulate(job.config, job.folder)), DATA, ("data", "out"),
    ),
    Verb(
        "filter", "run a filter over a recording: solution, metrics, figures",
        later("filtering", lambda jobs, job: jobs.run(job)),
        (*DATA, MAP, FILTER, PARAMS,
         Argument("--smooth", "by all fixes, those after it too ([filter] smooth)", "filter.smooth"),
         Argument("--lag", "by the fixes of the next S seconds ([filter] lag_s)", "filter.lag_s", value="S",
                  type=float),
         Argument("--warm", "compile for recordings like this one and write nothing: before a demo")),
        (*RUN, "time", "out"), writes=lambda args: not args.warm, report=True, defaults=warm, unused=start_found,
    ),
    Verb(
        "stream", "the solution as data arrive: from standard input, or from a recording in real time",
        later("stream", lambda jobs, job: jobs.run(job)),
        (*DATA, MAP, FILTER, PARAMS,
         Argument("--speed", "multiple of real time (0: no wait)", value="X", type=float, more={"default": 0.0}),
         Argument("--every", "s of data between rows", value="S", type=float, more={"default": 1.0}),
         Argument("--format", "of the rows: csv, jsonl, nmea (GGA)", value="F",
                  more={"default": "csv", "choices": ("csv", "jsonl", "nmea")}),
         Argument("--axes", "of the IMU in lines of standard input, such as flu", value="AXES"),
         Argument("--units", "of those lines: of rates, accelerations, angles, such as deg/s,g,deg", value="U,U,U"),
         Argument("--udp", "send rows to this port of this machine", value="PORT", type=int)),
        writes=never,
    ),
    Verb(
        "tune", "tune a filter's parameters and show the gain on test data", tune,
        (*DATA, MAP, FILTER, PARAMS,
         Argument("--for", "another filter, such as kfgins, px4", "tune.target", value="TARGET"), RESUME, *DEVICES),
        (*RUN, "tune", "out"), report=True, unused=tuned,
    ),
    Verb(
        "bakeoff", "filters tuned alike on the same scenarios, ranked on runs and scenarios that none has seen",
        later("bakeoff", lambda jobs, job: jobs.bakeoff(job.config, job.folder, job.progress, job.devices)),
        (*DATA, FILTER, PARAMS,
         Argument("--unseen", "scenarios to test on only; SOURCE, --filter take lists too", "bakeoff.unseen",
                  value="A,B", type=strings), *DEVICES),
        ("data", "filter", *TABLES, "tune", "bakeoff", "out"),
        report=True, defaults=lambda args: BAKEOFF, unused=scenarios, simulates=True,
    ),
    Verb(
        "mc", "Monte Carlo: filters over many simulated runs, errors, consistency, divergence",
        later("mc", lambda jobs, job: jobs.mc(job.config, job.folder, job.progress, job.long)),
        (*DATA, FILTER, PARAMS,
         Argument("--runs", "how many ([mc] runs); --filter takes A,B,...", "mc.runs", value="N", type=int),
         RESUME, *DEVICES),
        ("data", "filter", *TABLES, "mc", "out"), report=True, unused=scenarios, simulates=True,
    ),
    Verb(
        "compare",
        "finished runs side by side: figures and settings that differ, tracks over one another; one alone is printed "
        "again",
        later("compare", lambda jobs, job: jobs.run(job)),
        (Argument("paths", "of finished runs of one verb", reads=True, value="FOLDER", more={"nargs": "+"}),),
        ("out",), writes=lambda args: len(args.paths) > 1,
    ),
    Verb(
        "allan", "Allan deviation of a resting IMU: white noise, bias instability, random walk, Gauss-Markov",
        later("allan", lambda jobs, job: jobs.allan(job.config, job.folder)),
        (*DATA, MAP,
         Argument("--start", "s, use the recording from here ([data] start)", "data.start", value="S", type=float),
         Argument("--stop", "s, to here ([data] stop)", "data.stop", value="S", type=float)),
        ("data", "out"),
    ),
    Verb(
        "config", "print every setting with its default and description, as a configuration to fill in",
        later("printed", lambda jobs, job: jobs.config(job.args.markdown)),
        (Argument("--markdown", "as a page of the docs"),), writes=never, needs_jax=False,
    ),
    Verb(
        "completion", "print a script that completes arguments by the tab key",
        later("printed", lambda jobs, job: jobs.completion(job.args.shell)),
        (Argument("shell", "name of the shell", more={"choices": SHELLS}),),
        writes=never, needs_jax=False,
    ),
    Verb(
        "info", "versions, devices, filters, data sets, compiled programs",
        later("info", lambda jobs, job: jobs.info(job.args.clear_cache)),
        (Argument("--clear-cache", "remove the compiled programs that are kept"),), writes=never,
    ),
    Verb(
        "data", "list, fetch or check public data sets",
        later("info", lambda jobs, job: jobs.data(job.args.action, job.args.name)),
        (Argument("action", "list, fetch or check", more={"choices": ("list", "fetch", "check")}),
         Argument("name", "of the data set; check also takes a path", more={"nargs": "?"})),
        writes=never,
    ),
)  # fmt: skip
VERBS: dict[str, Verb] = {row.name: row for row in ROWS}
