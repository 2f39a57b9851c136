"""How far the ground is below: radar or laser that looks along the body's down axis."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxnav.maths.units import DELAY, Unit
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav

STEEPEST = 0.2  # cosine of the tilt, 78 deg: beyond it the beam does not meet the ground, and its row is bounded


class RangeParams(NamedTuple):
    """Parameters of a rangefinder."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped
    ground: Leaf  # () m, height of level ground above the ellipsoid; the state ``ground_height`` comes on top


def observe_range(theta: RangeParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """(h - ground) / c - y, where c is the cosine of the beam's angle to the vertical."""
    down = kin.C[:, 2]  # of the body, ENU
    c = jnp.maximum(-down[2], STEEPEST)
    above = kin.lla[2] - theta.ground - nav.errors.get("ground_height", jnp.zeros(1))[0]
    up = jnp.array([[0.0, 0.0, 1.0]]) / c
    # d down = phi x down, so that d c = -(phi x down)_up
    tilt = jnp.stack([down[1], -down[0], jnp.zeros(())])[None] * jnp.where(-down[2] > STEEPEST, above / c**2, 0.0)
    rows = {"position": up, "attitude": tilt, "ground_height": -up[:, 2:]}
    return Observation(above[None] / c - fix.value, rows, fix.sd, theta.sd_scale)


RANGEFINDER = Measurement(
    "rangefinder", ("down",), observe_range, RangeParams(1.0, 0.0, 0.0),
    RangeParams(
        Unit(), DELAY,
        Unit("m", text="m", step=10.0),
    ),
    states=("ground_height",), columns=(column("range_m", "length", 0.2, plausible=(0.0, 3e4), marks=(0.0,)),),
)  # fmt: skip
"""Radar or laser height: value m along the body's down axis to level ground, sd."""
