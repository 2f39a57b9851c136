"""Barometric height, which is off by the state ``barometer_bias``."""

from typing import NamedTuple

import jax.numpy as jnp

from jaxnav.maths.units import DELAY, Unit
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav


class BarometerParams(NamedTuple):
    """Parameters of a barometer."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped


def observe_barometer(theta: BarometerParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return h + b - y."""
    bias = nav.errors.get("barometer_bias", jnp.zeros(1))
    rows = {"position": jnp.array([[0.0, 0.0, 1.0]]), "barometer_bias": jnp.ones((1, 1))}
    return Observation(kin.lla[2:] + bias - fix.value, rows, fix.sd, theta.sd_scale)


BAROMETER = Measurement(
    "barometer",
    ("up",),
    observe_barometer,
    BarometerParams(1.0, 0.0),
    BarometerParams(Unit(), DELAY),
    states=("barometer_bias",),
    columns=(column("height_m", "length", 1.0, plausible=(-12e3, 1e5), marks=(-9999.0, -99999.0)),),
)
"""Height by air pressure: value m above the ellipsoid but for its bias, sd."""
