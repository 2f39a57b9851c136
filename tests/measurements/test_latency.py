"""What a late measurement sees: every row of MEASUREMENTS and STATES against "perturb, propagate, observe"."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.run import initial_nav
from jaxnav.maths.units import DEG
from jaxnav.measurements import latency
from jaxnav.measurements.measurement import layout
from jaxnav.states import table
from jaxnav.states.grades import GRADES
from jaxnav.states.table import zeros
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import Fix, Imu, Nav, Params
from tests.test_contract_rows import ALL, EVERY, difference, sizes

DT, SAMPLES = 0.01, 50
RATE = np.array([0.25, 0.15, -0.2])  # rad/s, body
FORCE = np.array([-4.0, 1.5, -17.0])  # m/s^2, body: braking, in a turn of 60 deg of bank
NAV = initial_nav([0.8, -1.3, 900.0], [60.0, -45.0, 5.0], np.array([60.0, 5.0, 120.0]) * DEG, azimuth=0.3)
CLOSE, LEAST = 0.04, 4e-3
"""Share of the effect of a state on a measurement, or of this share of the largest effect: C turns by 6 deg."""


def params_of(age: float) -> Params:
    """Every measurement ``age`` s old; arms and angles that are not zero."""
    params = datasheet_params(GRADES["consumer"], states=EVERY)
    late = {
        name: p._replace(latency=jnp.asarray(age)) if hasattr(p, "latency") else p
        for name, p in params.measurements.items()
    }
    own = dict(lever_arm=jnp.array([0.3, -0.6, -0.4]), vehicle=jnp.array([0.03, -0.05]),
               wheel_arm=jnp.array([-1.0, 0.7, 1.2]))  # fmt: skip
    return params._replace(measurements=late, mounting=params.mounting._replace(**own))


IMU = Imu(
    jnp.full(SAMPLES, DT),
    jnp.tile(jnp.asarray(RATE), (SAMPLES, 1)),
    jnp.tile(jnp.asarray(FORCE), (SAMPLES, 1)),
)


@cache
def program(frame: str):
    """The model of a frame with everything, and its navigation over the samples from a start without the error x."""
    model, propagate = error_model(frame, EVERY, measurements=ALL), FRAMES[frame].propagate
    start = jax.jit(model.enter)(NAV._replace(errors=zeros(EVERY)))
    return model, jax.jit(lambda x: propagate(model.retract(start, x), None, IMU, 1, jnp.arange(SAMPLES))[0])


def last(nav: Nav) -> Nav:
    return jax.tree.map(lambda a: a[-1], nav)


def in_enu(model, nav: Nav):
    """d(error in local level) / d(error in the frame), (n, n)."""
    n = model.n_states
    return jax.jacfwd(lambda x: model.report(last(nav), x, jnp.eye(n))[1])(jnp.zeros(n))


@pytest.mark.full
@pytest.mark.parametrize("frame", FRAMES)
def test_rows_of_late_measurements_are_derivatives(frame):
    """d y / d(error before the interval) = H d(error at its end) / d(error before the interval)."""
    model, navigate = program(frame)
    m, places = model.n_channels, layout(ALL)
    h = np.concatenate([np.repeat([0.1, 0.1, 0.01], 3), 10 * sizes()[9:]])  # of like effect on a position
    value = jnp.full(m, 0.3).at[places["position"]].set(NAV.pos)
    fix = Fix(value, jnp.full(m, 0.5), jnp.zeros(m), jnp.ones(m, bool))
    steps = 0.1 * np.concatenate([np.diag(h), -np.diag(h)])
    moved = jax.vmap(navigate)(jnp.asarray(steps))
    past = navigate(jnp.zeros(h.size))
    observe = jax.jit(lambda age, past: model.observe(params_of(age), past, fix)[:2])
    ends = np.asarray(jax.vmap(lambda nav: difference(model, last(past), last(nav)))(moved))
    halved = lambda a: (a[h.size :] - a[: h.size]).T / (0.2 * h)
    x = np.linalg.solve(np.asarray(in_enu(model, past)), -halved(ends))
    for age in (0.3, 0.3037):  # at a sample, and between two
        y, H = observe(age, past)
        dy = halved(np.asarray(jax.vmap(observe, (None, 0))(age, moved)[0]))
        for name, place in places.items():
            error, effect = (np.abs(a[place] * h).max(0) for a in (np.asarray(H) @ x - dy, dy))
            worst = error / np.maximum(effect, LEAST * effect.max())
            assert worst.max() <= CLOSE, (name, worst.argmax(), worst.max())


@pytest.mark.full
@pytest.mark.parametrize("frame", FRAMES)
def test_an_error_is_carried_back_over_the_samples_before(frame):
    """A correction at the end takes the error that it leads to out of every sample of the past."""
    model, navigate = program(frame)
    h = 0.1 * sizes()
    x0 = jnp.asarray(h * np.random.default_rng(2).normal(size=h.size))
    estimate, truth = navigate(jnp.zeros(h.size)), navigate(x0)
    x = np.linalg.solve(in_enu(model, estimate), difference(model, last(estimate), last(truth)))
    back = jax.vmap(model.retract)(estimate, jax.jit(model.earlier)(estimate, jnp.asarray(x)))
    left = np.asarray(jax.vmap(lambda a, b: difference(model, a, b))(back, truth))
    assert (np.abs(left / h) < 0.01).all(), np.abs(left / h).max(0)


def test_biases_act_as_the_integrals_of_a_constant_force():
    """A body that does not turn under a force f: phi' = -b_g, v' = phi x f - b_a, p' = v have closed forms."""
    age, f = 0.7, np.array([3.0, -2.0, 9.0])
    between = latency.Interval(jnp.asarray(age), f * age, f * age**2 / 2, *2 * [jnp.array([1.0, 0.0, 0.0, 0.0])])
    B = np.asarray(latency.error_then(between, table.chosen(table.BIASES)))
    p, v, phi, b_g, b_a = then = np.random.default_rng(4).normal(size=(5, 3))
    now = [
        p + v * age + np.cross(phi * age**2 / 2 - b_g * age**3 / 6, f) - b_a * age**2 / 2,
        v + np.cross(phi * age - b_g * age**2 / 2, f) - b_a * age,
        phi - b_g * age,
        b_g,
        b_a,
    ]
    np.testing.assert_allclose(B @ np.concatenate(now), np.concatenate(then[:3]), atol=1e-12)


def test_without_age_nothing_is_carried_back():
    between = latency.interval(NAV, NAV, jnp.zeros(()))
    B = np.asarray(latency.error_then(between, table.chosen(EVERY)))
    np.testing.assert_array_equal(B, np.eye(9, 9 + sum(s.size for s in table.chosen(EVERY))))


def test_the_form_by_components_is_the_matrix():
    """`earlier_error` of a random error, for each sample of history and with every state, is `error_then` times it."""
    states = table.chosen(EVERY)
    n = 9 + sum(s.size for s in states)
    model, path = program("local_level")
    past = path(jnp.zeros(n))
    x = jnp.asarray(np.random.default_rng(2).normal(size=n))
    for i in (0, SAMPLES // 2, SAMPLES - 2):
        then, now = (jax.tree.map(lambda a, k=k: a[k], past) for k in (i, -1))
        between = latency.interval(then, now, now.t - then.t)
        found, expected = latency.earlier_error(between, states)(x), latency.error_then(between, states) @ x
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
