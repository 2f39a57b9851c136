"""Where data comes from: simulated runs, public data sets, recordings at a path."""

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxnav import reading
from jaxnav.app.config import Config
from jaxnav.filters.run import require_x64
from jaxnav.measurements import MEASUREMENTS
from jaxnav.reading.read import read
from jaxnav.simulate.faults import FAULTS, Fault
from jaxnav.simulate.keys import Purpose, run_key
from jaxnav.simulate.readings import with_equipment
from jaxnav.simulate.satellites import with_sky
from jaxnav.simulate.scenarios import SCENARIOS, Scenario
from jaxnav.simulate.simulation import simulate_runs, to_recording
from jaxnav.states.grades import GRADES
from jaxnav.states.table import BIASES, chosen
from jaxnav.types import ConfigError, DataError, Recording, nearest

EQUIPMENT, SKY = 5, 6  # folded into a run's key, in addition to the purposes of `jaxnav.simulate.simulation`


def scenario_of(config: Config) -> Scenario | None:
    """Return the scenario that [data] names, with its options; None if the source is none.

    Raises:
        ConfigError: an unknown option, or one of the wrong type.
    """
    data = config.data
    if data.source not in SCENARIOS:
        return None
    scenario = SCENARIOS[data.source]
    for key, value in data.options.items():
        scenario = _with(scenario, key, value)
    if scenario.imu.grade not in GRADES:
        raise ConfigError(
            f"data.options.grade: no IMU grade {scenario.imu.grade!r}: {nearest(scenario.imu.grade, GRADES)}"
        )
    worse, late = data.imu_worse_by, data.gnss_latency_s
    if worse != 1.0:
        scenario = scenario._replace(imu=scenario.imu._replace(imu_noise_factor=worse))
    if late != 0.0:
        scenario = scenario._replace(gnss=scenario.gnss._replace(latency_s=late))
    return scenario


def _with(scenario: Scenario, key: str, value: Any) -> Scenario:
    """Return the scenario with one option, a field of it or of one of its groups."""
    name, groups = f"data.options.{key}", [g for g in scenario._fields if hasattr(getattr(scenario, g), "_fields")]
    owners = {field: group for group in groups for field in getattr(scenario, group)._fields}
    plain = [field for field in scenario._fields if field not in groups and field not in ("name", "faults")]
    if key == "sensors":
        return scenario._replace(sensors=_sensors(name, value))
    if key == "sensor_states":
        return scenario._replace(sensor_states=_states(name, value))
    if key == "faults":
        return scenario._replace(faults=_faults(name, value))
    if key in plain:
        return scenario._replace(**{key: _like(name, value, getattr(scenario, key))})
    if key not in owners:
        raise ConfigError(f"{name}: unknown for a scenario: {nearest(key, [*plain, *owners])}")
    group = getattr(scenario, owners[key])
    return scenario._replace(**{owners[key]: group._replace(**{key: _like(name, value, getattr(group, key))})})


def _sensors(name: str, value: Any) -> tuple[tuple[str, float], ...]:
    """Sensors by name with the sd of their noise, in the order of the table of measurements."""
    known = [name for name, each in MEASUREMENTS.items() if each.columns]
    if not isinstance(value, dict):
        raise ConfigError(f"{name} must be like {{barometer = 0.5}}, sd by measurement, got {value!r}")
    for sensor, sd in value.items():
        if sensor not in known:
            raise ConfigError(f"{name}: no sensor {sensor!r}: {nearest(sensor, known)}")
        if isinstance(sd, bool) or not isinstance(sd, (int, float)) or not 0 < sd < 1e6:
            raise ConfigError(f"{name}.{sensor}: the sd of its noise must be a positive number, got {sd!r}")
    return tuple((each, float(value[each])) for each in known if each in value)


def _faults(name: str, value: Any) -> tuple[Fault, ...]:
    """Return faults of the receiver, each stated as a kind with its fields."""
    kinds = {re.sub("(?<!^)(?=[A-Z])", "_", kind.__name__).lower(): kind for kind in FAULTS}
    if not isinstance(value, (list, tuple)) or not all(isinstance(each, dict) for each in value):
        example = '[{kind = "ramp", start_s = 60, stop_s = 90, position_m = [30, 0, 0]}]'
        raise ConfigError(f"{name} must be like {example}, or [] for none, got {value!r}")
    found = []
    for i, stated in enumerate(value):
        where, title = f"{name}[{i}]", str(stated.get("kind"))
        given = {key: each for key, each in stated.items() if key != "kind"}
        if title not in kinds:
            raise ConfigError(f"{where}.kind: no fault {title!r}: {nearest(title, kinds)}")
        kind: Any = kinds[title]
        likes = {field: kind._field_defaults.get(field, 0.0) for field in kind._fields}
        if unknown := [key for key in given if key not in likes]:
            raise ConfigError(f"{where}.{unknown[0]}: unknown for a {title}: {nearest(unknown[0], likes)}")
        if missing := [key for key in likes if key not in given and key not in kind._field_defaults]:
            raise ConfigError(f"{where}: a {title} needs {', '.join(missing)}")
        fault = kind(**{key: _like(f"{where}.{key}", each, likes[key]) for key, each in given.items()})
        if not fault.start_s < fault.stop_s:
            raise ConfigError(f"{where}: stop_s must be after start_s, got {fault.start_s:g} and {fault.stop_s:g}")
        found.append(fault)
    return tuple(found)


def _states(name: str, value: Any) -> tuple[str, ...]:
    """Return names of further states with drawn errors."""
    if not isinstance(value, (list, tuple)) or not all(isinstance(each, str) for each in value):
        raise ConfigError(f"{name} must be names of states, got {value!r}")
    try:
        chosen(value)
    except ValueError as error:
        raise ConfigError(f"{name}: {error}") from error
    for state in chosen(value):
        if state.reads:
            raise ConfigError(f"{name}: {state.name} reads {', '.join(state.reads)}, which a simulated run has not")
    return tuple(each for each in value if each not in BIASES)  # these every simulated IMU has by its grade


def _like(name: str, value: Any, default: Any) -> Any:
    """``value`` with the type of ``default``: numbers, text, or tuples of them."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        inner = default[0] if default else (0.0, 0.0)  # windows of time may be empty
        if isinstance(inner, tuple) or len(value) == len(default):
            return tuple(_like(name, v, inner) for v in value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, float) and number:
        return float(value)
    if type(default) is type(value) and not isinstance(default, tuple):
        return value
    raise ConfigError(f"{name} must be like {default!r}, got {value!r}")


def load(config: Config) -> Recording:
    """Return the recording that [data] names, read or simulated.

    Raises:
        DataError: it is not there, or cannot be used.
    """
    data, scenario = config.data, scenario_of(config)
    require_x64(jnp.zeros((), float))
    if scenario is not None:
        sims = simulate_runs(run_key(config.seed, Purpose.SINGLE, 0)[None], scenario)
        sim = jax.tree.map(lambda a: a[0], sims)
        key = run_key(config.seed, Purpose.SINGLE, 0)
        if scenario.sensors or scenario.sensor_states:
            sim = with_equipment(jax.random.fold_in(key, EQUIPMENT), sim, scenario)
        if scenario.sky is not None:
            sim = with_sky(jax.random.fold_in(key, SKY), sim, scenario)
        return to_recording(sim, scenario)
    if data.source in reading.DATASETS:
        return reading.load(data.source, **data.options)
    if not data.source.strip():
        raise DataError("data.source: no name of a scenario, data set or recording")
    if Path(data.source).exists():
        return read(data.source, **data.options)
    names = [*SCENARIOS, *reading.DATASETS]
    raise DataError(f"{data.source}: no such file, scenario or data set: {nearest(data.source, names)}")
