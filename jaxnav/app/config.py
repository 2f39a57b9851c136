"""Configuration of the command line: TOML, or the run.json of an earlier run, into frozen dataclasses.

Layers, the later wins: defaults, the preset of a data set, the file, ``--params``, flags, ``--set a.b=c``. Values are
in a user's units, the unit in the name.
"""

import dataclasses
import difflib
import json
import math
import tomllib
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from jaxnav.filters.border import NAMES, TABLES, flat, name_of, nested, user_value
from jaxnav.filters.parameters import UNITS
from jaxnav.io.toml import converted, describe, place, plain, quoted
from jaxnav.maths.units import Unit
from jaxnav.measurements import GNSS
from jaxnav.reading.datasets import DATASETS
from jaxnav.types import ConfigError, DataError, Json, nearest

Numbers = float | tuple[float, ...]


def said(words: str, low: float | None = None, high: float | None = None) -> Meta:
    """Return the words and limits of a setting: what `jaxnav config` prints, and what its values are held against."""
    return Meta(description=words, ge=low, le=high)


Satellites = Annotated[int, Meta(ge=0, le=14)]
RECEIVER = tuple(m.name for m in GNSS)


@dataclasses.dataclass(frozen=True)
class Data:
    """The recording, or the scenario to simulate."""

    source: Annotated[str, said("a scenario, a data set of `jaxnav data list`, or a path to a canonical recording")] = (
        "urban"
    )
    start: Annotated[float | None, said("s, use the recording from here")] = None
    stop: Annotated[float | None, said("s, to here")] = None
    options: Annotated[Json, said("of the reader, or fields of the scenario")] = dataclasses.field(default_factory=dict)
    imu_worse_by: Annotated[
        float, said("simulated: the IMU's noise and drift are its datasheet's times this", 1.0, 1000.0)
    ] = 1.0
    gnss_latency_s: Annotated[float, said("simulated: age of a fix at its stamp", 0.0, 1.0)] = 0.0


@dataclasses.dataclass(frozen=True)
class Filter:
    """The filter and its options."""

    name: Annotated[str, said("see `jaxnav info`")] = "ekf15"
    grade: Annotated[
        str, said('IMU datasheet, or "auto": noise and latency by likelihood; empty: the scenario\'s, else auto')
    ] = ""
    adapter: Annotated[str, said("learned part, a row of `jaxnav.ADAPTERS`, or the .npz of its weights")] = ""
    states: Annotated[
        tuple[str, ...], said("optional error states in addition to the filter's, see `jaxnav.states.STATES`")
    ] = ()
    measurements: Annotated[tuple[str, ...], said("the filter's, see `jaxnav.measurements.MEASUREMENTS`")] = RECEIVER
    cov_stride: Annotated[int, said("the error dynamics see means over so many IMU samples", 1, 1000)] = 5
    interval_s: Annotated[float, said("nominal fix interval; 0: the median of the position's", 0.0, 60.0)] = 0.0
    smooth: Annotated[bool, said("each epoch by all fixes, those after it too")] = False
    lag_s: Annotated[float, said("or by the fixes of the next seconds alone", 0.0, 3600.0)] = 0.0
    sd_factor: Annotated[float, said("sd of positions are the filter's times this, see jaxnav solve", 1e-3, 1e3)] = 1.0
    velocity_sd_factor: Annotated[float, said("and those of velocities", 1e-3, 1e3)] = 1.0
    delay_sd_s: Annotated[
        float, said("sd of the delay between IMU and fixes, which is one of positions along the track", 0.0, 10.0)
    ] = 0.0
    clock_rate_sd_ppm: Annotated[float, said("sd of the growth of that delay, none halfway", 0.0, 1e5)] = 0.0
    outages: Annotated[tuple[tuple[float, ...], ...], said("(start, end) s, fixes hidden from the filter")] = ()
    standing_window_s: Annotated[
        float, said("of the standstill detector: both sd, root sum square of axes, below these", 0.01, 3600.0)
    ] = 1.0
    standing_accel_sd_mps2: Annotated[float, said("of the specific force within the window", 0.0, 1000.0)] = 0.2
    standing_gyro_sd_deg_per_s: Annotated[float, said("of the rate", 0.0, 10000.0)] = 1.0


@dataclasses.dataclass(frozen=True)
class Initialization:
    """Initial navigation: position and velocity by the first fix, level by a standstill, heading as stated."""

    heading: Annotated[float | str, said('"motion", "course", "unknown", "truth" or degrees')] = "motion"
    course_speed_mps: Annotated[float, said("least speed for a course", 0.1, 100.0)] = 5.0
    position_sd_m: Annotated[Numbers | None, said("None: the fix's sd, and 0.5 m")] = None
    velocity_sd_mps: Annotated[Numbers | None, said("None: the fix's sd, and 0.3 m/s")] = None
    tilt_sd_deg: Annotated[float, said("of levelling; an alignment in motion estimates its sd", 1e-6, 90.0)] = 2.0
    heading_sd_deg: Annotated[float, said("of a course, or of degrees", 1e-6, 180.0)] = 5.0
    hypotheses: Annotated[int, said("of an unknown heading, each with an sd of their spacing", 2, 360)] = 12


def _type_of(unit: Unit) -> Any:
    """Return the type of a key's value: a number, one an axis or, of a root, a lower triangular matrix."""
    number: Any = Annotated[float, Meta(ge=-unit.most, le=unit.most)] if math.isfinite(unit.most) else float
    row = tuple[number, ...]
    return number if not unit.shape else number | tuple[number | row, ...] if unit.root else number | row


def _made(name: str, fields: Mapping[str, tuple[Any, Any]], doc: str = "") -> Any:
    """Return a section with these keys, each with its type and default."""
    rows = [(key, hint, default) for key, (hint, default) in fields.items()]
    return dataclasses.make_dataclass(name, rows, frozen=True, namespace={"__doc__": doc})


def _sections_of_rows() -> Json:
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

    free: Annotated[
        tuple[str, ...],
        said(
            "groups, or dotted names such as noise.gyro; empty: noise and timing, with the fixes of recordings, or "
            "the rule of simulated runs"
        ),
    ] = ()
    frozen: Annotated[tuple[str, ...], said("taken out of ``free`` again")] = ()
    per_recording: Annotated[
        tuple[str, ...], said('several recordings: free parameters with one value for each, such as "timing"')
    ] = ()
    prior: Annotated[
        dict[str, float],
        said(
            'name -> one sd about the datasheet: a factor for a positive parameter (2 is "within a factor 2"), '
            "else in the parameter's unit"
        ),
    ] = dataclasses.field(default_factory=dict)
    priors: Annotated[str, said('or "none": maximum likelihood, see `tuning.recordings.priors`')] = "datasheet"
    method: Annotated[
        str,
        said(
            "auto: tempered for recordings, adam for simulated runs and for a custom objective; also sgd, lbfgs, and "
            "scoring, for simulated runs and the objective nll; `tuning.recordings.recorded`: tempered"
        ),
    ] = "auto"
    objective: Annotated[dict[str, float], said("of a gradient method: name -> weight")] = dataclasses.field(
        default_factory=lambda: {"log_drift": 1.0, "nll": 1.0}
    )
    steps: Annotated[int, said("updates of a gradient method, evaluations of scoring", 0, 1_000_000)] = 40
    rate: Annotated[float, said("of a gradient method: a step of 0.1 is 10 % of a positive parameter", 1e-9, 10.0)] = (
        0.1
    )
    more: Annotated[tuple[str, ...], said("further sources to tune on together, as [data] source")] = ()
    target: Annotated[
        str, said("another filter, tuned as it measures and estimates: kfgins, navego, px4, ardupilot, ...")
    ] = ""
    outage_s: Annotated[
        float, said("recorded: length of the hidden windows; 0: by the recording's length", 0.0, 3600.0)
    ] = 0.0
    hidden_satellites: Annotated[
        Satellites | tuple[Satellites, ...], said("the highest, that a hidden window keeps; several: by turns")
    ] = 0
    runs: Annotated[int, said("simulated: for training", 1, 1_000_000)] = 8
    validation_runs: Annotated[int, said("to choose the best step", 1, 1_000_000)] = 4
    test_runs: Annotated[int, said("to judge", 1, 1_000_000)] = 8


@dataclasses.dataclass(frozen=True)
class Mc:
    """Monte Carlo runs."""

    runs: Annotated[int, said("how many", 1, 10_000_000)] = 100
    chunk: Annotated[int, said("that live at a time", 1, 10000)] = 16
    limit_m: Annotated[float, said("a horizontal error above this is a divergence", 1e-3)] = 1000.0


@dataclasses.dataclass(frozen=True)
class Bakeoff:
    """Filters against each other; budget of [tune] (steps, rate, runs), divergence limit of [mc] limit_m."""

    unseen: Annotated[
        tuple[str, ...], said("test scenarios without tuning, in addition to those of [data] source")
    ] = ()


@dataclasses.dataclass(frozen=True)
class Out:
    """Output files."""

    formats: Annotated[tuple[str, ...], said("of the solution; also tum, pos, nav")] = ("csv", "kml", "geojson")
    figures: Annotated[str, said('in report.html; "files": as PNG files as well; "none"')] = "report"
    imu_rate: Annotated[bool, said("the solution at every sample of the IMU, not at the ends of epochs alone")] = False


@dataclasses.dataclass(frozen=True)
class Time:
    """Clock of the solution's times, where fixes are late or early."""

    base: Annotated[str, said('stamps of the IMU; or "fixes": the stamps of the fixes')] = "imu"


@dataclasses.dataclass(frozen=True)
class Config:
    """One job, resolved."""

    seed: Annotated[int, said("of all that is random", 0, 2**32 - 1)] = 0
    data: Data = Data()
    filter: Filter = Filter()
    initialization: Initialization = Initialization()
    noise: Noise = Noise()
    mounting: Mounting = Mounting()
    states: States = States()
    measurements: Measurements = Measurements()
    rule: Json = dataclasses.field(default_factory=dict)
    tune: Tune = Tune()
    mc: Mc = Mc()
    bakeoff: Bakeoff = Bakeoff()
    out: Out = Out()
    time: Time = Time()


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
    merged: Json = _checked(Config, preset, "preset")
    for _, tree in layers:
        merged = merge(merged, tree)
    names = [name for _, tree in layers for name in flat(tree)]
    stated = frozenset(key for key in _values(Config()) if any(f"{name}.".startswith(f"{key}.") for name in names))
    config = msgspec.convert(merged, Config)
    object.__setattr__(config, "_stated", stated)
    return config


def for_source(config: Config, source: str) -> Config:
    """Return the same job on another source: with its presets, and without settings of the first one's data."""
    default, preset = _values(Config()), _values(resolve([("", {"data": {"source": config.data.source}})]))
    stated: frozenset[str] = getattr(config, "_stated", frozenset())
    chosen = {k: v for k, v in _values(config).items() if k in stated or v not in (default[k], preset[k])}
    for key in ("data.options", "data.start", "data.stop"):
        chosen.pop(key, None)
    return resolve([("tune.more", nested(chosen | {"data.source": source}))])


def read(path: str | Path) -> Json:
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


def read_params(path: str | Path) -> Json:
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


def _of_another_filter(path: Path) -> Json:
    from tuning.recordings.targets import read_settings  # not for every command

    try:
        found = read_settings(path)
    except (OSError, DataError) as error:
        raise ConfigError(str(error)) from error
    numbers = {leaf: np.ravel(user_value(leaf, value)).tolist() for leaf, value in found.items()}
    return nested({name_of(leaf): v[0] if len(set(v)) == 1 else v for leaf, v in numbers.items()})


def parse_set(setting: str) -> Json:
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
    tree: Json = {names[-1]: value}
    for name in reversed(names[:-1]):
        tree = {name: tree}
    return tree


def merge(a: Mapping[str, Any], b: Mapping[str, Any], path: str = "") -> Json:
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


def as_dict(config: Config) -> Json:
    """Return the resolved configuration as a tree for TOML or JSON, without None."""
    return plain(dataclasses.asdict(config))


# ---------------------------------------------------------------------------- details


def _checked(kind: type, tree: Any, where: str, text: str = "", path: str = "") -> Json:
    """Return the tree with every key known and every value of its field's type."""
    if not isinstance(tree, Mapping):
        raise ConfigError(f"{place(where, text, path)}: [{path.rstrip('.')}] is a section, got {tree!r}")
    hints, out = hints_of(kind), Json()
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
        try:
            out[key] = converted(value, hint)
        except msgspec.ValidationError as error:
            raise ConfigError(f"{place(where, text, name)}: {name} must be {describe(hint)}, got {value!r}") from error
    return out


def hints_of(kind: type) -> Json:
    """Return the fields of a section, each with its type, words and limits."""
    return typing.get_type_hints(kind, include_extras=True)


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


def _values(section: Any, above: str = "") -> Json:
    """Return the values of a section and of those in it, by dotted key."""
    out: Json = {}
    for field in dataclasses.fields(section):
        value, name = getattr(section, field.name), above + field.name
        out |= _values(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return out
