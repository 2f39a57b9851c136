"""Is a filter stable, and how fast does a small error of its grow or die out (GPID paper, section 4.1)?

Two ways that know nothing of each other. The matrices of the paper's filter in closed form, from the gains of a run:
`paper_matrix` as printed and `exact_matrix` as it should be. And the derivative of `Filter.step` itself, for any
filter in any frame: `transitions`. Their product over a trajectory is a monodromy matrix; its largest eigenvalue is
the growth over that trajectory if it is gone through again and again: `multipliers`, `growth_rate`.
"""

import functools
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from jaxnav.filters.core import ErrorModel, Filter, FilterState, masked
from jaxnav.filters.run import initial_nav
from jaxnav.maths import linalg
from jaxnav.simulate.imu import sense
from jaxnav.simulate.trajectories import Shape, travel
from jaxnav.types import Epoch, Fix, Imu, Nav, Params

Array = jax.Array | np.ndarray

TABLE_1 = (5.0, 5.0, 5.0, 0.1, 0.1, 0.1)  # m, m/s: the paper's receiver

# ---------------------------------------------------------------------------- closed forms for the GPID filter


def paper_matrix(A: jax.Array, K: jax.Array, C: jax.Array, ki: ArrayLike) -> jax.Array:
    """The paper's matrix of (e, d), (2n, 2n), as printed in (44) and (45), from A (n, n), K (n, m) and C (m, n).

    It does not describe the filter of (21)-(34), for which see `exact_matrix`:

    * (37) corrects with y - H x(k|k), the residual of the old estimate, where (23) has the innovation y - H A x(k|k);
      and adds x_I(k), where (27) has x_I(k + 1), one step of the integral more.
    * (42) puts K_I C e(k) for K_I yt(k), but yt = C e + w_m by (21): K_I w_m is lost. With it a constant measurement
      error b is not rejected: at rest K_I yt = 0, so C e = -b, and the integral follows the error to the last bit.
    * (45) drops K_P (w_m(k+1) - w_m(k)) because consecutive outputs of the *inertial* sensors differ little; w_m is
      the noise of the receiver, white from fix to fix, and the difference has twice its variance.

    With A = C = 1 it has abs(eigenvalue)^2 = 1 - K (1 - ki) for K < 4 ki: ki = 1, which the paper analyses, is exactly
    marginal, and its second choice 1.5 unstable for every K; the proof's "stable matrix" excludes the printed gains.
    """
    n = A.shape[0]
    eye = jnp.eye(n)
    return jnp.block([[A - K @ C, eye], [-(K * jnp.asarray(ki)) @ C, eye]])


def exact_matrix(
    A: jax.Array, K: jax.Array, H: jax.Array, ki: ArrayLike, kd: ArrayLike, states: ArrayLike, leak: ArrayLike = 1.0
) -> jax.Array:
    """The matrix of s = (e, x_I, yt(k), yt(k-1)), (2n + 2m, 2n + 2m), of the filter of (21)-(34) from fix to fix.

    With e = x - x(k|k), M = diag(states), K and H those of the step's end, and no noise, so that yt(k) = H e:

        e+   = (I - K H) A e - leak x_I - M K (ki + kd) yt(k) + M K kd yt(k-1)
        x_I+ = leak x_I + M K ki yt(k),    yt(k+1) = H e+

    A (n, n), K (n, m), H (m, n); ki and kd () or (m,), states (n,), leak (). In closed loop e is the remaining error of
    navigation. With A = H = 1 and kd = 0 it has abs(eigenvalue)^2 = 1 - K; with kd it needs K < 2 / (1 + ki/2 + 2 kd).
    """
    n, m = K.shape
    MK = jnp.asarray(states)[:, None] * K
    integral, derivative = MK * jnp.asarray(ki), MK * jnp.asarray(kd)
    still = jnp.asarray(leak) * jnp.eye(n)
    error = jnp.concatenate([(jnp.eye(n) - K @ H) @ A, -still, -integral - derivative, derivative], axis=1)
    summed = jnp.concatenate([jnp.zeros((n, n)), still, integral, jnp.zeros((n, m))], axis=1)
    shifted = jnp.eye(m, 2 * n + 2 * m, 2 * n)
    return jnp.concatenate([error, summed, H @ error, shifted])


# ---------------------------------------------------------------------------- the derivative of any filter's step


def _parts(state: FilterState) -> list[jax.Array]:
    """Parts of an error other than navigation: x, the observer's drive, the rule's memory; real numbers only."""
    leaves = jax.tree.leaves((state.x, state.u, state.memory))
    return [a for a in leaves if jnp.issubdtype(a.dtype, jnp.floating)]


def _last(state: FilterState) -> Nav:
    return jax.tree.map(lambda a: a[-1], state.past)


def _numbers(nav: Nav) -> jax.Array:
    return jnp.concatenate([nav.pos, nav.vel, nav.q, *jax.tree.leaves(nav.errors)])


def _to_enu(model: ErrorModel, nav: Nav, P: jax.Array) -> jax.Array:
    """The matrix (n, n) from errors in the frame's axes to ENU."""
    return jax.jacfwd(lambda x: model.report(nav, x, P)[1])(jnp.zeros(model.n_states))


def _displace(model: ErrorModel, state: FilterState, s: jax.Array, back: jax.Array) -> FilterState:
    """The state with errors s (N,): of navigation, n in ENU, which ``back`` (n, n) turns; then `_parts`."""
    past = jax.vmap(model.retract, (0, None))(state.past, -back @ s[: model.n_states])
    leaves, tree = jax.tree.flatten((state.x, state.u, state.memory))
    at = model.n_states
    for i, a in enumerate(leaves):
        if jnp.issubdtype(a.dtype, jnp.floating):
            leaves[i] = a + s[at : at + a.size].reshape(a.shape)
            at += a.size
    x, u, memory = jax.tree.unflatten(tree, leaves)
    return state._replace(past=past, x=x, u=u, memory=memory, x0=x)


def _read(state: FilterState) -> tuple[jax.Array, jax.Array]:
    """Read the parts that `_displace` has moved: the numbers of navigation at the end, and the rest."""
    return _numbers(_last(state)), jnp.concatenate([a.ravel() for a in _parts(state)])


def _measure(model: ErrorModel, state: FilterState) -> jax.Array:
    """The matrix from small changes of `_numbers` to the error in ENU that they are, (n, 16)."""
    nav = _last(state)
    J = jax.jacfwd(lambda e: _numbers(model.retract(nav, -e)))(jnp.zeros(model.n_states))
    size = jnp.sqrt((J * J).sum(0))  # radians of latitude and metres per second differ in size
    J = J / size
    return _to_enu(model, nav, state.P) @ (jnp.linalg.inv(J.T @ J) @ J.T / size[:, None])


def _along(filt: Filter, params: Params, navs: Nav, epochs: Epoch, P: jax.Array, step: Callable) -> tuple:
    """The covariance (n, n), in ENU, after the epochs, and the results of ``step(state, epoch)`` at every truth."""
    model = filt.model

    def one(P, x):
        nav, epoch = x
        state = filt.init(params, nav)
        back = jnp.linalg.inv(_to_enu(model, _last(state), P))
        new, found = step(state._replace(P=back @ P @ back.T), epoch)
        turn = _to_enu(model, _last(new), P)
        return turn @ new.P @ turn.T, found

    return lax.scan(one, P, (navs, epochs))


def perfect(
    shape: Shape, lla: Sequence[float], epochs: int, T: float = 1.0, k: int = 10, sd: Sequence[float] = TABLE_1
) -> tuple[Nav, Epoch]:
    """The truth at the start of every epoch, and epochs of T s without any error, from a trajectory: for `transitions`.

    ``lla`` (3,) lat rad, lon rad, h m at the start; ``k`` IMU samples an epoch; ``sd`` (6,) of position (ENU m) and
    velocity (ENU m/s), which the fixes claim.
    """
    way = travel(shape, jnp.asarray(lla, float), T / k, k, epochs, sense)
    (first, *_), (ends, *_) = way.start, way.ends
    points = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), first, ends)
    navs = jax.vmap(initial_nav)(points.lla, points.vel, points.rph, points.t)
    navs = navs._replace(origin=jax.tree.map(lambda a: jnp.broadcast_to(a[0], a.shape), navs.origin))
    value = jnp.concatenate([ends.lla, ends.vel], axis=1)
    some = jnp.broadcast_to(jnp.asarray(sd, float), value.shape)
    fix = Fix(value, some, jnp.zeros_like(value), jnp.ones(value.shape, bool))
    return navs, Epoch(Imu(jnp.full((epochs, k), T / k, float), *way.means), fix)


@partial(jax.jit, static_argnums=0)
def settle(
    filt: Filter, params: Params, navs: Nav, epochs: Epoch, tolerance: float = 1e-6, rounds: int = 3000
) -> jax.Array:
    """The covariance (n, n), in ENU, that comes back after the epochs, by going through them again and again.

    Arguments as for `transitions`. From `Params.prior`; stops when a round changes no element by more than
    ``tolerance`` of the two sd, or after so many rounds: the variance of an unobserved state grows for ever.
    """
    model = filt.model

    def again(carry):
        P, _, i = carry
        new, _ = _along(filt, params, navs, epochs, P, lambda state, epoch: (filt.step(params, state, epoch)[0], None))
        sd = jnp.sqrt(jnp.diag(new))
        return new, jnp.max(jnp.abs(new - P) / (sd[:, None] * sd)), i + 1

    start = filt.init(params, jax.tree.map(lambda a: a[0], navs))
    turn = _to_enu(model, _last(start), start.P)
    begin = (turn @ start.P @ turn.T, jnp.array(jnp.inf), 0)
    return lax.while_loop(lambda carry: (carry[1] > tolerance) & (carry[2] < rounds), again, begin)[0]


@partial(jax.jit, static_argnums=0)
def transitions(filt: Filter, params: Params, navs: Nav, epochs: Epoch, P: jax.Array) -> jax.Array:
    """Derivatives (E, N, N) of every step by the error before it, at the truth.

    ``navs`` (E, ...): the true navigation, local level, at the start of every epoch; ``epochs`` with fixes without
    noise. The N components: error of the navigation as the error model's n states, with position, velocity and
    attitude in ENU; the filter's x; the observer's drive; the real numbers in the rule's memory, which is at its start
    in every epoch. ``P`` (n, n), in ENU, is the covariance at the start; it is no part of the error, since with a zero
    innovation a small change of P changes nothing else.
    """
    model = filt.model

    def step(state: FilterState, epoch: Epoch):
        back = jnp.linalg.inv(_to_enu(model, _last(state), state.P))

        def moved(s):
            before = filt.predict(params, _displace(model, state, s, back), epoch.imu)
            new, _ = filt.correct(params, before._replace(P=lax.stop_gradient(before.P)), epoch.fix)
            return _read(new), new

        zero = jnp.zeros(model.n_states + sum(a.size for a in _parts(state)))
        (nav, rest), new = jax.jacfwd(moved, has_aux=True)(zero)
        return new, jnp.concatenate([_measure(model, new) @ nav, rest])

    return _along(filt, params, navs, epochs, P, step)[1]


@partial(jax.jit, static_argnums=0)
def linear_model(
    filt: Filter, params: Params, navs: Nav, epochs: Epoch, P: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A filter's model of the error's dynamics: A (E, n, n), Kalman gain K (E, n, m), H (E, m, n) of every epoch.

    Arguments as for `transitions`; in the axes of the frame.
    """

    def step(state: FilterState, epoch: Epoch):
        def predicted(x):
            before = filt.predict(params, state._replace(x=x), epoch.imu)
            return before.x, before

        A, before = jax.jacfwd(predicted, has_aux=True)(state.x)
        y, H, R = filt.model.observe(params, before.past, epoch.fix)
        _, H, R = masked(y, H, R, epoch.fix.valid)
        K = linalg.update(before.P, H, R)[0]
        return filt.correct(params, before, epoch.fix)[0], (A, K, H)

    return _along(filt, params, navs, epochs, P, step)[1]


def multipliers(matrices: Array, n: int) -> np.ndarray:
    """Eigenvalues of the product of matrices (E, N, N), the first one applied first; largest absolute value first.

    Only of those components that an error of the first ``n`` ever reaches: a counter, or an integral that a mask
    keeps at zero, would each add an eigenvalue 1 that says nothing of the navigation.
    """
    M = np.asarray(matrices)
    linked = np.any(M != 0, axis=0)
    reached = np.arange(M.shape[1]) < n
    for _ in range(M.shape[1]):
        reached = reached | linked[:, reached].any(1)
    product = functools.reduce(lambda a, b: b @ a, M[:, reached][:, :, reached])
    values = np.linalg.eigvals(product)
    return values[np.argsort(-np.abs(values))]


def growth_rate(filt: Filter, params: Params, navs: Nav, epochs: Epoch, P: jax.Array | None = None) -> float:
    """Rate (1/s) at which a small error grows if the trajectory is gone through again and again; negative is stable.

    Arguments as for `transitions`, ``P`` as `settle` finds it if not given. One period of a periodic trajectory gives
    its largest Floquet exponent; one epoch at rest or any drive will do. Any filter in any frame; 0 where an error
    is not observed.
    """
    P = settle(filt, params, navs, epochs) if P is None else P
    largest = multipliers(transitions(filt, params, navs, epochs, P), filt.model.n_states)[0]
    return float(np.log(np.abs(largest)) / np.sum(epochs.imu.dt))
