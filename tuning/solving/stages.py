"""Progress of a job of known stages: which one runs, about how long the rest takes, and which ones a limit allows."""

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple


class Stage(NamedTuple):
    """A part of a job."""

    name: str
    weight: float  # its usual share of the time


class Stages:
    """Writes a line at the beginning of each stage.

    The remaining time is estimated from the elapsed time and the weights of the finished and remaining stages.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        log: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
        limit: float = math.inf,
    ) -> None:
        self.stages, self.log, self.clock, self.limit = list(stages), log, clock, limit
        self.started, self.done = clock(), 0

    def replace(self, stages: Sequence[Stage]) -> None:
        """Replace the stages that have not started."""
        self.stages[self.done :] = stages

    def takes(self, stages: Sequence[Stage]) -> float:
        """Return about how many seconds stages take; nan before the first one has ended."""
        weight = lambda some: sum(stage.weight for stage in some)
        before = weight(self.stages[: self.done])
        return (self.clock() - self.started) * weight(stages) / before if before else math.nan

    def fits(self, *stages: Stage) -> bool:
        """Return whether stages can end within the limit, s since the begin."""
        return not self.clock() - self.started + self.takes(stages) > self.limit

    def coming(self) -> str:
        """Return which stages are to come, and about how long they take."""
        rest = self.stages[self.done :]
        return f"{', '.join(stage.name for stage in rest)} to come, about {self.takes(rest):.0f} s"

    def next(self) -> None:
        """Begin the next stage."""
        left = self.takes(self.stages[self.done :])
        rest = f", about {left:.0f} s left" if math.isfinite(left) else ""
        self.log(f"{self.done + 1} of {len(self.stages)}: {self.stages[self.done].name}{rest}")
        self.done += 1
