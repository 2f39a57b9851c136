"""How a search ended."""

from enum import StrEnum


class Status(StrEnum):
    """How a search ended; its best point is kept in any case."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration_limit"
    STOPPED_EARLY = "stopped_early"  # no better validation any more
    INTERRUPTED = "interrupted"
