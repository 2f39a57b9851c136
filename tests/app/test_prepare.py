"""From a configuration to parameters and a start: for every filter, and where it is easily wrong."""

import json
import tomllib
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis import evaluate
from jaxnav.app import cli, config, prepare
from jaxnav.app.jobs import tune
from jaxnav.app.unused import unused
from jaxnav.app.verbs import VERBS
from jaxnav.filters import border, epochs
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.parameters import datasheet_params, get, history_for, mounting, put
from jaxnav.filters.run import initial_nav
from jaxnav.filters.standstill import is_driving
from jaxnav.initialization import initialize as alignment
from jaxnav.io.toml import to_toml
from jaxnav.maths import earth
from jaxnav.measurements import counted_from
from jaxnav.navigation import Solution
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError, DataError, Epoch, ImuLog, Info, Recording, Samples, Track, sample_rows
from tuning.fit.transforms import join, labels, split
from tuning.recordings import parts, runs
from tuning.recordings.priors import spec_of


def resolved(**sections) -> config.Config:
    return config.resolve([("", sections)])


def params_of(c: config.Config):
    return prepare.base_params(c, GRADES["adis16465"], np.zeros(3), 1.0, 0.1)


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_has_its_parameters_and_tunes_them_by_default(name):
    params, entry = params_of(resolved(filter={"name": name})), FILTERS[name]
    assert jax.tree.structure(params.feedback) == jax.tree.structure(entry.feedback_theta())
    filt = build(name)
    spec = spec_of(filt, params, tune.free_of(resolved(), filt, params, tune.FREE_SIMULATED).leaves)
    leaves = {leaf for leaf in spec if leaf.startswith("rule.")}
    assert leaves == {f"rule.{leaf}" for leaf in entry.tunable}
    # what tuning moves can be written, read back, and is what the filter then has
    raw = split(spec, params)
    names = labels(spec, raw)
    assert len(set(names)) == sum(np.size(value) for value in raw.values())
    moved = join(spec, {leaf: value + 0.1 for leaf, value in raw.items()}, params)
    text = to_toml(border.nested(border.in_user_units(moved, list(spec))) | {"filter": {"name": name}})
    again = params_of(config.resolve([("", tomllib.loads(text))]))
    for leaf in spec:
        np.testing.assert_allclose(get(again, leaf), get(moved, leaf), rtol=1e-14)


@pytest.mark.parametrize(
    "name, rule, words",
    [("fwekf", {"system.centre": 1.0}, "'centre' is not one of"), ("ekf15", {"knee": 1.0}, "no parameter 'rule.knee'"),
     ("ekf15_huber", {"knee": [1.0, 2.0]}, "of shape"), ("ekf15_huber", {"knee": "x"}, "rule.knee"),
     ("ekf15_huber", {"knee": float("inf")}, "must be finite")],
)  # fmt: skip
def test_wrong_parameters_of_a_rule_are_named(name, rule, words):
    with pytest.raises(ConfigError, match=words):
        params_of(resolved(filter={"name": name}, rule=rule))


def test_a_frozen_parameter_has_no_prior():
    filt, job = build("ekf15"), resolved(tune={"free": ["noise"], "prior": {"measurements.velocity.scale": 2.0}})
    with pytest.raises(ConfigError, match="tune.prior: measurements.velocity.scale is not in tune.free"):
        tune.free_of(job, filt, params_of(resolved()), tune.FREE_RECORDED)


def test_a_filter_with_an_observer_runs_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    flags = ["--set", "out.figures=none", "--set", "data.options.duration_s=30", "--json"]
    assert cli.main(["filter", "--data", "urban_short", "--filter", "fwekf", "--out", "f", *flags]) == 0
    assert "nis_per_dof" in capsys.readouterr().out


def test_a_further_source_has_its_own_presets_and_the_users_settings():
    drive = {"source": "rtkexplorer_drive", "stop": 300.0}
    first = resolved(data=drive, initialization={"tilt_sd_deg": 7.0}, noise={"gyro_deg_per_sqrt_hour": 0.4})
    assert "zero_velocity" in first.filter.measurements and first.measurements.velocity.latency_s == 0.125
    town = config.for_source(first, "urban")
    assert (
        town.data == config.Data(source="urban")
        and "zero_velocity" not in town.filter.measurements
        and not town.filter.grade
    )
    assert not town.measurements.velocity.latency_s
    assert town.noise.gyro_deg_per_sqrt_hour == 0.4 and town.initialization.tilt_sd_deg == 7.0
    back = config.for_source(town, "rtkexplorer_drive")
    assert (
        back.measurements.velocity.latency_s == 0.125
        and "zero_velocity" in back.filter.measurements
        and back.initialization.tilt_sd_deg == 7.0
    )


def test_a_setting_that_equals_a_default_is_a_setting():
    """The preset of the other source does not take its place."""
    first = resolved(data={"source": "urban"}, initialization={"heading_sd_deg": 5.0})
    assert config.for_source(first, "navego_synthetic").initialization.heading_sd_deg == 5.0
    assert (
        config.for_source(resolved(data={"source": "urban"}), "navego_synthetic").initialization.heading_sd_deg == 1.0
    )


def positions(moves_at: float) -> Samples:
    """200 s at 1 Hz with 3 m of noise: stands, then drives north at 12 m/s."""
    rng, t = np.random.default_rng(0), np.arange(200.0)
    noise = rng.normal(size=(2, 200)) * 3.0
    north = np.where(t > moves_at, 12.0 * (t - moves_at), 0.0)
    lla = np.stack([0.8 + (north + noise[0]) / 6.37e6, 0.2 + noise[1] / 4.4e6, 0 * t], 1)
    return Samples(t, lla, np.full((200, 3), 3.0), np.zeros((200, 3)))


def test_noise_of_positions_is_no_course():
    begin, heading = alignment.course(alignment._differences(positions(120.0)), 5.0)
    assert 120 < begin < 126 and abs(heading) < 0.5
    with pytest.raises(DataError, match="3 sd"):
        alignment.course(alignment._differences(positions(1e9)), 5.0)


@pytest.mark.parametrize("sd", [[1.0, 2.0], -1.0, [1.0, 0.0, 1.0]])
def test_sd_of_the_start_are_one_or_three_positive_numbers(tmp_path, monkeypatch, capsys, sd):
    monkeypatch.chdir(tmp_path)
    setting = f"initialization.position_sd_m={sd}"
    assert cli.main(["filter", "--data", "urban_short", "--out", "f", "--set", setting]) == 2
    assert "initialization.position_sd_m must be one number or 3, > 0" in capsys.readouterr().err


def northward(late: float = 0.0) -> Recording:
    """A minute north at 12 m/s and 10 Hz, fixes and truth at 1 Hz; ``late``: age of a fix at its stamp, in IMU time."""
    t, k = np.arange(0.1, 60.05, 0.1), np.arange(1.0, 60.0)
    track = lambda t: np.stack([0.8 + 12.0 * t / 6.37e6, 0.2 + 0 * t, 100.0 + 0 * t], 1)
    level, three = np.tile([0, 0, -9.81], (t.size, 1)), np.zeros((k.size, 3))
    position = Samples(k, track(k - late), np.full((k.size, 3), 1.0), three)
    velocity = Samples(k, np.tile([0, 12.0, 0], (k.size, 1)), np.full((k.size, 3), 0.1), three)
    truth = Track(k, track(k), velocity.value, three)
    imu = ImuLog(t, np.full(t.size, 0.1), 0 * level, level)
    return Recording("northward", imu, {"position": position, "velocity": velocity}, truth, np.zeros(3))


def started(config, rec: Recording):
    """Where a job starts in a recording."""
    params = prepare.base_params(config, prepare.grade_of(config, None), rec.lever_arm)
    return prepare.initialization_of(config, rec, params)


def starts(origin: float):
    """The starts of a case whose clock is counted from ``origin``."""
    return jax.tree.map(lambda a: a[None], initial_nav(jnp.zeros(3), t=origin))


def test_navigation_starts_where_the_vehicle_is_by_then():
    # its clock drifts by 1 %, so that where the run starts, 29 s before half-time, it is 0.29 s early
    late = {"position": {"latency_s": 0.3}}
    c = resolved(
        mounting={"time_offset_s": 0.39, "clock_drift_ppm": 1e4},
        measurements=late,
        initialization={"heading": "course"},
    )
    nav, on_time = (
        started(c, northward(0.4)).navs,
        started(resolved(initialization={"heading": "course"}), northward()).navs,
    )
    assert float(nav.t[0]) == 1.0 and float(nav.origin.t[0]) == pytest.approx(30.05)
    np.testing.assert_allclose(earth.enu_difference(nav.pos[0], on_time.pos[0]), 0, atol=0.02)


def test_a_start_without_a_velocity_beside_it_is_refused():
    rec = northward()
    velocity = sample_rows(rec.aiding["velocity"], slice(20, None))
    with pytest.raises(DataError, match=r"velocity: none within 2 s of the first position, at 1.000 s: set data.start"):
        started(resolved(initialization={"heading": 0.0}), rec._replace(aiding=rec.aiding | {"velocity": velocity}))


def test_motion_by_the_receiver_is_no_standstill():
    rec, t = northward(), np.array([0.2, 10.0, 30.5, 70.0])
    np.testing.assert_array_equal(is_driving(rec.aiding["velocity"], t), [True, True, True, False])  # the last: far
    slow = rec.aiding["velocity"]._replace(value=np.full((59, 3), 0.3))
    assert not is_driving(slow, t).any()
    c = resolved(
        filter={"measurements": ["position", "velocity", "zero_velocity"]}, initialization={"heading": 0.0}
    )  # a drive without any vibration
    with pytest.raises(ConfigError, match=r"standing_gyro_sd_deg_per_s: 59 of 60 epochs .* the first at 1.000 s"):
        epochs.pack_recording(rec, prepare.measurements_of(c), 0.0, 1.0)
    epochs.pack_recording(rec._replace(aiding=rec.aiding | {"velocity": slow}), prepare.measurements_of(c), 0.0, 1.0)


def test_z_up_is_said_where_motion_levels_and_refused_where_nothing_does():
    rec = northward()
    upside = rec._replace(imu=rec.imu._replace(accel=-rec.imu.accel))
    start = started(resolved(), upside)
    assert "the IMU hangs upside down, or its axes are not forward, right, down" in start.how
    with pytest.raises(DataError, match=r"imu: z of specific force is \+9.8"):
        started(resolved(initialization={"heading": "course"}), upside)


def test_an_outage_lasts_to_the_end_of_the_data():
    rec = northward()
    short = rec._replace(aiding={k: sample_rows(s, slice(None, 40)) for k, s in rec.aiding.items()})
    gaps = lambda rec: Solution.gaps(
        SimpleNamespace(fixes=rec.aiding["position"], packed=SimpleNamespace(t=np.arange(1.0, 61.0)), outages=())
    )
    assert gaps(short) == [(40.0, 60.0)] and gaps(rec) == []


def used_of(rec: Recording, params) -> SimpleNamespace:
    """A recording as tuning uses it, whose clock is counted from 30 s."""
    nav = jax.tree.map(lambda a: a[0], starts(30.0))
    return SimpleNamespace(truth=rec.truth, datasheet=params, nav=nav, packed=SimpleNamespace(t=np.array([90.0])))


def test_the_truth_of_a_tuning_run_is_at_the_time_that_the_clocks_give():
    rec, t, known = northward(), np.array([0.2, 10.0, 30.5, 70.0]), {"time_offset_s": 0.25, "clock_drift_ppm": 1e4}
    used = used_of(rec, params_of(resolved(mounting=known)))
    truth = parts.truth_of(used, t)
    np.testing.assert_array_equal(truth.known, [False, True, True, False])
    north = (np.asarray(truth.lla)[1:3, 0] - 0.8) * 6.37e6
    np.testing.assert_allclose(north, 12.0 * (t[1:3] + 0.25 + 0.01 * (t[1:3] - 30.0)), rtol=1e-9)
    np.testing.assert_allclose(np.asarray(truth.rate)[1:3, 0] * 6.37e6, 12.0, rtol=1e-6)
    late = rec._replace(truth=Track(*(a[-1:] + 1e3 * (i == 0) for i, a in enumerate(rec.truth))))
    assert parts.truth_of(used_of(late, used.datasheet), t) is None


def test_supervised_tuning_sees_the_clocks_apart(monkeypatch):
    """Navigation is right; the truth is met where the offset is, by value and by slope."""
    offset, true = 0.1, 0.35
    t, params = np.arange(5.0, 55.0), params_of(resolved(mounting={"time_offset_s": offset}))
    truth = parts.truth_of(used_of(northward(), params), t)
    pos = jnp.stack([0.8 + 12.0 * (t + true) / 6.37e6, 0.2 + 0 * t, 100.0 + 0 * t], 1)
    nav = counted_from(jax.vmap(initial_nav)(pos)._replace(t=jnp.asarray(t)), 30.0)
    none = jnp.zeros((1, 1))
    info = SimpleNamespace(nav=nav, valid=none > 0, residual=none, ok=jnp.array([True]))
    monkeypatch.setattr(runs, "run", lambda *_: info)
    r = runs.Run(params, (), Epoch((), ()), (), (), (), jnp.ones(t.size, bool), truth)
    loss = runs.loss_of(None, (("rmse", 1.0),), ("mounting.time_offset",))
    at = lambda s: float(loss(put(params, "mounting.time_offset", s), r))
    assert at(offset) == pytest.approx(12.0 * (true - offset) / 3, rel=1e-3) and at(true) < 1e-3
    loss = runs.loss_of(None, (("rmse", 1.0),), ("mounting.time_offset", "mounting.clock_drift"))
    drifting = put(put(params, "mounting.time_offset", true), "mounting.clock_drift", 1e-3)
    error = 12.0 * 1e-3 * np.sqrt(np.mean((t - 30.0) ** 2)) / 3
    assert float(loss(drifting, r)) == pytest.approx(error, rel=1e-3)


def test_a_solution_is_told_at_gnss_time():
    t, none = np.array([10.0, 30.0, 50.0]), jnp.zeros(3)
    nav = counted_from(jax.vmap(initial_nav)(jnp.zeros((3, 3)))._replace(t=jnp.asarray(t)), 30.0)
    info = Info(nav, jnp.zeros((3, 9, 9)), *[none] * 9)
    params = params_of(resolved(mounting={"time_offset_s": 0.25, "clock_drift_ppm": 1e4}))
    np.testing.assert_allclose(evaluate.trace(info, params).track.t, t + [0.05, 0.25, 0.45], rtol=1e-12)


def vector(info, epochs, truth):
    return jnp.ones(2)


def test_an_objective_gives_one_number():
    score = runs.score_of("tests.app.test_prepare:vector")
    with pytest.raises(ConfigError, match=r"'tests.app.test_prepare:vector' must give one number, got shape \(2,\)"):
        score((), SimpleNamespace(epochs=(), truth=None))


def sheet(**timing):
    return datasheet_params(GRADES["consumer"], install=mounting(**timing))


def test_history_covers_what_is_known_and_what_tuning_adds():
    stress = matched_params(SCENARIOS["gipkf_urban_stress"])  # 0.15 s late
    assert history_for(stress, 10.0, 60.0) == 4 and history_for(stress, 100.0, 60.0) == 2 + 16
    assert history_for(stress, 100.0, 60.0, parts.MAX_ADDED_DELAY_S) >= 2 + 100 * (0.15 + parts.MAX_ADDED_DELAY_S)
    assert history_for(sheet(time_offset=-1.0), 100.0, 60.0) == history_for(sheet(), 100.0, 60.0) == 2 + 6
    assert history_for(sheet(clock_drift=-1e-3), 100.0, 60.0) >= 2 + 100 * 0.03


@pytest.mark.parametrize("verb, tree, keys", [
    ("filter", {"data": {"source": "rtkexplorer_drive", "imu_worse_by": 2.0}}, ["data.imu_worse_by"]),
    ("filter", {"filter": {"outages": [[1.0, 2.0]]}, "data": {"imu_worse_by": 2.0, "stop": 9.0}}, []),
    ("tune", {"filter": {"outages": [[1.0, 2.0]]}, "data": {"stop": 9.0}}, ["filter.outages", "data.stop"]),
    ("tune", {"tune": {"method": "lbfgs", "rate": 0.3}, "initialization": {"heading": 3.0}}, ["tune.rate"]),
    ("mc", {"data": {"source": "gipkf_urban"}, "initialization": {"heading": 3.0}}, ["initialization.heading"]),
    ("mc", {"data": {"source": "gipkf_urban"}, "filter": {"cov_stride": 7}}, []),
    ("filter", {"filter": {"name": "ekf9"}, "states": {"gyro_bias": {"tau_s": 9.0}}}, ["states.gyro_bias.tau_s"]),
    ("bakeoff", {"data": {"source": "urban,gipkf_urban"}, "filter": {"cov_stride": 10}}, []),
    ("tune", {"data": {"source": "umn_thor75"}}, []),
])  # fmt: skip
def test_settings_without_effect_are_said(verb, tree, keys):
    assert [line.partition(":")[0] for line in unused(VERBS[verb], resolved(**tree))] == keys


@pytest.mark.parametrize(
    "key", ["noise.gyro_deg_per_sqrt_hour", "mounting.lever_arm_m", "measurements.speed.scale", "rule.ki"]
)
def test_parameters_are_finite(key):
    value = [0.0, np.inf, 0.0] if key == "mounting.lever_arm_m" else np.inf
    with pytest.raises(ConfigError, match=f"{key} must be finite"):
        params_of(resolved(filter={"name": "gpid"}, **border.nested({key: value})))
    walk = params_of(resolved(states={"gyro_bias": {"tau_s": np.inf}}))
    assert np.isinf(walk.states["gyro_bias"].tau).all()


@pytest.mark.full
def test_a_street_is_filtered_by_its_satellites(tmp_path, capsys):
    """From the command line: the states that ranges need are added; the fixes are compared alone."""
    sets = [
        "filter.measurements=['position', 'pseudorange', 'range_rate']", "filter.cov_stride=25", "out.figures=none",
        "data.options.duration_s=70", "filter.grade=consumer",
    ]  # fmt: skip
    argv = ["filter", "--data", "street", "--quiet", "--json", "--out", str(tmp_path / "out")]
    assert cli.main([*argv, *(word for each in sets for word in ("--set", each))]) == 0
    metrics = json.loads(capsys.readouterr().out)["metrics"]
    assert 0.7 < metrics["nis_per_dof"] < 1.4 and metrics["errors"]["horizontal_m"]["rms"] < 10.0
    assert not [f["code"] for f in metrics["findings"] if f["severity"] == "warning"]
    assert any(name.startswith("pseudorange") for name in metrics["innovation_rms"])
    assert not any(name.startswith("position") for name in metrics["innovation_rms"])
