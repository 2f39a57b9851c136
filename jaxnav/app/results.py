"""What a job leaves: a folder that is whole or not there, run.json written last, and tables for the terminal."""

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
from pathlib import Path
from typing import Any, NamedTuple

from jaxnav.app.config import Config, as_dict
from jaxnav.io.json import write_json
from jaxnav.types import DataError, Finding

RUN = "run.json"


@contextlib.contextmanager
def picture(name: str) -> Iterator[None]:
    """A picture that cannot be drawn is a warning: what was worked out is worth more."""
    try:
        yield
    except Exception as error:
        stderr(f"jaxnav: warning: no picture of {name}: {type(error).__name__}: {' '.join(str(error).split())}")


class Outcome(NamedTuple):
    """What a verb hands to the command line."""

    metrics: dict[str, Any]
    text: str  # for the terminal
    seconds: dict[str, float]  # wall time by part
    stopped: str = ""  # why it ended early
    layout: Callable[[], Any] | None = None  # makes what a report can be zoomed into
    config: Config | None = None  # that runs it again, where it is not the one that was given
    failed: bool = False  # exit code 1
    findings: Sequence[Finding] = ()  # after the text


@contextlib.contextmanager
def staged(out: Path, verb: str, inputs: Sequence[str | Path] = ()) -> Iterator[Path]:
    """A folder to write into beside ``out``; what it holds moves there when all went well, run.json last.

    A failure leaves ``out`` as it was. Files that an earlier run of the same verb left and the new one has not are
    removed; nothing else is: an ``out`` that holds anybody else's files, or one of the ``inputs``, is refused before
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
    _clear_after_the_dead(out)
    try:
        temporary.mkdir(parents=True)
        yield temporary
        if not out.exists():
            os.rename(temporary, out)  # all of it at once
            return
        names = sorted(p.name for p in temporary.iterdir())
        old = _listed(out / RUN)
        # killed from here on it is not whole, says so, and is this verb's to write again
        write_json(out / RUN, {"verb": verb, "stopped": "while it was written", "files": sorted({*old, *names, RUN})})
        for name in sorted(names, key=lambda n: n == RUN):
            if name not in (*old, RUN) and (out / name).exists():
                _keep(out / name)
            os.replace(temporary / name, out / name)
        for name in set(old) - set(names):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _clear_after_the_dead(out: Path) -> None:
    """Remove what killed runs left beside ``out``: hidden folders of processes that are no more."""
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
    try:  # one that was killed and that nobody waited for is dead as well: some containers never do
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
        raise DataError(f"{out}: holds {some}, which no jaxnav {verb} wrote: choose a folder of its own for --out")
    for path in (Path(p).resolve() for p in inputs):
        if path == out or (path.parent == out and path.name != RUN):  # run.json is re-run where it lies
            raise DataError(f"{path}: is read by this run and lies in its --out: choose another folder")


def _keep(path: Path) -> None:
    """Move a file that is not ours out of the way, to the first free name."""
    free = (path.with_name(f"{path.name}.kept{i or ''}") for i in itertools.count())
    os.rename(path, next(p for p in free if not p.exists()))


def _about(run: Path) -> dict[str, Any] | None:
    """What a run.json says, None where there is none that can be read."""
    try:
        about = json.loads(run.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return about if isinstance(about, dict) and isinstance(about.get("files"), list) else None


def _listed(run: Path) -> list[str]:
    """The files that a run.json says are its own; only names, never paths."""
    files = (_about(run) or {"files": []})["files"]
    return [f for f in files if isinstance(f, str) and f == Path(f).name and f not in ("", ".", "..")]


def write_run(folder: Path, verb: str, read: Sequence[str], config: Config, outcome: Outcome) -> None:
    """Write run.json: sections ``read`` of the configuration, versions, device, seed, wall times, metrics, files."""
    files = sorted(p.name for p in folder.iterdir())
    own = {k: v for k, v in as_dict(config).items() if k in read or not isinstance(v, Mapping)}
    about = {
        "verb": verb, "config": own, "seed": config.seed, "versions": versions(), "git": git_hash(),
        "device": device(), "seconds": outcome.seconds, "stopped": outcome.stopped or None,
        "text": outcome.text, "metrics": outcome.metrics, "files": [*files, RUN],
    }  # fmt: skip
    write_json(folder / RUN, about)


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    names = ("jaxnav", "jax", "jaxlib", "numpy", "scipy", "optax")
    found = {"python": platform.python_version()}
    for name in names:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def device() -> str:
    """The device that jax computes on, in words."""
    import jax

    first = jax.devices()[0]
    return f"{first.platform}: {first.device_kind}, {jax.device_count()} device(s), {os.cpu_count()} CPU cores"


def git_hash() -> str | None:
    """The commit of a source checkout; None for an installed package."""
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
    """A line of progress, apart from the results."""
    print(text, file=sys.stderr, flush=True)
