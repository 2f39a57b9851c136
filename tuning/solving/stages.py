"""Progress of a job of known stages: which one runs, and about how long the rest takes."""

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
        self, stages: Sequence[Stage], log: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.stages, self.log, self.clock, self.started, self.done = list(stages), log, clock, clock(), 0

    def replace(self, stages: Sequence[Stage]) -> None:
        """Replace the stages that have not started."""
        self.stages[self.done :] = stages

    def next(self) -> None:
        """Begin the next stage."""
        weights = [stage.weight for stage in self.stages]
        before, spent = sum(weights[: self.done]), self.clock() - self.started
        left = f", about {spent * sum(weights[self.done :]) / before:.0f} s left" if before else ""
        self.log(f"{self.done + 1} of {len(self.stages)}: {self.stages[self.done].name}{left}")
        self.done += 1
