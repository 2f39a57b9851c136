"""Thousands of damaged inputs: a solution, a solution with a sentence, or one clear error; never anything else.

*Recordings*: a simulated drive with files damaged (`damage_rows.py`) at random places and in random size,
through `jaxnav filter`. *Silent wrong* is a solution with an error against truth outside its 3 sd for more
than 5 % of the time, with no sentence that the drive as it is does not have. *Formats*: one file of each recording of
docs/recipes, read. *Configurations*: random values of random settings. *Checkpoints*: bytes of a fit's checkpoint and
history. *Signals*: Ctrl-C, SIGTERM and kill at random times of `filter`, `simulate`, `tune` and `mc`, and once more:
nothing half-written, nothing left.
"""

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import common
from benchmarks.recordings.wild import sources
from benchmarks.simulated.damage_rows import DAMAGES, Rng
from jaxnav import read
from jaxnav.analysis.tables import table
from jaxnav.app import cli, config, settings
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.types import ConfigError, DataError
from tuning.fit.checkpoint import CheckpointError
from tuning.fit.train import fit
from tuning.fit.transforms import LOG

QUICK = ["--set", "out.figures=none", "--set", "filter.cov_stride=25", "--set", "out.formats=[]"]
SHARE = 0.95  # of the time inside 3 sd
BYTES = "bytes"  # of any file: changed, added, gone
STREAMS = ("imu.csv", "position.csv", "velocity.csv")


def damaged(folder: Path, rng: Rng) -> str:
    """Damage a folder; return the damage."""
    kind = str(rng.choice([*DAMAGES, BYTES, BYTES, "gone", "arm"]))
    path = folder / str(rng.choice(STREAMS))
    if kind == "gone":
        path.unlink()
    elif kind == "arm":
        path = folder / "recording.json"
        about = json.loads(path.read_text())
        off = 5 * rng.normal(size=2)  # a vertical one is an offset in height, which shows in nothing
        about["lever_arm_frd_m"] = (np.array(about["lever_arm_frd_m"]) + [*off, 0.0]).tolist()
        path.write_text(json.dumps(about))
    elif kind == BYTES:
        path = folder / str(rng.choice([*STREAMS, "recording.json"]))
        whole = path.read_bytes()
        at, gone = int(rng.integers(len(whole))), int(rng.choice([0, 1, 2, 50, 10**9]))
        path.write_bytes(whole[:at] + rng.bytes(int(rng.integers(0, 6))) + whole[at + gone :])
    else:
        rows = [line.split(",") for line in path.read_text().splitlines()]
        DAMAGES[kind](rows, rng)
        path.write_text("".join(",".join(row) + "\n" for row in rows))
    return f"{kind} {path.name}"


def spoken(argv: list[str]) -> tuple[int, str]:
    """The command line in this process: exit code (-1 of an exception), and its output."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = cli.main(argv)
        except (Exception, SystemExit):
            traceback.print_exc()
            code = -1
    return code, said.getvalue()


def sentences(folder: Path) -> set[str]:
    """Sentences of a run, without numbers."""
    found = json.loads((folder / "metrics.json").read_text())
    plain = lambda text: re.sub(r"-?\d+(\.\d+)?(e[-+]\d+)?", "#", text)
    return {
        plain(line) for line in [*(f["message"] for f in found["findings"]), *found["notes"], found["initialization"]]
    }


def recordings(tries: int, seed: int, report: list[dict]) -> dict[str, int]:
    """Counts over damaged recordings; ``report`` collects failures."""
    counts = Counter(
        {k: 0 for k in ("tried", "solution", "said", "clear_error", "traceback", "silent_wrong", "killed")}
    )
    with tempfile.TemporaryDirectory() as name:
        base, run = Path(name) / "drive", Path(name) / "run"
        assert cli.main(["simulate", "--data", "urban_short", "--out", str(base), *QUICK[:2]]) == 0
        whole = ["--data", str(base), "--out", str(run), *QUICK]
        assert spoken(["filter", *whole])[0] == 0
        usual = sentences(run)
        for i in range(tries):
            clear_caches_if_needed()
            rng = np.random.default_rng([seed, i])
            folder = Path(name) / "bad"
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(base, folder)
            what = damaged(folder, rng)
            shutil.rmtree(run, ignore_errors=True)
            code, said = spoken(["filter", "--data", str(folder), "--out", str(run), *QUICK])
            how = outcome(code, said, run, usual)
            counts["tried"] += 1
            counts[how] += 1
            if how in ("traceback", "silent_wrong"):
                report.append({"seed": [seed, i], "what": what, "how": how, "said": said[-1500:]})
            if i % 100 == 99:
                print(f"{i + 1} recordings: {dict(counts)}", flush=True)
    return dict(counts)


def outcome(code: int, said: str, run: Path, usual: set[str]) -> str:
    """Outcome of a run."""
    if code in (1, 2, 3) and "Traceback" not in said and not (run / "solution.csv").exists():
        return "clear_error"
    if code != 0 or "Traceback" in said:
        return "traceback"
    if sentences(run) - usual:
        return "said"
    errors = json.loads((run / "metrics.json").read_text()).get("errors") or {}
    inside = [e["inside_3sd"] for e in errors.values() if e.get("inside_3sd") is not None]
    return "silent_wrong" if inside and min(inside) < SHARE else "solution"


# ---------------------------------------------------------------------------- formats


def formats(tries: int, seed: int, report: list[dict]) -> dict[str, int]:
    """``tries`` damaged copies of a file of every recording of docs/recipes and of those that need no recipe."""
    counts = Counter({k: 0 for k in ("recordings", "tried", "read", "clear_error", "traceback")})
    for source, path in sources().items():
        counts["recordings"] += 1
        for i in range(tries):
            rng = np.random.default_rng([seed, i, counts["recordings"]])
            with tempfile.TemporaryDirectory() as name:
                copied, what = _damaged_copy(path, Path(name), rng)
                counts["tried"] += 1
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("error")
                        rec = read(copied)
                    good = np.isfinite(rec.imu.gyro).all() and (np.diff(rec.imu.t) > 0).all()
                    counts["read" if good else "traceback"] += 1
                except DataError as error:
                    counts["clear_error" if "\n" not in str(error) else "traceback"] += 1
                except Exception:
                    counts["traceback"] += 1
                    report.append({"seed": [seed, i], "what": f"{source}: {what}", "how": "traceback",
                                   "said": traceback.format_exc()})  # fmt: skip
        print(f"{source}: {dict(counts)}", flush=True)
    return dict(counts)


def _damaged_copy(path: Path, to: Path, rng: Rng) -> tuple[Path, str]:
    """A recording whose files are links but for one, which is damaged; and what was done to it."""
    recipe = path.suffix == ".toml"
    text = path.read_text() if recipe else ""
    home = Path(os.path.expandvars(re.search(r'folder = "([^"]+)"', text)[1])) if recipe else path
    files = sorted(p for p in home.rglob("*") if p.is_file()) if home.is_dir() else [home]
    named = [p for p in files if p.name in text] or files
    chosen = named[int(rng.integers(len(named)))]
    data = to / "data"
    for file in named if recipe else files:
        into = data / file.relative_to(home) if home.is_dir() else data / file.name
        into.parent.mkdir(parents=True, exist_ok=True)
        if file == chosen:
            whole = file.read_bytes()
            at, gone = int(rng.integers(len(whole))), int(rng.choice([0, 1, 7, 500, 10**10]))
            into.write_bytes(whole[:at] + rng.bytes(int(rng.integers(0, 9))) + whole[at + gone :])
        else:
            into.symlink_to(file)
    if not recipe:
        return (data if home.is_dir() else data / home.name), chosen.name
    where = data if home.is_dir() else data / home.name
    (to / path.name).write_text(re.sub(r'folder = "[^"]+"', f'folder = "{where}"', text))
    return to / path.name, chosen.name


# ---------------------------------------------------------------------------- settings


def configurations(tries: int, seed: int, report: list[dict]) -> dict[str, int]:
    """Random values of random settings: a configuration that says the same when read again, or one error."""
    keys = [(s.name, k.name) for s in settings.sections() for k in s.settings]
    pool = [True, False, 0, -1, 3, 1e-9, 1e12, float("nan"), float("inf"), "", "ekf15", "motion", "x" * 300, [], [1],
            ["noise"], [1.0, 2.0, 3.0], [[1, 2], [3, 4]], {}, {"a": 1}, None, "ü", "$HOME", "../x"]  # fmt: skip
    counts = Counter({k: 0 for k in ("tried", "accepted", "clear_error", "traceback")})
    for i in range(tries):
        rng = np.random.default_rng([seed, i])
        tree: dict = {}
        for _ in range(int(rng.integers(1, 4))):
            section, key = keys[int(rng.integers(len(keys)))]
            (tree.setdefault(section, {}) if section else tree)[key] = pool[int(rng.integers(len(pool)))]
        counts["tried"] += 1
        try:
            found = config.resolve([("damage", tree)])
            assert config.resolve([("again", config.as_dict(found))]) == found
            counts["accepted"] += 1
        except ConfigError as error:
            counts["clear_error" if "\n" not in str(error) else "traceback"] += 1
        except Exception:
            counts["traceback"] += 1
            report.append({"seed": [seed, i], "what": repr(tree), "how": "traceback", "said": traceback.format_exc()})
    return dict(counts)


# ---------------------------------------------------------------------------- checkpoints


def checkpoints(tries: int, seed: int, report: list[dict]) -> dict[str, int]:
    """A fit's folder, damaged and resumed: refused in one line, or it ends where it would have."""
    counts = Counter({k: 0 for k in ("tried", "same_end", "clear_error", "traceback", "silent_wrong")})
    job = lambda folder, resume: fit(
        lambda p: jnp.log(p["a"] / 2.0) ** 2, {"a": LOG}, {"a": jnp.array(5.0)}, 12, optax.adam(0.1),
        folder=folder, resume=resume, identity="job",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        whole, bad = Path(name) / "whole", Path(name) / "bad"
        end = job(whole, False).params["a"]
        files = sorted(path.name for path in whole.iterdir())
        for i in range(tries):
            rng = np.random.default_rng([seed, i])
            shutil.rmtree(bad, ignore_errors=True)
            shutil.copytree(whole, bad)
            path = bad / str(rng.choice(files))
            data = path.read_bytes()
            at, gone = int(rng.integers(len(data))), int(rng.choice([0, 1, 2, 50, 10**9]))
            path.write_bytes(data[:at] + rng.bytes(int(rng.integers(0, 6))) + data[at + gone :])
            counts["tried"] += 1
            try:
                same = bool(job(bad, True).params["a"] == end)
                counts["same_end" if same else "silent_wrong"] += 1
            except CheckpointError as error:
                counts["clear_error" if "\n" not in str(error) else "traceback"] += 1
            except Exception:
                counts["traceback"] += 1
                report.append({"seed": [seed, i], "what": path.name, "how": "traceback",
                               "said": traceback.format_exc()})  # fmt: skip
    return dict(counts)


# ---------------------------------------------------------------------------- signals

JOBS = {
    "simulate": ["simulate", "--data", "urban_short"],
    "filter": ["filter", "--data", "{drive}", "--set", "filter.cov_stride=25"],
    "tune": ["tune", "--data", "{drive}", "--set", "filter.cov_stride=25", "--set", "tune.free=['fixes']"],
    "mc": ["mc", "--data", "urban_short", "--runs", "4"],
}
LONGEST = {"simulate": 9.0, "filter": 10.0, "tune": 30.0, "mc": 15.0}  # s within which a signal comes
EXIT = {signal.SIGINT: (130,), signal.SIGTERM: (143, -signal.SIGTERM), signal.SIGKILL: (-signal.SIGKILL,)}
FINISHED = {"simulate": "imu.csv", "filter": "metrics.json", "tune": "metrics.json", "mc": "metrics.json"}


def signals(tries: int, seed: int, report: list[dict]) -> dict[str, int]:
    """Runs that end by a signal, and the next one: complete results or none, nothing of either left behind."""
    counts = Counter({k: 0 for k in ("tried", "stopped", "finished", "traceback", "half_written", "left_behind")})
    with tempfile.TemporaryDirectory() as name:
        drive = Path(name) / "drive"
        longer = ["--set", "data.options.duration_s=130"]  # or tuning refuses it
        assert cli.main(["simulate", "--data", "urban_short", "--out", str(drive), *longer, *QUICK[:2]]) == 0
        for i in range(tries):
            rng = np.random.default_rng([seed, i])
            verb, number = list(JOBS)[i % len(JOBS)], list(EXIT)[i // len(JOBS) % len(EXIT)]
            place = Path(name) / "place"
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            argv = [part.format(drive=drive) for part in JOBS[verb]] + ["--out", str(place / "out")]
            heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
            code = heard + "import sys; from jaxnav.app.console import console; sys.exit(console())"
            process = subprocess.Popen(
                [sys.executable, "-c", code, *argv], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
            )
            time.sleep(float(rng.uniform(0.0, LONGEST[verb])))
            process.send_signal(number)
            said, _ = process.communicate(timeout=120)
            counts["tried"] += 1
            wrong = []
            if process.returncode == 0:
                counts["finished"] += 1
            elif process.returncode in EXIT[number]:
                counts["stopped"] += 1
            else:
                wrong.append("traceback")
            out = place / "out"
            if "Traceback" in said:
                wrong.append("traceback")
            written = out.exists() and any(p.is_file() for p in out.iterdir())  # beside the checkpoints of a long job
            if written and not ((out / FINISHED[verb]).exists() and (out / "run.json").exists()):
                wrong.append("half_written")
            if number == signal.SIGKILL:  # what it could not clear away, the next one does
                again = subprocess.run([sys.executable, "-c", code, *argv], capture_output=True, timeout=300)
                wrong += ["traceback"] if again.returncode else []
            left = [p.name for p in place.iterdir() if p.name != "out"]
            if left:
                wrong.append("left_behind")
            for how in wrong:
                print(f"{how}: {verb} {number.name}: exit {process.returncode}, left {left}: {said[-300:]}", flush=True)
                counts[how] += 1
                report.append({"seed": [seed, i], "what": f"{verb} {number.name}", "how": how,
                               "said": f"{process.returncode} {left} {said[-1500:]}"})  # fmt: skip
            if i % 20 == 19:
                print(f"{i + 1} signals: {dict(counts)}", flush=True)
    return dict(counts)


STUDIES = {
    "recordings": recordings, "formats": formats, "configurations": configurations, "checkpoints": checkpoints,
    "signals": signals,
}  # fmt: skip
TRIES = {"recordings": 2000, "formats": 30, "configurations": 2000, "checkpoints": 500, "signals": 100}


def main(argv: list[str]) -> None:
    """Print the counts, write the JSON."""
    parser = common.options("damage", __doc__.splitlines()[0])
    parser.add_argument("--only", metavar="A,B", help=f"some of {', '.join(STUDIES)}")
    parser.add_argument("--quick", action="store_true", help="a tenth of the tries")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    args = parser.parse_args(argv)
    results: dict = {}
    report: list[dict] = []
    for name in args.only.split(",") if args.only else STUDIES:
        tries = TRIES[name] // 10 if args.quick else TRIES[name]
        results[name] = STUDIES[name](tries, args.seed, report)
        print(table(list(results[name]), [list(results[name].values())]), flush=True)
        common.write_json(args.json, results | {"seed": args.seed, "report": report})
    for row in report[:20]:
        print(f"{row['how']}: {row['what']} {row['seed']}: {row['said'].strip().splitlines()[-1:]}")
