"""Free and frozen parameters: what goes out comes back, and nothing else moves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.gpid import gpid_params
from jaxnav.sensors.grades import GRADES, datasheet_params
from tests.conftest import leaves_equal
from tuning.transforms import IDENTITY, LOG, TRANSFORMS, get, interval, join, put, scaled, split

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
    assert TRANSFORMS == {"log": LOG, "identity": IDENTITY}


SPEC = {"noise.gyro": LOG, "noise.position_scale": LOG, "mounting.lever_arm": scaled(0.1), "rule.ki": LOG}


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
    with pytest.raises(ValueError, match="'nois' is not one of noise, prior, mounting, rule, feedback"):
        split({"nois.gyro": LOG}, PARAMS)
    with pytest.raises(ValueError, match="no parameter"):
        put(PARAMS, "noise.giro", 1.0)
    with pytest.raises(ValueError, match=r"mounting.lever_arm = \[0. 0. 0.\] cannot start there"):
        split({"mounting.lever_arm": LOG}, PARAMS)
    with pytest.raises(ValueError, match="rule.ki"):
        split({"rule.ki": interval(0.5, 1.0)}, PARAMS)
