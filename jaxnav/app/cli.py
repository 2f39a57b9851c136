"""The command line: ``jaxnav VERB``, of the verbs of `jaxnav.app.verbs.VERBS`.

Exit codes: 0 done, 1 a check failed (the filter stopped being finite), 2 usage or configuration, 3 data that cannot be
used, 130 Ctrl-C. Results are on stdout and in the folder of --out, progress and errors on stderr.
"""

import argparse
import gc
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from jaxnav.app import config as configuration
from jaxnav.app.console import INTERRUPTED
from jaxnav.app.verb import Argument, Job
from jaxnav.app.verbs import VERBS
from jaxnav.filters.compiler import cache, enable_x64, fast_compiler
from jaxnav.types import ConfigError, DataError, FilterError, Json

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome

SHARED = (
    Argument("--config", "TOML, or the run.json of an earlier run", value="FILE"),
    Argument("--set", "one setting; may be repeated", value="A.B=C", more={"action": "append", "default": []}),
    Argument("--seed", "of everything random", value="N", type=int),
    Argument("--out", "folder of the results (default out/VERB)", value="DIR", type=Path),
    Argument("--json", "the result as JSON on stdout, and nothing else there"),
    Argument("--quiet", "print nothing but errors"),
    Argument("--verbose", "print remarks in addition to warnings"),
)
"""Arguments of every verb."""
COLLECT = 20_000  # new objects until the garbage collector looks; at Python's 700 it takes a third of tracing


EXAMPLES = """\
a recording:
  jaxnav solve drive.bag --out out/drive             the best trajectory, calibrated sd, a verdict
or by its parts:
  jaxnav check drive.bag                             faults of the log, and a configuration that runs it
  jaxnav filter drive.bag --out out/run              solution, figures, report.html
  jaxnav filter drive.bag --smooth --out out/smooth  smoothed (RTS): past and future fixes
  jaxnav tune drive.bag --out out/tuned              noise, fixes and clocks, without truth
  jaxnav filter drive.bag --params out/tuned/tuned.toml --out out/after
  jaxnav compare out/run out/after
live:
  jaxnav stream drive.bag --speed 1
simulated:
  jaxnav simulate urban --seed 1 --out out/urban
  jaxnav mc urban --filter ekf15,ekf15_gate --runs 100 --devices 0
  jaxnav bakeoff gipkf_urban --filter gpid15,gipkf,fwekf15,ekf15_gate
settings:
  jaxnav config > job.toml; jaxnav filter --config job.toml --set filter.cov_stride=10
  jaxnav completion bash > ~/.local/share/bash-completion/completions/jaxnav

Exit codes: 0 done, 1 failed check, 2 usage or configuration, 3 bad data, 130 stopped by Ctrl-C"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    parser = make_parser()
    try:
        args, rest = parser.parse_known_args(argv)
        if rest:
            parser.error(f"unrecognized arguments: {' '.join(rest)}")
    except SystemExit as stop:  # --help, --version, usage
        return int(stop.code or 0)
    try:
        return _main(args)
    except KeyboardInterrupt:
        print("jaxnav: stopped", file=sys.stderr)
        return INTERRUPTED
    except (ConfigError, DataError, FilterError) as error:
        return _fail(args, error, {ConfigError: 2, DataError: 3, FilterError: 1}.get(type(error), 3))
    except BrokenPipeError:  # `jaxnav info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0


def make_parser() -> argparse.ArgumentParser:
    """Return the arguments of every verb."""
    shared = argparse.ArgumentParser(add_help=False)
    for argument in SHARED:
        argument.add_to(shared)
    shared.add_argument("--debug", action="store_true", help=argparse.SUPPRESS)
    parser = argparse.ArgumentParser(
        prog="jaxnav",
        description="INS/GNSS navigation, differentiable: simulate, filter, tune.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jaxnav {_version()}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb in VERBS.values():
        sub = verbs.add_parser(verb.name, help=verb.help, description=verb.help, parents=[shared])
        for argument in verb.arguments:
            argument.add_to(sub)
    return parser


def _main(args: argparse.Namespace) -> int:
    verb = VERBS[args.verb]
    config = resolve(args)
    if not verb.needs_jax:
        return _report(args, verb.run(Job(args, config, Path(), Path(), False)), None)
    _start_jax(args)
    from jaxnav.app import report, results

    out = args.out or Path("out") / args.verb
    if not (verb.writes(args) and _first()):  # of several processes one writes
        with tempfile.TemporaryDirectory() as scratch:
            outcome = _work(args, config, Path(scratch), out)
        return _report(args, outcome, None) if _first() else 0
    with results.staged(out, args.verb, _inputs(args, config)) as folder:
        published = []

        def complete(outcome: "Outcome") -> None:
            if config.out.figures != "none" and verb.report:
                report.write(folder, args.verb, config, outcome)
            results.write_run(folder, args.verb, verb.sections, outcome.config or config, outcome)

        def publish(outcome: "Outcome") -> None:
            complete(outcome)
            results.publish(folder, out.resolve(), args.verb)
            published.append(out)

        try:
            outcome = _work(args, config, folder, out, publish)
        except BaseException:
            if published:
                print(f"jaxnav: the best answer so far is in {out}", file=sys.stderr)
            raise
        complete(outcome)
    return _report(args, outcome, out)


def _inputs(args: argparse.Namespace, config: configuration.Config) -> list[str]:
    """Return the files and folders that a run reads, which its results must not touch."""
    from jaxnav.simulate.scenarios import SCENARIOS

    named = [source for source in (config.data.source, *config.tune.more) if source not in SCENARIOS] + [args.config]
    for argument in VERBS[args.verb].arguments:
        if argument.reads:
            value = getattr(args, argument.attribute)
            named += value if isinstance(value, list) else [value]
    return [path for path in named if path and Path(path).exists()]


def resolve(args: argparse.Namespace) -> configuration.Config:
    """Return the configuration: the verb's defaults, the file, --params, the flags, then --set."""
    verb = VERBS[args.verb]
    layers: list[tuple[str, Json]] = [(args.verb, verb.defaults(args))]
    if args.config is not None:
        layers.append((args.config, configuration.read(args.config)))
    if getattr(args, "params", None) is not None:
        layers.append((args.params, configuration.read_params(args.params)))
    if args.seed is not None:
        layers.append(("--seed", {"seed": args.seed}))
    named: dict[str, str] = {}  # the argument of each setting
    for argument in verb.arguments:
        value = getattr(args, argument.attribute)
        if argument.setting and value is not None and value is not False and value != []:
            if argument.setting in named:
                first = named[argument.setting]
                raise ConfigError(f"{argument.setting}: by {first} and by {argument.name}; leave one out")
            named[argument.setting] = argument.name
            section, *keys = argument.setting.split(".")
            paths = argument.setting == "data.source" and isinstance(value, list)
            value, *more = value if paths else [value]
            for key in reversed(keys):
                value = {key: value}
            layers.append((argument.name, {section: value}))
            if len(more) > 1:
                raise ConfigError(f"{argument.name}: a recording and a file with its fixes, got {1 + len(more)} paths")
            if more:
                layers.append((argument.name, {section: {"options": {"gnss": more[0]}}}))
    layers += [(f"--set {setting}", configuration.parse_set(setting)) for setting in args.set]
    return configuration.resolve(layers)


def _work(
    args: argparse.Namespace,
    config: configuration.Config,
    folder: Path,
    out: Path,
    publish: Callable[["Outcome"], None] = lambda outcome: None,
) -> "Outcome":
    from jaxnav.analysis.progress import compiling
    from jaxnav.app.unused import unused

    verb, progress = VERBS[args.verb], not (args.quiet or args.json) and _first()
    if verb.sections and not args.quiet and _first():
        for line in unused(verb, config):
            print(f"jaxnav: not used here: {line}", file=sys.stderr)
    with compiling(progress):
        return verb.run(Job(args, config, folder, out, progress, publish))


def _first() -> bool:
    """Is this the only process, or number 0?"""
    import jax

    return jax.process_index() == 0


def _report(args: argparse.Namespace, outcome: "Outcome", out: Path | None) -> int:
    from jaxnav.app.results import terminal
    from jaxnav.io.json import to_json

    code = INTERRUPTED if outcome.stopped else int(outcome.failed)
    if args.json:
        about = {"verb": args.verb, "out": None if out is None else str(out), "stopped": outcome.stopped or None}
        print(to_json(about | {"seconds": outcome.seconds, "metrics": outcome.metrics}))
    elif outcome.text and not args.quiet:
        color = sys.stdout.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") != "dumb"
        print("\n".join(terminal(outcome, args.verbose, color)))
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
    if hasattr(args, "devices"):
        from tuning.fit import distributed

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
