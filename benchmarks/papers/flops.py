"""Floating-point operations of one filter cycle: a covariance prediction and an update by the rule.

By hand as in textbooks: dense matrices, (a, b) times (b, c) costs a c (2 b - 1), an inverse 2 n^3, every formula as it
printed. From the program: the compiler's count of the operations that run here (Joseph's form), but with an inverse at
2 n^3, the cost of its sweeps: the compiler also counts choices, and repeated values once per user.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.papers.nine_states import KEPT, correct_nine, nine_params
from jaxnav.filters.catalogue import FILTERS
from jaxnav.filters.error_model import error_model
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.rule import Innovation
from jaxnav.filters.run import initial_nav
from jaxnav.maths import linalg
from jaxnav.measurements import GNSS
from jaxnav.states.grades import GRADES
from jaxnav.states.table import zeros
from jaxnav.types import ErrorInputs, Params

PAPER = {"ekf15": 30800, "gipkf_literal": 15050}
CHANNELS = 6


def product(a: int, b: int, c: int) -> int:
    """Of an (a, b) by a (b, c) matrix."""
    return a * c * (2 * b - 1)


def kalman_by_hand(n: int, m: int = CHANNELS) -> int:
    """A Kalman filter: x and P predicted, K, x and P corrected (the short form of P)."""
    predict = product(n, n, 1) + 2 * product(n, n, n) + n * n
    gain = product(n, n, m) + product(m, n, m) + m * m + 2 * m**3 + product(n, m, m)
    state = product(m, n, 1) + m + product(n, m, 1) + n
    return predict + gain + state + product(n, m, n) + n * n + product(n, n, n)


def increment_by_hand(n: int, m: int = CHANNELS) -> int:
    """G of the GIP-KF as printed in eq. 34, with H' R_l twice, and dm = G nu."""
    weighted = product(n, m, m)
    return 2 * weighted + product(n, m, n) + n * n + 2 * n**3 + product(n, n, m) + product(n, m, 1)


def literal_by_hand(n: int, m: int = CHANNELS) -> int:
    """Eqs. 29 to 36: both past states, H (I + F) and H F, the increment, and the Kalman filter."""
    state = n + 2 * product(n, n, 1) + 2 * n - product(n, n, 1)  # one F x is counted with the Kalman filter
    residual = 2 * product(m, n, n) + 2 * product(m, n, 1) + 2 * m
    return kalman_by_hand(n, m) + state + residual + increment_by_hand(n, m)


def working_by_hand(n: int, m: int = CHANNELS) -> int:
    """From x = 0, so that nothing of the state is predicted; dm enters the residual and x."""
    return kalman_by_hand(n, m) - product(n, n, 1) + increment_by_hand(n, m) + m + n


LEARNING = 9 + 18  # R_m's growth, and the noise of velocity and attitude
BY_HAND = {"ekf15": kalman_by_hand(15), "ekf9": kalman_by_hand(9), "gipkf_literal": literal_by_hand(9),
           "gipkf": working_by_hand(9), "gipkf_learning": working_by_hand(9) + LEARNING,
           "gipkf_mix": working_by_hand(9) + 6}  # fmt: skip
NINE_GAINS = 60  # of `nine_states`: two scalars, ten products with the residuals, the drive and the fade


def by_sweeps(compiled: int, *sizes: int) -> int:
    """The count of a program that inverts covariances of these sizes, each at 2 n^3."""
    return compiled + sum(2 * n**3 - count(linalg.inverse, jnp.eye(n)) for n in sizes)


def cycle(rule, theta, P, Phi, Q, H, R, y):
    """Prediction of P and one correction, on matrices that are given: all dense."""
    P = Phi @ P @ Phi.T + Q
    memory = rule.init(P.shape[0], y.size)
    x, memory = rule.extrapolate(theta, memory, P[0], P[1])
    z = Innovation(y - H @ x, H, R, P, jnp.ones(y.size, bool), jnp.asarray(1.0), jnp.ones(y.size))
    c = rule.correct(theta, memory, z)
    return x + c.delta, c.P, c.memory, c.drive


def count(function, *arguments) -> int:
    """Return the compiler's count of operations of a function of these arguments."""
    analysis = jax.jit(function).lower(*arguments).compile().cost_analysis()
    return round(((analysis[0] if isinstance(analysis, list) else analysis) or {})["flops"])


def of(name: str) -> dict:
    """Count by hand, from the compiled program, and of the frame's Phi and Q."""
    entry = FILTERS[name]
    model = error_model("tangent", entry.states, entry.form)
    n = model.n_states
    theta, rule = entry.theta(), entry.rule(GNSS)
    square, H = jnp.eye(n), jnp.zeros((CHANNELS, n))
    compiled = count(partial(cycle, rule), theta, square, square, square, H, jnp.eye(CHANNELS), jnp.zeros(CHANNELS))
    params: Params = datasheet_params(GRADES["adis16488a"])
    nav = model.enter(initial_nav([0.6, 0.9, 1200.0])._replace(errors=zeros(entry.states)))
    point = jax.tree.map(lambda a: a[None], ErrorInputs(nav, jnp.eye(3), *(jnp.zeros(3),) * 3))
    dynamics = count(model.discretize, params, point, jnp.ones(1), None)
    inside = by_sweeps(compiled, CHANNELS, *([n] if name.startswith("gipkf") else []))
    return {"hand": BY_HAND.get(name), "compiled": inside, "compiled_phi_and_q": dynamics, "paper": PAPER.get(name)}


def nine_cycle(theta, P, Phi, Q, H, R, y):
    """As `cycle` for `nine_states`, which predicts only its covariance, (9, 9); x is that of 15 states."""
    P = jnp.zeros((15, 15)).at[np.ix_(KEPT, KEPT)].set(Phi @ P @ Phi.T + Q)
    z = Innovation(y, H, R, P, jnp.ones(y.size, bool), jnp.asarray(1.0), jnp.ones(y.size))
    c = correct_nine(theta, (jnp.asarray(3.0), jnp.asarray(0.1)), z)
    return c.delta, (c.fade[:, None] * c.P * c.fade)[np.ix_(KEPT, KEPT)], c.memory, c.drive


def of_nine() -> dict:
    """Of `nine_states`, as `of`; Phi and Q of all 15 states, so that less would do."""
    square, H = jnp.eye(9), jnp.eye(CHANNELS, 15)
    arguments = nine_params(), square, square, square, H, jnp.eye(CHANNELS), jnp.zeros(CHANNELS)
    hand = kalman_by_hand(9, 2) + NINE_GAINS
    return {"hand": hand, "compiled": by_sweeps(count(nine_cycle, *arguments), 2),
            "compiled_phi_and_q": of("ekf15")["compiled_phi_and_q"], "paper": None}  # fmt: skip


def table() -> dict:
    """Of every filter of the outage study."""
    return {name: of(name) for name in BY_HAND} | {"nine_states": of_nine()}


def show(found: dict) -> None:
    """Print the table."""
    print("\nfloating-point operations of a cycle: by hand | compiled | Phi and Q | paper")
    for name, r in found.items():
        print(
            f"  {name:16} {r['hand'] or '-':8} | {r['compiled']:8} | {r['compiled_phi_and_q']:8} | {r['paper'] or '-'}"
        )
