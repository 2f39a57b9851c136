"""Fuzzy inference against a naive evaluation, its limits, and what holds by construction."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks.papers import fuzzy_plots as plots_fuzzy
from jaxnav.filters.rules import fuzzy

CENTRES, WIDTHS = ((0.25, 0.5, 0.9), (0.3, 3.0)), ((0.12, 0.2, 0.2), (0.4, 1.0))
TABLE = ((0, 1), (1, 2), (0, 3))  # not square: three sets and two
SYSTEM = fuzzy.system(CENTRES, WIDTHS, (1.0, 1.02, 1.05, 0.98), (0.9, 1.2))
LINEAR = SYSTEM._replace(consequents=SYSTEM.consequents.at[:, 1:].set(np.arange(8.0).reshape(4, 2) / 5 - 0.7))
infer, firing = jax.jit(fuzzy.infer, static_argnums=(1, 3)), jax.jit(fuzzy.firing, static_argnums=(1, 3))
sets = jax.jit(fuzzy.sets, static_argnums=1)


def naive(x, slopes, both):
    """Eqs. 29 and 30 as they stand, in loops and without logarithms."""
    top = bottom = 0.0
    for rule in itertools.product(range(3), range(2)):
        mu = [np.exp(-0.5 * ((x[i] - CENTRES[i][j]) / WIDTHS[i][j]) ** 2) for i, j in enumerate(rule)]
        label = TABLE[rule[0]][rule[1]]
        share = ((1.0, 1.02, 1.05, 0.98)[label] - 0.9) / 0.3
        z = np.log(share / (1 - share)) + (np.dot(slopes[label], x) if slopes is not None else 0.0)
        w = both(mu)
        top, bottom = top + w * (0.9 + 0.3 / (1 + np.exp(-z))), bottom + w
    return top / bottom


@pytest.mark.parametrize("conjunction, both", [(fuzzy.product, np.prod), (fuzzy.minimum, min)])
@pytest.mark.parametrize("theta", [SYSTEM, LINEAR], ids=["constant", "linear"])
def test_inference_is_the_paper_s(theta, conjunction, both):
    for x in np.random.default_rng(0).uniform([0, 0], [1, 4], (20, 2)):
        expected = naive(x, None if theta is SYSTEM else np.asarray(theta.consequents[:, 1:]), both)
        np.testing.assert_allclose(infer(theta, TABLE, jnp.asarray(x), conjunction), expected, rtol=1e-12)


@pytest.mark.parametrize("conjunction", [fuzzy.product, fuzzy.minimum])
def test_rules_share_the_answer(conjunction):
    for x in np.random.default_rng(1).normal(size=(5, 2)) * [1, 1e3]:
        share = np.asarray(firing(SYSTEM, (3, 2), jnp.asarray(x), conjunction))
        assert share.shape == (3, 2) and share.min() >= 0
        np.testing.assert_allclose(share.sum(), 1, rtol=1e-14)
    at = np.asarray(firing(SYSTEM, (3, 2), jnp.array([0.9, 3.0]), conjunction))
    assert at.argmax() == 5 and at.max() > 0.8


def test_one_rule_is_its_consequent_and_equal_labels_are_one():
    one = fuzzy.system(((0.0,),), ((1.0,),), (1.1,), (1.0, 1.2))
    for x in (-1e6, 0.3, 1e300):
        np.testing.assert_allclose(infer(one, (0,), jnp.array([x])), 1.1, rtol=1e-15)
    np.testing.assert_allclose(infer(SYSTEM, ((1, 1), (1, 1), (1, 1)), jnp.array([0.4, 2.0])), 1.02, rtol=1e-14)
    shut = one._replace(bounds=jnp.ones(2))
    assert float(infer(shut, (0,), jnp.array([0.3]))) == 1.0  # exactly: a weighted filter is then a plain one
    # narrow sets are a look-up table
    crisp = fuzzy.system(CENTRES, tuple((0.011,) * len(c) for c in CENTRES), (1.0, 1.02, 1.05, 0.98), (0.9, 1.2))
    for (i, c1), (j, c2) in itertools.product(enumerate(CENTRES[0]), enumerate(CENTRES[1])):
        expected = (1.0, 1.02, 1.05, 0.98)[TABLE[i][j]]
        np.testing.assert_allclose(infer(crisp, TABLE, jnp.array([c1, c2])), expected, rtol=1e-13)


@pytest.mark.parametrize("conjunction", [fuzzy.product, fuzzy.minimum])
def test_extreme_inputs_give_finite_answers_and_gradients(conjunction):
    grad = jax.jit(jax.value_and_grad(lambda theta, x: fuzzy.infer(theta, TABLE, x, conjunction), (0, 1)))
    for x in itertools.product((-np.inf, -1e308, -1e5, 0.0, 40.0, 1e200, np.inf), repeat=2):
        for theta in (SYSTEM, LINEAR):
            value, slopes = grad(theta, jnp.array(x))
            assert 0.9 <= float(value) <= 1.2
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes)), x
    # far from all centres the products of eq. 30 are 0, their ratio is not: the nearest rule answers
    with np.errstate(invalid="ignore"):
        assert np.isnan(naive(np.array([0.25, -60.0]), None, np.prod))
    np.testing.assert_allclose(infer(SYSTEM, TABLE, jnp.array([0.25, -9.0])), 1.02, rtol=1e-2)


def test_any_raw_numbers_make_a_system():
    for key in jax.random.split(jax.random.key(3), 20):
        keys = fuzzy.System(*jax.random.split(key, 4))
        raw = jax.tree.map(lambda a, k: 10 * jax.random.normal(k, a.shape), SYSTEM, keys)
        raw = raw._replace(bounds=SYSTEM.bounds)
        for centres, widths in sets(raw, (3, 2)):
            assert (np.diff(centres) > 0).all() and (np.asarray(widths) >= fuzzy.NARROWEST).all()
        for x in ([0.3, 0.4], [1.0, 6.0]):
            assert 0.9 <= float(infer(raw, TABLE, jnp.array(x))) <= 1.2
    for i, (centres, widths) in enumerate(sets(SYSTEM, (3, 2))):  # and plain numbers come back
        np.testing.assert_allclose(centres, CENTRES[i], rtol=1e-14)
        np.testing.assert_allclose(widths, WIDTHS[i], rtol=1e-13)


def test_gradient_in_every_parameter():
    x, h = jnp.array([0.6, 1.2]), 1e-5
    flat, unravel = ravel_pytree(LINEAR)
    f = jax.jit(lambda v: fuzzy.infer(unravel(v), TABLE, x))
    grad = np.asarray(jax.jit(jax.grad(f))(flat))
    steps = jnp.asarray(np.eye(flat.size) * h)
    numeric = np.array([(f(flat + s) - f(flat - s)) / (2 * h) for s in steps])
    np.testing.assert_allclose(grad, numeric, rtol=1e-6, atol=1e-11)
    used = np.abs(grad) > 1e-12
    assert used.all()


def test_tables_of_other_shapes_are_refused():
    good = dict(centres=CENTRES, widths=WIDTHS, consequents=(1.0,), bounds=(0.9, 1.2))
    for change, message in (
        (dict(centres=((0.5, 0.25, 0.9), (0.3, 3.0))), "ascend"),
        (dict(widths=((0.1, 0.1, 0.01), (0.4, 1.0))), "widths"),
        (dict(consequents=(1.2,)), "between 0.9 and 1.2"),
    ):
        with pytest.raises(ValueError, match=message):
            fuzzy.system(**(good | change))
    for table, message in ((((0, 1), (1, 2)), "centres and widths"), (((0, 1), (1, 4), (0, 3)), "consequents")):
        with pytest.raises(ValueError, match=message):
            fuzzy.infer(SYSTEM, table, jnp.zeros(2))


def test_figures_show_the_sets_and_the_surface():
    span, names = ((0.0, 1.2), (0.0, 6.0)), ("x1", "x2")
    fig = plots_fuzzy.memberships(SYSTEM, TABLE, span, names, (("a", "b", "c"), ("a", "b")), before=LINEAR)
    curves = [line for line in fig.axes[1].lines if line.get_linestyle() == "-"]
    assert [len(ax.lines) for ax in fig.axes] == [6, 4] and len(curves) == 2
    for line, centre in zip(curves, CENTRES[1], strict=True):
        x, y = line.get_data()
        assert x[y.argmax()] == pytest.approx(centre, abs=0.01) and y.max() == pytest.approx(1, abs=1e-3)
    fig = plots_fuzzy.surface(SYSTEM, TABLE, span, names, "y", points=7)
    assert [t.get_text() for t in fig.axes[0].texts] == ["0", "1", "1", "2", "0", "3"]
    fig = plots_fuzzy.surface(SYSTEM, TABLE, span, names, "y", points=7, labels=("Z", "S", "L", "NS"))
    assert [t.get_text() for t in fig.axes[0].texts] == ["Z", "S", "S", "L", "Z", "NS"]
    with pytest.raises(ValueError, match="two inputs"):
        plots_fuzzy.surface(fuzzy.system(((0.0,),), ((1.0,),), (1.1,), (1.0, 1.2)), (0,), span[:1], names, "y")
