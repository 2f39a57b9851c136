"""`jaxnav check`, `jaxnav map` and `jaxnav convert`."""

import json
import time
import tomllib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np

from jaxnav import io
from jaxnav.analysis.observability import observability, observability_findings
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import checkup as plots_checkup
from jaxnav.app.config import Config, Data, resolve
from jaxnav.app.jobs.filtering import describe, describe_text
from jaxnav.app.prepare import base_params, filter_of, grade_of, initialization_of, measurements_of, standing_of
from jaxnav.app.results import Outcome, draws, picture
from jaxnav.checkup import checkup
from jaxnav.checkup.support import REASONS, options, untried
from jaxnav.filters.epochs import pack_recording
from jaxnav.filters.parameters import history_for
from jaxnav.findings import finding
from jaxnav.io.draft import draft
from jaxnav.io.json import write_json
from jaxnav.io.toml import inline
from jaxnav.reading.read import read
from jaxnav.types import ConfigError, DataError, Finding, Recording

MAX_EPOCHS, WINDOW_S = 2000, 30.0  # epochs in all, and length s of a window, of the observability analysis


def check(config: Config, folder: Path) -> Outcome:
    """Check the recording of [data] against itself; table, check.json, a picture, and a configuration that runs it.

    Raises:
        DataError: nothing there that can be read.
    """
    begin = time.perf_counter()
    rec = read(config.data.source, **config.data.options)
    seconds = {"read": time.perf_counter() - begin}
    begin = time.perf_counter()
    found = checkup(rec)
    seconds["check"] = time.perf_counter() - begin
    if "position" in rec.aiding:
        begin = time.perf_counter()
        (folder / "config.toml").write_text(configuration(config.data, rec, found), encoding="utf-8")
        found = found + shown(folder / "config.toml", rec)
        seconds["states"] = time.perf_counter() - begin
    about = {"recording": describe(rec), "findings": [asdict(f) for f in found]}
    write_json(folder / "check.json", about)
    if draws(config):
        with picture("the recording"):
            plots.save(plots_checkup.overview(rec), folder / "check.png")
    wrong = sum(f.warns for f in found)
    return Outcome(about | {"wrong": wrong}, in_words(rec), seconds, findings=found, verdict="no faults found")


def shown(file: Path, rec: Recording) -> list[Finding]:
    """Return observability findings of the states in a configuration."""
    try:
        config = resolve([(str(file), tomllib.loads(file.read_text(encoding="utf-8")))])
        params = base_params(config, grade_of(config, None), rec.lever_arm)
        begin, measurements = initialization_of(config, rec, params), measurements_of(config)
        params = begin.apply_to(params)
        packed = pack_recording(rec, measurements, begin.t, stop=config.data.stop, standing=standing_of(config))
        history = history_for(params, 1 / float(np.median(rec.imu.dt)), np.ptp(rec.imu.t))
        filt = filter_of(config, measurements, history)
        cut = lambda a: a[:MAX_EPOCHS]
        first, epochs = jax.tree.map(lambda a: a[0], begin.navs), jax.tree.map(cut, packed.epochs)
        seen = observability(filt, params, first, epochs, cut(packed.t), WINDOW_S)
    except (ConfigError, DataError) as error:
        return [finding("observability.unknown", why=str(error))]
    return observability_findings(seen, WINDOW_S)


def convert(config: Config, folder: Path) -> Outcome:
    """Write the recording of [data] as our folder of CSV files (docs/formats.md).

    Raises:
        DataError: nothing there that can be read.
    """
    begin = time.perf_counter()
    rec = read(config.data.source, **config.data.options)
    io.write_recording(folder / "recording", rec)
    for file in (folder / "recording").iterdir():
        file.rename(folder / file.name)
    (folder / "recording").rmdir()
    about = describe(rec)
    text = describe_text(about) + "".join(f"\n{note}" for note in rec.notes.splitlines())
    return Outcome({"recording": about}, text, {"convert": time.perf_counter() - begin})


def drafted(files: Sequence[str]) -> Outcome:
    """Draft a column map of tables; it fails where a person has to confirm something.

    Raises:
        DataError: no table, or none with an IMU or fixes.
    """
    found = draft([Path(file) for file in files], Path())
    return Outcome({"map": found.text(), "unsure": found.unsure}, found.text().rstrip(), {}, failed=bool(found.unsure))


def in_words(rec: Recording) -> str:
    """Return a table of a recording's streams, and the notes of its reader."""
    lines = [describe_text(describe(rec)), ""]
    if "position" not in rec.aiding:
        lines.append("there are no positions, so that no filter can be run on it")
    return "\n".join([*lines, *(f"  {note}" for note in rec.remarks.splitlines())])


def configuration(data: Data, rec: Recording, found: list[Finding]) -> str:
    """Return a configuration that runs the recording, a remark on each line."""
    whole = lambda path: str(Path(path).resolve()).replace("\\", "/")
    given = {k: whole(v) if k == "gnss" else v for k, v in data.options.items()}
    offset = next((f.value for f in found if f.code == "time.offset" and f.value is not None), 0.0)
    if offset:
        given["time_shift_s"] = round(float(given.get("time_shift_s", 0.0)) + offset, 2)
    lines = [
        "# jaxnav filter --config config.toml",
        "[data]",
        f'source = "{whole(data.source)}"  # the checked recording',
        *([f"options = {inline(given)}"] if given else []),
        "[filter]",
        'name = "ekf15"  # errors of position, velocity, attitude and both biases; `jaxnav info` lists the others',
        f'grade = "auto"  # IMU noise and latency by likelihood, or a datasheet; {_noise(found)}',
    ]
    tried = options(rec, found)
    taken = untried(tried, found)
    used = ["position", "velocity", *(name for each in taken for name in each.measurements)]
    states = list(dict.fromkeys(name for each in taken for name in each.states))
    remarks = "; ".join(REASONS[each.measurements[0]] for each in taken)
    lines.append(f"measurements = {json.dumps(used)}" + (f"  # {remarks}" if remarks else ""))
    if more := [name for each in tried if each not in taken for name in each.measurements]:
        lines.append(f"# `jaxnav solve` also tries {', '.join(more)}")
    for f in (f for f in found if f.code.startswith("standstill.")) if "zero_velocity" in more else ():
        lines.append(f"# {f.setting.split('.')[1]} = {f.value:.3g}  # {f.message}")
    if states:
        lines.append(f"states = {json.dumps(states)}  # estimated with them")
    lines += ["[initialization]", 'heading = "motion"  # found by alignment; or "course", "unknown", degrees']
    return "\n".join([*lines, *_timing(found)]) + "\n"


def _timing(found: list[Finding]) -> list[str]:
    """Return settings of the clocks: an early stream is the IMU's clock, a late one the stream's latency."""
    by = {f.code: f for f in found if f.value is not None}
    delay = by.get("time.late", by.get("time.delay"))
    tables: dict[str, list[str]] = {"mounting": [], "measurements.position": [], "measurements.velocity": []}
    if delay is not None:
        behind = by.get("velocity.latency")
        gap = 0.0 if behind is None else float(behind.value or 0.0)  # s, velocity later than position
        first = float(delay.value or 0.0)
        of_velocity = "velocity" in delay.setting
        late = {"position": first - gap if of_velocity else first, "velocity": first if of_velocity else first + gap}
        offset = min(0.0, *late.values())
        why = delay.message + (f"; {behind.message}" if behind is not None else "")
        settings = {("mounting", "time_offset_s"): offset}
        settings |= {(f"measurements.{name}", "latency_s"): t - offset for name, t in late.items()}
        for (table, key), value in settings.items():
            if abs(value) > 5e-3:
                tables[table].append(f"{key} = {value:.3f}  # {why}")
    if "time.drift" in by:
        tables["mounting"].append(f"clock_drift_ppm = {by['time.drift'].value:.0f}  # {by['time.drift'].message}")
    return [line for table, lines in tables.items() if lines for line in (f"[{table}]", *lines)]


def _noise(found: list[Finding]) -> str:
    return next((f.message for f in found if f.code == "imu.noise"), "see `jaxnav info`")
