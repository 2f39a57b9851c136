"""Trajectories as smooth functions of time that jax can differentiate, and a sensor's readings along them.

A *motion* (`Circle`, `Urban`, ...) is a frozen tuple of plain numbers in a user's units; `shape_of` makes its shape,
a function ``t -> Motion(vel, rph)``. `travel` integrates a shape to position and means over samples.
"""

from collections.abc import Callable
from typing import Any

import jax

from jaxnav.simulate.trajectories.closed import (
    Circle,
    LaunchMove,
    SShape,
    Static,
    Straight,
    circle,
    launch_move,
    s_shape,
    static,
    straight,
)
from jaxnav.simulate.trajectories.drive import Urban, urban
from jaxnav.simulate.trajectories.motion import Motion, Shape
from jaxnav.simulate.trajectories.quadrature import NODES, WEIGHTS, Point, Travel, travel
from jaxnav.simulate.trajectories.recorded import Recorded, recorded
from jaxnav.simulate.trajectories.route import Waypoints, waypoints

MOTIONS: dict[type, Callable[[Any, jax.Array, float], Shape]] = {
    Static: lambda motion, key, duration: static(motion),
    Straight: lambda motion, key, duration: straight(motion),
    Circle: lambda motion, key, duration: circle(motion),
    SShape: lambda motion, key, duration: s_shape(motion),
    LaunchMove: lambda motion, key, duration: launch_move(motion),
    Waypoints: lambda motion, key, duration: waypoints(motion),
    Urban: lambda motion, key, duration: urban(key, duration, *motion),
}
"""Type of a motion -> ``(motion, key, duration s) -> shape``; only `Urban` is random."""


def shape_of(key: jax.Array, motion: Any, duration: float) -> Shape:
    """Return the shape of a motion over ``duration`` s.

    Raises:
        ValueError: no motion, or numbers that make none.
    """
    if type(motion) not in MOTIONS:
        known = ", ".join(each.__name__ for each in MOTIONS)
        raise ValueError(f"motion must be one of {known}, got {type(motion).__name__}")
    return MOTIONS[type(motion)](motion, key, duration)


__all__ = [
    "MOTIONS",
    "NODES",
    "WEIGHTS",
    "Circle",
    "LaunchMove",
    "Motion",
    "Point",
    "Recorded",
    "SShape",
    "Shape",
    "Static",
    "Straight",
    "Travel",
    "Urban",
    "Waypoints",
    "circle",
    "launch_move",
    "recorded",
    "s_shape",
    "shape_of",
    "static",
    "straight",
    "travel",
    "urban",
    "waypoints",
]
