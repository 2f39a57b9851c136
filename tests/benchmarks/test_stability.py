"""Stability of the GPID filter: closed forms, the paper's slips, and growth along the paper's circle three ways."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from benchmarks.papers import stability as robustness
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.filters.papers import gpid
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.rule import Innovation
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.simulate.trajectories import Circle, circle
from jaxnav.states.grades import GRADES
from jaxnav.types import Epoch, Nav, Params

ONE = jnp.eye(1)
PERIOD = 126.0
PRINTED = {"G1": (1.0, 0.0), "G2": (1.5, 3.0)}
GAINS = [0.01, 0.1, 0.2, 0.5, 0.9]


def scalar(K):
    return jnp.full((1, 1), K)


# ---------------------------------------------------------------------------- closed forms


def spectral_radius(M):
    """The largest absolute value of an eigenvalue: below 1 is stable."""
    return float(np.abs(np.linalg.eigvals(np.asarray(M))).max())


@pytest.mark.parametrize("K", GAINS)
@pytest.mark.parametrize("ki", [0.5, 1.0, 1.5])
def test_paper_matrix_of_one_state(K, ki):
    """|lambda|^2 = 1 - K (1 - ki): the analysed ki = 1 is marginal, the printed 1.5 unstable for every gain."""
    M = np.asarray(robustness.paper_matrix(ONE, scalar(K), ONE, ki))
    values = np.linalg.eigvals(M)
    assert abs(values[0].imag) > 0  # K < 4 ki
    np.testing.assert_allclose(np.abs(values) ** 2, 1 - K * (1 - ki), rtol=1e-12)
    assert (spectral_radius(M) > 1 + 1e-9) == (ki > 1)


@pytest.mark.parametrize("K", GAINS[:4])
def test_exact_matrix_without_derivative(K):
    """What the filter does with ki = 1: |lambda|^2 = 1 - K, stable where the paper's matrix is marginal."""
    M = robustness.exact_matrix(ONE, scalar(K), ONE, 1.0, 0.0, np.ones(1))
    values = np.sort_complex(np.linalg.eigvals(np.asarray(M)))
    pair = values[np.abs(values.imag) > 1e-9]
    np.testing.assert_allclose(np.abs(pair) ** 2, 1 - K, rtol=1e-9)
    assert pair.size == 2 and spectral_radius(M) < 1


@pytest.mark.parametrize("ki, kd", [(1.5, 3.0), (1.0, 2.0), (0.1, 5.0)])
def test_derivative_bounds_the_gain(ki, kd):
    """Stable below K = 2 / (1 + ki/2 + 2 kd), 0.258 for the paper's second pair, and not above."""
    bound = 2 / (1 + ki / 2 + 2 * kd)
    radius = lambda K: spectral_radius(robustness.exact_matrix(ONE, scalar(K), ONE, ki, kd, np.ones(1)))
    assert radius(0.999 * bound) < 1 < radius(1.001 * bound)
    if (ki, kd) == PRINTED["G2"]:
        assert bound == pytest.approx(0.258, abs=5e-4)


# ---------------------------------------------------------------------------- the matrix against the rule itself

A4 = np.eye(4) + np.array([[0.0, 1, 0.1, 0], [0, 0, -0.3, 0.2], [0.05, 0, 0, 0], [0, -0.02, 0, -0.1]])
H4 = jnp.asarray(np.array([[1.0, 0, 0, 0], [0, 1, 0.2, 0]]))
MASK = np.array([1.0, 1.0, 0.0, 1.0])
THETA = gpid.gpid_params([0.3, 0.1], [0.2, 0.05], leak=0.97)._replace(states=jnp.asarray(MASK))


def linear_run(theta, A, H, P, R, e0, bias, steps):
    """The rule in closed loop on x+ = A x, y = H x + bias: what is left of x, and the rule's memory, after each fix."""
    n, m = H.shape[1], H.shape[0]

    def step(carry, _):
        e, memory = carry
        x = A @ e
        z = Innovation(H @ x + bias, H, R, P, jnp.ones(m, bool), jnp.array(1.0), jnp.zeros(m))
        c = gpid.correct(theta, memory, z)
        return (x - c.delta, c.memory), jnp.concatenate([x - c.delta, *c.memory[:3]])

    first = (e0, gpid.gpid().init(n, m))
    return jax.jit(lambda first: lax.scan(step, first, None, steps)[1])(first)


def test_exact_matrix_is_the_rule():
    """Gains per channel, a mask and a leak included, from an error that has a memory."""
    P, R = jnp.diag(jnp.array([1.0, 0.5, 0.1, 0.2])), jnp.diag(jnp.array([1.0, 2.0]))
    K = P @ H4.T @ jnp.linalg.inv(H4 @ P @ H4.T + R)
    M = np.asarray(robustness.exact_matrix(jnp.asarray(A4), K, H4, *THETA[:4]))
    s = np.asarray(linear_run(THETA, jnp.asarray(A4), H4, P, R, jnp.array([1.0, -2.0, 0.5, 3.0]), 0.0, 30))
    np.testing.assert_allclose(s[:-1] @ M.T, s[1:], rtol=0, atol=1e-11 * np.abs(s).max())


def test_integral_follows_a_constant_measurement_error():
    """The paper's (42) loses K_I w_m and concludes that it is rejected; the filter ends at H e = -b."""
    P, R, bias = jnp.diag(jnp.array([0.2, 0.1])), jnp.eye(2), jnp.array([3.0, -1.0])
    s = linear_run(gpid.gpid_params(0.3, 0.0, 9)._replace(states=jnp.ones(2)), jnp.eye(2), jnp.eye(2), P, R,
                   jnp.zeros(2), bias, 600)  # fmt: skip
    np.testing.assert_allclose(s[-1, :2], -bias, atol=1e-8)
    K = P @ jnp.linalg.inv(P + R)
    assert spectral_radius(robustness.paper_matrix(jnp.eye(2), K, jnp.eye(2), 0.3)) < 1  # says e -> 0


def test_multipliers_leave_out_what_no_error_reaches():
    """A counter and a masked integral have an eigenvalue 1 of their own; a reached integrator counts."""
    alone = np.array([[[0.5, 0.3], [0.0, 1.0]]])
    np.testing.assert_allclose(robustness.multipliers(alone, 1), [0.5])
    reached = np.array([[[0.5, 0.0], [0.1, 1.0]]])
    np.testing.assert_allclose(robustness.multipliers(reached, 1), [1.0, 0.5])
    later = np.array([[[0.5, 0.0], [0.0, 1.0]], [[0.5, 0.0], [0.1, 1.0]]])  # linked in the second step only
    np.testing.assert_allclose(robustness.multipliers(later, 1), [1.0, 0.25])


# ---------------------------------------------------------------------------- the paper's circle


class Round(NamedTuple):
    """One round of the circle and a filter on it."""

    filter: Filter
    params: Params
    navs: Nav
    epochs: Epoch
    P: jax.Array


def on_circle(frame: str = "", rounds: int = 1) -> Round:
    """The paper's simple error model with its Table 1 on V = 10 m/s, 126 s, at latitude 30 deg."""
    filt = build("gpid_literal", frame=frame)
    navs, epochs = robustness.perfect(circle(Circle(10.0, PERIOD)), (30 * DEG, 0.0, 0.0), 126 * rounds, k=1)
    params = datasheet_params(
        GRADES["tactical"], (5.0, 5.0, 5.0), (0.1, 0.1, 0.1), 0.05 * DEG, 0.3 * DEG, rule=gpid.literal_params(0.0, 0.0)
    )
    return Round(filt, params, navs, epochs, jnp.zeros((9, 9)))


def noisier(params: Params, factor: float) -> Params:
    """With ``factor`` times the IMU's noise: the gain on the heading then settles within an hour."""
    noise = params.noise
    return params._replace(noise=noise._replace(gyro=factor * noise.gyro, accel=factor * noise.accel))


@pytest.fixture(scope="module")
def first() -> Round:
    """After three hours of rounds, when the gain on the heading still falls slowly."""
    r = on_circle()
    return r._replace(P=robustness.settle(*r[:4], rounds=86))


@pytest.fixture(scope="module")
def settled(first) -> Round:
    """Ten times the IMU's noise, and the covariance that comes back after every round."""
    r = first._replace(params=noisier(first.params, 10.0))
    return r._replace(P=robustness.settle(*r[:4]))


def with_gains(r: Round, theta) -> tuple:
    return r.filter, r.params._replace(rule=theta), r.navs, r.epochs, r.P


def explicit_rate(r: Round, theta) -> float:
    """Growth from the filter's own A, K and H by the closed form."""
    A, K, H = robustness.linear_model(*with_gains(r, theta))
    M = jax.vmap(lambda A, K, H: robustness.exact_matrix(A, K, H, *theta[:4]))(A, K, H)
    return float(np.log(np.abs(robustness.multipliers(M, 9)[0])) / PERIOD)


@pytest.mark.full
@pytest.mark.parametrize("gains, rate", [("G1", 4.5e-3), ("G2", 7.3e-3)])
def test_printed_gains_diverge_on_the_circle(first, gains, rate):
    """On all states; derivative of the step and closed form agree, up to what the paper's F leaves out."""
    literal = gpid.literal_params(*PRINTED[gains])
    explicit = explicit_rate(first, literal)
    assert explicit == pytest.approx(rate, rel=0.25)
    if gains == "G1":  # for one of them: it takes seconds
        assert robustness.growth_rate(*with_gains(first, literal)) == pytest.approx(explicit, rel=5e-3)


@pytest.mark.full
def test_position_states_hold_on_the_circle(first):
    """As stable as the Kalman filter, with both pairs."""
    kalman = explicit_rate(first, gpid.literal_params(0.0, 0.0))
    assert kalman < 0
    for gains in PRINTED.values():
        assert kalman < explicit_rate(first, gpid.gpid_params(*gains)) < 0.7 * kalman
    position = gpid.gpid_params(*PRINTED["G1"])
    assert robustness.growth_rate(*with_gains(first, position)) == pytest.approx(
        explicit_rate(first, position), abs=5e-6
    )


@partial(jax.jit, static_argnums=0)
def heading_difference(filt, params, nav, epochs, P):
    """Heading of a run that starts 1e-7 rad off minus that of one that does not, at the end of every epoch."""

    def run(phi):
        state = filt.init(params, filt.model.retract(nav, jnp.zeros(9).at[8].set(-phi)))._replace(P=P)
        return lax.scan(lambda s, e: filt.step(params, s, e), state, epochs)[1].nav.q

    a, b = run(0.0), run(1e-7)
    up = jax.vmap(rotations.multiply)(b, jax.vmap(rotations.conjugate)(a))[:, 3]
    return 2 * up


@pytest.mark.full
@pytest.mark.parametrize("gains, states", [("G1", "literal"), ("G2", "literal"), ("G1", "position")])
def test_growth_of_a_small_simulated_error(settled, gains, states):
    """The nonlinear filter over 17 rounds: RMS of the heading error in the last six against the six before."""
    make = gpid.literal_params if states == "literal" else gpid.gpid_params
    r = on_circle(rounds=17)._replace(params=settled.params, P=settled.P)
    theta = make(*PRINTED[gains])
    filt, params, navs, epochs, P = with_gains(r, theta)
    error = np.asarray(heading_difference(filt, params, jax.tree.map(lambda a: a[0], navs), epochs, P))
    rms = np.sqrt(np.mean(error.reshape(17, 126)[5:].reshape(2, -1) ** 2, axis=1))
    predicted = explicit_rate(settled, theta)
    assert np.log(rms[1] / rms[0]) / (6 * PERIOD) == pytest.approx(predicted, rel=0.1)
    assert (predicted > 0) == (states == "literal")
    assert np.abs(error).max() < 1e-3  # still small


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["tangent", "inertial"])
def test_rate_is_the_same_in_every_frame(first, frame):
    """The error that grows is a physical one, whatever axes the filter has."""
    r = on_circle(frame)._replace(P=first.P)
    theta = gpid.literal_params(*PRINTED["G1"])
    here, there = (robustness.growth_rate(*with_gains(a, theta)) for a in (first, r))
    assert there == pytest.approx(here, rel=0.02)
