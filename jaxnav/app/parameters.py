"""Filter parameters in a user's units, and names of what is free in tuning."""

from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxnav.app import config
from jaxnav.filters.catalogue import FILTERS
from jaxnav.filters.parameters import UNITS, get, has, put
from jaxnav.maths.units import Unit
from jaxnav.measurements import Measurement
from jaxnav.states.table import STATES
from jaxnav.types import ConfigError, Params, nearest
from tuning.transforms import LOG, TRANSFORMS, Spec, Transform, believed, factor, scaled, tied

KEYS = {unit.key: leaf for leaf, unit in UNITS.items()}
"""The keys of [params]: dotted names in `Params`."""
NAMES = {leaf: unit.key for leaf, unit in UNITS.items()}
ROOTS = tuple(leaf for leaf, unit in UNITS.items() if unit.root and not leaf.endswith(".sd"))
"""Leaves that may be a lower triangular root, see `jaxnav.types.Noise`."""


def transform_of(unit: Unit) -> Transform:
    """How a parameter is tuned."""
    return LOG if unit.step is None else scaled(unit.step)


def override(params: Params, section: config.Params) -> Params:
    """``params`` with what [params] states, in SI.

    Raises:
        ConfigError: a wrong number of axes, a value out of range, a matrix that is no root, or a parameter the filter's
            rule has not.
    """
    for leaf, unit in UNITS.items():
        name, value = unit.key, section.value(unit.key)
        if value is None:
            continue
        if not has(params, leaf):
            continue  # of a state that this filter lacks: see `jaxnav.app.unused`
        if isinstance(value, tuple) and any(isinstance(row, tuple) for row in value):
            _check_root(name, value)
        elif np.shape(value) not in ((), unit.shape):
            expected = f"one number or {unit.shape[0]}" if unit.shape else "one number"
            raise ConfigError(f"params.{name} must be {expected}, got {value!r}")
        elif unit.step is None and not np.all(np.asarray(value) > 0):
            raise ConfigError(f"params.{name} must be > 0, got {value!r}")
        elif not np.isfinite(value).all() and not (unit.endless and not np.isnan(value).any()):
            raise ConfigError(f"params.{name} must be finite, got {value!r}")
        old = jnp.shape(get(params, leaf))
        shape = np.shape(value) or (unit.shape if old else ())
        params = put(params, leaf, jnp.broadcast_to(jnp.asarray(value, float) * unit.factor, shape))
    for name, value in section.rule.items():
        params = put(params, f"rule.{name}", _rule_value(params, name, value))
    return params


def _rule_value(params: Params, name: str, value: Any) -> Any:
    """What [params.rule] states, in the shape that the rule has it in."""
    try:
        old = get(params, f"rule.{name}")
        new = np.asarray(value, float)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"params.rule.{name}: {error}") from error
    if new.shape not in ((), jnp.shape(old)) or not np.isfinite(new).all():
        raise ConfigError(f"params.rule.{name} must be finite, of shape {jnp.shape(old)}, got {value!r}")
    return jnp.broadcast_to(jnp.asarray(new), jnp.shape(old))


def _check_root(name: str, value: tuple) -> None:
    """Raise ConfigError unless it is a lower triangular 3 x 3 with a positive diagonal."""
    what = f"params.{name} as a matrix must be lower triangular, 3 x 3, with a positive diagonal, got {value!r}"
    if [len(row) for row in value] != [3, 3, 3]:
        raise ConfigError(what)
    L = np.array(value)
    if np.any(np.triu(L, 1)) or not np.all(np.diag(L) > 0) or not np.isfinite(L).all():
        raise ConfigError(what)


def in_user_units(params: Params, leaves: list[str]) -> dict[str, Any]:
    """The named leaves as keys and values of [params]; axes that agree are one number."""
    found: dict[str, Any] = {NAMES[leaf]: user_value(leaf, get(params, leaf)) for leaf in leaves if leaf in NAMES}
    rule = {leaf.removeprefix("rule."): user_value(leaf, get(params, leaf)) for leaf in leaves if leaf not in NAMES}
    return found | ({"rule": rule} if rule else {})


def unit_of(leaf: str) -> Unit:
    """How a user states a leaf; a rule's own parameters have no unit."""
    return UNITS[leaf] if leaf in UNITS else Unit(leaf, step=1.0)


def name_of(leaf: str) -> str:
    """The key of [params], or the dotted name of a rule's own parameter."""
    return NAMES.get(leaf, leaf)


def user_value(leaf: str, value: Any, short: bool = True) -> Any:
    """A leaf's value in a user's units, as plain numbers; ``short``: axes that agree are one number."""
    value = np.asarray(value, float) / unit_of(leaf).factor
    same = short and value.ndim and np.all(value == value.flat[0]) and leaf in UNITS and UNITS[leaf].step is None
    return float(value.flat[0]) if same else value.tolist()


def groups(name: str, measurements: tuple[Measurement, ...], states: tuple[str, ...] = ()) -> dict[str, list[str]]:
    """What the short names in ``tune.free`` stand for, with a filter, its measurements and its further states."""
    used = {m.name for m in measurements}
    entry = FILTERS[name]
    own = (*entry.states, *states)
    driven = [state for state in own if STATES[state].defaults.drive > 0]  # of a constant there is no logarithm
    vehicle = bool(used & {"nonholonomic", "speed"})
    others = [f"measurements.{m.name}.{leaf}" for m in measurements if not m.receiver
              for leaf, unit in m.units._asdict().items() if unit.step is None]  # fmt: skip
    return {
        "noise": ["noise.gyro", "noise.accel", *(f"states.{state}.drive" for state in driven), *others],
        "fixes": ["measurements.position.scale", "measurements.velocity.scale"],
        # of the IMU's
        "timing": ["mounting.time_offset", "mounting.clock_drift", "measurements.velocity.latency"],
        # of the receiver: its fixes are old
        "latency": ["measurements.position.latency", "measurements.velocity.latency"],
        "lever_arm": ["mounting.lever_arm"],
        "vehicle": ["mounting.vehicle", "mounting.wheel_arm"] if vehicle else [],
        "prior": [f"states.{state}.sd" for state in own],
        # a gain of zero, such as the derivative's of the printed GPID, has no logarithm and stays what it is
        "rule": [f"rule.{leaf}" for leaf, kind in entry.tunable.items()
                 if np.isfinite(TRANSFORMS[kind].inverse(get(entry.theta(), leaf))).all()],
    }  # fmt: skip


def free_spec(
    free: tuple[str, ...], filter_name: str, measurements: tuple[Measurement, ...], states: tuple[str, ...] = ()
) -> Spec:
    """The transforms of what ``tune.free`` names: groups, dotted leaves, or keys of [params].

    Raises:
        ConfigError: an unknown name, or nothing is free.
    """
    spec = {}
    for leaf in leaves_of("tune.free", free, filter_name, measurements, states):
        spec[leaf] = step_of(leaf, filter_name)
    if not spec:
        raise ConfigError("tune.free: nothing is free")
    return spec


def step_of(leaf: str, filter_name: str) -> Transform:
    """How a leaf is tuned.

    Raises:
        ConfigError: the filter's rule has no such parameter.
    """
    group, _, name = leaf.partition(".")
    if group != "rule":
        return transform_of(UNITS[leaf])
    if name not in FILTERS[filter_name].tunable:
        raise ConfigError(f"tune.free: filter {filter_name} has no {leaf}")
    return TRANSFORMS[FILTERS[filter_name].tunable[name]]


def leaves_of(
    key: str,
    names: Iterable[str],
    filter_name: str,
    measurements: tuple[Measurement, ...],
    states: tuple[str, ...] = (),
) -> list[str]:
    """The dotted leaves that groups, leaves and keys of [params] name; ``key`` is the setting, for messages.

    ``states``: of the filter, beside those that it has by its name.

    Raises:
        ConfigError: an unknown name, or a leaf of a state that the filter has not.
    """
    short, held = groups(filter_name, measurements, states), (*FILTERS[filter_name].states, *states)
    leaves: list[str] = []
    for name in names:
        for leaf in short[name] if name in short else [KEYS.get(name, name)]:
            if leaf not in NAMES and leaf.removeprefix("rule.") not in FILTERS[filter_name].tunable:
                raise ConfigError(f"{key}: no parameter {leaf}: {nearest(leaf, [*short, *NAMES])}")
            if leaf.startswith("states.") and leaf.split(".")[1] not in held:
                raise ConfigError(f"{key}: {leaf}: the filter has no state {leaf.split('.')[1]}: see filter.states")
            leaves.append(leaf)
    return list(dict.fromkeys(leaves))


def tune_spec(tune: config.Tune, filter_name: str, measurements: tuple[Measurement, ...], sheet: Params) -> Spec:
    """What [tune] frees, with its ties and correlations, and its beliefs about the datasheet's values ``sheet``.

    Of a group that is to be correlated it is those leaves that can be.

    Raises:
        ConfigError: a name that is unknown or not free, one that cannot be correlated or is tied, an sd that is none.
    """
    more = tuple(state for state in sheet.states if state not in FILTERS[filter_name].states)
    which = lambda key, names: leaves_of(f"tune.{key}", names, filter_name, measurements, more)
    frozen = set(which("frozen", tune.frozen))
    spec = {k: v for k, v in free_spec(tune.free, filter_name, measurements, more).items() if k not in frozen}
    if not spec:
        raise ConfigError("tune.frozen: nothing is left free")

    def free(key: str, name: str) -> list[str]:
        """Those of a name's leaves that are free; of a group that may be some, otherwise it is a mistake."""
        found = [leaf for leaf in which(key, [name]) if leaf in spec]
        if not found and not set(which(key, [name])) & frozen:
            raise ConfigError(f"tune.{key}: {name} is not in tune.free, where it would have to be")
        return found

    for name in tune.tied:
        for leaf in free("tied", name):
            spec[leaf] = tied(spec[leaf])
    for name in tune.correlated:
        roots = [leaf for leaf in which("correlated", [name]) if leaf in ROOTS]
        if not roots:
            known = ", ".join(NAMES[leaf] for leaf in ROOTS)
            raise ConfigError(f"tune.correlated: {name} cannot be correlated, only {known}")
        for leaf in (leaf for leaf in free("correlated", name) if leaf in roots):
            if spec[leaf].tie is not None:
                raise ConfigError(f"tune.correlated: {leaf} is in tune.tied, where its axes share one number")
            spec[leaf] = factor(3)
    for name, sd in tune.prior.items():
        for leaf in free("prior", name):
            spec[leaf] = believed(spec[leaf], get(sheet, leaf), _sd(name, leaf, step_of(leaf, filter_name), sd))
    return spec


def _sd(name: str, leaf: str, step: Transform, sd: float) -> float:
    """One sd of a belief in the unconstrained space: a factor where the parameter is positive, else the user's unit."""
    positive = step is LOG
    if not sd > (1.0 if positive else 0.0):
        what = "a factor above 1" if positive else "above 0"
        raise ConfigError(f"tune.prior.{name}: one sd must be {what}, got {sd:g}")
    return float(np.log(sd)) if positive else float(step.inverse(jnp.asarray(sd * unit_of(leaf).factor)))


def component(label: str) -> str:
    """``noise.gyro[1]`` by the key of [params]: ``gyro_deg_per_sqrt_hour[1]``."""
    leaf, bracket, index = label.partition("[")
    return name_of(leaf) + bracket + index
