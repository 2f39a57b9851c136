"""The first answer: seconds from the command to its end, from an empty cache of compiled programs and from a full one.

Each command is a separate process; its time is given in multiples of `import jax; jax.jit(lambda x: x)(1.)`.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.common import options, write_json
from jaxnav.analysis.tables import table

NOTHING = [sys.executable, "-c", "import jax; jax.jit(lambda x: x)(1.0)"]
TEN_MINUTES = ["--set", "data.options.duration_s=600"]


def timed(argv: list[str], cache: Path, mark: str = "") -> tuple[float, float]:
    """Seconds that a process takes, and until the first line of its stderr that has the mark (nan without one).

    Raises:
        SystemExit: it fails.
    """
    begin, seen, said = time.perf_counter(), float("nan"), []
    env = os.environ | {"JAXNAV_CACHE_DIR": str(cache), "MPLBACKEND": "Agg"}
    process = subprocess.Popen(argv, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        said.append(line)
        if mark and mark in line and seen != seen:
            seen = time.perf_counter() - begin
    if process.wait():
        raise SystemExit(f"{' '.join(argv)}: exit code {process.returncode}\n{''.join(said[-5:])}")
    return time.perf_counter() - begin, seen


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = options("first", __doc__ or "")
    parser.add_argument("--filter", action="store_true", help="no further than the filter")
    args = parser.parse_args(argv)
    verb = [sys.executable, "-m", "jaxnav"]
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        drive = ["--data", str(home / "drive")]
        caches = iter(home / f"cache{i}" for i in range(9))
        found["nothing"] = timed(NOTHING, home)[0]
        simulate = [*verb, "simulate", "--data", "urban", *TEN_MINUTES, "--out", str(home / "drive")]
        found["simulate_cold"] = timed(simulate, next(caches))[0]
        for grade in ("auto", "consumer"):
            cache, named = next(caches), ["--set", f"filter.grade={grade}"]
            for name in (f"filter_cold_{grade}", f"filter_warm_{grade}"):
                found[name] = timed([*verb, "filter", *drive, *named, "--out", str(home / name)], cache)[0]
        if args.filter:
            finish(found, args.json)
            return
        checked = next(caches)
        for name in ("check_cold", "check_warm"):
            found[name] = timed([*verb, "check", str(home / "drive"), "--out", str(home / name)], checked)[0]
        tuned = next(caches)
        for name, first in (("tune_cold", "tune_first_step"), ("tune_warm", "tune_first_step_warm")):
            run = [*verb, "tune", *drive, "--out", str(home / name)]
            found[name], found[first] = timed(run, tuned, "evaluation 1")
        solved = next(caches)
        for name in ("solve_cold", "solve_warm"):
            found[name] = timed([*verb, "solve", str(home / "drive"), "--out", str(home / name)], solved)[0]
        found["demo"] = timed([*verb, "demo", "--out", str(home / "demo")], next(caches))[0]
    finish(found, args.json)


def finish(found: dict[str, float], path: Path | None) -> None:
    """Print the table, write the JSON."""
    rows = [[name, seconds, seconds / found["nothing"]] for name, seconds in found.items()]
    print(table(["", "s", "times nothing"], rows))
    write_json(path, found | {"times_nothing": {name: ratio for name, _, ratio in rows}})
