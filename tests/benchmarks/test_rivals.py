"""Searches without derivatives find a bowl, keep to their budget, and are counted fairly."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed import budget, rivals

CENTRE, START = np.array([0.5, -0.3, 1.0]), np.zeros(3)


def bowl(candidates):
    values = np.sum((candidates - CENTRE) ** 2 * [1.0, 4.0, 9.0], axis=1)
    return np.where(candidates[:, 0] > 5.0, np.nan, values)  # a corner that fails


@pytest.mark.parametrize("search, near", [(rivals.random_search, 2.0), (rivals.coordinate_search, 1e-3)])
def test_searches_fall_and_keep_to_their_budget(search, near):
    best = search(bowl, START, 400, 0)
    assert best.shape == (400,) or search is rivals.coordinate_search
    assert best[0] == pytest.approx(float(bowl(START[None])[0])) and (np.diff(best) <= 0).all()
    assert best[-1] < near and best.size <= 400
    np.testing.assert_array_equal(best, search(bowl, START, 400, 0))


def test_cma_finds_the_bowl_and_survives_what_fails():
    pytest.importorskip("cma")
    best = rivals.cma(bowl, START, 600, 0)
    assert best[-1] < 1e-4 and best.size <= 600


def test_cost_is_read_off_where_a_curve_first_comes_close(capsys):
    curves = {
        "adam": (5.0 * np.arange(1, 5), np.array([3.0, 1.0, 0.105, 0.1])),
        "cma": (np.arange(1, 101.0), np.minimum.accumulate(np.linspace(3.0, 0.102, 100))),
        "coordinate_search": (np.arange(1, 51.0), np.full(50, 2.0)),
        "random_search": (np.arange(1, 21.0), np.full(20, 2.5)),
        "lbfgs": (5.0 * np.arange(1, 3), np.array([3.0, 0.108])),
    }
    row = budget.verdict("made up", 3, curves, {"gradient": 5.0}, 1e-3, 0.2)
    cost = {name: method["cost"] for name, method in row["methods"].items()}
    assert cost == {"adam": 15.0, "cma": 100.0, "coordinate_search": None, "random_search": None, "lbfgs": 10.0}
    assert budget.ratio(row, "cma", "adam") == pytest.approx(100 / 15)
    assert budget.ratio(row, "coordinate_search", "adam") == pytest.approx(50 / 15)  # from below
    assert budget.ratio(row, "adam", "coordinate_search") is None  # it never comes close
    assert "not in 50" in capsys.readouterr().out
    table = budget.medians([row, row | {"methods": row["methods"] | {"lbfgs": row["methods"]["coordinate_search"]}}])
    assert table["adam"]["cma"]["median"] == pytest.approx(100 / 15)
    assert table["scoring, else lbfgs"]["cma"]["each"] == [pytest.approx(10.0), None]
    assert table["lbfgs"]["cma"]["median"] == pytest.approx(5.0)  # never is worse than any cost


@pytest.mark.parametrize("method", [budget.descend, budget.quasi_newton])
def test_descents_fall_and_go_around_what_fails(method):
    def gradient(raw):
        x = np.concatenate([np.ravel(raw["a"]), np.ravel(raw["b"])])
        value = np.inf if x[2] > 2.5 else float(np.sum((x - CENTRE) ** 2 * [1.0, 4.0, 9.0]))
        slope = 2 * (x - CENTRE) * [1.0, 4.0, 9.0]
        return jnp.asarray(value), {"a": jnp.asarray(slope[:2]), "b": jnp.asarray(slope[2])}

    losses = method(gradient, {"a": jnp.zeros(2), "b": jnp.zeros(())}, 60)
    assert losses.size <= 61 and losses[0] == pytest.approx(bowl(START[None])[0]) and losses.min() < 1e-2


def test_problems_have_fifteen_parameters_or_more():
    from jaxnav.filters.parameters import datasheet_params
    from jaxnav.states.grades import GRADES
    from tuning.transforms import labels, split

    params = budget.per_axis(datasheet_params(GRADES["consumer"]))
    assert len(labels(budget.free(), split(budget.free(), params))) == 18
