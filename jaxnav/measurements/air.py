"""Measurements of the air around an aircraft: airspeed, and flight without sideslip."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxnav.maths import rotations
from jaxnav.maths.units import DELAY, Unit
from jaxnav.measurements.columns import column
from jaxnav.measurements.measurement import Kinematics, Measurement, Observation
from jaxnav.types import Fix, Leaf, Mounting, Nav


class AirspeedParams(NamedTuple):
    """Parameters of a pitot tube along the body's x."""

    sd_scale: Leaf  # () factor on the stated sd
    latency: Leaf  # () s, its age when it is stamped
    scale: Leaf  # () scale error; 0 is none


class SideslipParams(NamedTuple):
    """Parameters of flight without sideslip."""

    sd: Leaf  # () m/s


def through_air(nav: Nav, kin: Kinematics) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Velocity through the air, body (3,), and its rows; without the state ``wind`` the air stands."""
    v = kin.vel - jnp.concatenate([nav.errors.get("wind", jnp.zeros(2)), jnp.zeros(1)])
    rows = {"velocity": kin.C.T, "attitude": kin.C.T @ rotations.skew(v), "wind": -kin.C.T[:, :2]}
    return kin.C.T @ v, rows


def observe_airspeed(theta: AirspeedParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return (1 + scale) v_x - y."""
    v, rows = through_air(nav, kin)
    scale = 1 + theta.scale
    return Observation(
        v[:1] * scale - fix.value, {name: row[:1] * scale for name, row in rows.items()}, fix.sd, theta.sd_scale
    )


def observe_sideslip(theta: SideslipParams, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
    """Return v_y."""
    v, rows = through_air(nav, kin)
    return Observation(v[1:2], {name: row[1:2] for name, row in rows.items()}, fix.sd, theta.sd)


AIRSPEED = Measurement(
    "airspeed",
    ("forward",),
    observe_airspeed,
    AirspeedParams(1.0, 0.0, 0.0),
    AirspeedParams(Unit(), DELAY, Unit(step=0.02)),
    states=("wind",),
    columns=(column("airspeed_mps", "speed", 1.0, plausible=(-100.0, 3000.0)),),
)
"""True airspeed: value forward m/s, sd."""
SIDESLIP = Measurement(
    "sideslip",
    ("right",),
    observe_sideslip,
    SideslipParams(1.0),
    SideslipParams(Unit("mps", text="m/s")),
    states=("wind",),
)
"""An aircraft flies without sideslip: no value; sd = its parameter times the fix's sd (1 by default)."""
