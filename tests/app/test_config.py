"""Configuration: layers, types, messages, and the way back to TOML and run.json."""

import dataclasses
import json
import re
import tomllib

import pytest

from jaxnav.app import config
from jaxnav.io.toml import to_toml
from jaxnav.types import ConfigError


def resolve(*settings, **tree):
    return config.resolve([("file", tree), *((f"--set {s}", config.parse_set(s)) for s in settings)])


def test_layers_later_wins():
    c = resolve("filter.name=gpid", filter={"name": "ekf9", "grade": "tactical"})
    assert (c.filter.name, c.filter.grade, c.filter.cov_stride) == ("gpid", "tactical", config.Filter().cov_stride)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("seed=3", 3),
        ("filter.smooth=true", True),
        ("filter.interval_s=1", 1.0),
        ("filter.outages=[[1, 2], [3.5, 4]]", ((1.0, 2.0), (3.5, 4.0))),
        ("initialization.heading=90", 90.0),
        ("initialization.heading=unknown", "unknown"),
        ("initialization.position_sd_m=[1, 2, 3]", (1.0, 2.0, 3.0)),
        ("states.gyro_bias.tau_s=inf", float("inf")),
        ("tune.objective=nll", {"nll": 1.0}),
        ("tune.objective={drift = 1, nll = 0.1}", {"drift": 1.0, "nll": 0.1}),
        ("tune.free=['noise', 'mounting.lever_arm']", ("noise", "mounting.lever_arm")),
        ("data.source=/some/folder", "/some/folder"),
        ("data.source='inf'", "inf"),
        ("tune.free=['inf']", ("inf",)),
        ("data.options.imu=imu1", {"imu": "imu1"}),
    ],
)
def test_set_takes_toml_values_and_types(setting, value):
    found, keys = resolve(setting), setting.partition("=")[0].split(".")
    for key in keys if keys[:2] != ["data", "options"] else keys[:2]:
        found = getattr(found, key)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("filter.nam=3", "unknown key filter.nam: did you mean filter.name?"),
        ("filtr.name=3", "unknown key filtr: did you mean filter?"),
        ("filter.tilt_sd_deg=3", "did you mean initialization.tilt_sd_deg?"),
        ("filter.cov_stride=1.5", "filter.cov_stride must be a whole number in .*, got 1.5"),
        ("filter.smooth=1", "filter.smooth must be true or false, got 1"),
        ("tune.steps=true", "tune.steps must be a whole number in .*, got True"),
        ("initialization.tilt_sd_deg=nan", "initialization.tilt_sd_deg must be a number"),
        ("filter=3", r"\[filter\] is a section"),
        ("seed=-1", r"seed must be a whole number in \[0, 4294967295\], got -1"),
        ("filter.cov_stride=0", r"filter.cov_stride must be a whole number in \[1, 1000\], got 0"),
        (
            "tune.hidden_satellites=15",
            r"must be a whole number in \[0, 14\] or a list of whole numbers in \[0, 14\], got 15",
        ),
        ("measurements.barometer.latency_s=11", r"latency_s must be a number in \[-10, 10\], got 11"),
        ("filter.outages=[[1, 'a']]", "filter.outages must be a list of lists of numbers, got"),
        ("filter.name", "--set takes a.b=value"),
        (".=1", "--set takes a.b=value"),
    ],
)
def test_messages_name_the_key_and_the_nearest(setting, message):
    with pytest.raises(ConfigError, match=message):
        resolve(setting)


def test_file_errors_name_file_and_line(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("seed = 1\n\n[filter]\nname = 'ekf9'\n\n[tune]\nstep = 3\n")
    with pytest.raises(ConfigError, match=r"c.toml: line 7: unknown key tune.step: did you mean tune.steps\?"):
        config.read(file)
    file.write_text("[filter]\nsmooth = 'yes'\n")
    with pytest.raises(ConfigError, match="c.toml: line 2: filter.smooth must be true or false, got 'yes'"):
        config.read(file)
    file.write_text("[filter\n")
    with pytest.raises(ConfigError, match="c.toml: .*line 1"):
        config.read(file)
    with pytest.raises(ConfigError, match="none.toml: cannot be read"):
        config.read(tmp_path / "none.toml")


def test_resolved_goes_through_toml_and_run_json(tmp_path):
    settings = [
        "filter.outages=[[1, 2]]",
        "states.gyro_bias.tau_s=inf",
        "data.options.imu='imu1'",
        "initialization.heading=30",
    ]
    c = resolve(*settings, "mounting.lever_arm_m=[0, 1, -2]", "tune.objective={nll = 1}")
    assert config.resolve([("toml", tomllib.loads(to_toml(config.as_dict(c))))]) == c
    run = tmp_path / "run.json"
    run.write_text(json.dumps({"config": config.as_dict(c)}))
    assert config.resolve([("run", config.read(run))]) == c
    run.write_text("[]")
    with pytest.raises(ConfigError, match="run.json"):
        config.read(run)


def test_presets_lie_under_the_users_settings():
    assert resolve("data.source=rtkexplorer_drive").measurements.velocity.latency_s == 0.125
    stated = resolve("data.source=rtkexplorer_drive", measurements={"velocity": {"latency_s": 0.0}})
    assert stated.measurements.velocity.latency_s == 0.0 and stated.filter.standing_window_s == 2.0
    for name, dataset in config.DATASETS.items():
        assert config.resolve([("", dataset.settings)]), name


def test_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.Config().seed = 3


@pytest.mark.parametrize(
    "setting, bound",
    [("tune.runs=0", "[1, "), ("mc.runs=0", "[1, "), ("mc.chunk=0", "[1, "), ("tune.validation_runs=0", "[1, "),
     ("tune.outage_s=-1", "[0, "), ("tune.steps=-1", "[0, "), ("filter.lag_s=-1", "[0, "),
     ("mc.limit_m=-1", "[0.001, ")],
)  # fmt: skip
def test_numbers_that_mean_nothing_are_refused_with_their_bounds(setting, bound):
    key = setting.partition("=")[0]
    with pytest.raises(ConfigError, match=f"{key} must be a (whole )?number in {re.escape(bound)}"):
        config.resolve([("--set", config.parse_set(setting))])
