"""The FWEKF benchmark's arithmetic, and one small case of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import fwekf, fwekf_figures, fwekf_study
from jaxnav.filters.fwekf import fwekf_params
from jaxnav.filters.kalman import kalman
from jaxnav.types import Params
from tuning.cases import clip, fit_cases
from tuning.transforms import IDENTITY


def test_each_case_s_gradient_is_clipped_by_itself():
    grads = {
        "a": jnp.array([[3.0, 0.0], [1e14, 0.0], [0.3, 0.0], [jnp.nan, 1.0]]),
        "b": jnp.array([4.0, 0.0, 0.4, 1.0]),
    }
    out = clip(grads)
    np.testing.assert_allclose(out["a"], [[0.6, 0], [1, 0], [0.3, 0], [0, 0]], rtol=1e-14)
    np.testing.assert_allclose(out["b"], [0.8, 0, 0.4, 0], rtol=1e-14)


def test_fit_over_cases_finds_what_they_agree_on():
    """A case with an enormous gradient, one that is never finite, and two that are sound."""

    def loss(params, case, key):
        noise = 0.01 * jax.random.normal(key)
        return case * (params.rule - 2.0) ** 2 + noise + jnp.where(case < 0, jnp.nan, 0.0) * params.rule

    params = Params((), (), (), jnp.asarray(0.5))
    cases = jnp.array([1e12, 1.0, 2.0])
    fit = fit_cases(loss, {"rule": IDENTITY}, params, cases, jax.random.key(0), 100)
    assert float(fit.params.rule) == pytest.approx(2.0, abs=0.05)
    assert len(fit.history) == 101 and len(fit.history[0]["cases"]) == 3
    broken = fit_cases(loss, {"rule": IDENTITY}, params, jnp.array([-1.0, 1.0]), jax.random.key(0), 3)
    assert float(broken.params.rule) == 0.5  # never judged better than the start
    with pytest.raises(ValueError, match="starting"):
        fit_cases(loss, {"rule": IDENTITY}, params, jnp.array([-1.0]), jax.random.key(0), 1)


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
    ):
        assert all(ax.lines for ax in fig.axes)
