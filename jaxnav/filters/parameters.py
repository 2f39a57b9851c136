"""A filter's parameters: from a datasheet, and how each is stated in a user's units."""

import math
from collections.abc import Collection, Iterable, Mapping
from copy import copy
from dataclasses import fields, is_dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxnav.maths import units
from jaxnav.maths.units import DELAY, Unit
from jaxnav.measurements import MEASUREMENTS
from jaxnav.states.grades import GRADES, Grade
from jaxnav.states.sensitivity import ESTIMATES
from jaxnav.states.table import BIASES, STATES, chosen
from jaxnav.types import Json, Mounting, Noise, Params, Prior, StateParams, Tree, nearest

NOISE_UNITS = Noise(
    Unit("deg_per_sqrt_hour", units.DEG_PER_SQRT_HOUR, (3,), "deg/sqrt(h)", root=True),
    Unit("ug_per_sqrt_hz", units.UG, (3,), "ug/sqrt(Hz)", root=True),
    Unit("ppm", units.PPM, text="ppm", zero=True),
)
MOUNTING_UNITS = Mounting(
    Unit("m", 1.0, (3,), "m", step=0.2),
    DELAY,
    Unit("ppm", units.PPM, text="ppm", step=300 * units.PPM, most=1e5),
    Unit("deg", units.DEG, (2,), "deg", step=1.0 * units.DEG),
    Unit("m", 1.0, (3,), "m", step=0.2),
)
REACH_STEP_S = 0.1  # s, of what a history reaches back: 0.05, 0.15 and so on


def get(tree: Tree, name: str) -> Any:
    """Return the leaf at a dotted name.

    Raises:
        ValueError: no such name; the message lists the known ones.
    """
    for part in name.split("."):
        fields = _fields(tree)
        if part not in fields:
            raise ValueError(f"no parameter {name!r}: {part!r} is not one of {', '.join(fields) or 'nothing'}")
        tree = fields[part]
    return tree


def has(tree: Tree, name: str) -> bool:
    """Whether there is a leaf or branch of a dotted name."""
    first, _, rest = name.partition(".")
    fields = _fields(tree)
    return first in fields and (not rest or has(fields[first], rest))


def _fields(tree: Tree) -> Json:
    """Return the branches of a node, by name."""
    if isinstance(tree, dict):
        return tree
    if is_dataclass(tree) and not isinstance(tree, type):
        return {field.name: getattr(tree, field.name) for field in fields(tree)}
    return tree._asdict() if hasattr(tree, "_asdict") else {}


def put(tree: Tree, name: str, value: Any) -> Any:
    """Return the tree with the leaf at a dotted name replaced."""
    first, _, rest = name.partition(".")
    branch = get(tree, first)
    new = put(branch, rest, value) if rest else value
    if isinstance(tree, dict):
        return tree | {first: new}
    if hasattr(tree, "_replace"):
        return tree._replace(**{first: new})
    changed = copy(tree)  # a dataclass, frozen or not, whatever its constructor takes: a module of equinox
    object.__setattr__(changed, first, new)
    return changed


def change(params: Params, values: Mapping[str, ArrayLike]) -> Params:
    """Return the parameters with values by dotted name, in SI: ``change(params, {"states.gyro_bias.tau": 100.0})``.

    Raises:
        ValueError: a name that is not there.
    """
    for name, value in values.items():
        params = put(params, name, jnp.asarray(value, float))
    return params


def without_states(params: Params, names: Collection[str]) -> Params:
    """Return parameters by which the states that are not among ``names`` are zero and stay it."""
    off = lambda state: state._replace(sd=0.0 * state.sd, driving_noise=0.0 * state.driving_noise)
    return params._replace(states={n: s if n in names else off(s) for n, s in params.states.items()})


def parameter_units() -> dict[str, Unit]:
    """Every parameter that has a unit at the border, by its dotted name in `Params`: collected from the rows."""
    found: Json = {"noise": NOISE_UNITS, "mounting": MOUNTING_UNITS}
    found |= {f"states.{name}": state.units for name, state in STATES.items()}
    found |= {f"measurements.{name}": each.units for name, each in MEASUREMENTS.items()}
    return {
        f"{group}.{leaf}": unit
        for group, fields in found.items()
        for leaf, unit in fields._asdict().items()
        if isinstance(unit, Unit)
    }


UNITS: dict[str, Unit] = parameter_units()
"""Every parameter that has a unit at the border, by its dotted name in `Params`."""


def strong(tree: Tree) -> Any:
    """Return the tree's numbers as strongly typed arrays: from Python floats every train step would compile twice."""
    return jax.tree.map(lambda v: jnp.asarray(v, float), tree, is_leaf=lambda v: isinstance(v, tuple) and _plain(v))


def _plain(v: tuple[Any, ...]) -> bool:
    return not hasattr(v, "_fields") and all(isinstance(x, (int, float, tuple)) for x in v) and len(v) > 0


def prior(position: ArrayLike, velocity: ArrayLike, attitude: ArrayLike) -> Prior:
    """`Prior` from plain numbers: m, m/s and rad in ENU."""
    return Prior(*(jnp.asarray(v, float) for v in (position, velocity, attitude)))


def mounting(
    lever_arm: ArrayLike = (0.0, 0.0, 0.0),
    time_offset: float = 0.0,
    clock_drift: float = 0.0,
    vehicle: ArrayLike = (0.0, 0.0),
    wheel_arm: ArrayLike = (0.0, 0.0, 0.0),
) -> Mounting:
    """Return an installation.

    Args:
        lever_arm: (3,) m, IMU -> antenna, body FRD.
        time_offset: s, GNSS time minus the IMU's stamp.
        clock_drift: s/s, growth of that offset.
        vehicle: (2,) rad, pitch and yaw of the vehicle's axes in the body's.
        wheel_arm: (3,) m, IMU -> wheel axle, body FRD.
    """
    return Mounting(*(jnp.asarray(v, float) for v in (lever_arm, time_offset, clock_drift, vehicle, wheel_arm)))


def installed(params: Params, lever_arm: ArrayLike) -> Params:
    """Return parameters with a recording's lever arm where they state none.

    Args:
        params: parameters; a lever arm of zero is none.
        lever_arm: (3,) m, IMU -> antenna, body FRD.
    """
    if np.any(np.asarray(params.mounting.lever_arm)) or not np.any(lever_arm):
        return params
    return params._replace(mounting=params.mounting._replace(lever_arm=jnp.asarray(lever_arm, float)))


def late(params: Params, position: ArrayLike, velocity: ArrayLike) -> Params:
    """Return the parameters with latencies, s, of a receiver's position and velocity."""
    old = {"position": position, "velocity": velocity}
    moved = {name: params.measurements[name]._replace(latency=jnp.asarray(age, float)) for name, age in old.items()}
    return params._replace(measurements=params.measurements | moved)


def grade_of(grade: str | Grade) -> Grade:
    """Return the grade, or that of a name.

    Raises:
        ValueError: a name that is not in `jaxnav.states.grades.GRADES`.
    """
    if isinstance(grade, Grade):
        return grade
    if grade not in GRADES:
        raise ValueError(f"no IMU grade {grade!r}: {nearest(grade, GRADES)}")
    return GRADES[grade]


def datasheet_states(grade: Grade, names: Iterable[str]) -> dict[str, StateParams]:
    """Return the datasheet's parameters of these states, and the rows' defaults for states it does not give.

    A drifting bias of sd s and time tau drives with root PSD s sqrt(2 / tau), as a random walk, since the turn-on bias,
    which is the same state, does not decay; a walk of the grade is added to it.
    """
    drive = np.sqrt(2 / grade.tau)
    given = {
        "gyro_bias": (grade.gyro_turn_on, np.hypot(grade.gyro_instability * drive, grade.gyro_walk), np.inf),
        "accel_bias": (grade.accel_turn_on, np.hypot(grade.accel_instability * drive, grade.accel_walk), np.inf),
    }
    return {s.name: strong(StateParams(*given.get(s.name, s.defaults))) for s in chosen(names)}


def datasheet_params(
    grade: Grade,
    position_sd: ArrayLike = (3.0, 3.0, 5.0),
    velocity_sd: ArrayLike = (0.1, 0.1, 0.1),
    tilt_sd: float = 1 * units.DEG,
    heading_sd: float = 5 * units.DEG,
    install: Mounting | None = None,
    rule: Tree = (),
    feedback: Tree = (),
    states: Iterable[str] = BIASES,
    measurements: Iterable[str] | None = None,
) -> Params:
    """Return filter parameters of a datasheet, the usual first choice.

    Args:
        grade: the datasheet.
        position_sd: (3,) m, initial, ENU.
        velocity_sd: (3,) m/s, initial, ENU.
        tilt_sd: rad, initial.
        heading_sd: rad, initial.
        install: the installation; None is all zero.
        rule: parameters of the rule.
        feedback: parameters of the feedback.
        states: names of optional states; their parameters by `datasheet_states`.
        measurements: names of measurements, with the defaults of their rows; None is all of them.
    """
    states = tuple(states)
    return Params(
        strong(Noise(grade.arw, grade.vrw, 0.0 if set(ESTIMATES) <= set(states) else grade.scale)),
        prior(position_sd, velocity_sd, (tilt_sd, tilt_sd, heading_sd)),
        datasheet_states(grade, states),
        {
            name: strong(MEASUREMENTS[name].defaults)
            for name in (MEASUREMENTS if measurements is None else measurements)
        },
        mounting() if install is None else install,
        rule,
        feedback,
    )


def with_prior_of(params: Params, before: Params, tuned: Iterable[str] = ()) -> Params:
    """Return parameters with the initial standard deviations of others.

    An initialization gives a posterior, a mean with its sd, for one run; parameters that are kept for other runs have
    the prior, of mean zero.

    Args:
        params: parameters of one run, such as of `Initialization.apply_to`.
        before: parameters with the prior; of a state that they lack, the sd of ``params`` stays.
        tuned: dotted leaves that stay as they are.
    """
    tuned = set(tuned)
    states = {
        name: of_state._replace(sd=before.states[name].sd)
        if name in before.states and f"states.{name}.sd" not in tuned
        else of_state
        for name, of_state in params.states.items()
    }
    return params._replace(prior=before.prior, states=states)


def earliest(known: Params, span: float) -> float:
    """Return the least delay of a fix in ``span`` s of data, s; a negative one is ahead of the IMU's stamps."""
    ages = [float(theta.latency) for theta in known.measurements.values() if hasattr(theta, "latency")]
    return (
        float(known.mounting.time_offset) - 0.5 * abs(float(known.mounting.clock_drift)) * span + min(ages, default=0.0)
    )


def later(known: Params, by: float) -> Params:
    """Return parameters with the fixes ``by`` s later against the IMU's stamps, see `jaxnav.types.Recording.early`."""
    return known._replace(mounting=known.mounting._replace(time_offset=known.mounting.time_offset + by))


def history_for(known: Params, rate_hz: float, span: float, more: float = 0.0) -> int:
    """IMU samples of history that reach back as far as the latest fix in ``span`` s of data, and ``more`` s.

    Rounded up in steps of `REACH_STEP_S`, so that runs with about the same delay share their programs.
    """
    offset = float(known.mounting.time_offset) + abs(float(known.mounting.clock_drift)) * span
    ages = [float(theta.latency) for theta in known.measurements.values() if hasattr(theta, "latency")]
    unsure = 3 * float(np.max(known.states["clock_offset"].sd)) if "clock_offset" in known.states else 0.0
    late = offset + max(ages, default=0.0) + more + unsure
    reach = REACH_STEP_S * (0.5 + max(0, math.ceil(late / REACH_STEP_S - 0.5 - 1e-9)))  # about zero as well as 0.3 s
    return 2 + math.ceil(reach * rate_hz + 1e-6)
