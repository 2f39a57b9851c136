"""What a filter takes for a mechanization: two functions, of each of which a frame has its own."""

from typing import Any, Protocol

import jax

from jaxnav.types import ErrorInputs, Forcing, Imu, Nav


class Propagate(Protocol):
    """Strapdown navigation through the samples of an epoch."""

    def __call__(
        self, nav: Nav, u: Forcing | None, imu: Any, stride: int = 1, keep: jax.Array | None = None, /
    ) -> tuple[Nav, ErrorInputs]:
        """Return navigation and what the error dynamics see of the way.

        Args:
            nav: navigation at the start, in the frame.
            u: feedback of an observer, None without one.
            imu: samples (k, ...), or what `Preintegrate` made of them.
            stride: samples of a point of the path.
            keep: (w,) int, the samples after which navigation is returned; None: after the last.

        Returns:
            Navigation (w, ...), or () without ``keep``; the path (k / stride, ...).
        """

    def __hash__(self) -> int: ...


class Preintegrate(Protocol):
    """What of a mechanization needs no navigation state, worked out once for all runs."""

    def __call__(self, imu: Imu, last: tuple[jax.Array, jax.Array], stride: int, keep: jax.Array, /) -> Any:
        """Return what `Propagate` takes; ``last``: rate (3,) rad/s and force (3,) m/s^2 of the sample before."""

    def __hash__(self) -> int: ...
