"""A progress bar: on a terminal as usual, elsewhere (a log, a pipe) a plain line now and then."""

import sys

from tqdm import tqdm

QUIET = 30.0  # s between lines where nobody watches, and before the first


class _Lines:
    """A text stream that ends a line where a terminal would go back to its start."""

    def write(self, text: str) -> None:
        text = text.strip()
        if text:
            sys.stderr.write(text + "\n")

    def flush(self) -> None:
        sys.stderr.flush()


def bar(total: int, unit: str, show: bool, done: int = 0) -> tqdm:
    """On stderr, of ``total`` steps of which some are ``done``; silent unless ``show``."""
    if sys.stderr.isatty():
        return tqdm(total=total, initial=done, unit=unit, disable=not show)
    return tqdm(
        total=total, initial=done, unit=unit, disable=not show, file=_Lines(), mininterval=QUIET, delay=QUIET,
        bar_format="{n_fmt}/{total_fmt} {unit}s [{elapsed}<{remaining}, {rate_fmt}{postfix}]",
    )  # fmt: skip
