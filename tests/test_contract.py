"""What every filter of the catalogue owes its user, on one small drive."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav import FILTERS, GNSS, NONHOLONOMIC, build, make_filter
from jaxnav.analysis import metrics
from jaxnav.filters.catalogue import Entry
from jaxnav.filters.error_model import error_model
from jaxnav.filters.papers.gpid import gpid_params
from jaxnav.filters.rule import Innovation, Rule
from jaxnav.filters.rules.combinators import only
from jaxnav.filters.run import run
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import matched_params, simulate_jit
from jaxnav.states.table import BIASES
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Epoch, Fix, Forcing

SCENARIO = SCENARIOS["urban_short"]
SCENARIO = SCENARIO._replace(imu=SCENARIO.imu._replace(grade="tactical"))  # of which 9 states are enough
DIVERGES = {"gpid_literal", "gipkf_literal", "gipkf_literal_shift"}  # as printed: measured by the benchmarks


@pytest.fixture(scope="module")
def drive():
    return simulate_jit(jax.random.key(5), SCENARIO)


def wider(epochs: Epoch) -> Epoch:
    """The same epochs with non-holonomic channels that are never there."""
    f = epochs.fix
    pad = lambda a, v: jnp.concatenate([a, jnp.full((a.shape[0], 2), v, a.dtype)], axis=1)
    return epochs._replace(fix=Fix(pad(f.value, 0.0), pad(f.sd, 1.0), pad(f.corr, 0.0), pad(f.valid, False)))


# one program serves all filters that differ in their rule alone: the suite's time is compilation


def one_of(rules: tuple[Rule, ...]) -> Rule:
    """The rule whose number comes first in theta (number, parameters of each)."""

    def correct(theta, memories, z):
        def branch(i, rule):
            c = rule.correct(theta[1][i], memories[i], z)
            memory = (*memories[:i], c.memory, *memories[i + 1 :])
            fade = jnp.broadcast_to(c.fade, c.delta.shape)
            return c._replace(memory=memory, fade=fade, drive=c.drive or Forcing(jnp.zeros(3), jnp.zeros(3)))

        return jax.lax.switch(theta[0], [partial(branch, i, rule) for i, rule in enumerate(rules)])

    def extrapolate(theta, memories, x0, x):
        def branch(i, rule):
            moved, memory = rule.extrapolate(theta[1][i], memories[i], x0, x)
            return moved, (*memories[:i], memory, *memories[i + 1 :])

        return jax.lax.switch(theta[0], [partial(branch, i, rule) for i, rule in enumerate(rules)])

    def transport(theta, memories, moved, T):
        pairs = zip(rules, theta[1], memories, strict=True)
        return tuple(rule.transport(own, memory, moved, T) if rule.transport else memory for rule, own, memory in pairs)

    init = lambda n, m: tuple(rule.init(n, m) for rule in rules)
    return Rule(
        init, correct, extrapolate, estimates=BIASES, transport=transport
    )  # of every branch, with a drive of its own or of zero


def alike(entry: Entry) -> tuple[str, ...]:
    """Names of the filters that differ from this one in their rule alone."""
    parts = ("frame", "states", "form", "feedback", "feedback_theta")
    return tuple(n for n, e in FILTERS.items() if all(getattr(e, p) == getattr(entry, p) for p in parts))


@cache
def program(names: tuple[str, ...], measurements=GNSS):
    entry = FILTERS[names[0]]
    rule = one_of(tuple(FILTERS[name].rule(GNSS) for name in names))
    rule = rule if measurements == GNSS else only(rule, tuple(range(6)))
    model = error_model(entry.frame, entry.states, entry.form, measurements)
    home = FRAMES[entry.frame]  # the form that `build` takes
    filt = make_filter(home.fast or home.propagate, model, rule, entry.feedback, 25)
    return jax.jit(partial(run, filt))


def solve(name, drive, epochs, measurements=GNSS):
    entry = FILTERS[name]
    names = alike(entry)
    theta = jnp.array(names.index(name)), tuple(FILTERS[each].theta() for each in names)
    params = matched_params(SCENARIO, rule=theta, feedback=entry.feedback_theta())
    return program(names, measurements)(params, drive.initial, epochs)


@pytest.mark.parametrize("name", FILTERS)
def test_contract(name, drive):
    entry = FILTERS[name]
    info = solve(name, drive, drive.epochs)
    assert bool(info.ok.all()) and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(info))
    P = np.asarray(info.P)
    np.testing.assert_allclose(P, np.swapaxes(P, 1, 2), rtol=1e-12, atol=1e-15)
    assert np.linalg.eigvalsh(P).min() > 0
    if name not in DIVERGES:
        error = np.asarray(jax.vmap(metrics.position_error)(info.nav, drive.truth.pos))
        assert metrics.rms(np.linalg.norm(error[20:48], axis=1)) < 4.0  # fixes of 2/2/4 m
    filt = build(name, (*GNSS, NONHOLONOMIC), cov_stride=25)
    params = matched_params(SCENARIO, rule=entry.theta(), feedback=entry.feedback_theta())
    epoch = jax.tree.map(lambda a: a[0], wider(drive.epochs))
    _, row = jax.eval_shape(filt.correct, params, jax.eval_shape(filt.init, params, drive.initial), epoch.fix)
    assert row.x.shape == (9 + 3 * len(entry.states),) and row.nu.shape == (8,)


@pytest.mark.full
@pytest.mark.parametrize("names", dict.fromkeys(map(alike, FILTERS.values())), ids=lambda names: names[0])
def test_no_filter_calls_lapack(names, drive):
    """Of two calls at the same time on two processors, in batches, neither ended: see `jaxnav.maths.linalg`."""
    theta = jnp.array(0), tuple(FILTERS[name].theta() for name in names)
    params = matched_params(SCENARIO, rule=theta, feedback=FILTERS[names[0]].feedback_theta())
    assert "lapack" not in program(names).lower(params, drive.initial, drive.epochs).as_text()


@pytest.mark.full
@pytest.mark.parametrize("name", alike(FILTERS["ekf15"]))
def test_a_channel_that_is_never_there_changes_nothing(name, drive):
    """Whatever the rule; and a constraint never reaches a paper's rule."""
    info = solve(name, drive, drive.epochs)
    more = solve(name, drive, wider(drive.epochs), (*GNSS, NONHOLONOMIC))
    np.testing.assert_allclose(more.nav.pos, info.nav.pos, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(more.P, info.P, rtol=0, atol=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("name", FILTERS)
def test_a_rule_is_finite_and_still_where_nothing_is_there(name):
    """With H = 0 and T = 0, as a batch asks of it where others of its runs have a fix."""
    entry, blank = FILTERS[name], jnp.zeros(6)
    n, rule = 9 + 3 * len(entry.states), entry.rule(GNSS)
    P = jnp.diag(jnp.linspace(1.0, 2.0, n))
    z = Innovation(blank, jnp.zeros((6, n)), jnp.eye(6), P, blank > 0, jnp.zeros(()), blank)
    memory = rule.init(n, 6)
    answer = jax.jit(rule.correct)(entry.theta(), memory, z)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(answer))
    assert not answer.used.any()
    assert jax.tree.structure(answer.memory) == jax.tree.structure(memory)


def test_a_kalman_rule_on_its_own_channels_is_the_joint_update(drive):
    chosen = (*GNSS, NONHOLONOMIC)
    params = matched_params(SCENARIO)
    epochs = wider(drive.epochs)
    valid = epochs.fix.valid.at[::2, 6:].set(True)  # with fixes, without, and without any receiver in the outage
    epochs = epochs._replace(fix=epochs.fix._replace(valid=valid))
    a = jax.jit(run, static_argnums=0)(build("ekf15", chosen, cov_stride=25), params, drive.initial, epochs)
    b = solve("ekf15", drive, epochs, chosen)
    np.testing.assert_allclose(a.nav.pos, b.nav.pos, rtol=1e-13, atol=1e-13)
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
