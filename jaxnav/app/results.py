"""Output of a job: a folder that is complete or absent, run.json written last, and tables for the terminal."""

import contextlib
import glob
import itertools
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from jaxnav.app.config import Config, as_dict
from jaxnav.findings import remarks, warnings
from jaxnav.io.json import write_json
from jaxnav.types import ConfigError, DataError, Finding, Json

RUN = "run.json"


@contextlib.contextmanager
def picture(name: str) -> Iterator[None]:
    """Turn an error in drawing into a warning: the results are worth more than a picture."""
    try:
        yield
    except Exception as error:
        stderr(f"jaxnav: warning: no picture of {name}: {type(error).__name__}: {' '.join(str(error).split())}")


FIGURES = ("report", "files", "none")


def draws(config: Config, interactive: bool = False) -> bool:
    """Return whether figures are drawn as files, which a report embeds; ``interactive``: it shows the run by bokeh.

    Raises:
        ConfigError: another value of ``out.figures``.
    """
    kind = config.out.figures
    if kind not in FIGURES:
        raise ConfigError(f"out.figures must be one of {', '.join(FIGURES)}, got {kind!r}")
    return kind == "files" or (kind == "report" and not (interactive and find_spec("bokeh") is not None))


class CardRow(NamedTuple):
    """A number of the answer."""

    name: str
    stated: str
    tested: str


class Card(NamedTuple):
    """The answer of a run, at the top of its report."""

    verdict: str
    color: str  # "good", "care", "bad"
    why: str  # one line
    rows: list[CardRow]


class Table(NamedTuple):
    """A table of a report."""

    title: str
    head: tuple[str, ...]
    rows: list[list[str]]


class Outcome(NamedTuple):
    """Result of a verb for the command line."""

    metrics: Json
    text: str  # for the terminal
    seconds: dict[str, float]  # wall time by part
    stopped: str = ""  # why it ended early
    layout: Callable[[], Any] | None = None  # makes the interactive figures of a report
    config: Config | None = None  # that runs it again, where it is not the one that was given
    failed: bool = False  # exit code 1
    findings: Sequence[Finding] = ()  # warnings before the text, others after it
    verdict: str = ""  # last line where no finding warns, or a card has one
    card: Card | None = None
    tables: Sequence[Table] = ()  # of the report
    pictures: Sequence[str] = ()  # PNG files that a report shows above the interactive figures


def terminal(outcome: Outcome, verbose: bool, color: bool) -> list[str]:
    """Return the lines of a result for a terminal: warnings, text, remarks if ``verbose``, and a verdict."""
    warned = sum(f.warns for f in outcome.findings)
    hidden = 0 if verbose else len(outcome.findings) - warned
    lines = [*warnings(outcome.findings, color), *([""] if warned else []), outcome.text]
    lines += remarks(outcome.findings) if verbose else []
    verdict = f"{warned} warning{'s' * (warned > 1)}: see above" if warned and not outcome.card else outcome.verdict
    more = f"{hidden} remark{'s' * (hidden > 1)}: --verbose" if hidden else ""
    return lines + ["; ".join(part for part in (verdict, more) if part)] * bool(verdict or more)


@contextlib.contextmanager
def staged(out: Path, verb: str, inputs: Sequence[str | Path] = ()) -> Iterator[Path]:
    """Yield a folder to write into next to ``out``; its files move there when all went well, see `publish`.

    A failure leaves ``out`` as it was. Files of an earlier run of the same verb that the new one does not write are
    removed; nothing else is: an ``out`` with any other files, or with one of the ``inputs``, is refused before
    the work begins, and a file that appeared there meanwhile is kept under another name.

    Raises:
        DataError: the folder cannot be written, is a file, belongs to another verb, or has others' files or an input.
    """
    out = Path(out).resolve()
    try:
        _refuse_others(out, verb, inputs)
    except OSError as error:
        raise DataError(f"{out}: cannot be used: {error.strerror or error}") from error
    temporary = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    _remove_stale_folders(out)
    try:
        temporary.mkdir(parents=True)
        yield temporary
        publish(temporary, out, verb)
    except OSError as error:
        raise DataError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def publish(folder: Path, out: Path, verb: str) -> None:
    """Move the files of a folder that `staged` yields to its ``out``, run.json last, in place of earlier ones.

    Raises:
        DataError: ``out`` cannot be written.
    """
    try:
        if not out.exists():
            os.rename(folder, out)  # all of it at once
            folder.mkdir()
            return
        names = sorted(p.name for p in folder.iterdir())
        old = _listed(out / RUN)
        # killed from here on it is not whole, says so, and is this verb's to write again
        write_json(out / RUN, {"verb": verb, "stopped": "while it was written", "files": sorted({*old, *names, RUN})})
        for name in sorted(names, key=lambda n: n == RUN):
            if name not in (*old, RUN) and (out / name).exists():
                _keep(out / name)
            os.replace(folder / name, out / name)
        for name in set(old) - set(names):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"{out}: cannot be written: {error.strerror or error}") from error


def _remove_stale_folders(out: Path) -> None:
    """Remove hidden folders next to ``out`` of killed processes."""
    for path in out.parent.glob(f".{glob.escape(out.name)}.*.tmp"):
        number = path.name.removesuffix(".tmp").rpartition(".")[2]
        if number.isdecimal() and not _alive(int(number)):
            shutil.rmtree(path, ignore_errors=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    try:  # a killed process without a waiting parent is dead as well: in some containers it stays
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (OSError, IndexError):  # not Linux, or gone just now
        return True


def _refuse_others(out: Path, verb: str, inputs: Sequence[str | Path]) -> None:
    """Raise DataError unless ``out`` is new, empty, or holds an earlier result of ``verb`` and none of the inputs."""
    if not out.exists():
        return
    if not out.is_dir():
        raise DataError(f"{out}: is a file, expected a folder or nothing")
    files = sorted(p.name for p in out.iterdir() if p.is_file())
    about = _about(out / RUN)
    if about is not None and about.get("verb") != verb:
        raise DataError(f"{out}: holds the result of jaxnav {about.get('verb')}: choose another --out for {verb}")
    if files and about is None:
        some = ", ".join(files[:3]) + (", ..." if len(files) > 3 else "")
        raise DataError(f"{out}: holds {some}, which no jaxnav {verb} wrote: choose an empty folder for --out")
    for path in (Path(p).resolve() for p in inputs):
        if path == out or (path.parent == out and path.name != RUN):  # run.json is re-run in its folder
            raise DataError(f"{path}: is an input of this run inside its --out: choose another folder")


def _keep(path: Path) -> None:
    """Move a file that is not ours out of the way, to the first free name."""
    free = (path.with_name(f"{path.name}.kept{i or ''}") for i in itertools.count())
    os.rename(path, next(p for p in free if not p.exists()))


def _about(run: Path) -> Json | None:
    """Return the content of a run.json, None where none can be read."""
    try:
        about = json.loads(run.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return about if isinstance(about, dict) and isinstance(about.get("files"), list) else None


def _listed(run: Path) -> list[str]:
    """Return the files that a run.json lists as written by its run; only names, never paths."""
    files = (_about(run) or {"files": []})["files"]
    return [f for f in files if isinstance(f, str) and f == Path(f).name and f not in ("", ".", "..")]


def write_run(folder: Path, verb: str, read: Sequence[str], config: Config, outcome: Outcome) -> None:
    """Write run.json: sections ``read`` of the configuration, versions, device, seed, wall times, metrics, files."""
    files = sorted(p.name for p in folder.iterdir())
    used = {k: v for k, v in as_dict(config).items() if k in read or not isinstance(v, Mapping)}
    about = {
        "verb": verb, "config": used, "seed": config.seed, "versions": versions(), "git": git_hash(),
        "device": device(), "seconds": outcome.seconds, "stopped": outcome.stopped or None,
        "text": outcome.text, "metrics": outcome.metrics, "files": [*files, RUN],
    }  # fmt: skip
    write_json(folder / RUN, about)


def versions() -> dict[str, str]:
    """Return versions of all packages that the numbers depend on."""
    names = ("jaxnav", "jax", "jaxlib", "numpy", "scipy", "optax")
    found = {"python": platform.python_version()}
    for name in names:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def device() -> str:
    """Return the device that jax computes on, in words."""
    import jax

    first = jax.devices()[0]
    return f"{first.platform}: {first.device_kind}, {jax.device_count()} device(s), {os.cpu_count()} CPU cores"


def git_hash() -> str | None:
    """Return the commit of a source checkout; None for an installed package."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def stderr(text: str) -> None:
    """Print a line of progress to stderr; results go to stdout."""
    print(text, file=sys.stderr, flush=True)
