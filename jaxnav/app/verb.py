"""A verb of the command line: its arguments, its sections of the configuration, and its work.

Verbs are rows of `jaxnav.app.verbs.VERBS`; parser, dispatch, run.json, completion, the settings named as unused and
docs/commands.md come from the rows. A row's module imports its job inside `Verb.run`: other verbs do not wait for it.
"""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxnav.app.config import Config
from jaxnav.types import Json

if TYPE_CHECKING:
    from jaxnav.app.long import Long
    from jaxnav.app.results import Outcome


class Argument(NamedTuple):
    """An argument of a verb."""

    name: str  # "path" of a positional one, "--data" of an option
    help: str
    setting: str = ""  # the key of the configuration that it sets, "data.source"
    value: str = ""  # how its value is called in the help; "" is none: an option is a switch then
    type: Callable[[str], Any] = str
    reads: bool = False  # names a file or folder that the run reads
    more: Mapping[str, Any] = {}  # further arguments of `argparse.ArgumentParser.add_argument`

    @property
    def attribute(self) -> str:
        """Its name in the parsed arguments."""
        return self.name.lstrip("-").replace("-", "_")

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Add it to a parser."""
        if self.name.startswith("-") and not self.value:
            parser.add_argument(self.name, help=self.help, action="store_true")
        else:
            more = dict(self.more) | ({"metavar": self.value} if self.value else {})
            parser.add_argument(self.name, help=self.help, type=self.type, **more)


class Job(NamedTuple):
    """One call of a verb."""

    args: argparse.Namespace
    config: Config
    folder: Path  # to write into
    out: Path  # where that will be
    progress: bool  # show it
    publish: Callable[["Outcome"], None] = lambda outcome: None  # moves the files in the folder to ``out``, as they are

    @property
    def devices(self) -> int:
        """Among how many devices runs are shared; 0: all."""
        import jax

        return 0 if jax.process_count() > 1 else getattr(self.args, "devices", 1)

    @property
    def long(self) -> "Long":
        """Checkpoints and devices of a long job."""
        from jaxnav.app.long import Long

        return Long(self.out / "checkpoint", getattr(self.args, "resume", False), self.devices)


class Verb(NamedTuple):
    """A row of `jaxnav.app.verbs.VERBS`."""

    name: str
    help: str  # a line
    run: Callable[[Job], "Outcome"]
    arguments: tuple[Argument, ...] = ()
    sections: tuple[str, ...] = ()  # of the configuration that it reads and run.json holds, in addition to the seed
    writes: Callable[[argparse.Namespace], bool] = lambda args: True  # into --out
    needs_jax: bool = True  # float64, kept programs and devices are set before it runs
    report: bool = False  # write report.html
    defaults: Callable[[argparse.Namespace], Json] = lambda args: {}  # settings that the user's replace
    # (configuration, whether it simulates) -> why, by the keys that have no effect though their sections are read
    unused: Callable[[Config, bool], dict[str, str]] = lambda config, simulated: {}
    simulates: bool = False  # runs scenarios alone


def no_effect(reason: str, *keys: str) -> dict[str, str]:
    """Return the reason by key, for `Verb.unused`."""
    return dict.fromkeys(keys, reason)


DATA = (
    Argument(
        "source",
        "scenario, data set or recording; a second path has the fixes of an IMU's file ([data] source)",
        "data.source",
        "SOURCE",
        reads=True,
        more={"nargs": "*"},
    ),
    Argument("--data", "the same as SOURCE", "data.source", value="SOURCE"),
)
PATH = Argument(
    "path",
    "file or folder of any known format, or a column map; a second one has the fixes of an IMU's file",
    "data.source",
    "PATH",
    reads=True,
    more={"nargs": "+"},
)
MAP = Argument(
    "--map",
    "read the recording by this column map, in place of the files that it names",
    "data.options.map",
    value="FILE",
    reads=True,
)
FILTER = Argument("--filter", "see `jaxnav info` ([filter] name)", "filter.name", value="NAME")
PARAMS = Argument(
    "--params",
    "parameters of this file, such as an earlier tuned.toml, or of another filter: .params of PX4",
    reads=True,
    value="FILE",
)
RESUME = Argument("--resume", "go on from the checkpoint in --out")
DEVICES = (
    Argument("--devices", "share runs among N, 0: all there", value="N", type=int, more={"default": 1}),
    Argument("--coordinator", "of several processes, private networks only", value="HOST:PORT"),
    Argument("--processes", "how many; under Slurm or MPI all is found", value="N", type=int),
    Argument("--process", "number of this one, from 0", value="I", type=int),
)
"""Arguments of verbs that several devices or processes may share."""
