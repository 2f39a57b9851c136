"""FRAMES: the frames that a filter may navigate in, each a row: mechanization, growth of errors, and conversions."""

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol

import jax

from jaxnav.states.transition import Blocks
from jaxnav.strapdown import inertial_quaternion, local_level, tangent_frame
from jaxnav.strapdown.errors import inertial_quaternion as inertial_errors
from jaxnav.strapdown.errors import local_level as local_level_errors
from jaxnav.strapdown.errors import tangent_frame as tangent_errors
from jaxnav.strapdown.fast import local_level as fast_local_level
from jaxnav.strapdown.mechanization import Preintegrate, Propagate
from jaxnav.types import ErrorInputs, Nav, Table


class Dynamics(Protocol):
    """The differential equation of position, velocity and attitude errors in one frame."""

    def __call__(self, point: ErrorInputs, form: Literal["full", "simple"]) -> Blocks:
        """Return the blocks of F at one point; "simple" has the terms of the papers' models alone."""


class Frame(NamedTuple):
    """A frame: how navigation moves in it, and how its errors of position, velocity and attitude do."""

    propagate: Propagate  # the plain form
    dynamics: Dynamics
    retract: Callable[[Nav, jax.Array], Nav]  # position and velocity less their errors
    fast: Propagate | None = None  # equal to the plain form by test
    preintegrate: Preintegrate | None = None  # the part of the fast form that needs no state
    enter: Callable[[Nav], Nav] | None = None  # local level navigation -> the frame's; None: it is local level
    leave: Callable[[Nav], Nav] | None = None  # the inverse
    enu_rows: Callable[[Nav, Nav], jax.Array] | None = None  # (nav, the same in local level) -> d(ENU error)/dx (9, 9)
    velocity_axes: Callable[[Nav], jax.Array] | None = None  # rotation from the axes of attitude to velocity's, (3, 3)
    vertical: int = 2  # which axis of velocity is vertical
    lumps_noise: bool = False  # the noise of its simple form is that of one step over the epoch, as W of GPID, eq. 29


FRAMES: Table[Frame] = Table(
    {
        "local_level": Frame(
            local_level.propagate,
            local_level_errors.dynamics,
            local_level_errors.retract,
            fast_local_level.propagate,
            fast_local_level.preintegrate,
            lumps_noise=True,
        ),
        "tangent": Frame(
            tangent_frame.propagate,
            tangent_errors.dynamics,
            tangent_errors.retract,
            enter=tangent_frame.enter,
            leave=tangent_frame.leave,
            enu_rows=lambda nav, local: tangent_errors.enu_rows(local),
            vertical=1,
        ),
        "inertial": Frame(
            inertial_quaternion.propagate,
            inertial_errors.dynamics,
            inertial_errors.retract,
            enter=inertial_quaternion.enter,
            leave=inertial_quaternion.leave,
            enu_rows=inertial_errors.enu_rows,
            velocity_axes=inertial_errors.velocity_axes,
        ),
    }
)
