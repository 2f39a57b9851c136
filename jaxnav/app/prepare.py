"""From a configuration to the arguments of a filter: initialization, parameters, epochs."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxnav.app.config import Config, as_dict, changed
from jaxnav.filters.border import in_user_units, override
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import datasheet_params, mounting
from jaxnav.filters.standstill import Standing
from jaxnav.initialization.initialize import Initialization, initialize
from jaxnav.io.weights import WEIGHTS, adapter_of, read_weights
from jaxnav.maths.units import DEG
from jaxnav.measurements import GNSS, MEASUREMENTS, Measurement
from jaxnav.simulate.scenarios import Scenario
from jaxnav.states.grades import GRADES, Grade
from jaxnav.types import ConfigError, Params, Recording, nearest

AUTO, DATASHEET = "auto", "consumer"
"""Grade with noise and latency from the recording, and the datasheet that is scaled for it."""
NOISE = ("noise.gyro", "noise.accel", "noise.scale")


# ---------------------------------------------------------------------------- filter and parameters


def filter_name(config: Config) -> str:
    """Return the filter's name, known.

    Raises:
        ConfigError: it is not in FILTERS.
    """
    name = config.filter.name
    if name not in FILTERS:
        raise ConfigError(f"filter.name: no filter {name!r}: {nearest(name, FILTERS)}")
    return name


def grade_name(config: Config, scenario: Scenario | None) -> str:
    """Return the grade of the configuration, else of the scenario, else "auto"."""
    return config.filter.grade or (scenario.imu.grade if scenario else AUTO)


def grade_of(config: Config, scenario: Scenario | None) -> Grade:
    """Return the IMU's datasheet; for "auto" a consumer's, to be scaled.

    Raises:
        ConfigError: it is not in GRADES.
    """
    name = grade_name(config, scenario)
    if name == AUTO:
        name = DATASHEET
    if name not in GRADES:
        raise ConfigError(f"filter.grade: no IMU grade {name!r}: {nearest(name, (*GRADES, AUTO))}")
    return GRADES[name]


def measurements_of(config: Config) -> tuple[Measurement, ...]:
    """Return the filter's measurements, in the order of `MEASUREMENTS`.

    Raises:
        ConfigError: an unknown name, or no position.
    """
    names = config.filter.measurements
    for name in names:
        if name not in MEASUREMENTS:
            raise ConfigError(f"filter.measurements: no measurement {name!r}: {nearest(name, MEASUREMENTS)}")
    if "position" not in names:
        raise ConfigError(f'filter.measurements: {list(names)} has no "position", which navigation starts from')
    return tuple(m for m in MEASUREMENTS.values() if m.name in names)


def filter_of(config: Config, measurements: Sequence[Measurement], history: int = 2) -> Filter:
    """Return the filter that [filter] names, with its optional states.

    Raises:
        ConfigError: states that are none, or that the filter cannot have.
    """
    f, adapter = config.filter, adapter_name(config)
    try:
        return build(filter_name(config), measurements, f.cov_stride, history, states=f.states, adapter=adapter)
    except ValueError as error:
        key = "adapter" if adapter and adapter in str(error) else "states"
        raise ConfigError(f"filter.{key}: {error}") from error


def adapter_name(config: Config) -> str:
    """Return the adapter that [filter] names, by itself or by a file of its weights; "" for none."""
    named = config.filter.adapter
    return adapter_of(named) if named.endswith(WEIGHTS) else named


def with_weights(config: Config, params: Params) -> Params:
    """Return the parameters of a filter with the weights of the file that [filter] names."""
    named = config.filter.adapter
    return params._replace(adapter=read_weights(named, params.adapter)) if named.endswith(WEIGHTS) else params


def base_params(
    config: Config, grade: Grade, lever_arm: np.ndarray, position_sd: Any = 3.0, velocity_sd: Any = 0.1
) -> Params:
    """Return the datasheet's parameters with the stated ones; the prior of the start by [initialization].

    Raises:
        ConfigError: states that are none, or that the filter cannot have.
    """
    filt = filter_of(config, measurements_of(config))
    start, entry = config.initialization, FILTERS[filter_name(config)]
    heading_sd = 360.0 / start.hypotheses if start.heading == "unknown" else start.heading_sd_deg
    params = datasheet_params(
        grade, position_sd, velocity_sd, start.tilt_sd_deg * DEG, heading_sd * DEG,
        mounting(lever_arm), entry.theta(), entry.feedback_theta(), filt.model.states,
    )  # fmt: skip
    params = params._replace(adapter=filt.params(grade).adapter)
    return override(with_weights(config, params), as_dict(config))


def states_noise(config: Config) -> bool:
    """Return whether [noise] states the white noise of the IMU, as a tuned.toml does."""
    return any(value is not None for value in vars(config.noise).values())


def with_noise(config: Config, params: Params, filt: Filter, delay_sd: float) -> Config:
    """Return the configuration that states noise, latency and errors of the receiver of a scan, to run it again.

    ``delay_sd``: s, of the latency.
    """
    scales = [f"measurements.{m.name}.scale" for m in GNSS if m.name in filt.model.measurements]
    usual = filter_of(config, measurements_of(config)).model.states
    more = [name for name in filt.model.states if name not in usual]
    slow = [f"states.{name}.{leaf}" for name in more for leaf in params.states[name]._fields]
    found = in_user_units(params, (*NOISE, "mounting.time_offset", *scales, *slow))
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in found.items()}
    states = {"filter.states": (*config.filter.states, *more)} if more else {}
    return changed(config, {"filter.grade": DATASHEET, "filter.delay_sd_s": delay_sd, **states, **values})


def standing_of(config: Config) -> Standing:
    """Return the detector of standstills that [filter] states."""
    f = config.filter
    return Standing(f.standing_window_s, f.standing_accel_sd_mps2, f.standing_gyro_sd_deg_per_s * DEG)


def initialization_of(config: Config, rec: Recording, params: Params) -> Initialization:
    """Return the initialization that [initialization] states."""
    return initialize(rec, params, t_start=config.data.start, **dataclasses.asdict(config.initialization))
