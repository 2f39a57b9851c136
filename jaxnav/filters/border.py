"""Parameters as a user states them: the keys and units of configurations, of tuned.toml and of reports."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxnav.filters.parameters import UNITS, get, has, put
from jaxnav.maths.units import Unit
from jaxnav.types import ConfigError, Params

KEYS = {unit.key: leaf for leaf, unit in UNITS.items()}
"""The keys of [params]: dotted names in `Params`."""
NAMES = {leaf: unit.key for leaf, unit in UNITS.items()}
ROOTS = tuple(leaf for leaf, unit in UNITS.items() if unit.root and not leaf.endswith(".sd"))
"""Leaves that may be a lower triangular root, see `jaxnav.types.Noise`."""


def override(params: Params, stated: Mapping[str, Any]) -> Params:
    """``params`` with what is ``stated`` by the keys of [params], in their units; None states nothing.

    Keys of states that ``params`` has not are passed over; ``rule`` holds the rule's own numbers by name.

    Raises:
        ConfigError: a wrong number of axes, a value out of range, a matrix that is no root, or a parameter the filter's
            rule has not.
    """
    for leaf, unit in UNITS.items():
        name, value = unit.key, stated.get(unit.key)
        if value is None or not has(params, leaf):
            continue
        if isinstance(value, (tuple, list)) and any(isinstance(row, (tuple, list)) for row in value):
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
    for name, value in (stated.get("rule") or {}).items():
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


def _check_root(name: str, value: Any) -> None:
    """Raise ConfigError unless it is a lower triangular 3 x 3 with a positive diagonal."""
    what = f"params.{name} as a matrix must be lower triangular, 3 x 3, with a positive diagonal, got {value!r}"
    if [np.size(row) for row in value] != [3, 3, 3]:
        raise ConfigError(what)
    L = np.array(value)
    if np.any(np.triu(L, 1)) or not np.all(np.diag(L) > 0) or not np.isfinite(L).all():
        raise ConfigError(what)


def in_user_units(params: Params, leaves: Iterable[str]) -> dict[str, Any]:
    """The named leaves as keys and values of [params]; axes that agree are one number."""
    leaves = list(leaves)
    found: dict[str, Any] = {NAMES[leaf]: user_value(leaf, get(params, leaf)) for leaf in leaves if leaf in NAMES}
    rule = {leaf.removeprefix("rule."): user_value(leaf, get(params, leaf)) for leaf in leaves if leaf not in NAMES}
    return found | ({"rule": rule} if rule else {})


def noise_leaves(params: Params) -> list[str]:
    """The leaves of ``params`` that are noise: positive numbers that are no prior's."""
    prior = lambda leaf: leaf.startswith("states.") and leaf.endswith(".sd")
    return [leaf for leaf, unit in UNITS.items() if unit.step is None and not prior(leaf) and has(params, leaf)]


def unit_of(leaf: str) -> Unit:
    """How a user states a leaf; a rule's own parameters have no unit."""
    return UNITS[leaf] if leaf in UNITS else Unit(leaf, step=1.0)


def name_of(leaf: str) -> str:
    """The key of [params], or the dotted name of a rule's own parameter."""
    return NAMES.get(leaf, leaf)


def component(label: str) -> str:
    """``noise.gyro[1]`` by the key of [params]: ``gyro_deg_per_sqrt_hour[1]``."""
    leaf, bracket, index = label.partition("[")
    return name_of(leaf) + bracket + index


def user_value(leaf: str, value: Any, short: bool = True) -> Any:
    """A leaf's value in a user's units, as plain numbers; ``short``: axes that agree are one number."""
    value = np.asarray(value, float) / unit_of(leaf).factor
    same = short and value.ndim and np.all(value == value.flat[0]) and leaf in UNITS and UNITS[leaf].step is None
    return float(value.flat[0]) if same else value.tolist()
