"""Free parameters: names of leaves, alone and in groups, and their transforms."""

from collections.abc import Iterable

import numpy as np

from jaxnav.filters.border import KEYS, NAMES
from jaxnav.filters.catalogue import FILTERS
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import UNITS, get, has
from jaxnav.measurements import MEASUREMENTS, Measurement
from jaxnav.types import ConfigError, Params, nearest
from tuning.fit.transforms import LOG, TRANSFORMS, Transform, scaled


def transform_of(leaf: str) -> Transform:
    """Return the logarithm for a positive parameter, else steps of a unit."""
    unit = UNITS.get(leaf)
    return LOG if unit is None or unit.step is None else scaled(unit.step)


def groups(
    measurements: Iterable[Measurement], states: Iterable[str], rule: Iterable[str] = ()
) -> dict[str, list[str]]:
    """Return the leaves of each short name, with these measurements and states; ``rule``: its leaves, see `of_rule`."""
    measurements, states = tuple(measurements), tuple(states)
    used = [m.name for m in measurements]
    fixes = [name for name in ("position", "velocity") if name in used]
    others = [f"measurements.{m.name}.{leaf}" for m in measurements if not m.receiver
              for leaf, unit in m.units._asdict().items() if unit.step is None]  # fmt: skip
    velocity = ["measurements.velocity.latency"] if "velocity" in fixes else []
    return {
        "noise": ["noise.gyro", "noise.accel", *(f"states.{state}.driving_noise" for state in states), *others],
        "fixes": [f"measurements.{name}.scale" for name in fixes],
        "timing": ["mounting.time_offset", "mounting.clock_drift", *velocity],  # of the IMU's clock
        "latency": [f"measurements.{name}.latency" for name in fixes],  # of the receiver: its fixes are old
        "lever_arm": ["mounting.lever_arm"],
        "vehicle": ["mounting.vehicle", "mounting.wheel_arm"] if {"nonholonomic", "speed"} & set(used) else [],
        "prior": [f"states.{state}.sd" for state in states],
        "ranges": _ranges(measurements, states),
        "rule": list(rule),
    }


def _ranges(measurements: tuple[Measurement, ...], states: tuple[str, ...]) -> list[str]:
    """Return weights of satellites, driving noise of their errors and of the receiver's clock, tau of the errors."""
    rows = [m for m in measurements if m.auxiliary]
    needed = {state for m in rows for state in m.needs} & set(states)
    weights = [
        f"measurements.{m.name}.{leaf}" for m in rows for leaf, unit in m.units._asdict().items() if unit.step is None
    ]
    slow = {name for m in rows for name in m.restarts} & needed
    processes = [f"states.{state}.driving_noise" for state in states if state in needed]
    return [*weights, *processes, *(f"states.{state}.tau" for state in sorted(slow))]


def of_rule(name: str) -> list[str]:
    """Return the leaves of a filter's rule that are worth tuning."""
    return [f"rule.{leaf}" for leaf in FILTERS[name].tunable]


def leaves_of(filt: Filter, params: Params, names: Iterable[str], key: str = "free") -> list[str]:
    """Return the dotted leaves that names stand for, without driving noises of constant states.

    Args:
        filt: the filter.
        params: its parameters.
        names: groups of `groups`, dotted leaves, or keys of a configuration.
        key: the setting, for messages.

    Raises:
        ConfigError: an unknown name, or a state or parameter that the filter has not.
    """
    used = [MEASUREMENTS[name] for name in filt.model.measurements]
    short = groups(used, filt.model.states, of_rule(filt.name) if filt.name else ())
    leaves: list[str] = []
    for name in names:
        for leaf in short.get(name, [KEYS.get(name, name)]):
            if leaf in UNITS and leaf.startswith("states.") and not has(params, leaf):
                raise ConfigError(f"{key}: {leaf}: the filter has no state {leaf.split('.')[1]}: see filter.states")
            if leaf not in UNITS and not leaf.startswith("rule.") or not has(params, leaf):
                raise ConfigError(f"{key}: no parameter {leaf}: {nearest(leaf, [*short, *NAMES])}")
            if not constant(leaf, params):
                leaves.append(leaf)
    return list(dict.fromkeys(leaves))


def constant(leaf: str, params: Params) -> bool:
    """Return whether it is the driving noise of a constant state: it has no logarithm."""
    return leaf.endswith(".driving_noise") and not np.all(np.asarray(get(params, leaf)) > 0)


def step_of(leaf: str, filter_name: str) -> Transform:
    """Return how a leaf is tuned.

    Raises:
        ConfigError: the filter's rule has no such parameter.
    """
    group, _, name = leaf.partition(".")
    if group != "rule":
        return transform_of(leaf)
    entry = FILTERS.get(filter_name)
    known = {} if entry is None else entry.tunable | entry.named
    if name not in known:
        raise ConfigError(f"tune.free: filter {filter_name or 'of a rule of its user'} has no {leaf}")
    return TRANSFORMS[known[name]]
