"""Work at the side of a job, such as answers before the best one: compilation and runs leave other cores free."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Self


class Aside:
    """Calls of a function in a thread, one after the other; all have ended where the ``with`` block has.

    An error ends the job: at the next call, or with the block. Where the block fails, calls that wait are dropped.
    """

    def __init__(self, function: Callable[[Any], None]) -> None:
        self.function, self.calls = function, list[Future[None]]()
        self.thread = ThreadPoolExecutor(1)

    def __call__(self, argument: Any) -> None:
        """Call the function with an argument, after the calls before."""
        self._raise_errors(wait=False)
        self.calls.append(self.thread.submit(self.function, argument))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.thread.shutdown(cancel_futures=error is not None)
        if error is None:
            self._raise_errors(wait=True)

    def _raise_errors(self, wait: bool) -> None:
        for call in self.calls:
            if wait or call.done():
                call.result()
