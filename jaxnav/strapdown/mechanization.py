"""The two functions of a mechanization, one of each per frame."""

from typing import Any, Protocol

import jax

from jaxnav.types import ErrorInputs, Forcing, Imu, Nav


class Propagate(Protocol):
    """Strapdown navigation through the samples of an epoch."""

    def __call__(
        self, nav: Nav, u: Forcing | None, imu: Any, stride: int = 1, keep: jax.Array | None = None, /
    ) -> tuple[Nav, ErrorInputs]:
        """Return navigation and the path for the error dynamics.

        Args:
            nav: navigation at the start, in the frame.
            u: feedback of an observer, None without one.
            imu: samples (k, ...), or the result of `Preintegrate`.
            stride: samples of a point of the path.
            keep: (w,) int, the samples after which navigation is returned; None: after the last.

        Returns:
            Navigation (w, ...), or () without ``keep``; the path (k / stride, ...).
        """

    def __hash__(self) -> int: ...


class Preintegrate(Protocol):
    """The part of a mechanization that needs no navigation state, computed once for all runs."""

    def __call__(self, imu: Imu, last: tuple[jax.Array, jax.Array], stride: int, keep: jax.Array, /) -> Any:
        """Return samples for `Propagate`; ``last``: rate (3,) rad/s and force (3,) m/s^2 of the sample before."""

    def __hash__(self) -> int: ...
