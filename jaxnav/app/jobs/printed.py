"""`jaxnav config` and `jaxnav completion`: what is printed without jax."""

import argparse

from jaxnav.app import settings
from jaxnav.app.results import Outcome
from jaxnav.types import DataError

FILES = ("config", "params", "path", "paths", "data")
FOLDERS = ("out",)


def config(markdown: bool) -> Outcome:
    """Return every setting as a configuration, or as a page of the docs."""
    return Outcome({}, (settings.page() if markdown else settings.commented()).rstrip("\n"), {})


def completion(shell: str) -> Outcome:
    """Return the script that a shell sources."""
    from jaxnav.app.cli import make_parser

    return Outcome({}, script(make_parser(), shell), {})


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
