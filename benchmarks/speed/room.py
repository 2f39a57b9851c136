"""What one process holds of memory and mappings while it runs other benchmarks, one after the other.

Each compiled program keeps memory and mappings of the system, of which Linux gives a process 65,530: a study that
compiles hundreds of filters must drop what it no longer needs (`jaxnav.filters.compiler.make_room`).
"""

import importlib
import shlex
import threading
import time
from types import TracebackType

from benchmarks import common
from jaxnav.filters.compiler import Held, held

STUDIES = ("gipkf --steps 2", "bakeoff")
QUICK = ("gipkf --quick", "bakeoff --quick")
EVERY = 0.5  # s between two looks
MAPS, RESIDENT = 40_000, 6 * 2**30  # the bars


class Most:
    """The largest `Held` of this process while it is open, looked at every half second from a thread of its own."""

    def __enter__(self) -> "Most":
        self.held, self._over = held(), threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        while True:
            now = held()
            self.held = Held(max(self.held.maps, now.maps), max(self.held.resident, now.resident))
            if self._over.wait(EVERY):
                return


def main(argv: list[str]) -> int:
    """Run the studies; print what was held at most of each, and write the JSON."""
    from benchmarks.__main__ import HOME

    parser = common.options("room", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="their quick forms")
    parser.add_argument("studies", nargs="*", help=f"as on a command line, default {STUDIES}")
    args = parser.parse_args(argv)
    found = {}
    for study in args.studies or (QUICK if args.quick else STUDIES):
        name, *options = shlex.split(study)
        begun = time.perf_counter()
        with Most() as most:
            importlib.import_module(f"benchmarks.{HOME[name]}.{name}").main(options)
        took = time.perf_counter() - begun
        found[study] = {"maps": most.held.maps, "resident_gib": most.held.resident / 2**30, "seconds": took}
    print(f"\none process, at most (bars {MAPS} mappings, {RESIDENT / 2**30:g} GiB):")
    for study, row in found.items():
        print(f"  {study:24} {row['maps']:6} mappings {row['resident_gib']:5.1f} GiB, {row['seconds'] / 60:.1f} min")
    common.write_json(args.json, {"studies": found})
    return 0
