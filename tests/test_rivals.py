"""Searches without derivatives find a bowl, keep to their budget, and are counted fairly."""

import numpy as np
import pytest

from benchmarks import budget
from tuning import rivals

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
        "gradient": (5.0 * np.arange(1, 5), np.array([3.0, 1.0, 0.105, 0.1])),
        "cma": (np.arange(1, 101.0), np.minimum.accumulate(np.linspace(3.0, 0.102, 100))),
        "coordinate_search": (np.arange(1, 51.0), np.full(50, 2.0)),
    }
    row = budget.verdict("made up", 3, curves, {"gradient": 5.0}, 1e-3, 0.2)
    cost = {name: method["cost"] for name, method in row["methods"].items()}
    assert cost["gradient"] == 15.0 and cost["cma"] == 100.0 and cost["coordinate_search"] is None
    assert budget.ratio(row, "cma") == pytest.approx(100 / 15)
    assert budget.ratio(row, "coordinate_search") == pytest.approx(50 / 15)
    assert "not in 50" in capsys.readouterr().out


def test_problems_have_fifteen_parameters_or_more():
    from jaxnav.sensors.grades import GRADES, datasheet_params
    from tuning.transforms import labels, split

    params = budget.per_axis(datasheet_params(GRADES["consumer"]))
    assert len(labels(budget.free(), split(budget.free(), params))) == 18
