"""Configuration of the command line: TOML, or the run.json of an earlier run, into frozen dataclasses.

Layers, the later wins: defaults, the preset of a data set, the file, ``--params``, flags, ``--set a.b=c``. Values are
in a user's units, the unit in the name.
"""

import dataclasses
import difflib
import json
import math
import operator
import tomllib
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.filters.border import NAMES, TABLES, flat, name_of, nested, user_value
from jaxnav.filters.parameters import UNITS
from jaxnav.io.toml import convert, describe, place, plain, quoted
from jaxnav.maths.units import Unit
from jaxnav.measurements import GNSS
from jaxnav.reading.datasets import DATASETS
from jaxnav.types import ConfigError, DataError, nearest

Numbers = float | tuple[float, ...]
Root = Numbers | tuple[tuple[float, ...], ...]  # or a lower triangular matrix


@dataclasses.dataclass(frozen=True)
class Data:
    """The recording, or the scenario to simulate."""

    source: str = "urban"  # a scenario, a data set of `jaxnav data list`, or a path to a canonical recording
    start: float | None = None  # s, use the recording from here
    stop: float | None = None  # s, to here
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # of the reader, or fields of the scenario
    imu_worse_by: float = 1.0  # simulated: the IMU's noise and drift are its datasheet's times this
    gnss_latency_s: float = 0.0  # simulated: age of a fix at its stamp


@dataclasses.dataclass(frozen=True)
class Filter:
    """The filter and its options."""

    name: str = "ekf15"  # see `jaxnav info`
    grade: str = ""  # IMU datasheet, or "auto": noise and latency by likelihood; empty: the scenario's, else auto
    adapter: str = ""  # learned part, a row of `jaxnav.ADAPTERS`, or the .npz of its weights
    states: tuple[str, ...] = ()  # optional error states in addition to the filter's, see `jaxnav.states.STATES`
    measurements: tuple[str, ...] = tuple(m.name for m in GNSS)  # the filter's, see `jaxnav.measurements.MEASUREMENTS`
    cov_stride: int = 5  # the error dynamics see means over so many IMU samples
    interval_s: float = 0.0  # nominal fix interval; 0: the median of the position's
    smooth: bool = False  # each epoch by all fixes, those after it too
    lag_s: float = 0.0  # or by the fixes of the next seconds alone
    sd_factor: float = 1.0  # stated sd of positions are the filter's times this, see jaxnav solve
    velocity_sd_factor: float = 1.0  # and those of velocities
    delay_sd_s: float = 0.0  # sd of the delay between IMU and fixes, which is one of positions along the track
    clock_rate_sd_ppm: float = 0.0  # sd of the growth of that delay, none halfway
    outages: tuple[tuple[float, ...], ...] = ()  # (start, end) s, fixes hidden from the filter
    standing_window_s: float = 1.0  # of the standstill detector: both sd, root sum square of axes, below these
    standing_accel_sd_mps2: float = 0.2  # of the specific force within the window
    standing_gyro_sd_deg_per_s: float = 1.0  # of the rate


@dataclasses.dataclass(frozen=True)
class Initialization:
    """Initial navigation: position and velocity by the first fix, level by a standstill, heading as stated."""

    heading: float | str = "motion"  # "motion", "course", "unknown", "truth" or degrees
    course_speed_mps: float = 5.0  # least speed for a course
    position_sd_m: Numbers | None = None  # None: the fix's sd, and 0.5 m
    velocity_sd_mps: Numbers | None = None  # None: the fix's sd, and 0.3 m/s
    tilt_sd_deg: float = 2.0  # of levelling; an alignment in motion estimates its sd
    heading_sd_deg: float = 5.0  # of a course, or of degrees
    hypotheses: int = 12  # of an unknown heading, each with an sd of their spacing


def _type_of(unit: Unit) -> Any:
    """Return the type of a key's value."""
    return float if not unit.shape else Root if unit.root else Numbers


def _made(name: str, fields: Mapping[str, tuple[Any, Any]], doc: str = "") -> Any:
    """Return a section with these keys, each with its type and default."""
    rows = [(key, hint, default) for key, (hint, default) in fields.items()]
    return dataclasses.make_dataclass(name, rows, frozen=True, namespace={"__doc__": doc})


def _sections_of_rows() -> dict[str, Any]:
    """Return the sections of `jaxnav.filters.border.TABLES` with the keys that the rows bring, all of them None."""
    tables: dict[str, dict[str, tuple[Any, Any]]] = {}
    for leaf, name in NAMES.items():
        section, _, key = name.rpartition(".")
        tables.setdefault(section, {})[key] = (_type_of(UNITS[leaf]) | None, None)
    for group in ("states", "measurements"):
        rows = {section: tables.pop(section) for section in list(tables) if section.startswith(f"{group}.")}
        kinds = {section.rpartition(".")[2]: _made(section, fields) for section, fields in rows.items()}
        tables[group] = {name: (kind, kind()) for name, kind in kinds.items()}
    return {name: _made(name.title(), tables[name], MODEL_HELP[name]) for name in TABLES if name in tables}


MODEL_HELP = {
    "noise": "White noise of the IMU, in place of the datasheet's.",
    "mounting": "Antenna, clock and vehicle relative to the IMU, in place of the recording's.",
    "states": "Error states: prior sd, driving noise, correlation time. A datasheet gives the values of the biases.",
    "measurements": "Measurement models: factors on the stated sd, latencies, constants.",
    "rule": "Parameters of the filter's rule, by name.",
}
if typing.TYPE_CHECKING:
    Noise = Any
    Mounting = Any
    States = Any
    Measurements = Any
else:
    _ROWS = _sections_of_rows()
    Noise, Mounting, States, Measurements = (_ROWS[name] for name in ("noise", "mounting", "states", "measurements"))


@dataclasses.dataclass(frozen=True)
class Tune:
    """The tuned parameters, their priors, the objective and the data."""

    free: tuple[str, ...] = ()  # groups, or dotted names such as noise.gyro; empty: noise and timing, with the fixes
    #   of recordings, or the rule of simulated runs
    frozen: tuple[str, ...] = ()  # taken out of ``free`` again
    per_recording: tuple[str, ...] = ()  # several recordings: free parameters with one value for each, such as "timing"
    prior: dict[str, float] = dataclasses.field(default_factory=dict)  # name -> one sd about the datasheet: a factor
    #   for a positive parameter (2 is "within a factor 2"), else in the parameter's unit
    priors: str = "datasheet"  # or "none": maximum likelihood, see `tuning.recordings.priors`
    # auto: tempered for recordings, adam for simulated runs and for a custom objective; also sgd, lbfgs, and
    method: str = "auto"  # scoring, for simulated runs and the objective nll; `tuning.recordings.recorded`: tempered
    objective: dict[str, float] = dataclasses.field(
        default_factory=lambda: {"log_drift": 1.0, "nll": 1.0}
    )  # of a gradient method: name -> weight
    steps: int = 40  # updates of a gradient method, evaluations of scoring
    rate: float = 0.1  # of a gradient method: a step of 0.1 is 10 % of a positive parameter
    more: tuple[str, ...] = ()  # further sources to tune on together, as [data] source
    target: str = ""  # another filter, tuned as it measures and estimates: kfgins, navego, px4, ardupilot, ...
    outage_s: float = 0.0  # recorded: length of the hidden windows; 0: by the recording's length
    hidden_satellites: int | tuple[int, ...] = 0  # the highest, that a hidden window keeps; several: by turns
    runs: int = 8  # simulated: for training
    validation_runs: int = 4  # to choose the best step
    test_runs: int = 8  # to judge


@dataclasses.dataclass(frozen=True)
class Mc:
    """Monte Carlo runs."""

    runs: int = 100  # how many
    chunk: int = 16  # that live at a time
    limit_m: float = 1000.0  # a horizontal error above this is a divergence


@dataclasses.dataclass(frozen=True)
class Bakeoff:
    """Filters against each other; budget of [tune] (steps, rate, runs), divergence limit of [mc] limit_m."""

    unseen: tuple[str, ...] = ()  # test scenarios without tuning, in addition to those of [data] source


@dataclasses.dataclass(frozen=True)
class Out:
    """Output files."""

    formats: tuple[str, ...] = ("csv", "kml", "geojson")  # of the solution; also tum, pos, nav
    figures: str = "report"  # in report.html; "files": as PNG files as well; "none"
    imu_rate: bool = False  # the solution at every sample of the IMU, not at the ends of epochs alone


@dataclasses.dataclass(frozen=True)
class Time:
    """Clock of the solution's times, where fixes are late or early."""

    base: str = "imu"  # stamps of the IMU; or "fixes": the stamps of the fixes


@dataclasses.dataclass(frozen=True)
class Config:
    """One job, resolved."""

    seed: int = 0
    data: Data = Data()
    filter: Filter = Filter()
    initialization: Initialization = Initialization()
    noise: Noise = Noise()
    mounting: Mounting = Mounting()
    states: States = States()
    measurements: Measurements = Measurements()
    rule: dict[str, Any] = dataclasses.field(default_factory=dict)
    tune: Tune = Tune()
    mc: Mc = Mc()
    bakeoff: Bakeoff = Bakeoff()
    out: Out = Out()
    time: Time = Time()
    stated: dataclasses.InitVar[frozenset[str]] = frozenset()  # names of all stated settings

    def __post_init__(self, stated: frozenset[str]) -> None:
        object.__setattr__(self, "_stated", stated)


LIMITS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**32 - 1),
    "data.imu_worse_by": (1.0, 1e3),
    "data.gnss_latency_s": (0.0, 1.0),
    "filter.cov_stride": (1, 1000),
    "filter.lag_s": (0.0, 3600.0),
    "filter.standing_window_s": (0.01, 3600.0),
    "filter.standing_accel_sd_mps2": (0.0, 1e3),
    "filter.standing_gyro_sd_deg_per_s": (0.0, 1e4),
    "filter.interval_s": (0.0, 60.0),
    "initialization.course_speed_mps": (0.1, 100.0),
    "initialization.tilt_sd_deg": (1e-6, 90.0),
    "initialization.heading_sd_deg": (1e-6, 180.0),
    "initialization.hypotheses": (2, 360),
    "mounting.time_offset_s": (-10.0, 10.0),
    "mounting.clock_drift_ppm": (-1e5, 1e5),
    "measurements.position.latency_s": (-10.0, 10.0),
    "measurements.velocity.latency_s": (-10.0, 10.0),
    "tune.steps": (0, 1_000_000),
    "tune.rate": (1e-9, 10.0),
    "tune.runs": (1, 1_000_000),
    "tune.validation_runs": (1, 1_000_000),
    "tune.test_runs": (1, 1_000_000),
    "tune.outage_s": (0.0, 3600.0),
    "tune.hidden_satellites": (0, 14),
    "mc.runs": (1, 10_000_000),
    "mc.chunk": (1, 10_000),
    "mc.limit_m": (1e-3, math.inf),
}
"""Smallest and largest value of numbers that would otherwise fail somewhere inside."""


def resolve(layers: Iterable[tuple[str, Mapping[str, Any]]]) -> Config:
    """Merge ``(where, tree)`` layers over the defaults; ``where`` names the origin in messages.

    Raises:
        ConfigError: an unknown key, or a value of the wrong type or out of its limits.
    """
    layers = [(where, _checked(Config, tree, where)) for where, tree in layers]
    source = Data.source
    for _, tree in layers:
        source = tree.get("data", {}).get("source", source)
    preset = DATASETS[source].settings if source in DATASETS else {}
    merged: dict[str, Any] = _checked(Config, preset, "preset")
    for _, tree in layers:
        merged = merge(merged, tree)
    names = [name for _, tree in layers for name in flat(tree)]
    stated = frozenset(key for key in _values(Config()) if any(f"{name}.".startswith(f"{key}.") for name in names))
    config = _build(Config, merged | {"stated": stated})
    for name, (low, high) in LIMITS.items():
        value = operator.attrgetter(name)(config)
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not low <= number <= high:
                raise ConfigError(f"{name} must be in [{low:.12g}, {high:.12g}], got {number:.12g}")
    return config


def for_source(config: Config, source: str) -> Config:
    """Return the same job on another source: with its presets, and without settings of the first one's data."""
    default, preset = _values(Config()), _values(resolve([("", {"data": {"source": config.data.source}})]))
    stated: frozenset[str] = getattr(config, "_stated", frozenset())
    chosen = {k: v for k, v in _values(config).items() if k in stated or v not in (default[k], preset[k])}
    for key in ("data.options", "data.start", "data.stop"):
        chosen.pop(key, None)
    return resolve([("tune.more", nested(chosen | {"data.source": source}))])


def read(path: str | Path) -> dict[str, Any]:
    """Read the tree of a TOML file, or of the configuration in a run.json.

    Raises:
        ConfigError: not readable, not TOML or JSON, unknown key, wrong type; names the file and line.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors put a mark in front
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    try:
        tree = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from error
    if path.suffix == ".json":
        tree = tree.get("config") if isinstance(tree, dict) else None
        if not isinstance(tree, dict):
            raise ConfigError(f'{path}: expected an object with a "config", as jaxnav writes it in run.json')
    _checked(Config, tree, str(path), text)
    return tree


def read_params(path: str | Path) -> dict[str, Any]:
    """Return the parameters of a file such as tuned.toml or grade.toml as a layer, or the noise of another filter's.

    With them come the states that they are for, and how far from them tuning is to look.

    Raises:
        ConfigError: the file cannot be read, or states no parameter.
    """
    if Path(path).suffix not in (".toml", ".json"):
        return _of_another_filter(Path(path))
    tree = read(path)
    layer = {name: tree[name] for name in TABLES if name in tree}
    if not layer:
        raise ConfigError(f"{path}: has none of {', '.join(f'[{name}]' for name in TABLES)}")
    for section, keys in (("filter", ("states", "adapter")), ("tune", ("prior",))):
        if given := {key: tree[section][key] for key in keys if key in tree.get(section, {})}:
            layer[section] = given
    weights = layer.get("filter", {}).get("adapter", "")
    if isinstance(weights, str) and weights.endswith(".npz"):
        layer["filter"]["adapter"] = str(Path(path).parent / weights)
    return layer


def _of_another_filter(path: Path) -> dict[str, Any]:
    from tuning.recordings.targets import read_settings  # not for every command

    try:
        found = read_settings(path)
    except (OSError, DataError) as error:
        raise ConfigError(str(error)) from error
    numbers = {leaf: np.ravel(user_value(leaf, value)).tolist() for leaf, value in found.items()}
    return nested({name_of(leaf): v[0] if len(set(v)) == 1 else v for leaf, v in numbers.items()})


def parse_set(setting: str) -> dict[str, Any]:
    """``a.b=c`` as a tree; the value is TOML, and text where it is none.

    Raises:
        ConfigError: no ``=``.
    """
    key, equals, text = setting.partition("=")
    names = [name.strip() for name in key.split(".")]
    if not equals or not all(names):
        raise ConfigError(f"--set takes a.b=value, got {setting!r}")
    try:
        value = tomllib.loads(f"v = {text}")["v"] if "\n" not in text else text
    except tomllib.TOMLDecodeError:
        value = text.strip()
    tree: dict[str, Any] = {names[-1]: value}
    for name in reversed(names[:-1]):
        tree = {name: tree}
    return tree


def merge(a: Mapping[str, Any], b: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """``b`` over ``a``, section by section; objective and prior are replaced as a whole."""
    out = dict(a)
    for key, value in b.items():
        whole = path + key in ("tune.objective", "tune.prior")
        deep = isinstance(value, Mapping) and isinstance(out.get(key), Mapping) and not whole
        out[key] = merge(out[key], value, f"{path}{key}.") if deep else value
    return out


def changed(config: Config, values: Mapping[str, Any]) -> Config:
    """Return the configuration with values by dotted key, such as ``mounting.time_offset_s``."""
    for name, value in values.items():
        config = _replaced(config, name.split("."), value)
    return config


def _replaced(section: Any, path: list[str], value: Any) -> Any:
    first, *rest = path
    return dataclasses.replace(section, **{first: _replaced(getattr(section, first), rest, value) if rest else value})


def as_dict(config: Config) -> dict[str, Any]:
    """Return the resolved configuration as a tree for TOML or JSON, without None."""
    return plain(dataclasses.asdict(config))


# ---------------------------------------------------------------------------- details


def _checked(kind: type, tree: Any, where: str, text: str = "", path: str = "") -> dict[str, Any]:
    """Return the tree with every key known and every value of its field's type."""
    if not isinstance(tree, Mapping):
        raise ConfigError(f"{place(where, text, path)}: [{path.rstrip('.')}] is a section, got {tree!r}")
    known = {field.name for field in dataclasses.fields(kind)}
    hints, out = {name: hint for name, hint in typing.get_type_hints(kind).items() if name in known}, {}
    for key, value in tree.items():
        name = path + quoted(key)
        if key not in hints:
            raise ConfigError(f"{place(where, text, name)}: unknown key {name}: {_near_key(name, path, hints)}")
        hint = hints[key]
        if dataclasses.is_dataclass(hint):
            out[key] = _checked(typing.cast(type, hint), value, where, text, f"{name}.")
            continue
        if name == "tune.objective" and isinstance(value, str):
            value = {value: 1.0}
        if name == "tune.prior" and isinstance(value, Mapping):  # its keys may be dotted
            value = flat(value)
        ok, out[key] = convert(value, hint)
        if not ok:
            raise ConfigError(f"{place(where, text, name)}: {name} must be {describe(hint)}, got {value!r}")
    return out


def _near_key(name: str, path: str, hints: Mapping[str, Any]) -> str:
    """Return the nearest key in the section, or in any section."""
    here = [path + k for k in hints]
    if difflib.get_close_matches(name, here, n=1, cutoff=0.7):
        return nearest(name, here)
    last = name.rpartition(".")[2]
    every = _values(Config())
    close = difflib.get_close_matches(last, [k.rpartition(".")[2] for k in every], n=1, cutoff=0.8)
    if close:
        return f"did you mean {next(k for k in every if k.endswith('.' + close[0]))}?"
    return nearest(name, here)


def _values(section: Any, above: str = "") -> dict[str, Any]:
    """Return the values of a section and of those in it, by dotted key."""
    out: dict[str, Any] = {}
    for field in dataclasses.fields(section):
        value, name = getattr(section, field.name), above + field.name
        out |= _values(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return out


def _build(kind: Any, tree: Mapping[str, Any]) -> Any:
    hints = typing.get_type_hints(kind)
    return kind(**{k: _build(hints[k], v) if dataclasses.is_dataclass(hints.get(k)) else v for k, v in tree.items()})
