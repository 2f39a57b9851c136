"""Likelihood of simulated runs on lanes: equal to tangents, of every run a block, and infinite where a run is lost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxnav.filters.catalogue import build
from jaxnav.filters.run import run
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import matched_params
from tests.tuning import tangents
from tuning import likelihood, simulated
from tuning.fit.transforms import LOG, join, leaves, merged, scaled, split, tied

SCENARIO = URBAN_SHORT._replace(duration_s=20.0, imu_rate_hz=20.0)
SPEC = {"noise.gyro": tied(LOG), "noise.accel": tied(LOG), "mounting.time_offset": scaled(0.01)}


@pytest.fixture(scope="module")
def runs():
    """Two training runs whose latency is theirs, with parameters that are not free of their scenario."""
    filt, params = build("ekf9", cov_stride=5), matched_params(SCENARIO)
    used = simulated._simulated(filt, SCENARIO, params, (2, 1, 1), 0)
    return simulated._source(filt, used), params


@pytest.mark.full
def test_it_is_that_of_tangents(runs, monkeypatch):
    found, params = runs
    raw = split(SPEC, params)
    flat, back = ravel_pytree(raw)
    other = params._replace(noise=params.noise._replace(gyro=2 * params.noise.gyro, accel=3 * params.noise.accel))

    def one(flat, nav, epochs, keep, i):
        solve = lambda r: run(found.filter, merged(join(SPEC, back(r), other), params, leaves(SPEC)), nav, epochs)
        return tangents.information(solve, flat, keep, jnp.full(keep.shape, i), 2)

    parts = jax.jit(jax.vmap(one, (None, 0, 0, 0, 0)))(flat, found.nav, found.epochs, found.keep, jnp.arange(2))
    whole = jax.tree.map(lambda a: np.asarray(a.sum(0)), parts)
    mine = likelihood.information(found, SPEC, other, flat)
    for a, b in zip(mine, whole, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-5 * np.abs(b).max())
    assert found.fixes == int(np.asarray(found.epochs.fix.valid).any(-1).sum())
    monkeypatch.setattr(likelihood, "MAX_LANE_EPOCHS", 1)  # one run at a time
    for a, b in zip(likelihood.information(found, SPEC, other, flat), mine, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_a_lost_run_has_no_likelihood_and_padding_none(runs):
    found, params = runs
    flat, _ = ravel_pytree(split(SPEC, params))
    none = found._replace(keep=np.zeros_like(found.keep))
    assert likelihood.information(none, SPEC, params, flat).nll == 0.0
    bad = found.epochs.fix.value.copy()
    bad[1, 3] = np.inf
    lost = found._replace(epochs=found.epochs._replace(fix=found.epochs.fix._replace(value=bad)))
    assert np.isinf(likelihood.information(lost, SPEC, params, flat).nll)
