"""`jaxnav completion SHELL`: completion of arguments by the tab key."""

import argparse
from typing import TYPE_CHECKING

from jaxnav.app.verb import Argument, Job, Verb
from jaxnav.types import DataError

if TYPE_CHECKING:
    from jaxnav.app.results import Outcome

SHELLS = ("bash", "zsh", "tcsh")
FILES = ("config", "params", "path", "paths", "data")
FOLDERS = ("out",)


def run(job: Job) -> "Outcome":
    """Return the script."""
    from jaxnav.app.cli import make_parser
    from jaxnav.app.results import Outcome

    return Outcome({}, script(make_parser(), job.args.shell), {})


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the script that a shell sources to complete verbs, options, filters, scenarios and files.

    Raises:
        DataError: shtab, which writes it, is not installed.
    """
    try:
        import shtab
    except ImportError as error:
        raise DataError("completion needs shtab: pip install 'jaxnav[completion]'") from error
    from jaxnav.filters.catalogue import FILTERS

    for sub in _verbs(parser).values():
        for action in sub._actions:
            if action.dest == "filter":
                action.choices = sorted(FILTERS)
            elif action.dest in FILES:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
            elif action.dest in FOLDERS:
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
    return shtab.complete(parser, shell)


def _verbs(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    return next(a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction))


VERB = Verb(
    "completion", "print a script that completes arguments by the tab key", run,
    (Argument("shell", "name of the shell", more={"choices": SHELLS}),), writes=lambda args: False, needs_jax=False,
)  # fmt: skip
