"""`jaxnav completion SHELL`: what a shell completes by the tab key."""

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
    """The script."""
    from jaxnav.app.cli import make_parser
    from jaxnav.app.results import Outcome

    return Outcome({}, script(make_parser(), job.args.shell), {})


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """The script that a shell sources to complete verbs, options, filters, scenarios and files.

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
    "completion", "what a shell completes by the tab key, as a script for it", run,
    (Argument("shell", "whose script it is", more={"choices": SHELLS}),), writes=lambda args: False, needs_jax=False,
)  # fmt: skip
