"""What every filter of the catalogue owes its user; one small drive, one compilation each."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import FILTERS, GNSS, NONHOLONOMIC, build, make_filter, metrics, run
from jaxnav.error_models.local_level import error_model
from jaxnav.filters.combinators import only
from jaxnav.filters.feedback import reset
from jaxnav.filters.gpid import gpid_params
from jaxnav.filters.kalman import kalman
from jaxnav.mechanizations import local_level
from jaxnav.scenarios import SCENARIOS
from jaxnav.simulation import matched_params, simulate_jit
from jaxnav.types import Epoch, Fix

SCENARIO = SCENARIOS["urban_short"]
DIVERGES = {"gpid_literal"}  # the paper's printed gains: documented, and measured by its benchmark


@pytest.fixture(scope="module")
def drive():
    return simulate_jit(SCENARIO, jax.random.key(5))


def wider(epochs: Epoch) -> Epoch:
    """The same epochs with non-holonomic channels that are never there."""
    f = epochs.fix
    pad = lambda a, v: jnp.concatenate([a, jnp.full((a.shape[0], 2), v, a.dtype)], axis=1)  # noqa: E731
    return epochs._replace(fix=Fix(pad(f.value, 0.0), pad(f.sd, 1.0), pad(f.corr, 0.0), pad(f.valid, False)))


@pytest.mark.parametrize("name", FILTERS)
def test_contract(name, drive):
    entry = FILTERS[name]
    params = matched_params(SCENARIO, rule=entry.theta())

    def solve(filt):
        return jax.jit(lambda epochs: run(filt, params, drive.initial, epochs))

    info = solve(build(name, cov_stride=25))(drive.epochs)
    assert bool(info.ok.all()) and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(info))
    P = np.asarray(info.P)
    np.testing.assert_allclose(P, np.swapaxes(P, 1, 2), rtol=1e-12, atol=1e-15)
    assert np.linalg.eigvalsh(P).min() > 0
    assert info.x.shape[-1] == entry.n_states and info.nu.shape[-1] == 6
    if name not in DIVERGES:
        error = np.asarray(jax.vmap(metrics.position_error)(info.nav, drive.truth.pos))
        assert metrics.rms(np.linalg.norm(error[20:48], axis=1)) < 6.0  # fixes of 2/2/4 m

    # a channel that is never there changes nothing, whatever the rule, and a constraint never reaches the paper's rule
    more = solve(build(name, (*GNSS, NONHOLONOMIC), cov_stride=25))(wider(drive.epochs))
    np.testing.assert_allclose(more.nav.pos, info.nav.pos, rtol=0, atol=1e-13)
    np.testing.assert_allclose(more.P, info.P, rtol=0, atol=1e-9)


def test_a_kalman_rule_on_its_own_channels_is_the_joint_update(drive):
    chosen = (*GNSS, NONHOLONOMIC)
    params = matched_params(SCENARIO)
    epochs = wider(drive.epochs)
    valid = epochs.fix.valid.at[::2, 6:].set(True)  # with fixes, without, and without any receiver in the outage
    epochs = epochs._replace(fix=epochs.fix._replace(valid=valid))
    joint = build("ekf15", chosen, cov_stride=25)
    split = make_filter(local_level.propagate, error_model(15, "full", chosen), only(kalman(), 6), reset, 25)
    a, b = (jax.jit(run, static_argnums=0)(f, params, drive.initial, epochs) for f in (joint, split))
    np.testing.assert_allclose(a.nav.pos, b.nav.pos, rtol=0, atol=1e-13)
    np.testing.assert_allclose(a.P, b.P, rtol=1e-7, atol=1e-10)
    assert np.array_equal(a.used, b.used) and bool(a.used[:, 6:].any())


def test_constraint_before_the_receiver_is_refused():
    with pytest.raises(ValueError, match="constraints come after"):
        build("gpid", (NONHOLONOMIC, *GNSS))


def test_unknown_filter_lists_the_known():
    with pytest.raises(ValueError, match="ekf15"):
        build("ekf16")


def test_gains_on_states_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match="9 states has no gyro_bias"):
        gpid_params(1.0, 0.0, 9, states=("position", "gyro_bias"))
