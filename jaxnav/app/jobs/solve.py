"""`jaxnav solve`: the best trajectory of a recording, its files and its verdict."""

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from jaxnav.analysis.tables import table
from jaxnav.app.aside import Aside
from jaxnav.app.config import Config, as_dict, changed
from jaxnav.app.config import Filter as FilterSection
from jaxnav.app.jobs.filtering import draw, require_formats, summary, time_of
from jaxnav.app.prepare import AUTO, DATASHEET, adapter_name, initialization_of, with_weights
from jaxnav.app.results import Card, CardRow, Outcome, Table, draws, stderr
from jaxnav.app.sources import load
from jaxnav.app.verb import Job
from jaxnav.filters.border import TABLES, flat, in_user_units, nested, override
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import UNITS, get, has, installed
from jaxnav.io import atomic_write
from jaxnav.io.json import write_json
from jaxnav.io.toml import to_toml
from jaxnav.io.weights import WEIGHTS, write_weights
from jaxnav.maths.units import DEG, PPM
from jaxnav.states.table import BIASES
from jaxnav.types import ConfigError, Params, Recording
from tuning.fit.status import Status
from tuning.solving.calibration import Calibration
from tuning.solving.corrections import AXES, DRIFT, OFFSET, Corrections, check_and_correct
from tuning.solving.solve import CARE, CONSISTENT, COV_STRIDE, UNUSABLE, Solved, solve

UNTESTED = "not tested: the filter takes no velocity, or none was hidden"
NO_HEADING = "not tested: takes a truth or a second compass"
OPTIONS = "data.options."
COLORS = {CONSISTENT: "good", CARE: "care", UNUSABLE: "bad"}


def run(job: Job, fast: bool, limit: float | None) -> Outcome:
    """Solve the recording of [data]; solution, tuned.toml, exports, metrics, figures.

    Answers before the best one are published as they come.

    Args:
        job: of the verb.
        fast: do not tune.
        limit: s; None: none.

    Raises:
        ConfigError: an unknown format of the solution, or a limit that is none.
        DataError: a recording that cannot be used.
        FilterError: the filter stops being finite.
    """
    config = job.config
    require_formats(config)
    if limit is not None and not limit > 0:
        raise ConfigError(f"--time must be seconds above 0, got {limit:g}")
    begin, seconds = time.perf_counter(), {}
    rec = load(config)
    seconds["read"], begin = time.perf_counter() - begin, time.perf_counter()
    log = partial(timed, begin) if job.progress else lambda line: None

    def so_far(make: Callable[[], Solved]) -> None:
        found = make()
        job.publish(written(config, job.folder, found, dict(seconds)))
        log(f"an answer is in {job.out}: {in_words(found)}")

    with Aside(so_far) as aside:
        found = solve(
            rec, partial(datasheet, config), adapter=adapter_name(config), fast=fast,
            initialization=partial(initialization_of, config),
            stop=config.data.stop, check=partial(corrected, config), log=log, so_far=aside,
            limit=math.inf if limit is None else limit - seconds["read"],
        )  # fmt: skip
    seconds["solve"] = time.perf_counter() - begin
    return written(config, job.folder, found, seconds)


def written(config: Config, folder: Path, found: Solved, seconds: dict[str, float]) -> Outcome:
    """Write the files of a solution into a folder."""
    begin = time.perf_counter()
    sol, again = found.solution, reproducing(config, found)
    for kind in config.out.formats:
        sol.write(folder / f"solution.{kind}", imu_rate=config.out.imu_rate, base=config.time.base)
    if found.tuned is not None:
        found.tuned.write(folder)
    if again.filter.adapter:
        write_weights(folder / f"tuned{WEIGHTS}", found.params.adapter, adapter_name(again))
    atomic_write(folder / "tuned.toml", parameters(again, found))
    metrics = found.metrics() | {"grade": AUTO, "time": time_of(config, sol)}
    if found.tuned is not None:
        metrics["parameters"] = found.tuned.metrics()["parameters"]
    write_json(folder / "metrics.json", metrics)
    if draws(config, interactive=True):
        draw(folder, again, sol)
    seconds["write"] = time.perf_counter() - begin
    stopped = "interrupted: the best so far is written" if found.status is Status.INTERRUPTED else ""
    text = "\n".join([*lines(found), "", summary(metrics, "ekf15", sol.recording.name)])
    return Outcome(
        metrics, text, seconds, stopped, sol.layout, again, findings=found.findings,
        verdict=f"{found.verdict}: {in_words(found)}", card=card(found),
        tables=tables(found),
    )  # fmt: skip


def timed(begin: float, line: str) -> None:
    """Print a line of progress with the seconds since ``begin``."""
    stderr(f"{time.perf_counter() - begin:6.1f} s  {line}")


def corrected(config: Config, rec: Recording) -> Corrections:
    """Check the recording, and read it again with the settings that this establishes; the user's settings stay."""
    kept = [name for name in (AXES, OFFSET) if name.removeprefix(OPTIONS) in config.data.options]
    found = check_and_correct(rec, kept + ([DRIFT] if config.mounting.clock_drift_ppm is not None else []))
    again = with_options(config, found.settings)
    return found if again == config else found._replace(recording=load(again))


def with_options(config: Config, settings: Mapping[str, float | str]) -> Config:
    """Return the configuration with the settings of the reader among ``settings``."""
    own = {name.removeprefix(OPTIONS): value for name, value in settings.items() if name.startswith(OPTIONS)}
    return changed(config, {"data.options": {**config.data.options, **own}})


def datasheet(config: Config, filt: Filter) -> Params:
    """Return a consumer's datasheet with the parameters that the configuration states."""
    return override(with_weights(config, filt.params(DATASHEET)), as_dict(config))


def reproducing(config: Config, found: Solved) -> Config:
    """Return the configuration of `jaxnav filter` that gives the same solution without searching."""
    sol, standing, params = found.solution, found.standing, found.params
    start = installed(datasheet(config, sol.filter), sol.recording.lever_arm)
    leaves = [leaf for leaf in UNITS if has(params, leaf) and np.any(get(params, leaf) != get(start, leaf))]
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in in_user_units(params, leaves).items()}
    extra = tuple(name for name in sol.filter.model.states if name not in BIASES)
    chosen = FilterSection(
        name=sol.filter.name, adapter=config.filter.adapter, grade=DATASHEET, states=extra,
        measurements=tuple(sol.filter.model.measurements),
        cov_stride=COV_STRIDE, smooth=sol.smoothed, sd_factor=sol.sd_factor, velocity_sd_factor=sol.velocity_sd_factor,
        delay_sd_s=sol.delay_sd, clock_rate_sd_ppm=sol.clock_rate_sd / PPM,
        standing_accel_sd_mps2=standing.accel_sd, standing_gyro_sd_deg_per_s=standing.gyro_sd / DEG,
        outages=found.left_out,
    )  # fmt: skip
    return changed(with_options(config, found.settings), values | {"filter": chosen})


def parameters(config: Config, found: Solved) -> str:
    """Return tuned.toml: filter and parameters of the solution, for ``jaxnav filter --params``."""
    stated = as_dict(config)
    tables = {"filter": {key: stated["filter"][key] for key in ("states", "measurements")}}
    if config.filter.adapter:
        tables["filter"]["adapter"] = f"tuned{WEIGHTS}"
    tables |= nested(flat({table: stated[table] for table in TABLES if table in stated}))
    return f"# jaxnav solve: {found.verdict}: {found.why}\n# use: jaxnav filter --params tuned.toml\n{to_toml(tables)}"


def lines(found: Solved) -> list[str]:
    """Return the answer for the terminal: accuracy as stated and as tested, and the drift."""
    rows = [[row.name, row.stated, row.tested] for row in card(found).rows]
    return [table(["", "stated (1 sd)", "tested"], rows)]


def tables(found: Solved) -> list[Table]:
    """Return the tables of the report: drift before and after, consistency by age, measurements that were tried."""
    out = []
    if found.drift_m:
        title = f"Drift over hidden windows of {found.window_s:g} s of the test part, RMS"
        names = {"datasheet": "datasheet", "auto": "noise by likelihood", "solution": "this solution"}
        out.append(Table(title, ("filter", "drift (m)"), [[names[k], f"{v:.2f}"] for k, v in found.drift_m.items()]))
    if found.calibration is not None:
        rows = [
            [f"{a.age_s:.1f}", f"{a.error_m:.2f}", f"{a.stated_m:.2f}", f"{100 * a.inside_95:.0f}", str(a.fixes)]
            for a in found.calibration.ages
        ]
        head = ("s without fixes", "error (m)", "stated (m, with the fix's)", "inside 95 %, %", "fixes")
        out.append(Table("Hidden fixes of the test part, RMS", head, rows))
    if found.tried:
        said = lambda taken: "taken" if taken else "left out"
        rows = [
            [", ".join(r.option.names), f"{r.sd:.2g}", f"{r.drift_ratio:.2f}", f"{r.gain:+.2f}", said(r.taken)]
            for r in found.tried
        ]
        columns = ("measurement", "sd, times that stated", "drift, ratio", "log-likelihood of a hidden fix", "")
        out.append(Table("Measurements that were tried", columns, rows))
    return out


def card(found: Solved) -> Card:
    """Return the answer: verdict and five numbers."""
    sol, c, drift = found.solution, found.calibration, found.drift_m
    sd = np.median(sol.sd[sol.ok], axis=0)
    truth = sol.metrics().get("errors", {})
    error = lambda key, unit: f"{truth[key]['rms']:.3g} {unit} RMS against truth" if key in truth else ""
    good = sol.metrics()["accuracy"]
    unseen = "not tested: takes a truth or a second receiver"
    hidden = "" if c is None else f"{100 * c.after.inside_95:.0f} % of hidden fixes inside the stated 95 %"
    uses = sol.metrics()["streams"]["position"]
    rows = [
        CardRow("horizontal position on the Earth", f"{good['earth_m']:.2f} m", error("horizontal_m", "m") or unseen),
        CardRow("horizontal position from second to second", f"{good['relative_m']:.2f} m", hidden),
        CardRow("velocity north", f"{sd[4]:.3f} m/s", error("vn_mps", "m/s") or velocities(c)),
        CardRow("heading", f"{sd[8] / DEG:.2f} deg", error("heading_deg", "deg") or NO_HEADING),
        CardRow("fixes used", f"{uses['used']} of {uses['read']}", ""),
    ]
    if c is not None:
        last = c.ages[-1]
        rows.append(
            CardRow(
                f"after {last.age_s:.0f} s without fixes",
                f"{last.stated_m:.2f} m",
                f"{last.error_m:.2f} m RMS, by the datasheet {drift['datasheet']:.2f} m",
            )
        )
    return Card(found.verdict, COLORS[found.verdict], in_words(found), rows)


def velocities(c: Calibration | None) -> str:
    """Return how the sd of velocities were tested."""
    if c is None or c.velocity is None:
        return UNTESTED
    return f"{100 * c.velocity.inside_95:.0f} % of hidden velocities inside the stated 95 %"


def in_words(found: Solved) -> str:
    """Return what follows from a solution, and why."""
    if found.verdict == UNUSABLE:
        return found.why
    good = found.solution.metrics()["accuracy"]
    return f"position good to {good['earth_m']:.2g} m, {good['relative_m']:.2g} m from second to second; {found.why}"
