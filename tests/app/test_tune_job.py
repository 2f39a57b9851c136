"""`jaxnav tune` beyond its defaults: scoring with intervals, several sources, resuming, settings that do not fit."""

import json
import tomllib
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.app import cli, config
from jaxnav.app.jobs import tune
from jaxnav.app.long import Long
from jaxnav.app.sources import scenario_of
from jaxnav.filters import border
from jaxnav.filters.catalogue import build
from jaxnav.filters.parameters import datasheet_params
from jaxnav.io.toml import to_toml
from jaxnav.maths.units import DEG_PER_SQRT_HOUR
from jaxnav.measurements import GNSS, ZERO_RATE
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import URBAN
from jaxnav.simulate.simulation import simulate_runs
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError
from tuning.fit.transforms import merged
from tuning.recordings import runs
from tuning.recordings.priors import spec_of
from tuning.simulated import _known, as_runs

SETTINGS = {
    "data": {"source": "urban_short"},
    "filter": {"name": "kf9_simple", "cov_stride": 25},
    "tune": {"runs": 2, "validation_runs": 1, "test_runs": 2, "steps": 2},
    "out": {"figures": "none"},
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


@pytest.mark.full
def test_scoring_says_how_well_each_parameter_is_known(tmp_path, capsys, monkeypatch):
    argv = flags(method="scoring", objective="nll", steps=9, more=["urban_short"],
                 free=["noise", "fixes", "latency"], frozen=[f"{V}.latency_s"],
                 prior={"noise.accel_ug_per_sqrt_hz": 1.01, f"{P}.latency_s": 1e-6})  # fmt: skip
    assert cli.main(argv) == 0
    found = json.loads(capsys.readouterr().out)["metrics"]
    rows = found["parameters"]
    assert set(rows) == {"noise.gyro", "noise.accel", "position.scale", "velocity.scale", "position.latency"}
    for row in rows.values():
        assert row["low"] < row["value"] < row["high"]
    assert rows["noise.accel"]["unit"] == "ug/sqrt(Hz)" and rows["noise.accel"]["prior"] == "within a factor 1.01"
    # a strong prior holds a parameter at the datasheet, and its interval is the prior's
    assert rows["noise.accel"]["value"] == pytest.approx(rows["noise.accel"]["datasheet"], rel=0.02)
    latency = rows["position.latency"]
    assert latency["high"] - latency["low"] == pytest.approx(2 * 1.96e-6, rel=0.1)
    assert 0.5 < rows["position.scale"]["value"] < 2.0 and found["status"] in ("converged", "iteration_limit")
    losses = [row["loss"] for row in map(json.loads, cli.Path("t/history.jsonl").read_text().splitlines())]
    assert losses == sorted(losses, reverse=True)
    assert found["per_window"]["recording"] == 10 * ["urban_short"]  # of 2 + 1 + 2 runs of both sources
    kfgins, navego = (cli.Path(f"t/tuned_{name}").read_text() for name in ("kfgins.yaml", "navego.m"))
    assert "imunoise:" in kfgins and "imu.arw" in navego
    assert cli.main(["filter", "--config", "job.toml", "--params", "t/tuned.toml", "--out", "f", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["metrics"]["nis_per_dof"] > 0
    ran = json.loads(cli.Path("f/run.json").read_text())["config"]
    assert ran["measurements"]["velocity"]["scale"] == pytest.approx(rows["velocity.scale"]["value"], rel=1e-12)


@pytest.mark.parametrize(
    "value",
    [[[1, 0, 0], [0, 1, 0]], [[1, 0], [0, 1], [0, 0]], [[1, 0, 0], [0, 1], [0, 0, 1]], [[]],
     [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], [[1, 0, 0], [0.5, 0, 0], [0, 0, 1]], [[1, 0, 0], [0.5, -1, 0], [0, 0, 1]],
     [[1, 0, 0], ["inf", 1, 0], [0, 0, 1]]],
)  # fmt: skip
def test_a_matrix_in_params_is_a_root(value):
    datasheet = datasheet_params(GRADES["adis16465"])
    section = config.resolve([("", {"noise": {"gyro_deg_per_sqrt_hour": value}})])
    with pytest.raises(ConfigError, match="noise.gyro_deg_per_sqrt_hour as a matrix must be lower triangular, 3 x 3"):
        border.override(datasheet, config.as_dict(section))


def test_a_root_in_params_is_in_users_units():
    L = [[0.1, 0, 0], [-0.05, 0.2, 0], [0, 0.03, 0.3]]
    c = config.resolve([("", {"noise": {"gyro_deg_per_sqrt_hour": L}})])
    params = border.override(datasheet_params(GRADES["adis16465"]), config.as_dict(c))
    np.testing.assert_allclose(params.noise.gyro, np.array(L) * DEG_PER_SQRT_HOUR, rtol=1e-15)
    text = to_toml(border.nested(border.in_user_units(params, ["noise.gyro"])))
    np.testing.assert_allclose(tomllib.loads(text)["noise"]["gyro_deg_per_sqrt_hour"], L, rtol=1e-15)
    with pytest.raises(ConfigError, match="states.gyro_bias.tau_s must be a number or a list of numbers"):
        config.resolve([("", {"states": {"gyro_bias": {"tau_s": L}}})])
    ragged = config.resolve([("", {"noise": {"gyro_deg_per_sqrt_hour": [1, [2, 3]]}})])
    with pytest.raises(ConfigError, match="gyro_deg_per_sqrt_hour as a matrix must be lower triangular"):
        border.override(params, config.as_dict(ragged))


@pytest.mark.full
def test_a_finished_job_resumes_to_itself_and_another_is_refused(capsys):
    assert cli.main(flags(objective="nll")) == 0
    first = json.loads(capsys.readouterr().out)["metrics"]
    assert {p.name for p in cli.Path("t/checkpoint").iterdir()} == {"last.npz", "history.jsonl"}
    assert cli.main([*flags(objective="nll"), "--resume"]) == 0
    assert json.loads(capsys.readouterr().out)["metrics"] == first
    assert cli.main([*flags(objective="nll", rate=0.2), "--resume"]) == 3
    assert "another job" in capsys.readouterr().err


@pytest.mark.full
def test_scores_of_a_lost_run_and_of_a_users_objective(monkeypatch, tmp_path):
    (tmp_path / "mine.py").write_text(
        "def score(info, epochs, truth):\n    return (info.nu**2).sum() + 0 * epochs.fix.sd.sum() + 0 * truth.sum()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    c = resolved()
    scenario, filt = scenario_of(c), build("kf9_simple", cov_stride=25)
    params = tune.simulated_params(c, scenario)
    sims = simulate_runs(run_keys(0, Purpose.TRAIN, np.arange(2)), scenario)
    several = as_runs(filt, sims, params)
    r = jax.tree.map(lambda a: a[0], several)
    loss = runs.loss_of(filt, (("mine:score", 2.0),), ("noise.gyro",))
    assert float(loss(params, r)) > 0
    fix = several.epochs.fix
    far = several._replace(epochs=several.epochs._replace(fix=fix._replace(value=fix.value.at[0, 40, 0].add(0.1))))
    assert np.isinf(float(loss(params, jax.tree.map(lambda a: a[0], far))))
    text = runs.why(filt, params, runs._at([far], 0))
    assert text.startswith("further than") and f"t = {float(sims.truth.t[0, 40]):.3f} s" in text
    # parameters of the source are its own but for what is free
    other = params._replace(noise=params.noise._replace(gyro=jnp.array(1.0), accel=jnp.array(1.0)))
    both = merged(other, params, ("noise.gyro",))
    assert float(both.noise.gyro) == 1.0 and both.noise.accel is params.noise.accel


def free(**changes) -> tune.Free:
    """What a job of an ekf15 frees."""
    filt = build("ekf15", (*GNSS, ZERO_RATE))
    return tune.free_of(resolved(**changes), filt, datasheet_params(GRADES["adis16465"]), tune.FREE_RECORDED)


@pytest.mark.parametrize(
    "changes, words",
    [({"method": "newton"}, "no method 'newton'"), ({"method": "scoring"}, "nll"),
     ({"objective": "nothing:here"}, "cannot be imported"), ({"objective": "nl"}, "did you mean nll"),
     ({"target": "kfgins", "method": "adam"}, "tune.target goes with"), ({"priors": "flat"}, "tune.priors must be")],
)  # fmt: skip
def test_settings_that_do_not_fit_are_named(changes, words):
    with pytest.raises(ConfigError, match=words):
        tune.check(resolved(**changes), True)
    with pytest.raises(ConfigError, match="scoring is for simulated runs"):
        tune.check(resolved(method="scoring", objective="nll"), False)


@pytest.mark.parametrize(
    "changes, words",
    [({"free": ["noise"], "frozen": ["noise"]}, "nothing is left"),
    ({"per_recording": ["gyr"]}, "tune.per_recording: no parameter gyr"),
     ({"prior": {"noise.gyro": 0.5}}, "factor above 1"), ({"prior": {"mounting.time_offset_s": 0.0}}, "above 0"),
     ({"free": ["states.gyro_scale.driving_noise"]}, "gyro_scale.driving_noise: the filter has no state gyro_scale")],
)  # fmt: skip
def test_names_that_free_nothing_are_named(changes, words):
    with pytest.raises(ConfigError, match=words):
        free(**changes)


def test_free_names_less_frozen_ones_with_priors_in_users_units():
    found = free(prior={"noise.gyro": 2.0, "mounting.time_offset_s": 0.05}, frozen=["states.gyro_bias.driving_noise"])
    assert found.leaves[:2] == ["noise.gyro", "noise.accel"] and "states.gyro_bias.driving_noise" not in found.leaves
    assert {f"{P}.scale", f"{V}.latency", "measurements.zero_rate.sd"} <= set(found.leaves)
    assert found.prior_sd == {"noise.gyro": 2.0, "mounting.time_offset": 0.05}
    spec = spec_of(build("ekf15"), datasheet_params(GRADES["adis16465"]), found.leaves[:2], found.prior_sd)
    assert spec["noise.gyro"].prior.sd == pytest.approx(np.log(2)) and spec["noise.gyro"].tie == ()


@pytest.mark.full
@pytest.mark.parametrize(
    "source, name, free, changes",
    [
        ("gpid_circle", "gpid_literal", ["rule"], {"data": {"options": {"duration_s": 80.0}}}),
        pytest.param("fwekf", "fwekf", ["rule"], {}, marks=pytest.mark.slow),
        pytest.param(
            "gipkf_urban",
            "gipkf",
            ["rule.log_rl", "rule.log_rm", "rule.rm_lower"],
            {"tune": {"rate": 0.01}},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_papers_parameters_are_tuned_by_the_command_line(source, name, free, changes, capsys):
    """Gains, memberships, cost weights with couplings: by gradient over simulated runs, judged on others."""
    own = {"data": {"source": source}, "filter": {"name": name, "cov_stride": 10}, "tune": {"free": free, "steps": 3}}
    settings = config.merge(config.merge(SETTINGS, own), changes)
    cli.Path("job.toml").write_text(to_toml(settings))
    assert cli.main(["tune", "--config", "job.toml", "--out", "t", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["metrics"]
    before, after = (found["test"][name]["rms_m"] for name in ("datasheet", "tuned"))
    assert np.isfinite([before, after]).all() and found["status"] == "iteration_limit"
    rows = [json.loads(line)["params"] for line in cli.Path("t/history.jsonl").read_text().splitlines()]
    assert len(rows) == 4  # the start is one
    for leaf in rows[0]:
        assert np.any(np.asarray(rows[-1][leaf]) != np.asarray(rows[0][leaf])), f"{leaf} has not moved"
    if source != "gipkf_urban":  # nothing is hidden: each run counts by its error
        errors = np.array(found["per_window"]["datasheet_m"])[found["per_window"]["test"]]
        assert errors.size == 2 and before == pytest.approx(np.sqrt(np.mean(errors**2)))


def test_the_figure_of_the_search_has_the_simulated_values(tmp_path, monkeypatch):
    """0.2 s of latency, and the noise of the simulated grade, in the units of the names beside them."""
    draw_state = {}
    monkeypatch.setattr(tune.plots, "save", lambda fig, path: None)
    monkeypatch.setattr(tune.plots_stats, "outage_drift", lambda *_, **__: None)
    monkeypatch.setattr(tune.plots_stats, "tuning", lambda history, truth: draw_state.update(truth))
    rows = [{"params": {"noise.gyro": np.full(3, 1e-4)}, "step": 0, "loss": 1.0}]
    runs = SimpleNamespace(known=_known(URBAN._replace(gnss=URBAN.gnss._replace(latency_s=0.2))), windows_hidden=True)
    found = SimpleNamespace(
        parts={"test": np.ones(1, bool)}, chosen="tuned", used=[runs], history=rows,
        trials=dict.fromkeys(("datasheet", "tuned"), SimpleNamespace(drift=np.ones(1))),
    )  # fmt: skip
    tune.draw(tmp_path, tune.Result(found, []), config.Config())
    assert draw_state["measurements.position.latency_s"] == 0.2
    gyro = GRADES[URBAN.imu.grade].arw * URBAN.imu.imu_noise_factor
    assert draw_state["noise.gyro_deg_per_sqrt_hour"] == pytest.approx(gyro / DEG_PER_SQRT_HOUR)


@pytest.mark.full
def test_sources_of_which_one_hides_nothing_are_not_judged_together():
    changes = {"data": {"source": "urban_short"}, "tune": {"more": ["fwekf"]}}
    job = config.resolve([("", config.merge(SETTINGS, changes))])
    with pytest.raises(ConfigError, match="tune.more: scenarios with outages and without"):
        tune.on_scenarios(job, Long(), False, lambda line: None)


@pytest.mark.full
def test_drift_is_asked_for_only_where_something_is_hidden():
    for objective in ({"drift": 1.0}, {"log_drift": 1.0, "rmse": 1.0}):
        changes = {"data": {"source": "fwekf"}, "tune": {"objective": objective}}
        job = config.resolve([("", config.merge(SETTINGS, changes))])
        with pytest.raises(ConfigError, match="drift needs outages"):
            tune.on_scenarios(job, Long(), False, lambda line: None)


def test_notes_name_their_recording_where_there_are_several():
    one, other = SimpleNamespace(name="a", notes="b is assumed"), SimpleNamespace(name="c", notes="")
    assert tune.notes_on([one], ["starts at 3 s"]) == ["starts at 3 s", "b is assumed"]
    assert tune.notes_on([one, other], ["starts at 3 s", "at 4"]) == ["a: starts at 3 s", "a: b is assumed", "c: at 4"]
