"""The command line: ``jaxnav check | convert | filter | tune | simulate | mc | bakeoff | allan | demo | config | ...``.

Exit codes: 0 done, 1 a check failed (the filter stopped being finite), 2 usage or configuration, 3 data that cannot be
used, 130 Ctrl-C. Results are on stdout and in the folder of --out, progress and errors on stderr.
"""

import argparse
import gc
import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxnav.app import completion
from jaxnav.app import config as configuration
from jaxnav.app.console import INTERRUPTED
from jaxnav.filters.compiler import cache, cache_home, enable_x64, fast_compiler
from jaxnav.types import ConfigError, DataError

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome

SHARED = ("tune", "mc", "bakeoff")  # whose runs several devices or processes may share
COLLECT = 20_000  # new objects until the garbage collector looks; at Python's 700 it takes a third of tracing
VERBS = {
    "demo": "simulate, tune by gradient and draw the figures: no data, no network, two minutes the first time",
    "check": "check a recording against itself: what looks wrong, and a configuration that runs it",
    "convert": "write a recording of any format as CSV files",
    "simulate": "write a simulated recording and its truth",
    "filter": "run a filter over a recording: solution, metrics, figures",
    "stream": "the solution as data comes: from standard input, or from a recording at its own pace",
    "tune": "tune a filter's parameters by gradient and show the gain on data kept aside",
    "bakeoff": "filters tuned alike on the same scenarios, ranked on runs and scenarios that none has seen",
    "mc": "Monte Carlo: filters over many simulated runs, errors, consistency, divergence",
    "show": "print what a finished run said once more",
    "compare": "finished runs side by side: figures and settings that differ, tracks over one another",
    "allan": "Allan deviation of a resting IMU: white noise, bias instability, random walk, Gauss-Markov",
    "config": "print every setting with its default and what it is, as a configuration to fill in",
    "cache": "the compiled programs that are kept: where, how many, how large; or clear them",
    "completion": "what a shell completes by the tab key, as a script for it",
    "warm": "compile what filter needs for recordings like this one, and keep it: after installation, before a demo",
    "info": "versions, devices, filters, data sets",
    "data": "list, fetch or check public data sets",
}


EXAMPLES = """\
a recording:
  jaxnav check drive.bag                                    what looks wrong, and a configuration that runs it
  jaxnav filter --data drive.bag --out out/run              solution, figures, report.html
  jaxnav filter --data drive.bag --smooth --out out/smooth  by all fixes
  jaxnav tune --data drive.bag --out out/tuned              noise, fixes and clocks, without truth
  jaxnav filter --data drive.bag --params out/tuned/tuned.toml --out out/after
  jaxnav compare out/run out/after
live:
  jaxnav stream --data drive.bag --speed 1
simulated:
  jaxnav simulate --data urban --seed 1 --out out/urban
  jaxnav mc --data urban --filter ekf15,ekf15_gate --runs 100 --devices 0
  jaxnav bakeoff --data gipkf_urban --filter gpid15,gipkf,fwekf15,ekf15_gate
settings:
  jaxnav config > job.toml; jaxnav filter --config job.toml --set filter.cov_stride=10
  jaxnav completion bash > ~/.local/share/bash-completion/completions/jaxnav

Exit codes: 0 done, 1 failed check, 2 usage or configuration, 3 bad data, 130 stopped by Ctrl-C"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    parser = make_parser()
    try:
        args = parser.parse_args(argv)
    except SystemExit as stop:  # --help, --version, usage
        return int(stop.code or 0)
    try:
        return _main(args)
    except KeyboardInterrupt:
        print("jaxnav: stopped", file=sys.stderr)
        return INTERRUPTED
    except (ConfigError, DataError) as error:
        return _fail(args, error, 2 if isinstance(error, ConfigError) else 3)
    except BrokenPipeError:  # `jaxnav info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except Exception as error:
        from jaxnav.app.results import FailedCheck

        if not isinstance(error, FailedCheck):
            raise
        return _fail(args, error, 1)


def make_parser() -> argparse.ArgumentParser:
    """The arguments of every verb."""
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--config", metavar="FILE", help="TOML, or the run.json of an earlier run")
    shared.add_argument("--set", metavar="A.B=C", action="append", default=[], help="one setting; may be repeated")
    shared.add_argument("--seed", type=int, help="of everything random")
    shared.add_argument("--out", metavar="DIR", type=Path, help="folder of the results (default out/VERB)")
    shared.add_argument("--json", action="store_true", help="the result as JSON on stdout, and nothing else there")
    shared.add_argument("--quiet", action="store_true", help="print nothing but errors")
    shared.add_argument("--debug", action="store_true", help=argparse.SUPPRESS)
    parser = argparse.ArgumentParser(
        prog="jaxnav", description="INS/GNSS navigation, differentiable: simulate, filter, tune.", epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"jaxnav {_version()}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb, text in VERBS.items():
        sub = verbs.add_parser(verb, help=text, description=text, parents=[shared])
        if verb == "allan":
            sub.add_argument("--start", metavar="S", type=float, help="s, use the recording from here ([data] start)")
            sub.add_argument("--stop", metavar="S", type=float, help="s, to here ([data] stop)")
        if verb in ("simulate", "filter", "tune", "bakeoff", "mc", "allan", "warm", "stream"):
            sub.add_argument("--data", metavar="NAME|PATH", help="scenario, data set or recording ([data] source)")
        if verb == "stream":
            sub.add_argument(
                "--speed", metavar="X", type=float, default=0.0, help="of a recording, times its own (0: all)"
            )
            sub.add_argument("--every", metavar="S", type=float, default=1.0, help="s of data between rows")
        if verb in ("filter", "tune", "bakeoff", "mc", "demo", "warm", "stream"):
            sub.add_argument("--filter", metavar="NAME", help="see `jaxnav info` ([filter] name)")
            sub.add_argument("--params", metavar="FILE", help="[params] of this file, such as an earlier tuned.toml")
        if verb == "cache":
            sub.add_argument("action", nargs="?", choices=["size", "clear"], default="size")
        if verb == "completion":
            sub.add_argument("shell", choices=completion.SHELLS)
        if verb == "config":
            sub.add_argument("--markdown", action="store_true", help="as a page of the docs")
        if verb == "filter":
            sub.add_argument("--smooth", action="store_true", help="by all fixes, those after it too ([filter] smooth)")
            sub.add_argument("--lag", metavar="S", type=float, help="by those of the next S seconds ([filter] lag_s)")
        if verb == "mc":
            sub.add_argument("--runs", metavar="N", type=int, help="how many ([mc] runs); --filter takes A,B,...")
        if verb == "bakeoff":
            sub.add_argument(
                "--unseen", metavar="A,B", help="scenarios to test on only; --data, --filter take lists too"
            )
        if verb == "tune":
            sub.add_argument("--for", metavar="TARGET", dest="target", help="another filter, such as kfgins, px4")
        if verb in ("tune", "mc"):
            sub.add_argument("--resume", action="store_true", help="go on from the checkpoint in --out, bit for bit")
        if verb in SHARED:
            sub.add_argument("--devices", metavar="N", type=int, default=1, help="share runs among N, 0: all there")
            sub.add_argument("--coordinator", metavar="HOST:PORT", help="of several processes, private networks only")
            sub.add_argument("--processes", metavar="N", type=int, help="how many; under Slurm or MPI all is found")
            sub.add_argument("--process", metavar="I", type=int, help="number of this one, from 0")
        if verb in ("check", "convert"):
            sub.add_argument("path", metavar="PATH", help="file or folder of any known format, or a column map")
        if verb == "show":
            sub.add_argument("path", metavar="FOLDER", help="of a finished run")
        if verb == "compare":
            sub.add_argument("paths", metavar="FOLDER", nargs="+", help="of finished runs of one verb, two or more")
        if verb == "data":
            sub.add_argument("action", choices=("list", "fetch", "check"))
            sub.add_argument("name", nargs="?", help="of the data set; check also takes a path")
    return parser


def _main(args: argparse.Namespace) -> int:
    if args.verb == "config":
        from jaxnav.app import settings

        print(settings.page() if args.markdown else settings.commented(), end="")
        return 0
    if args.verb == "cache":
        print(_cache(args.action))
        return 0
    if args.verb == "completion":
        print(completion.script(make_parser(), args.shell))
        return 0
    if args.verb == "show":
        from jaxnav.app.verbs import compare

        return _report(args, compare.show(args.path), None)
    config = resolve(args)
    if args.verb == "data" and args.action != "list" and not args.name:
        raise ConfigError(f"data {args.action} needs the name of a data set")
    if args.verb != "data" or args.action == "check":
        _start_jax(args)
    if args.verb in ("info", "data"):
        return _report(args, _look(args), None)
    if args.verb == "stream":
        from jaxnav.app.verbs import stream

        outcome = stream.stream(config, args.speed, args.every, None if args.data else sys.stdin)
        print(outcome.text, file=sys.stderr)
        return 0 if outcome.metrics["ok"] else 1
    if args.verb == "warm":
        with tempfile.TemporaryDirectory() as folder:
            outcome = _work(args, config, Path(folder), Path(folder))
        return _report(args, outcome._replace(text=_cache("size")), None)
    from jaxnav.app import results

    out = args.out or Path("out") / args.verb
    if not _first():  # of several processes one writes
        with tempfile.TemporaryDirectory() as folder:
            _work(args, config, Path(folder), out)
        return 0
    with results.staged(out, args.verb, _inputs(args, config)) as folder:
        outcome = _work(args, config, folder, out)
        if config.out.figures and args.verb in ("filter", "tune", "demo", "mc", "bakeoff"):
            from jaxnav.app import report

            report.write(folder, args.verb, config, outcome, outcome.layout)
        results.write_run(folder, args.verb, outcome.config or config, outcome)
    return _report(args, outcome, out)


def _cache(action: str) -> str:
    """What is kept of compiled programs, in a sentence; cleared if asked for."""
    from jaxnav.filters.compiler import CACHE, cache_home

    home = cache_home()
    if home is None:
        return f"no compiled programs are kept: {CACHE} is empty"
    own = [path for path in home.glob("jaxlib-*") if path.is_dir()]  # what else lies there is not ours
    files = [path for folder in own for path in folder.rglob("*") if path.is_file()]
    held = f"{len(files)} files, {sum(path.stat().st_size for path in files) / 2**20:.1f} MiB, in {home}"
    if action == "clear":
        for folder in own:
            shutil.rmtree(folder, ignore_errors=True)
        return f"cleared {held}"
    return held


def _inputs(args: argparse.Namespace, config: configuration.Config) -> list[str]:
    """The files and folders that a run reads, which its results must not touch."""
    from jaxnav.simulate.scenarios import SCENARIOS

    recordings = [source for source in (config.data.source, *config.tune.more) if source not in SCENARIOS]
    named = [args.config, getattr(args, "params", None), getattr(args, "path", None), *recordings]
    named += getattr(args, "paths", [])
    return [path for path in named if path and Path(path).exists()]


def resolve(args: argparse.Namespace) -> configuration.Config:
    """The configuration: the verb's own, the file, --params, the flags, then --set."""
    layers: list[tuple[str, dict[str, Any]]] = []
    if args.verb in OWN and not (args.verb == "warm" and (args.data or args.config)):
        layers.append((args.verb, OWN[args.verb]))
    if args.config is not None:
        layers.append((args.config, configuration.read(args.config)))
    if getattr(args, "params", None) is not None:
        layers.append((args.params, configuration.read_params(args.params)))
    if args.seed is not None:
        layers.append(("--seed", {"seed": args.seed}))
    if args.verb in ("check", "convert"):
        layers.append(("PATH", {"data": {"source": args.path}}))
    if getattr(args, "data", None) is not None:
        layers.append(("--data", {"data": {"source": args.data}}))
    span = {key: getattr(args, key) for key in ("start", "stop") if getattr(args, key, None) is not None}
    if span:
        layers.append(("--start, --stop", {"data": span}))
    if getattr(args, "filter", None) is not None:
        layers.append(("--filter", {"filter": {"name": args.filter}}))
    if getattr(args, "target", None) is not None:
        layers.append(("--for", {"tune": {"target": args.target}}))
    if getattr(args, "smooth", False):
        layers.append(("--smooth", {"filter": {"smooth": True}}))
    if getattr(args, "lag", None) is not None:
        layers.append(("--lag", {"filter": {"lag_s": args.lag}}))
    if getattr(args, "runs", None) is not None:
        layers.append(("--runs", {"mc": {"runs": args.runs}}))
    if getattr(args, "unseen", None) is not None:
        layers.append(("--unseen", {"bakeoff": {"unseen": [name.strip() for name in args.unseen.split(",")]}}))
    layers += [(f"--set {setting}", configuration.parse_set(setting)) for setting in args.set]
    return configuration.resolve(layers)


DEMO: dict[str, Any] = {
    "data": {"source": "urban", "imu_worse_by": 3.0, "gnss_latency_s": 0.1},
    "filter": {"cov_stride": 10},
    "tune": {"steps": 24, "rate": 0.25, "runs": 6, "validation_runs": 8, "test_runs": 12, "free": ["noise", "latency"]},
}
"""The demo's own settings: an IMU three times noisier than its datasheet, and fixes 0.1 s late that nobody told of."""

BAKEOFF: dict[str, Any] = {
    "data": {"source": "gipkf_urban"},
    "filter": {"name": "gpid,gpid15,gipkf,fwekf,fwekf15,ekf15_gate,ekf15_huber", "cov_stride": 10},
    "bakeoff": {"unseen": ["gipkf_urban_uncalibrated", "gipkf_urban_stress"]},
    "tune": {"steps": 20, "rate": 0.2, "runs": 6, "validation_runs": 4, "test_runs": 16},
}
"""A bake-off of the papers' filters in outages, if nothing else is said."""

# ten minutes at usual rates: recordings of similar ones share its programs (`jaxnav.data.epochs.of_shared_size`)
WARM: dict[str, Any] = {"data": {"source": "urban", "options": {"duration_s": 600.0, "imu_rate_hz": 100.0}}}
OWN = {"demo": DEMO, "bakeoff": BAKEOFF, "warm": WARM}


def _look(args: argparse.Namespace) -> "Outcome":
    from jaxnav.app.verbs import info

    if args.verb == "data":
        return info.data(args.action, args.name)
    return info.info(cache_home())


def _work(args: argparse.Namespace, config: configuration.Config, folder: Path, out: Path) -> "Outcome":
    from jaxnav.analysis.progress import compiling

    progress = not (args.quiet or args.json) and _first()
    with compiling(progress):
        return _verb(args, config, folder, out, progress)


def _verb(args: argparse.Namespace, config: configuration.Config, folder: Path, out: Path, progress: bool) -> "Outcome":
    from jaxnav.app.unused import unused

    if not args.quiet and _first():
        for line in unused(args.verb, config):
            print(f"jaxnav: not used here: {line}", file=sys.stderr)
    if args.verb == "compare":
        from jaxnav.app.verbs import compare

        return compare.compare(args.paths, folder, config.out.figures)
    if args.verb in ("check", "convert"):
        from jaxnav.app.verbs import check

        return check.check(config, folder) if args.verb == "check" else check.convert(config, folder)
    if args.verb in ("simulate", "filter", "warm"):
        from jaxnav.app.verbs import filtering

        return filtering.simulate(config, folder) if args.verb == "simulate" else filtering.filter(config, folder)
    if args.verb == "allan":
        from jaxnav.app.verbs import allan

        return allan.allan(config, folder)
    import jax

    from jaxnav.app.long import Long

    devices = 0 if jax.process_count() > 1 else getattr(args, "devices", 1)
    long = Long(out / "checkpoint", getattr(args, "resume", False), devices)
    if args.verb == "mc":
        from jaxnav.app.verbs import mc

        return mc.mc(config, folder, progress, long)
    if args.verb == "bakeoff":
        from jaxnav.app.verbs import bakeoff

        return bakeoff.bakeoff(config, folder, progress, devices)
    from jaxnav.app.verbs import tune

    return tune.tune(config, folder, progress, long)


def _first() -> bool:
    """Is this the only process, or number 0?"""
    import jax

    return jax.process_index() == 0


def _report(args: argparse.Namespace, outcome: "Outcome", out: Path | None) -> int:
    from jaxnav.data.json import to_json

    code = INTERRUPTED if outcome.stopped else 0
    if args.json:
        about = {"verb": args.verb, "out": None if out is None else str(out), "stopped": outcome.stopped or None}
        print(to_json(about | {"seconds": outcome.seconds, "metrics": outcome.metrics}))
    elif not args.quiet:
        print(outcome.text)
        if out is not None:
            figures = sorted(p.name for p in out.glob("*.png"))
            print(f"\nresults in {out}" + (f", figures {', '.join(figures)}" if figures else ""))
    if outcome.stopped:
        print(f"jaxnav: stopped: {outcome.stopped}", file=sys.stderr)
    sys.stdout.flush()
    return code


def _fail(args: argparse.Namespace, error: Exception, code: int) -> int:
    if args.debug:
        traceback.print_exception(error)
    print(f"jaxnav: error: {' '.join(str(error).split())}", file=sys.stderr)
    return code


def _start_jax(args: argparse.Namespace) -> None:
    """Float64, compiled programs kept for the next start, and the devices and processes that tuning asks for."""
    fast_compiler()
    enable_x64()
    gc.set_threshold(COLLECT)
    if args.verb in SHARED:
        from tuning import distributed

        if args.devices < 0:
            raise ConfigError(f"--devices must be 0 (all) or more, got {args.devices}")
        if args.devices > 1 and args.processes is None:
            distributed.use_cpu_devices(args.devices)
        distributed.start(args.coordinator, args.processes, args.process)
    cache()


def _version() -> str:
    try:
        return metadata.version("jaxnav")
    except metadata.PackageNotFoundError:
        return "(not installed)"
