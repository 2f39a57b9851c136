"""From a configuration to parameters and a start: for every filter, and where it is easily wrong."""

import tomllib

import jax
import numpy as np
import pytest

from jaxnav import alignment, cli, config, plots_stats
from jaxnav.errors import ConfigError, DataError
from jaxnav.filters.catalogue import FILTERS
from jaxnav.jobs import parameters, prepare, tune_report
from jaxnav.measurements import GNSS
from jaxnav.sensors.grades import GRADES
from jaxnav.toml import to_toml
from jaxnav.types import Samples
from tuning.transforms import get, join, labels, split


def resolved(**sections) -> config.Config:
    return config.resolve([("", sections)])


def params_of(c: config.Config):
    return prepare.base_params(c, GRADES["adis16465"], np.zeros(3), 1.0, 0.1)


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_has_its_parameters_and_tunes_them_by_default(name):
    params, entry = params_of(resolved(filter={"name": name})), FILTERS[name]
    assert jax.tree.structure(params.feedback) == jax.tree.structure(entry.feedback_theta())
    spec = parameters.tune_spec(resolved().tune, name, GNSS, params)
    leaves = {leaf for leaf in spec if leaf.startswith("rule.")}
    assert leaves == {f"rule.{leaf}" for leaf in entry.tunable} - ({"rule.kd"} if name == "gpid_literal" else set())
    # what tuning moves can be written, read back, and is what the filter then has
    raw = split(spec, params)
    names = labels(spec, raw)
    assert len(set(names)) == sum(np.size(value) for value in raw.values())
    moved = join(spec, {leaf: value + 0.1 for leaf, value in raw.items()}, params)
    text = to_toml({"params": parameters.in_user_units(moved, list(spec)), "filter": {"name": name}})
    again = params_of(config.resolve([("", tomllib.loads(text))]))
    for leaf in spec:
        np.testing.assert_allclose(get(again, leaf), get(moved, leaf), rtol=1e-14)


def test_a_table_is_shown_whole_and_a_root_without_its_zeros():
    table, root = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0], [0.0, 1.0, 2.0]], [[1.0, 0.0], [2.0, 3.0]]
    for value, text, n in ((table, "[1, 2, 3; 4, 5, 6; 7, 8, 9; 0, 1, 2]", 12), (root, "[1; 2, 3]", 3)):
        assert tune_report._short(value) == text
        assert plots_stats._components(value).size == n


@pytest.mark.parametrize(
    "name, rule, words",
    [("fwekf", {"system.centre": 1.0}, "'centre' is not one of"), ("ekf15", {"knee": 1.0}, "no parameter 'rule.knee'"),
     ("ekf15_huber", {"knee": [1.0, 2.0]}, "of shape"), ("ekf15_huber", {"knee": "x"}, "params.rule.knee"),
     ("ekf15_huber", {"knee": float("inf")}, "must be finite")],
)  # fmt: skip
def test_wrong_parameters_of_a_rule_are_named(name, rule, words):
    with pytest.raises(ConfigError, match=words):
        params_of(resolved(filter={"name": name}, params={"rule": rule}))


@pytest.mark.parametrize("key", ["tied", "correlated", "prior"])
def test_what_is_not_free_cannot_be_tied_correlated_or_believed(key):
    value = {"velocity_scale": 2.0} if key == "prior" else ["velocity_scale"]
    tune = resolved(tune={"free": ["noise"], key: value}).tune
    with pytest.raises(ConfigError, match=f"tune.{key}: velocity_scale is not in tune.free"):
        parameters.tune_spec(tune, "ekf15", GNSS, params_of(resolved()))


def test_a_filter_with_an_observer_runs_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    flags = ["--set", "out.figures=false", "--set", "data.options.duration_s=30", "--json"]
    assert cli.main(["filter", "--data", "urban_short", "--filter", "fwekf", "--out", "f", *flags]) == 0
    assert "nis_per_dof" in capsys.readouterr().out


def test_a_further_source_has_its_own_presets_and_the_users_settings():
    drive = {"source": "rtkexplorer_drive", "stop": 300.0}
    first = resolved(data=drive, start={"tilt_sd_deg": 7.0}, params={"gyro_deg_per_sqrt_hour": 0.4})
    assert first.filter.zero_velocity and first.params.time_offset_s == 0.175
    town = config.for_source(first, "urban")
    assert town.data == config.Data(source="urban") and not town.filter.zero_velocity and not town.filter.grade
    assert town.params.time_offset_s is None
    assert town.params.gyro_deg_per_sqrt_hour == 0.4 and town.start.tilt_sd_deg == 7.0
    back = config.for_source(town, "rtkexplorer_drive")
    assert back.data.options == {"imu_delay": -0.3} and back.filter.zero_velocity and back.start.tilt_sd_deg == 7.0


def positions(moves_at: float) -> Samples:
    """200 s at 1 Hz with 3 m of noise: stands, then drives north at 12 m/s."""
    rng, t = np.random.default_rng(0), np.arange(200.0)
    noise = rng.normal(size=(2, 200)) * 3.0
    north = np.where(t > moves_at, 12.0 * (t - moves_at), 0.0)
    lla = np.stack([0.8 + (north + noise[0]) / 6.37e6, 0.2 + noise[1] / 4.4e6, 0 * t], 1)
    return Samples(t, lla, np.full((200, 3), 3.0), np.zeros((200, 3)))


def test_noise_of_positions_is_no_course():
    begin, heading = alignment.course(prepare._differences(positions(120.0)), 5.0)
    assert 120 < begin < 126 and abs(heading) < 0.5
    with pytest.raises(DataError, match="3 sd"):
        alignment.course(prepare._differences(positions(1e9)), 5.0)


@pytest.mark.parametrize("sd", [[1.0, 2.0], -1.0, [1.0, 0.0, 1.0]])
def test_sd_of_the_start_are_one_or_three_positive_numbers(tmp_path, monkeypatch, capsys, sd):
    monkeypatch.chdir(tmp_path)
    setting = f"start.position_sd_m={sd}"
    assert cli.main(["filter", "--data", "urban_short", "--out", "f", "--set", setting]) == 2
    assert "start.position_sd_m must be one number or 3, > 0" in capsys.readouterr().err
