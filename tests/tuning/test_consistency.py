"""Filters at their tuned point: are normalised innovations and errors squared what they should be?

Tuned by the likelihood of innovations from white noise that is three times too large, all that a filter has being free;
judged on other runs. Innovations are consistent in every filter that has a covariance: that is what the likelihood
sees. Errors are in those of 15 states; nine states cannot hold a bias that lasts, and the printed forms of the papers
not even what they do hold.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis import metrics
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.run import run
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params, simulate
from tuning.contest import applied, datasheet, spec_of
from tuning.fit.objectives import innovation_nll
from tuning.fit.optimizers import adam
from tuning.fit.train import fit

SCENARIO = SCENARIOS["urban_short"]._replace(duration_s=90.0)
SETTLED = 40.0  # s
TRAIN, TEST, STEPS = 10, 40, 60
SURE = 0.999  # of the bounds of a mean over the test's runs
NINE = 3.5  # times the error that nine states may have beside what they believe: a bias that they have no state for
LEARNING = {"gipkf": 15.0, "ekf9_iae": 15.0}  # likewise, of rules whose weights follow the innovations
CAREFUL = {"ekf15_iae": 0.5}  # least share of the error that it believes in: its R is a mean over a window
PRINTED = ("gipkf_literal", "gipkf_literal_shift", "fwekf_literal")  # whose errors have no bound at all


@cache
def drives():
    make = jax.jit(jax.vmap(partial(simulate, scenario=SCENARIO)))
    return make(jax.random.split(jax.random.key(0), TRAIN)), make(jax.random.split(jax.random.key(1), TEST))


@cache
def loss_of(filt):
    def loss(params, sim):
        info = run(filt, applied(params, matched_params(SCENARIO)), sim.initial, sim.epochs)
        return innovation_nll(info, sim.truth.t > 5.0)

    return loss


@partial(jax.jit, static_argnums=0)
def squares(filt, params, sims):
    """NIS per channel after the start, and NEES of motion per degree of freedom at the end, of every run."""

    def one(sim):
        info = run(filt, applied(params, matched_params(SCENARIO)), sim.initial, sim.epochs)
        used = info.valid.any(-1) & (sim.truth.t > SETTLED)
        nis = jnp.sum(jnp.where(used, info.nis, 0.0)) / jnp.sum(jnp.where(used, info.valid.sum(-1), 0))
        x = jax.vmap(metrics.state_error)(info.nav, sim.truth)[-1]
        return nis, metrics.nees(x, info.P[-1, :9, :9]) / 9, info.ok.all()

    return jax.vmap(one)(sims)


def tuned(name, steps=STEPS):
    filt, start = build(name, cov_stride=10), datasheet(name)
    start = start._replace(noise=jax.tree.map(lambda a: 3.0 * a, start.noise))
    train, test = drives()
    found = fit(loss_of(filt), spec_of(name), start, steps, adam(steps, 0.2), cases=[train], clip=1.0)
    nis, nees, ok = (np.asarray(a) for a in squares(filt, found.params, test))
    assert ok.all() and found.loss <= found.history[0]["loss"]
    return float(nis.mean()), float(nees.mean())


def check(name, nis, nees):
    low, high = np.array(metrics.chi2_bounds(9, TEST, SURE)) / 9
    if name in PRINTED:
        assert nis < 2.0
        return
    assert 0.9 < nis < 1.1
    states = build(name).model.n_states
    assert CAREFUL.get(name, low) < nees < (high if states >= 15 else LEARNING.get(name, NINE))


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_a_tuned_filter_knows_its_innovations_and_with_15_states_its_errors(name):
    check(name, *tuned(name))
