"""`jaxnav tune` beyond its defaults: scoring with intervals, several sources, resuming, settings that do not fit."""

import json
import tomllib

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.app import batches, cli, config, objectives, prepare
from jaxnav.app.jobs import tune
from jaxnav.app.sources import scenario_of
from jaxnav.data.toml import to_toml
from jaxnav.filters import border
from jaxnav.filters.parameters import datasheet_params
from jaxnav.maths.units import DEG_PER_SQRT_HOUR
from jaxnav.measurements import GNSS, ZERO_RATE
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError
from tests.conftest import LEAVES
from tuning import uncertainty
from tuning.free import specify
from tuning.transforms import LOG, merged

SETTINGS = {
    "data": {"source": "urban_short"},
    "filter": {"name": "kf9_simple", "cov_stride": 25},
    "tune": {"runs": 2, "validation_runs": 1, "test_runs": 2, "steps": 2, "intervals": False},
    "out": {"figures": False},
}

P, V = "measurements.position", "measurements.velocity"


@pytest.fixture(autouse=True)
def no_cache_no_cwd(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    monkeypatch.chdir(tmp_path)


def resolved(**changes) -> config.Config:
    return config.resolve([("", SETTINGS), ("test", {"tune": changes})])


def flags(**changes) -> list[str]:
    (cli.Path("job.toml")).write_text(to_toml(config.merge(SETTINGS, {"tune": changes})))
    return ["tune", "--config", "job.toml", "--out", "t", "--json"]


def test_scoring_says_how_well_each_parameter_is_known(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(uncertainty, "TOGETHER", 10)  # all directions at once compile once
    argv = flags(method="scoring", objective="nll", steps=9, intervals=True, more=["urban_short"],
                 free=["noise", "fixes", "latency"], frozen=[f"{V}.latency_s"], tied=[f"{P}.scale"],
                 correlated=[f"{V}.scale"],
                 prior={"noise.accel_ug_per_sqrt_hz": 1.01, f"{P}.latency_s": 1e-6})  # fmt: skip
    assert cli.main(argv) == 0
    found = json.loads(capsys.readouterr().out)["metrics"]
    rows = found["parameters"]
    assert set(rows) == {"noise.gyro_deg_per_sqrt_hour", "noise.accel_ug_per_sqrt_hz", f"{P}.scale", f"{P}.latency_s",
                         *(f"{V}.scale[{i}]" for i in ("0", "1", "2", "1,0", "2,0", "2,1"))}  # fmt: skip
    for row in rows.values():
        assert row["low"] < row["value"] < row["high"]
    assert rows["noise.accel_ug_per_sqrt_hz"]["unit"] == "ug/sqrt(Hz)"
    # a strong belief holds a parameter at the datasheet, and its interval is the belief's
    assert rows["noise.accel_ug_per_sqrt_hz"]["ratio"] == pytest.approx(1.0, rel=0.02)
    latency, scale = rows[f"{P}.latency_s"], rows[f"{P}.scale"]
    assert latency["high"] - latency["low"] == pytest.approx(2 * 1.96e-6, rel=0.1)
    assert 0.5 < scale["value"] < 2.0 and scale["identified"]
    assert all(isinstance(text, str) for text in found["identifiability"]) and found["aside"] == []
    losses = [row["loss"] for row in map(json.loads, cli.Path("t/history.jsonl").read_text().splitlines())]
    assert losses == sorted(losses, reverse=True) and found["loss"] == losses[-1]
    assert found["per_window"]["block"] == [0.0, 1.0, 1e6, 1e6 + 1]  # of both sources
    kfgins, navego = (cli.Path(f"t/tuned_{name}").read_text() for name in ("kfgins.yaml", "navego.m"))
    assert "imunoise:" in kfgins and "correlations" not in kfgins
    assert "imu.arw" in navego and "correlations between the axes are left out of velocity_scale" in navego
    # a root is told as the axes' sd and the correlations, and what is written is what a filter runs with
    L = np.array(found["params_after"][f"{V}.scale"])
    assert L.shape == (3, 3) and not np.triu(L, 1).any() and found["params_before"][f"{V}.scale"] == 1.0
    sd = np.linalg.norm(L, axis=1)
    corr = (L @ L.T) / np.outer(sd, sd)
    told = {"0": sd[0], "1": sd[1], "2": sd[2], "1,0": corr[1, 0], "2,0": corr[2, 0], "2,1": corr[2, 1]}
    for index, value in told.items():
        assert rows[f"{V}.scale[{index}]"]["value"] == pytest.approx(value, abs=1e-12)
    of = rows[f"{V}.scale[2,1]"]
    assert of["unit"] == "correlation" and of["datasheet"] == 0 and abs(of["value"]) > 1e-4
    assert cli.main(["filter", "--config", "job.toml", "--params", "t/tuned.toml", "--out", "f", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["metrics"]["nis_per_dof"] > 0
    ran = json.loads(cli.Path("f/run.json").read_text())["config"]
    np.testing.assert_allclose(ran["measurements"]["velocity"]["scale"], L, rtol=1e-15)


@pytest.mark.parametrize(
    "changes, leaves",
    [({"correlated": ["noise", f"{V}.scale"]}, ["gyro", "accel", "gyro_bias", "accel_bias", "velocity_scale"]),
     ({"correlated": ["fixes"], "tied": ["noise"]}, ["position_scale", "velocity_scale"]),
     ({"correlated": ["noise.gyro", "states.accel_bias.driving_noise"], "frozen": ["noise.gyro"]}, ["accel_bias"])],
)  # fmt: skip
def test_correlated_takes_groups_leaves_and_keys(changes, leaves):
    sheet = datasheet_params(GRADES["adis16465"])
    t = resolved(free=["noise", "fixes"], prior={"noise": 2.0}, **changes).tune
    spec = prepare.tune_spec(t, "ekf15", (*GNSS, ZERO_RATE), sheet)
    assert [name for name, transform in spec.items() if transform.axes] == [LEAVES[leaf] for leaf in leaves]
    assert spec["noise.accel"].belief.sd == pytest.approx(np.log(2))


@pytest.mark.parametrize(
    "value",
    [[[1, 0, 0], [0, 1, 0]], [[1, 0], [0, 1], [0, 0]], [[1, 0, 0], [0, 1], [0, 0, 1]], [[]],
     [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], [[1, 0, 0], [0.5, 0, 0], [0, 0, 1]], [[1, 0, 0], [0.5, -1, 0], [0, 0, 1]],
     [[1, 0, 0], ["inf", 1, 0], [0, 0, 1]]],
)  # fmt: skip
def test_a_matrix_in_params_is_a_root(value):
    sheet = datasheet_params(GRADES["adis16465"])
    section = config.resolve([("", {"noise": {"gyro_deg_per_sqrt_hour": value}})])
    with pytest.raises(ConfigError, match="noise.gyro_deg_per_sqrt_hour as a matrix must be lower triangular, 3 x 3"):
        border.override(sheet, config.as_dict(section))


def test_a_root_in_params_is_in_users_units():
    L = [[0.1, 0, 0], [-0.05, 0.2, 0], [0, 0.03, 0.3]]
    c = config.resolve([("", {"noise": {"gyro_deg_per_sqrt_hour": L}})])
    params = border.override(datasheet_params(GRADES["adis16465"]), config.as_dict(c))
    np.testing.assert_allclose(params.noise.gyro, np.array(L) * DEG_PER_SQRT_HOUR, rtol=1e-15)
    text = to_toml(border.nested(border.in_user_units(params, ["noise.gyro"])))
    np.testing.assert_allclose(tomllib.loads(text)["noise"]["gyro_deg_per_sqrt_hour"], L, rtol=1e-15)
    with pytest.raises(ConfigError, match="states.gyro_bias.tau_s must be a number or a list of numbers"):
        config.resolve([("", {"states": {"gyro_bias": {"tau_s": L}}})])
    with pytest.raises(ConfigError, match="position.scale must be .* a list of .a list of numbers"):
        config.resolve([("", {"measurements": {"position": {"scale": [1, [2, 3]]}}})])


def test_a_finished_job_resumes_to_itself_and_another_is_refused(capsys):
    assert cli.main(flags(objective="nll", patience=5)) == 0
    first = json.loads(capsys.readouterr().out)["metrics"]
    assert {p.name for p in cli.Path("t/checkpoint").iterdir()} == {"last.npz", "history.jsonl"}
    assert cli.main([*flags(objective="nll", patience=5), "--resume"]) == 0
    assert json.loads(capsys.readouterr().out)["metrics"] == first
    assert cli.main([*flags(objective="nll", patience=6), "--resume"]) == 3
    assert "another job" in capsys.readouterr().err


def test_what_a_lost_run_and_a_users_own_objective_score(monkeypatch, tmp_path):
    (tmp_path / "mine.py").write_text(
        "def score(info, epochs, truth):\n    return (info.nu**2).sum() + 0 * epochs.fix.sd.sum() + 0 * truth.sum()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    c = resolved()
    m = batches.from_scenario(c, scenario_of(c))
    case = objectives.TuningCase(m.train, tune._many(m.params, m.train))
    one = lambda tree: tune.jax.tree.map(lambda a: a[0], tree)
    loss = objectives.objective(m.filter, (("mine:score", 2.0),), ("noise.gyro",))
    assert float(loss(m.params, one(case))) > 0
    far = m.train._replace(epochs=m.train.epochs._replace(
        fix=m.train.epochs.fix._replace(value=m.train.epochs.fix.value.at[0, 40, 0].add(0.1))))  # fmt: skip
    lost = objectives.TuningCase(far, case.own)
    assert np.isinf(float(loss(m.params, one(lost))))
    text = tune.why([m._replace(train=far)], m.params, (), 0)
    assert text.startswith("further than") and f"t = {m.t_train[40]:.3f} s" in text
    # parameters of the source are its own but for what is free
    other = m.params._replace(noise=m.params.noise._replace(gyro=jnp.array(1.0), accel=jnp.array(1.0)))
    both = merged(other, m.params, ("noise.gyro",))
    assert float(both.noise.gyro) == 1.0 and both.noise.accel is m.params.noise.accel
    again = [m.redraw(step) for step in (3, 3, 4)]
    np.testing.assert_array_equal(again[0].epochs.fix.value, again[1].epochs.fix.value)
    assert not np.array_equal(again[0].epochs.fix.value, again[2].epochs.fix.value)
    assert not np.array_equal(again[0].epochs.fix.value, m.train.epochs.fix.value)


@pytest.mark.parametrize(
    "changes, words",
    [({"method": "newton"}, "no method 'newton'"), ({"method": "scoring"}, "nll"), ({"over_runs": "median"}, "no way"),
     ({"over_runs": "log_mean"}, "positive objectives"),
     ({"objective": "nothing:here"}, "cannot be imported"), ({"objective": "nl"}, "did you mean nll"),
     ({"frozen": ["noise", "timing", "rule"]}, "nothing is left"), ({"tied": ["gyr"]}, "tune.tied"),
     ({"prior": {"noise.gyro": 0.5}}, "factor above 1"), ({"prior": {"mounting.time_offset_s": 0.0}}, "above 0"),
     ({"correlated": ["mounting.time_offset_s"]}, "mounting.time_offset_s cannot be correlated, only noise.gyro_deg"),
     ({"free": ["states.gyro_scale.driving_noise"]}, "gyro_scale.driving_noise: the filter has no state gyro_scale"),
     ({"correlated": ["timing"]}, "timing cannot be correlated"), ({"correlated": ["gyr"]}, "no parameter gyr"),
     ({"correlated": ["noise"], "tied": ["noise.accel"]}, "tune.correlated: noise.accel is in tune.tied")],
)  # fmt: skip
def test_settings_that_do_not_fit_are_named(changes, words):
    with pytest.raises(ConfigError, match=words):
        tune.check(resolved(**changes))


def test_beliefs_and_ties_in_users_units():
    sheet = datasheet_params(GRADES["adis16465"])
    t = resolved(prior={"noise.gyro": 2.0, "mounting.time_offset_s": 0.05}, tied=[f"{V}.scale"],
                 free=["noise", "fixes", "timing"]).tune  # fmt: skip
    spec = prepare.tune_spec(t, "ekf15", GNSS, sheet)
    assert spec["noise.gyro"].belief.sd == pytest.approx(np.log(2)) and spec["noise.gyro"].forward is LOG.forward
    assert spec["noise.gyro"].belief.centre == (pytest.approx(GRADES["adis16465"].arw),)
    assert spec["mounting.time_offset"].belief.sd == pytest.approx(0.5)  # its raw unit is 0.1 s
    assert spec[f"{V}.scale"].tie == () and spec[f"{P}.scale"].tie is None


def test_starts_are_spread_and_the_same_for_a_seed():
    c = resolved(starts=4, spread=2.0)
    params = datasheet_params(GRADES["adis16465"])
    spec = specify("ekf15", GNSS, params, free=("noise",))
    found, again = (tune.starts(c, spec, params) for _ in range(2))
    ratios = np.log([float(p.noise.gyro / params.noise.gyro) for p in found])
    assert len(found) == 3 and 0 < np.abs(ratios).max() < 4 * np.log(2)
    np.testing.assert_array_equal(ratios, np.log([float(p.noise.gyro / params.noise.gyro) for p in again]))


@pytest.mark.parametrize(
    "source, name, free, changes",
    [
        ("gpid_circle", "gpid_literal", ["rule"], {"data": {"options": {"duration_s": 80.0}}}),
        ("fwekf", "fwekf", ["rule"], {}),
        ("gipkf_urban", "gipkf", ["rule.log_rl", "rule.log_rm", "rule.rm_lower"], {"tune": {"rate": 0.01}}),
    ],
)
def test_what_the_papers_are_about_is_tuned_by_the_command_line(source, name, free, changes, capsys):
    """Gains, memberships, cost weights with couplings: by gradient over simulated runs, judged on others."""
    own = {"data": {"source": source}, "filter": {"name": name, "cov_stride": 10}, "tune": {"free": free, "steps": 3}}
    settings = config.merge(config.merge(SETTINGS, own), changes)
    cli.Path("job.toml").write_text(to_toml(settings))
    assert cli.main(["tune", "--config", "job.toml", "--out", "t", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["metrics"]
    what = "outage" if source == "gipkf_urban" else "run"
    before, after = (found[part][f"{what}_rms_m"] for part in ("before", "after"))
    assert np.isfinite([before, after]).all() and found["steps"] == 4  # the start is one
    rows = [json.loads(line)["params"] for line in cli.Path("t/history.jsonl").read_text().splitlines()]
    for leaf in rows[0]:
        assert np.any(np.asarray(rows[-1][leaf]) != np.asarray(rows[0][leaf])), f"{leaf} has not moved"
    if what == "run":  # each counts by its own error, and the runs are what is drawn for the interval
        errors = np.array(found["per_window"]["before_m"])
        assert before == pytest.approx(np.sqrt(np.mean(errors**2))) and found["per_window"]["block"] == [0.0, 1.0]


def test_sources_of_which_one_hides_nothing_are_not_judged_together():
    changes = {"data": {"source": "urban_short"}, "tune": {"more": ["fwekf"]}}
    job = config.resolve([("", config.merge(SETTINGS, changes))])
    with pytest.raises(ConfigError, match="tune.more: sources with outages and without"):
        tune.with_objective(job, tune.prepare(job))


def test_drift_is_asked_for_only_where_something_is_hidden():
    scenario = scenario_of(config.resolve([("", config.merge(SETTINGS, {"data": {"source": "fwekf"}}))]))
    assert not scenario.gnss.outages_s
    for objective in ({"drift": 1.0}, {"log_drift": 1.0, "rmse": 1.0}):
        changes = {"data": {"source": "fwekf"}, "tune": {"objective": objective}}
        job = config.resolve([("", config.merge(SETTINGS, changes))])
        with pytest.raises(ConfigError, match="drift needs outages"):
            tune.with_objective(job, tune.prepare(job))
