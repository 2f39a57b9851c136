"""The fuzzy weighted filter: its limits, its printed form, and what its inputs and its fading do."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxnav.filters.catalogue import build
from jaxnav.filters.core import make_filter
from jaxnav.filters.error_model import error_model
from jaxnav.filters.feedback import observer, poles
from jaxnav.filters.papers import fwekf
from jaxnav.filters.rule import Innovation
from jaxnav.filters.rules import fuzzy
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.run import initial_nav, run
from jaxnav.maths import earth, rotations
from jaxnav.maths.units import DEG
from jaxnav.states.motion import P
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Epoch, Fix, Imu
from tests.conftest import all_finite, leaves_equal

ONE = ((0,),)  # a table of one rule
OFF = fwekf.limits(*[np.inf] * 5)


def constant(a):
    """Parameters whose answer is ``a`` (a tracer too), whatever the residuals; no limit on fading."""
    system = fuzzy.system(((0.0,), (0.0,)), ((1.0,), (1.0,)), (1.5,), (1.0, 2.0))
    return fwekf.Fwekf(system._replace(bounds=jnp.broadcast_to(jnp.asarray(a, float), (2,))), OFF)


@pytest.fixture(scope="module")
def solve(case):
    """Run a rule on the shared drive with 9 states and the observer, in the frame that compiles soonest."""

    @functools.cache
    def make(rule):
        frame = FRAMES["local_level"]
        filt = make_filter(frame.fast, error_model(states=()), rule, observer, 20)
        params = case.params._replace(feedback=poles())
        return jax.jit(lambda theta: run(filt, params._replace(rule=theta), case.nav, case.packed.epochs))

    return make


@pytest.mark.full
def test_without_fading_it_is_the_kalman_filter(solve):
    plain, ours = solve(kalman())(()), solve(fwekf.fwekf(5, ONE))(constant(1.0))
    leaves_equal(ours.nav, plain.nav, 1e-12)
    leaves_equal(ours.P, plain.P, 1e-14, 1e-10)


@pytest.mark.full
def test_printed_weights_are_the_same_filter_while_a_is_constant(solve):
    recursive, literal = solve(fwekf.fwekf(5, ONE)), solve(fwekf.fwekf_literal(5, ONE))
    for a in (1.01, 1.05):
        one, two = recursive(constant(a)), literal(constant(a))
        height = np.abs(one.nav.pos[:, 2] - two.nav.pos[:, 2]).max()
        assert height < 1e-9 and np.abs(one.nav.vel - two.nav.vel).max() < 1e-9
        # P of the printed form shrinks by a^-2 a fix
        k = np.arange(one.P.shape[0])[:, None, None]
        np.testing.assert_allclose(np.asarray(two.P) * a ** (2.0 * k), one.P, rtol=1e-6, atol=1e-12)
    # they part where a changes, and the printed form runs out of numbers: 1e8 a fix here, after 38 fixes
    changing = constant(1.1)
    system = changing.system._replace(bounds=jnp.array([1.0, 1.2]), consequents=jnp.array([[-2.0, 8.0, 0.0]]))
    changing = changing._replace(system=system)
    assert np.abs(recursive(changing).nav.vel - literal(changing).nav.vel).max() > 1e-3
    last = literal(constant(1e4))
    assert not bool(last.ok[-1]) and all_finite(last)


def test_fading_is_exponential_forgetting():
    """A scalar that is observed directly: least squares in which a fix k ago has the weight a^-2(k+1)."""
    a, sd, n = 1.1, 2.0, 30
    rng = np.random.default_rng(0)
    y = rng.normal(size=n)
    rule, theta = fwekf.fwekf(4, ONE), constant(a)
    memory, x, p = rule.init(1, 1), 0.0, 100.0
    correct = jax.jit(rule.correct)
    one = lambda v: jnp.full((1, 1), v)
    for v in y:
        z = Innovation(jnp.array([v - x]), one(1.0), one(sd**2), one(p), jnp.array([True]), *jnp.ones(2))
        c = correct(theta, memory, z)
        memory, x, p = c.memory, x + float(c.delta[0]), float(c.fade[0] ** 2 * c.P[0, 0])
    weight = a ** (2 - 2 * (n - 1 - np.arange(n))) / sd**2
    information = weight.sum() + a ** (-2 * (n - 1)) / 100.0
    np.testing.assert_allclose(x, weight @ y / information, rtol=1e-12)
    np.testing.assert_allclose(c.P[0, 0], 1 / information, rtol=1e-12)


def innovation(nu, valid=None, n=9, sd=None):
    H = jnp.eye(6, n)
    P = jnp.diag(jnp.linspace(1.0, 2.0, n) ** 2) if sd is None else jnp.diag(sd**2)
    valid = jnp.ones(6, bool) if valid is None else valid
    return Innovation(jnp.where(valid, nu, 0.0), jnp.where(valid[:, None], H, 0.0), jnp.eye(6), P, valid,
                      jnp.ones(()), jnp.ones(6))  # fmt: skip


def window_of(residuals, valid=None, n=50):
    """A window that residuals (K, 6) have gone through, and the last innovation."""
    past = fwekf.window(n, 6)
    for i, r in enumerate(residuals):
        z = innovation(jnp.asarray(r), None if valid is None else jnp.asarray(valid[i]))
        past = jax.jit(fwekf.push)(past, z)
    return past, z


def test_window_holds_the_last_n_and_divides_by_what_there_is():
    r = np.random.default_rng(1).normal(size=(12, 6))
    for K, n in ((3, 5), (12, 5)):
        mean, power = fwekf.moments(window_of(r[:K], n=n)[0])
        last = r[max(0, K - n) : K]
        np.testing.assert_allclose(mean, last.mean(0), rtol=1e-13)
        np.testing.assert_allclose(power, (last**2).mean(0), rtol=1e-13)
    # a channel that was not there does not count
    valid = np.ones((12, 6), bool)
    valid[8:, 2] = False
    past, z = window_of(r, valid, n=5)
    np.testing.assert_allclose(fwekf.moments(past)[1][2], r[7, 2] ** 2, rtol=1e-13)
    inputs = jax.jit(fwekf.inputs)
    other = window_of(np.where(valid, r, 1e6), valid, n=5)
    np.testing.assert_allclose(inputs(past, z), inputs(*other), rtol=1e-15)


def test_inputs_see_a_bias_and_a_size():
    rng = np.random.default_rng(2)
    expected = np.sqrt(np.linspace(1.0, 2.0, 9)[:6] ** 2 + 1)  # of the residuals, see `innovation`
    inputs = jax.jit(fwekf.inputs)
    _, z = window_of(np.ones((1, 6)))
    for n in (20, 50):
        white = jnp.asarray(expected * rng.normal(size=(200, n, 6)))
        x = jax.vmap(lambda r, n=n: inputs(fwekf.Window(r, jnp.ones((n, 6), bool)), z))(white)
        np.testing.assert_allclose([np.sqrt((x[:, 0] ** 2).mean()), x[:, 1].mean()], [n**-0.5, np.log10(2)], rtol=0.04)
    np.testing.assert_allclose(inputs(*window_of(np.tile(3 * expected, (9, 1)))), [1, 1], rtol=1e-6)  # log10(1 + 9)
    np.testing.assert_allclose(inputs(*window_of(np.tile(1e9 * expected, (9, 1)))), [1, 6], rtol=1e-6)
    quiet = inputs(*window_of(np.zeros((3, 6))))
    np.testing.assert_allclose(quiet, [1e-5, 0], atol=1e-12)


def test_fading_ends_at_the_limit_and_nowhere_jumps():
    limit, fading = fwekf.limits(), jax.jit(fwekf.fading)
    top = np.repeat(np.asarray(limit), 3)
    for a in (1.01, 1.2, 2.0):
        start = np.logspace(-3, 0.5, 15)
        sd = top * start
        for _ in range(1000):
            sd = sd * np.asarray(fading(limit, jnp.asarray(a), jnp.diag(sd**2)))
        below = start < 1
        assert (sd[below] <= top[below]).all() and (sd > 0.5 * top).all()
        np.testing.assert_allclose((sd / top)[~below], start[~below], rtol=1e-12)
        small = fading(limit, jnp.asarray(a), jnp.diag((1e-4 * top) ** 2))
        np.testing.assert_allclose(small, a, rtol=1e-7)
        np.testing.assert_array_equal(fading(limit, jnp.asarray(a), jnp.diag((1.5 * top) ** 2)), 1.0)
    # no kink where the weight crosses 1, at any P: the slope in a is the same on both sides
    half = jax.jit(lambda a: fwekf.fading(limit, a, jnp.diag(0.5 * top**2)))
    up, down = (np.asarray(half(jnp.asarray(1 + h)) - 1) for h in (1e-6, -1e-6))
    np.testing.assert_allclose(up, -down, rtol=1e-5)
    np.testing.assert_allclose(up, 0.25e-6, rtol=1e-5)
    slope = jax.jit(jax.vmap(jax.grad(lambda s: fwekf.fading(limit, 1.2, jnp.diag((s * top) ** 2)).sum())))
    steps = np.asarray(slope(jnp.linspace(0.5, 1.5, 2001)))
    assert np.abs(np.diff(steps)).max() < 0.05  # a slope without a jump
    np.testing.assert_array_equal(fading(limit, jnp.asarray(1.0), jnp.diag(top**2 / 2)), 1.0)


def standing(E):
    """A vehicle that stands, with a fix of 10 m and 0.2 m/s ten times a second: heading is all but unobservable."""
    nav = initial_nav([0.65, 2.0, 100.0])
    C = rotations.to_dcm(nav.q)
    gyro, accel = earth.earth_rate(nav.pos[0]) @ C, earth.gravity(nav.pos[0], nav.pos[2]) * C[2]
    z = np.random.default_rng(4).normal(size=(E, 6)) * np.repeat([10.0, 0.2], 3)
    value = jnp.concatenate([jax.vmap(earth.move, (None, 0))(nav.pos, z[:, :3]), z[:, 3:]], 1)
    sd = jnp.tile(jnp.repeat(jnp.array([10.0, 0.2]), 3), (E, 1))
    imu = Imu(jnp.full((E, 2), 0.05), jnp.tile(gyro, (E, 2, 1)), jnp.tile(accel, (E, 2, 1)))
    return nav, Epoch(imu, Fix(value, sd, jnp.zeros((E, 6)), jnp.ones((E, 6), bool)))


@pytest.mark.full
def test_heading_at_rest_does_not_wind_up(case):
    nav, epochs = standing(300)
    params = case.params._replace(feedback=poles(), prior=case.params.prior._replace(attitude=jnp.asarray(DEG)))
    frame = FRAMES["local_level"]
    filt = make_filter(frame.fast, error_model(states=()), fwekf.fwekf(5, ONE), observer, 2)

    @jax.jit
    @jax.vmap
    def covariance(top):
        theta = constant(1.1)._replace(limit=OFF._replace(attitude=top))
        return run(filt, params._replace(rule=theta), nav, epochs).P

    free, held, lower = np.asarray(covariance(jnp.array([np.inf, 10 * DEG, 5 * DEG])))
    sd = lambda P: np.sqrt(P[:, 8, 8]) / DEG
    assert sd(free).max() > 100  # degrees: a covariance that means nothing
    assert 2 < sd(held).max() < 10
    np.testing.assert_allclose(held[-1, P, P], lower[-1, P, P], rtol=0, atol=0.01 * lower[-1, 0, 0])


@pytest.mark.full
def test_it_runs_with_biases_in_a_frame_that_is_not_its_own(case):
    filt = build("fwekf15", cov_stride=20, frame="tangent")
    params = case.params._replace(rule=fwekf.fwekf_params(), feedback=poles())
    info = jax.jit(run, static_argnums=0)(filt, params, case.nav, case.packed.epochs)
    assert bool(info.ok.all())
    error = np.asarray(info.nav.vel)[-20:] - case.truth.vel[20::20][-20:]
    assert np.sqrt((error**2).mean()) < 0.1


def test_gradient_of_a_run_in_memberships_and_consequents():
    """Position and velocity tracked by a rule that is told too little noise; every parameter against differences."""
    rule, theta = fwekf.fwekf(8), fwekf.fwekf_params(0.9)
    y = jnp.asarray(np.random.default_rng(5).normal(size=(60, 1)) * 3)
    Phi, Q, H = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.diag(jnp.array([1e-6, 1e-4])), jnp.array([[1.0, 0.0]])
    flat, unravel = ravel_pytree(theta.system[:3])

    @jax.jit
    def rms(flat):
        mine = theta._replace(system=fuzzy.System(*unravel(flat), theta.system.bounds))

        def step(state, y):
            x, P, memory = state
            x, P = Phi @ x, Phi @ P @ Phi.T + Q
            z = Innovation(H @ x - y, H, jnp.eye(1), P, jnp.array([True]), *jnp.ones(2))
            c = rule.correct(mine, memory, z)
            x = x - c.delta
            return (x, c.fade[:, None] * c.P * c.fade, c.memory), x

        start = jnp.zeros(2), jnp.eye(2), rule.init(2, 1)
        return jnp.sqrt((jax.lax.scan(step, start, y)[1][:, 0] ** 2).mean())

    grad, h = np.asarray(jax.jit(jax.grad(rms))(flat)), 1e-5
    numeric = np.array([(rms(flat + e) - rms(flat - e)) / (2 * h) for e in h * np.eye(flat.size)])
    assert (np.abs(grad) > 1e-9).sum() > 20
    np.testing.assert_allclose(grad, numeric, rtol=1e-5, atol=1e-9 * np.abs(grad).max())


def test_printed_inputs_add_up_one_more_than_they_divide_by():
    """Eqs. 31 and 32 by hand, n = 4: five residuals over 4, and the squares of the last four, in metres."""
    rng = np.random.default_rng(3)
    residual, n = rng.normal(size=(5, 6)) * [3, 4, 5, 0.1, 0.2, 0.3], 4
    past = fwekf.Window(jnp.asarray(residual), jnp.ones((5, 6), bool))
    z = innovation(jnp.zeros(6))
    x1, x2 = fwekf.printed_inputs(past, z)
    np.testing.assert_allclose(x1, np.sqrt(np.mean((residual.sum(0) / n) ** 2) + 1e-10), rtol=1e-12)
    np.testing.assert_allclose(x2, np.mean((residual[1:] ** 2).sum(0) / n), rtol=1e-12)
    first = fwekf.Window(past.residual, jnp.zeros((5, 6), bool).at[-1].set(True))  # the first fix of a run
    np.testing.assert_allclose(fwekf.printed_inputs(first, z)[1], np.mean(residual[-1] ** 2), rtol=1e-12)
