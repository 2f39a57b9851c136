"""Progress: a bar of steps, and a line while programs compile, on a terminal; elsewhere a plain line now and then."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

LOG_INTERVAL_S = 30.0  # s between lines where nobody watches, and before the first
SILENT_COMPILING_S = 4.0  # s of compiling, or of loading programs, without a message
POLL_INTERVAL_S = 0.25  # s between looks
COMPILING = "compiling (first time, about 20 s; cached from then on)"
# files of jax that are on the stack while it traces, lowers and compiles
STAGES = ("jax/_src/interpreters/partial_eval.py", "jax/_src/interpreters/mlir.py", "jax/_src/compiler.py")


class _Lines:
    """A text stream that ends a line where a terminal would go back to its start."""

    def write(self, text: str) -> None:
        text = text.strip()
        if text:
            sys.stderr.write(text + "\n")

    def flush(self) -> None:
        sys.stderr.flush()


class Bar(tqdm):
    """A progress bar; its estimate of the remaining time excludes the first step, in which programs compile."""

    n: float
    started = False

    def update(self, n: float | None = 1) -> bool | None:
        """Advance by finished steps."""
        if self.disable or self.started:
            return super().update(n)
        self.started = True
        self.n = self.initial = self.last_print_n = self.n + (n or 0)
        self.start_t = self.last_print_t = self._time()
        return None


def bar(total: int, unit: str, show: bool, done: int = 0) -> Bar:
    """Return a bar on stderr, of ``total`` steps with ``done`` finished; silent unless ``show``."""
    if sys.stderr.isatty():
        return Bar(total=total, initial=done, unit=unit, disable=not show)
    return Bar(
        total=total, initial=done, unit=unit, disable=not show, file=_Lines(),
        mininterval=LOG_INTERVAL_S, delay=LOG_INTERVAL_S,
        bar_format="{n_fmt}/{total_fmt} {unit}s [{elapsed}<{remaining}, {rate_fmt}{postfix}]",
    )  # fmt: skip


@contextmanager
def compiling(show: bool) -> Iterator[None]:
    """While the block runs: say so on stderr when the calling thread has compiled for longer than `SILENT_COMPILING_S`.

    On a terminal with the seconds, for as long as it lasts; elsewhere once.
    """
    if not show:
        yield
        return
    over = threading.Event()
    watch = threading.Thread(target=_watch, args=(threading.get_ident(), over), daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()


def _watch(thread: int, over: threading.Event) -> None:
    spent, since, line = 0.0, time.monotonic(), None
    while not over.wait(POLL_INTERVAL_S):
        now = time.monotonic()
        busy = compiles(thread)
        spent += now - since if busy else 0.0
        since = now
        if spent < SILENT_COMPILING_S:
            continue
        if not sys.stderr.isatty():
            print(f"{COMPILING} ...", file=sys.stderr, flush=True)
            return
        if busy and line is None:
            line = tqdm(bar_format="{desc}", leave=False)
        if busy and line is not None:
            line.set_description_str(f"{COMPILING}: {spent:.0f} s")
        elif line is not None:
            line.close()
            line = None
    if line is not None:
        line.close()


def compiles(thread: int) -> bool:
    """Is jax tracing, lowering or compiling in a thread?"""
    frame = sys._current_frames().get(thread)
    while frame is not None:
        if frame.f_code.co_filename.replace("\\", "/").endswith(STAGES):
            return True
        frame = frame.f_back
    return False
