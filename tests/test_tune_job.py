"""`jaxnav tune` beyond its defaults: scoring with intervals, several sources, resuming, settings that do not fit."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import cli, config
from jaxnav.errors import ConfigError
from jaxnav.jobs import batches, objectives, parameters, tune
from jaxnav.jobs.sources import scenario_of
from jaxnav.measurements import GNSS
from jaxnav.sensors.grades import GRADES, datasheet_params
from tuning.transforms import LOG

SETTINGS = {
    "data": {"source": "urban_short"},
    "filter": {"name": "kf9_simple", "cov_stride": 25},
    "tune": {"runs": 2, "validation_runs": 1, "test_runs": 2, "steps": 2, "intervals": False},
    "out": {"figures": False},
}


@pytest.fixture(autouse=True)
def no_cache_no_cwd(monkeypatch, tmp_path):
    monkeypatch.setenv(cli.CACHE, "")
    monkeypatch.chdir(tmp_path)


def resolved(**changes) -> config.Config:
    return config.resolve([("", SETTINGS), ("test", {"tune": changes})])


def flags(**changes) -> list[str]:
    (cli.Path("job.toml")).write_text(config.to_toml(config.merge(SETTINGS, {"tune": changes})))
    return ["tune", "--config", "job.toml", "--out", "t", "--json"]


def test_scoring_says_how_well_each_parameter_is_known(tmp_path, capsys):
    argv = flags(method="scoring", objective="nll", steps=12, intervals=True, more=["urban_short"],
                 free=["noise", "fixes", "latency"], frozen=["velocity_latency_s"], tied=["position_scale"],
                 prior={"accel_ug_per_sqrt_hz": 1.01, "position_latency_s": 1e-6})  # fmt: skip
    assert cli.main(argv) == 0
    found = json.loads(capsys.readouterr().out)["metrics"]
    rows = found["parameters"]
    assert set(rows) == {"gyro_deg_per_sqrt_hour", "accel_ug_per_sqrt_hz", "position_scale", "position_latency_s",
                         "velocity_scale[0]", "velocity_scale[1]", "velocity_scale[2]"}  # fmt: skip
    for row in rows.values():
        assert row["low"] < row["value"] < row["high"]
    assert rows["accel_ug_per_sqrt_hz"]["unit"] == "ug/sqrt(Hz)"
    # a strong belief holds a parameter at the datasheet, and its interval is the belief's
    assert rows["accel_ug_per_sqrt_hz"]["ratio"] == pytest.approx(1.0, rel=0.02)
    assert rows["position_latency_s"]["high"] - rows["position_latency_s"]["low"] == pytest.approx(2 * 1.96e-6, rel=0.1)
    assert 0.5 < rows["position_scale"]["value"] < 2.0 and rows["position_scale"]["identified"]
    assert all(isinstance(text, str) for text in found["identifiability"]) and found["aside"] == []
    losses = [row["loss"] for row in map(json.loads, cli.Path("t/history.jsonl").read_text().splitlines())]
    assert losses == sorted(losses, reverse=True) and found["loss"] == losses[-1]
    assert found["per_window"]["block"] == [0.0, 1.0, 1e6, 1e6 + 1]  # of both sources
    assert "imunoise:" in cli.Path("t/tuned_kfgins.yaml").read_text()
    assert "imu.arw" in cli.Path("t/tuned_navego.m").read_text()


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
    case = objectives.Case(m.train, tune._many(m.params, m.train))
    one = lambda tree: tune.jax.tree.map(lambda a: a[0], tree)  # noqa: E731
    loss = objectives.objective(m.filter, (("mine:score", 2.0),), ("noise.gyro",))
    assert float(loss(m.params, one(case))) > 0
    far = m.train._replace(epochs=m.train.epochs._replace(
        fix=m.train.epochs.fix._replace(value=m.train.epochs.fix.value.at[0, 40, 0].add(0.1))))  # fmt: skip
    lost = objectives.Case(far, case.own)
    assert np.isinf(float(loss(m.params, one(lost))))
    text = tune.why([m._replace(train=far)], m.params, (), 0)
    assert text.startswith("further than") and f"t = {m.t_train[40]:.3f} s" in text
    # parameters of the source are its own but for what is free
    other = m.params._replace(noise=m.params.noise._replace(gyro=jnp.array(1.0), accel=jnp.array(1.0)))
    both = objectives.merged(other, m.params, ("noise.gyro",))
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
     ({"prior": {"noise.gyro": 0.5}}, "factor above 1"), ({"prior": {"time_offset_s": 0.0}}, "above 0")],
)  # fmt: skip
def test_settings_that_do_not_fit_are_named(changes, words):
    with pytest.raises(ConfigError, match=words):
        tune.check(resolved(**changes))


def test_beliefs_and_ties_in_users_units():
    sheet = datasheet_params(GRADES["adis16465"])
    t = resolved(prior={"noise.gyro": 2.0, "time_offset_s": 0.05}, tied=["velocity_scale"],
                 free=["noise", "fixes", "timing"]).tune  # fmt: skip
    spec = parameters.tune_spec(t, "ekf15", GNSS, sheet)
    assert spec["noise.gyro"].belief.sd == pytest.approx(np.log(2)) and spec["noise.gyro"].forward is LOG.forward
    assert spec["noise.gyro"].belief.centre == (pytest.approx(GRADES["adis16465"].arw),)
    assert spec["mounting.time_offset"].belief.sd == pytest.approx(0.5)  # its raw unit is 0.1 s
    assert spec["noise.velocity_scale"].tie == () and spec["noise.position_scale"].tie is None


def test_starts_are_spread_and_the_same_for_a_seed():
    c = resolved(starts=4, spread=2.0)
    params = datasheet_params(GRADES["adis16465"])
    spec = parameters.free_spec(("noise",), "ekf15", GNSS)
    found, again = (tune.starts(c, spec, params) for _ in range(2))
    ratios = np.log([float(p.noise.gyro / params.noise.gyro) for p in found])
    assert len(found) == 3 and 0 < np.abs(ratios).max() < 4 * np.log(2)
    np.testing.assert_array_equal(ratios, np.log([float(p.noise.gyro / params.noise.gyro) for p in again]))
