"""Parameters as a user states them: the keys and units of configurations, of tuned.toml and of reports."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxnav.filters.parameters import UNITS, get, has, put
from jaxnav.maths.units import Unit
from jaxnav.types import ConfigError, Json, Params

NAMES = {leaf: f"{leaf}_{unit.suffix}" if unit.suffix else leaf for leaf, unit in UNITS.items()}
"""The keys of configurations, by dotted name in `Params`: ``mounting.lever_arm_m``."""
KEYS = {name: leaf for leaf, name in NAMES.items()}
TABLES = ("noise", "mounting", "states", "measurements", "rule")
"""The tables of a configuration that state parameters."""


def flat(tree: Mapping[str, Any], above: str = "") -> Json:
    """Return the values of nested tables by their dotted keys; an empty table is a value."""
    out: Json = {}
    for key, value in tree.items():
        name = above + key
        out |= flat(value, f"{name}.") if isinstance(value, Mapping) and value else {name: value}
    return out


def nested(values: Mapping[str, Any]) -> Json:
    """Return nested tables of values by dotted keys, the inverse of `flat`."""
    tree: Json = {}
    for name, value in values.items():
        *tables, key = name.split(".")
        at = tree
        for table in tables:
            at = at.setdefault(table, {})
        at[key] = value
    return tree


def override(params: Params, stated: Mapping[str, Any]) -> Params:
    """Return the parameters with those that a configuration states.

    Args:
        params: parameters of a filter.
        stated: a configuration as a tree; of its tables `TABLES` count, in a user's units. A state that ``params`` has
            not is passed over.

    Raises:
        ConfigError: a wrong number of axes, a value out of range, a matrix that is no root, or a parameter that the
            filter's rule has not.
    """
    values = flat({table: stated.get(table, {}) for table in TABLES})
    for name, leaf in KEYS.items():
        unit, value = UNITS[leaf], values.get(name)
        if value is None or not has(params, leaf):
            continue
        if isinstance(value, (tuple, list)) and any(isinstance(row, (tuple, list)) for row in value):
            _check_root(name, value)
        elif np.shape(value) not in ((), unit.shape):
            expected = f"one number or {unit.shape[0]}" if unit.shape else "one number"
            raise ConfigError(f"{name} must be {expected}, got {value!r}")
        elif unit.step is None and not np.all((np.asarray(value) > 0) | (unit.zero & (np.asarray(value) == 0))):
            raise ConfigError(f"{name} must be {'>= 0' if unit.zero else '> 0'}, got {value!r}")
        elif not np.isfinite(value).all() and not (unit.endless and not np.isnan(value).any()):
            raise ConfigError(f"{name} must be finite, got {value!r}")
        old = jnp.shape(get(params, leaf))
        shape = np.shape(value) or (unit.shape if old else ())
        params = put(params, leaf, jnp.broadcast_to(jnp.asarray(value, float) * unit.factor, shape))
    for name, value in values.items():
        if name.startswith("rule."):
            params = put(params, name, _rule_value(params, name, value))
    return params


def _rule_value(params: Params, name: str, value: Any) -> Any:
    """Return the value of a key of [rule], in the shape of the rule's parameter."""
    try:
        old = get(params, name)
        new = np.asarray(value, float)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{name}: {error}") from error
    if new.shape not in ((), jnp.shape(old)) or not np.isfinite(new).all():
        raise ConfigError(f"{name} must be finite, of shape {jnp.shape(old)}, got {value!r}")
    return jnp.broadcast_to(jnp.asarray(new), jnp.shape(old))


def _check_root(name: str, value: Any) -> None:
    """Raise ConfigError unless it is a lower triangular 3 x 3 with a positive diagonal."""
    expected = f"{name} as a matrix must be lower triangular, 3 x 3, with a positive diagonal, got {value!r}"
    if [np.size(row) for row in value] != [3, 3, 3]:
        raise ConfigError(expected)
    L = np.array(value)
    if np.any(np.triu(L, 1)) or not np.all(np.diag(L) > 0) or not np.isfinite(L).all():
        raise ConfigError(expected)


def in_user_units(params: Params, leaves: Iterable[str]) -> Json:
    """Return the named leaves by their keys in a configuration; axes that agree are one number."""
    return {name_of(leaf): user_value(leaf, get(params, leaf)) for leaf in leaves}


def noise_leaves(params: Params) -> list[str]:
    """Return the leaves of ``params`` that are noise: positive numbers that are no prior's."""
    prior = lambda leaf: leaf.startswith("states.") and leaf.endswith(".sd")
    return [leaf for leaf, unit in UNITS.items() if unit.step is None and not prior(leaf) and has(params, leaf)]


def unit_of(leaf: str) -> Unit:
    """Return how a user states a leaf; a rule's parameters have no unit."""
    return UNITS.get(leaf, Unit(step=1.0))


def name_of(leaf: str) -> str:
    """Return the key of a leaf in a configuration; a parameter of a rule keeps its name."""
    return NAMES.get(leaf, leaf)


def component(label: str) -> str:
    """Return the label ``noise.gyro[1]`` with the key of a configuration: ``noise.gyro_deg_per_sqrt_hour[1]``."""
    leaf, bracket, index = label.partition("[")
    return name_of(leaf) + bracket + index


def user_value(leaf: str, value: Any, short: bool = True) -> Any:
    """Return a leaf's value in a user's units, as plain numbers; ``short``: axes that agree are one number."""
    value = np.asarray(value, float) / unit_of(leaf).factor
    same = short and value.ndim and np.all(value == value.flat[0]) and leaf in UNITS and UNITS[leaf].step is None
    return float(value.flat[0]) if same else value.tolist()
