"""Free and frozen parameters: what goes out comes back, and nothing else moves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxnav.filters.papers.gpid import gpid_params
from jaxnav.filters.parameters import datasheet_params
from jaxnav.states.grades import GRADES
from tests.conftest import leaves_equal
from tuning.fit.transforms import (
    IDENTITY,
    LOG,
    SIGNED,
    TRANSFORMS,
    factor,
    get,
    interval,
    join,
    labels,
    penalty,
    put,
    reported,
    scaled,
    split,
    tied,
    values,
    with_prior,
)

PARAMS = datasheet_params(GRADES["adis16465"], rule=gpid_params(0.01, 0.1))


@pytest.mark.parametrize(
    "transform, values",
    [(LOG, [1e-9, 1.0, 1e6]), (IDENTITY, [-2.0, 0.0, 3.0]), (scaled(0.01), [-0.5, 0.0, 0.02]),
     (interval(-0.5, 2.0), [-0.499, 0.0, 1.999])],
)  # fmt: skip
def test_round_trips_and_monotonic(transform, values):
    values = jnp.array(values)
    np.testing.assert_allclose(transform.forward(transform.inverse(values)), values, rtol=1e-12, atol=1e-15)
    raw = jnp.linspace(-4.0, 4.0, 9)
    np.testing.assert_allclose(transform.inverse(transform.forward(raw)), raw, atol=1e-12)
    slope = jax.vmap(jax.grad(lambda r: transform.forward(r)))(raw)
    assert (slope > 0).all()


def test_a_step_is_worth_what_it_says():
    assert LOG.forward(LOG.inverse(3.0) + 0.1) / 3.0 == pytest.approx(np.exp(0.1))
    assert scaled(0.01).forward(jnp.array(1.0)) == pytest.approx(0.01)
    forward = interval(-0.5, 2.0).forward
    assert forward(jnp.array(0.0)) == pytest.approx(0.75) and -0.5 < forward(jnp.array(-30.0)) < -0.49
    assert TRANSFORMS == {"log": LOG, "identity": IDENTITY, "signed": SIGNED}


def test_a_gain_of_any_sign_moves_from_zero_and_by_tenths_where_it_is_large():
    forward, inverse = SIGNED.forward, SIGNED.inverse
    np.testing.assert_allclose(
        forward(inverse(jnp.array([-3.0, -1e-4, 0.0, 2.0]))), [-3.0, -1e-4, 0.0, 2.0], rtol=1e-12
    )
    assert forward(inverse(2.0) + 0.1) == pytest.approx(2.0 * np.exp(0.1), rel=1e-4)
    assert forward(inverse(0.0) - 0.1) == pytest.approx(-0.001, rel=2e-3)
    assert jax.grad(forward)(inverse(0.0)) == pytest.approx(0.01)


SPEC = {"noise.gyro": LOG, "measurements.position.scale": LOG, "mounting.lever_arm": scaled(0.1), "rule.ki": LOG}


def test_split_and_join_are_inverse_and_leave_the_frozen_alone():
    raw = split(SPEC, PARAMS)
    assert set(raw) == set(SPEC) and raw["mounting.lever_arm"].shape == (3,)
    back = join(SPEC, raw, PARAMS)
    leaves_equal(back, PARAMS, 1e-15)
    moved = join(SPEC, {k: v + 0.1 for k, v in raw.items()}, PARAMS)
    for name in SPEC:
        assert (np.asarray(get(moved, name)) != np.asarray(get(PARAMS, name))).all()
        moved = put(moved, name, get(PARAMS, name))
    for a, b in zip(jax.tree.leaves(moved), jax.tree.leaves(PARAMS), strict=True):
        assert a is b  # the very same arrays
    np.testing.assert_allclose(
        get(join(SPEC, {k: v + 0.1 for k, v in raw.items()}, PARAMS), "mounting.lever_arm"), 0.01
    )


def test_gradients_reach_the_raw_numbers_only():
    raw = split(SPEC, PARAMS)
    grads = jax.grad(lambda r: jnp.sum(join(SPEC, r, PARAMS).noise.gyro ** 2))(raw)
    sigma = float(PARAMS.noise.gyro)
    assert float(grads["noise.gyro"]) == pytest.approx(2 * sigma**2)  # d/d log
    assert not np.asarray(grads["rule.ki"]).any()


def test_raw_numbers_are_strong_floats():
    weak = PARAMS._replace(noise=PARAMS.noise._replace(gyro=1e-3))
    raw = split({"noise.gyro": LOG}, weak)
    assert raw["noise.gyro"].dtype == jnp.float64 and not raw["noise.gyro"].weak_type


def test_names_that_are_not_there_are_explained():
    with pytest.raises(ValueError, match="no parameter 'noise.giro': 'giro' is not one of gyro, accel"):
        get(PARAMS, "noise.giro")
    with pytest.raises(ValueError, match="'noise' is not one of nothing"):
        get(PARAMS, "noise.gyro.noise")
    with pytest.raises(
        ValueError, match="'nois' is not one of noise, prior, states, measurements, mounting, rule, feedback"
    ):
        split({"nois.gyro": LOG}, PARAMS)
    with pytest.raises(ValueError, match="no parameter"):
        put(PARAMS, "noise.giro", 1.0)
    with pytest.raises(ValueError, match=r"mounting.lever_arm = \[0. 0. 0.\] cannot start there"):
        split({"mounting.lever_arm": LOG}, PARAMS)
    with pytest.raises(ValueError, match="rule.ki"):
        split({"rule.ki": interval(0.5, 1.0)}, PARAMS)


ROOT = np.array([[2e-3, 0, 0], [-1.5e-3, 2e-3, 0], [4e-3, -3e-3, 1e-3]])
SIGMA = ROOT @ ROOT.T
SD = np.sqrt(np.diag(SIGMA))
CORR = (SIGMA / np.outer(SD, SD))[np.tril_indices(3, -1)]


def test_a_root_goes_by_logarithms_of_sd_and_partial_correlations():
    raw = factor(3).inverse(jnp.asarray(ROOT))
    np.testing.assert_allclose(factor(3).forward(raw), ROOT, rtol=1e-13)
    np.testing.assert_allclose(raw[:3], np.log(SD), rtol=1e-13)
    np.testing.assert_allclose(np.tanh(raw[3:5]), CORR[:2], rtol=1e-13)
    partial = (CORR[2] - CORR[0] * CORR[1]) / np.sqrt((1 - CORR[0] ** 2) * (1 - CORR[1] ** 2))
    assert np.tanh(raw[5]) == pytest.approx(partial)
    other = jnp.array([0.3, -2.0, 5.0, -3.0, 0.4, 2.5])
    np.testing.assert_allclose(factor(3).inverse(factor(3).forward(other)), other, rtol=1e-9)
    units = np.array([1e3, 1e-4, 7.0])  # of the axes move the logarithms alone
    moved = factor(3).inverse(jnp.asarray(units[:, None] * ROOT)) - raw
    np.testing.assert_allclose(moved, [*np.log(units), 0, 0, 0], atol=1e-9)


def test_a_root_is_free_from_any_start_and_told_as_sd_and_correlations():
    spec = {"noise.accel": LOG, "noise.gyro": factor(3)}
    for start, L in ((2.0, 2 * np.eye(3)), ([1.0, 2.0, 3.0], np.diag([1.0, 2, 3])), (ROOT, ROOT)):
        params = put(PARAMS, "noise.gyro", jnp.asarray(start))
        raw = split(spec, params)
        np.testing.assert_allclose(join(spec, raw, params).noise.gyro, L, atol=1e-15)
        jac = jax.jacobian(lambda r, p=params: join(spec, r, p).noise.gyro)(raw)["noise.gyro"]
        assert np.isfinite(jac).all() and np.linalg.matrix_rank(jac.reshape(9, 6) / np.abs(L).max()) == 6
    names = [f"noise.gyro[{i}]" for i in ("0", "1", "2", "1,0", "2,0", "2,1")]
    assert labels(spec, raw) == ["noise.accel", *names]
    shown = values(spec, reported(spec, raw))
    np.testing.assert_allclose(ravel_pytree(shown)[0], [PARAMS.noise.accel, *SD, *CORR], rtol=1e-12)
    # a prior has the datasheet's sd and no correlation, however the datasheet says it
    for datasheet in (2.0, np.full(3, 2.0), 2 * np.eye(3)):
        cost = penalty({"noise.gyro": with_prior(factor(3), datasheet, 0.5)}, raw)
        z = np.append(np.log(SD / 2), raw["noise.gyro"][3:])
        assert cost == pytest.approx(0.5 * np.sum((z / 0.5) ** 2))
    with pytest.raises(ValueError, match="cannot be tied"):
        tied(factor(3))
