"""A bake-off tunes alike, ranks what is better as better, keeps what is finished, and refuses what is not known.

The filters are a toy of one number, whose best setting has a closed form: real ones take a minute each to compile.
"""

import json
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.app import cli
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.run import initial_nav
from jaxnav.simulate.scenarios import CIRCLE, GIPKF, SCENARIOS
from jaxnav.simulate.simulation import matched_params
from jaxnav.states.table import BIASES
from jaxnav.types import Epoch, Fix, Imu, Info
from tuning import contest, contest_report
from tuning.contest import ContestRuns, Kind, Plan
from tuning.fit.status import Status
from tuning.fit.train import Fit
from tuning.fit.transforms import labels, split
from tuning.recordings.validation import paired_ratio

E, METRES = 30, 1e-7  # epochs; rad of latitude a metre, nearly
SD = {"ekf9": 6.0, "ekf15": 3.0, "gpid": 1.5}  # m, of the fixes that each toy sees
BUDGET = {"steps": 15, "rate": 0.3, "runs": (3, 2, 6)}


@cache
def toy(name: str) -> Filter:
    """Height by a constant gain g = q / (1 + q), of a fix that scatters by the filter's own sd about zero."""

    def step(params, state, epoch):
        gain = params.noise.gyro / (1 + params.noise.gyro)
        height = state[0] + gain * (SD[name] * epoch.fix.value[2] - state[0])
        ok = state[1] & (epoch.fix.value[3] == 0)
        height = jnp.where(ok, height, state[0])
        nav = initial_nav(jnp.stack([jnp.zeros(()), jnp.zeros(()), height]))
        zero, eye = jnp.zeros(6), jnp.eye(6)
        flags = jnp.ones(6, bool)
        nothing = jnp.zeros(())
        return (height, ok), Info(nav, jnp.eye(9), jnp.zeros(9), zero, eye, zero, flags, flags, nothing, ok, nothing)

    def advance(params, state, epoch):
        after, info = step(params, state, epoch)
        return Step(state, state, None, after, info, jnp.zeros(9))

    start = lambda params, nav: (nav.pos[2], jnp.array(True))
    return Filter(start, None, None, step, build("ekf9").model, lambda epochs: epochs, None, advance)


def toy_runs(plan: Plan) -> contest.Runs:
    """Fixes of unit noise, the same for all kinds; the last kind's truth is 40 m up."""

    def case(i: int, runs: int, seed: int) -> ContestRuns:
        value = jnp.zeros((runs, E, 6)).at[:, :, 2].set(np.random.default_rng(seed).normal(size=(runs, E)))
        fix = Fix(value, jnp.ones_like(value), jnp.zeros_like(value), jnp.ones(value.shape, bool))
        imu = Imu(jnp.ones((runs, E, 1)), *(jnp.zeros((runs, E, 1, 3)) for _ in range(2)))
        nav = jax.tree.map(lambda a: jnp.broadcast_to(a, (runs, *a.shape)), initial_nav(jnp.zeros(3)))
        truth = jax.tree.map(lambda a: jnp.broadcast_to(a[:, None], (runs, E, *a.shape[1:])), nav)
        truth = truth._replace(pos=truth.pos.at[..., 2].add(40.0 * (i == 2)))
        nominal = jax.tree.map(lambda a: jnp.broadcast_to(a, (runs, *jnp.shape(a))), matched_params(CIRCLE))
        nominal = nominal._replace(
            noise=nominal.noise._replace(gyro=jnp.full(runs, 10.0))
        )  # the datasheet follows every fix
        return ContestRuns(nominal, nav, Epoch(imu, fix), truth)

    train, validation, test = plan.runs
    kinds = range(len(plan.trained) + len(plan.unseen))
    trained = kinds[: len(plan.trained)]
    return contest.Runs([case(i, train, 0) for i in trained], [case(i, validation, 1) for i in trained],
                        [case(i, test, 2) for i in kinds])  # fmt: skip


@pytest.fixture
def toys(monkeypatch):
    """Toy filters in the place of real ones, with the gain alone to tune."""
    monkeypatch.setenv("JAXNAV_CACHE_DIR", "")
    monkeypatch.setattr(contest, "build", lambda name, **_: toy(name))
    monkeypatch.setattr(contest, "draw", toy_runs)
    whole = contest.spec_of
    monkeypatch.setattr(contest, "spec_of", lambda name: {"noise.gyro": whole(name)["noise.gyro"]})


@pytest.fixture
def plan() -> Plan:
    nominal = matched_params(CIRCLE)
    kinds = [Kind(CIRCLE._replace(name=name), nominal) for name in ("a", "b", "c")]
    return Plan(tuple(kinds[:2]), tuple(kinds[2:]), **BUDGET)


@pytest.mark.full
def test_tuning_helps_on_other_runs_and_the_better_filter_wins(toys, plan):
    found, stopped = contest.contest(list(SD), plan)
    result = contest_report.verdict(found, plan)
    assert not stopped and list(result["filters"]) == ["gpid", "ekf15", "ekf9"]
    for name, about in result["filters"].items():
        seen = about["trained"]
        assert seen["against"]["untuned"]["high"] < 0.7  # the best gain for a truth that stands still is small
        assert about["parameters"]["noise.gyro"] < 0.5 and about["free"] == 1
        # errors scale with the toy's sd and the runs are paired: the ratio is exact but for where Adam ended
        against = seen["against"]["ekf15"]
        assert against["ratio"] == pytest.approx(SD[name] / SD["ekf15"], rel=0.1)
        assert against["low"] <= against["ratio"] <= against["high"]
        assert np.shape(seen["runs_position_m"]) == (2, 6) and np.shape(about["unseen"]["runs_position_m"]) == (1, 6)
        mean = np.exp(np.mean(np.log(seen["runs_position_m"])))
        assert seen["position_m"] == pytest.approx(mean) and about["unseen"]["position_m"] > 30
    assert result["budget"]["gradients_of_a_run"] == 16 * 3 * 2


def test_a_run_that_fails_counts_as_the_limit(toys, plan):
    runs = toy_runs(plan)
    epochs = runs.test[0].epochs
    fix = epochs.fix._replace(value=epochs.fix.value.at[1, 5, 3].set(1.0))
    cases = [runs.test[0]._replace(epochs=epochs._replace(fix=fix))]
    got = contest.scores_of(toy("ekf9"), contest.datasheet("ekf9"), cases, 77.0)
    assert got.ok.tolist() == [[True, False, True, True, True, True]] and (got.rms[0, 1] == 77.0).all()
    assert (got.rms[0, 0] < 77.0).all()


def run_verb(tmp_path, *more) -> int:
    values = [BUDGET["steps"], BUDGET["rate"], *BUDGET["runs"]]
    keys = ("steps", "rate", "runs", "validation_runs", "test_runs")
    budget = [arg for key, value in zip(keys, values, strict=True) for arg in ("--set", f"tune.{key}={value}")]
    return cli.main(["bakeoff", "--data", "gpid_circle,gpid_circle_white", "--unseen", "gpid_circle_ramp",
                     "--filter", "gpid", "--out", str(tmp_path / "out"), "--quiet", *budget, *more])  # fmt: skip


def test_the_verb_leaves_table_figure_and_json(toys, tmp_path):
    assert run_verb(tmp_path) == 0
    out = tmp_path / "out"
    result = json.loads((out / "bakeoff.json").read_text())
    assert set(result["filters"]) == set(SD) and result["unseen"] == ["gpid_circle_ramp"]
    assert result["budget"]["test_runs"] == 6 and (out / "bakeoff.png").stat().st_size > 5000
    text = (out / "bakeoff.txt").read_text()
    assert all(name in text for name in SD) and "/ ekf15" in text
    assert "bakeoff.png" in json.loads((out / "run.json").read_text())["files"]


def test_ctrl_c_keeps_the_filters_that_are_finished(toys, tmp_path, monkeypatch, capsys):
    done = []

    def fit(*args, **_):
        done.append(args)
        return Fit(args[2], 0.0, [], Status.CONVERGED if len(done) < 3 else Status.INTERRUPTED)

    monkeypatch.setattr(contest, "fit", fit)
    assert run_verb(tmp_path) == 130
    assert "after 2 of 3 filters" in capsys.readouterr().err
    assert set(json.loads((tmp_path / "out" / "bakeoff.json").read_text())["filters"]) == {"ekf9", "ekf15"}
    assert run_verb(tmp_path / "none") == 130  # nothing finished, nothing written
    assert not (tmp_path / "none" / "out").exists()


@pytest.mark.parametrize(
    "more, words",
    [
        (["--filter", "gpid,gpdi"], ["no filter 'gpdi'", "did you mean gpid"]),
        (["--data", "gpid_circel"], ["'gpid_circel'", "did you mean gpid_circle"]),
        (["--unseen", "gipkf_urbam"], ["'gipkf_urbam'", "gipkf_urban"]),
        (["--unseen", "gpid_circle_white"], ["bakeoff.unseen", "gpid_circle_white is trained on"]),
        (["--set", "tune.test_runs=1"], ["tune.test_runs"]),
    ],
)
def test_an_unknown_name_is_one_clear_error(more, words, tmp_path, capsys):
    assert run_verb(tmp_path, *more) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(word in said for word in words)


def test_every_filter_has_something_to_tune_and_starts_at_the_datasheet():
    nominal = matched_params(GIPKF)
    for name, entry in FILTERS.items():
        spec, start = contest.spec_of(name), contest.datasheet(name)
        raw = split(spec, start)  # nothing that cannot start
        assert len(labels(spec, raw)) >= 7 + 4 * (entry.states == BIASES)
        assert ("states.gyro_bias.driving_noise" in spec) == (entry.states == BIASES)
        same = contest.applied(start, nominal)
        for part in ("noise", "prior", "states", "measurements", "mounting"):
            jax.tree.map(np.testing.assert_array_equal, getattr(same, part), getattr(nominal, part))
    assert "rule.kd" in contest.spec_of("gpid_literal") and "feedback.position" in contest.spec_of("fwekf")


def test_cases_of_one_shape_share_a_program_and_keep_their_names(plan):
    runs = toy_runs(plan)
    short = jax.tree.map(lambda a: a, runs.train[0])
    short = short._replace(truth=jax.tree.map(lambda a: a[:, : E // 2], short.truth))
    groups, order = contest.together([runs.train[0], short, runs.train[1]])
    assert [g.start.t.shape[0] for g in groups] == [6, 3] and order == [0, 1, 2, 6, 7, 8, 3, 4, 5]


def test_filter_of_a_plan_serves_all_its_scenarios(monkeypatch):
    asked = {}
    monkeypatch.setattr(contest, "build", lambda name, **options: asked.update(options))
    late = SCENARIOS["gipkf_urban_stress"]
    kinds = tuple(Kind(s, matched_params(s)) for s in (CIRCLE, late, late._replace(imu_rate_hz=15.0)))
    contest.filter_for("ekf9", Plan(kinds, ()))
    assert asked == {"cov_stride": 5, "history": 2 + 3}  # 10 and 15 samples; 0.15 s at 15 Hz


def test_paired_ratio_of_known_errors():
    b = np.exp(np.random.default_rng(0).normal(size=(3, 12)))
    r = paired_ratio(2 * b, b)
    assert (r.ratio, r.low, r.high) == pytest.approx((2.0, 2.0, 2.0))
    noisy = paired_ratio(b * np.exp(np.random.default_rng(1).normal(size=b.shape)), b)
    assert noisy.low < noisy.ratio < noisy.high and noisy.low < 1 < noisy.high
    for wrong in ((b, b[:, :5]), (b[:, :1], b[:, :1]), (b, -b), (b[0], b[0])):
        with pytest.raises(ValueError, match="errors must be"):
            paired_ratio(*wrong)
