"""The FWEKF benchmark's arithmetic, one small case of it, and (slow) its short form and the tuned rules' figures."""

import json

import jax
import numpy as np
import pytest

from benchmarks.papers import fwekf, fwekf_figures, fwekf_study
from jaxnav.filters.papers.fwekf import fwekf_params
from jaxnav.filters.rules.kalman import kalman
from jaxnav.types import DataError


def test_arithmetic_of_the_tables():
    cases = {"A": {"ekf": 1.0, "x": 2.0}, "B": {"ekf": 4.0, "x": 8.0}, "C": {"ekf": 100.0, "x": 1.0}}
    assert fwekf.geomean(cases, ("A", "B", "Z")) == pytest.approx({"ekf": 2.0, "x": 4.0})
    per_seed = {"A": {"ekf": [2.0, 8.0], "x": [1.0, 1.0]}}
    f = fwekf.paired(per_seed)["A"]["x"]
    assert f["factor"] == pytest.approx(4.0) and f["se"] == pytest.approx(4.0 * np.log(2) * np.sqrt(2) / np.sqrt(2))
    t = np.arange(5.0)
    assert fwekf.settles(np.array([5, 1, 2, 0.5, 0.4]), t, 1.5) == 3.0
    assert fwekf.settles(np.array([1.0] * 5), t, 1.5) == 0.0
    assert fwekf.settles(np.array([1.0] * 4 + [2.0]), t, 1.5) == np.inf


def test_parameters_survive_the_file():
    theta = fwekf_params(0.9)
    again = fwekf.plain_tree(theta, fwekf.as_dict(theta))
    jax.tree.map(np.testing.assert_array_equal, theta, again)
    for name, theta in fwekf.stored().items():
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(theta)), name


@pytest.mark.full
def test_noise_free_launch_converges_as_the_paper_says():
    """Its first test: |dv| < 0.02 m/s and |dr| < 5 mm, in 10 s and, by the observer's poles, within 12 s."""
    test = fwekf_study.draw(("C1",), jax.random.key(0), 1)
    runs = test["C1"]
    filt = fwekf_study.navigator(kalman())
    e, nu = fwekf_study.navigate_first(runs, filt, ())
    t = np.asarray(runs.sim.truth.t[0])
    position, velocity = (np.linalg.norm(v, axis=1) for v in (e.position, e.velocity))
    assert position[0] > 10 and velocity[0] > 0.2
    still = t <= 20  # then what is left of the heading's error shows, which nothing has seen before
    assert fwekf.settles(velocity[still], t[still], 0.02) < 10 and fwekf.settles(position[still], t[still], 0.005) < 12
    assert 0.005 < position[~still].max() < 0.02 and position[-1] < 2e-4
    np.testing.assert_allclose(fwekf_study.rms(e.position), np.sqrt((position[200:] ** 2).mean()), rtol=1e-12)
    truth = jax.tree.map(lambda a: a[0], runs.sim.truth)
    assert float(truth.vel[-1, 1]) == pytest.approx(30.0, abs=0.01)  # eq. 33
    for fig in (
        fwekf_figures.reference(truth),
        fwekf_figures.errors(t, {"EKF": e}),
        fwekf_figures.residuals(t, {"EKF": nu}),
        fwekf_figures.attitude(t, {"EKF": e}),
        fwekf_figures.by_case({c: dict.fromkeys(fwekf_figures.SHOWN, 1.0) for c in ("C1", "C2")}),
    ):
        assert all(ax.lines for ax in fig.axes)


def test_heading_that_turns_round_is_drawn_in_pieces():
    t = np.arange(4.0)
    turning = np.deg2rad([[0, 0, a] for a in (170.0, 179.0, -179.0, -170.0)])
    errors = fwekf_study.Errors(turning, turning, turning, turning)
    line = fwekf_figures.attitude(t, {"": errors}).axes[0].lines[2]
    np.testing.assert_array_equal(np.isnan(line.get_ydata()), [False, False, True, False])


def test_without_recorded_data_the_rest_is_kept(monkeypatch, capsys):
    def missing(tuned):
        raise DataError("no such data")

    monkeypatch.setattr(fwekf.fwekf_recorded, "table", missing)
    assert fwekf.recorded({}) == {}
    assert "no such data" in capsys.readouterr().out


@pytest.mark.slow
def test_short_form_of_the_study(tmp_path, capsys):
    path = tmp_path / "fwekf.json"
    fwekf.main(["--quick", "--json", str(path)])
    assert "fwekf_tuned.json" in capsys.readouterr().out
    r = json.loads(path.read_text())
    assert set(r["cases"]) == set(fwekf_study.QUICK) and r["steps"] == 0
    methods = {"ekf", "fwekf_hand", "fwekf_0.9_tuned", "fwekf_1.0_tuned", "fuzzy_combined_tuned"}
    for case, row in r["cases"].items():
        assert methods <= set(row)
        for method, value in row.items():
            assert value == pytest.approx(np.mean(r["per_seed"][case][method]))
    assert methods <= set(r["geomean_train"]) and methods <= set(r["geomean_unseen"])
    assert max(r["gradient_rel_error"].values()) < 1e-6
    assert r["convergence"]["ekf"]["velocity_below_0.02_mps_from_s"] < 10
    assert len(r["figures"]) == 17 and all((tmp_path / "fwekf" / p.split("/")[-1]).exists() for p in r["figures"])


@pytest.mark.slow
def test_tuned_rules_on_runs_that_tuning_did_not_see():
    test = fwekf_study.draw(fwekf_study.TRAIN + fwekf_study.UNSEEN, jax.random.fold_in(jax.random.key(0), 1), 64)
    every = fwekf_study.methods(fwekf.stored(), True)
    table = {m: every[m] for m in ("ekf", "fwekf_hand", *fwekf.RECIPES)}
    judged = fwekf.evaluate(test, table)
    cases = {c: {m: float(v.position.mean()) for m, v in row.items()} for c, row in judged.items()}
    train, unseen = fwekf.geomean(cases, fwekf_study.TRAIN), fwekf.geomean(cases, fwekf_study.UNSEEN)
    matched = cases["C2m"]
    assert matched["ekf"] == pytest.approx(1.07, rel=0.25)
    assert train["fwekf_0.9_tuned"] < 1.75 and train["fwekf_1.0_tuned"] < 1.90 < train["fwekf_hand"] < train["ekf"]
    assert train["fuzzy_combined_tuned"] < 1.4 and unseen["fuzzy_combined_tuned"] < 1.4 < 3 < unseen["ekf"]
    assert max(matched["fwekf_1.0_tuned"], matched["fuzzy_combined_tuned"]) < 1.02 * matched["ekf"]
