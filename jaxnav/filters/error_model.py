"""The error state of a filter put together: a frame's motion, the optional states and the measurements' rows."""

from collections.abc import Callable
from functools import cache, partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.maths import linalg, rotations
from jaxnav.measurements import GNSS, MEASUREMENTS, Measurement, latency
from jaxnav.measurements.measurement import ObserveFix, references, stack, value_channels
from jaxnav.states import table
from jaxnav.states.motion import A, V, prior_sd
from jaxnav.states.second_order import second_order
from jaxnav.states.state import State
from jaxnav.states.table import BIASES
from jaxnav.states.transition import discretize
from jaxnav.strapdown.frames import FRAMES
from jaxnav.types import ErrorInputs, Fix, Forcing, Nav, Params, StateParams, nearest


class ErrorModel(NamedTuple):
    """The error state of a filter, x = estimate - truth; a NamedTuple of functions."""

    states: tuple[str, ...]  # the optional ones, behind position, velocity and attitude
    measurements: tuple[str, ...]
    n_states: int
    n_channels: int
    value_channels: tuple[int, ...]  # (n_channels,) channel that each entry of a fix's value shows
    retract: Callable[[Nav, jax.Array], Nav]  # truth = retract(estimate, x (n,))
    absorb: Callable[[Nav, Forcing], Nav]  # a constant model error becomes sensor bias
    covariance: Callable[[Params, Nav], jax.Array]  # P (n, n) at the start
    # (params, points (b, ...), T (b,) s, forcing) -> Phi (n, n), Q (n, n), d (n,)
    discretize: Callable[[Params, ErrorInputs, jax.Array, Forcing | None], tuple[jax.Array, jax.Array, jax.Array]]
    # (nav and P (n, n) at the epoch's start, Phi (n, n), T () s) -> see `jaxnav.states.second_order.second_order`
    second_order: Callable[[Nav, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]] | None
    observe: ObserveFix
    enter: Callable[[Nav], Nav]  # local level navigation -> the frame's
    report: Callable[[Nav, jax.Array, jax.Array], tuple[Nav, jax.Array, jax.Array]]  # (nav, x, P) -> in local level
    # (past (w, ...), x (n,) at its end) -> x (w, n) at each of its samples
    earlier: Callable[[Nav, jax.Array], jax.Array]
    reads: tuple[str, ...] = ()  # auxiliary values that its states' effects depend on
    # (params, fix) -> which states restart before the fix, (n,) bool, and their sd then, (n,); None: never
    restart: Callable[[Params, Fix], tuple[jax.Array, jax.Array]] | None = None
    compared: tuple[bool, ...] = ()  # (m,) channels that are only compared with (`references`); () is none
    auxiliary: tuple[
        tuple[str, int, int], ...
    ] = ()  # measurements with auxiliary values, their channels, values of each


def _same(nav: Nav) -> Nav:
    return nav


def _stationary(process: StateParams) -> jax.Array:
    """Return the sd of a Gauss-Markov process that has run for long; of a walk, that of its start."""
    lasting = jnp.isinf(process.tau)
    tau = jnp.where(lasting, 1.0, process.tau)
    return jnp.where(lasting, process.sd, process.driving_noise * jnp.sqrt(0.5 * tau))


def inverse_rows(J: jax.Array) -> jax.Array:
    """Return J^-1 (9, 9) of `Frame.enu_rows`: rotations on the diagonal, off it only columns of position."""
    diagonal = np.kron(np.eye(3), np.ones((3, 3)))
    turn = (diagonal * J).T
    return turn - turn @ ((1 - diagonal) * J) @ turn


@cache
def error_model(
    frame: str = "local_level",
    states: tuple[str, ...] = BIASES,
    form: Literal["full", "simple"] = "full",
    measurements: tuple[Measurement, ...] = GNSS,
) -> ErrorModel:
    """Return the error model of a frame with these optional states, observed through ``measurements``.

    ``form``: "simple" has the terms of the papers' models alone.

    Raises:
        ValueError: an unknown frame, state or form, or a state that no sensor and none of the measurements sees.
    """
    if frame not in FRAMES:
        raise ValueError(f"no frame {frame!r}: {nearest(frame, FRAMES)}")
    if form not in ("full", "simple"):
        raise ValueError(f"form is 'full' or 'simple', got {form!r}")
    rows, motion = table.chosen(states), FRAMES[frame]
    _check_seen(rows, measurements)
    n = 9 + sum(s.size for s in rows)
    slices = table.layout(rows)

    def retract(nav: Nav, x: jax.Array) -> Nav:
        q = rotations.normalize(rotations.multiply(rotations.exp(-x[A]), nav.q))
        errors = nav.errors | {name: nav.errors[name] - x[s] for name, s in slices.items()}
        return motion.retract(nav, x)._replace(q=q, errors=errors)

    def absorb(nav: Nav, forcing: Forcing) -> Nav:
        """Return navigation with sensor biases that absorb ``forcing``: an excess acceleration lowers the bias."""
        C = rotations.to_dcm(nav.q)
        accel = motion.velocity_axes(nav).T @ forcing.accel if motion.velocity_axes else forcing.accel
        moved = {"gyro_bias": C.T @ forcing.omega, "accel_bias": C.T @ accel}
        return nav._replace(errors=nav.errors | {name: nav.errors[name] + b for name, b in moved.items()})

    def covariance(params: Params, nav: Nav) -> jax.Array:
        optional = [jnp.broadcast_to(params.states[s.name].sd, (s.size,)) for s in rows]
        sd = jnp.concatenate([prior_sd(params.prior), *optional])
        root = jnp.diag(sd)
        if params.prior.correlated is not None:
            root = correlated_root(sd, params.prior.correlated)
        if motion.leave is not None and motion.enu_rows is not None:
            turn = jnp.eye(n).at[:9, :9].set(inverse_rows(motion.enu_rows(nav, motion.leave(nav))))
            root = turn @ root
        return linalg.square(root)

    def correlated_root(sd: jax.Array, rows: jax.Array) -> jax.Array:
        """Return the root (n, n + 12) of the ENU covariance, correlated with the biases that the filter estimates."""
        places = {"velocity": V, "attitude": A} | {name: slices[name] for name in BIASES if name in slices}
        alone, together = jnp.ones(n), jnp.zeros((n, 12))
        for i, name in enumerate(("velocity", "attitude", *BIASES)):
            if name in places:
                alone = alone.at[places[name]].set(0.0)
                together = together.at[places[name]].set(rows[3 * i : 3 * i + 3])
        return sd[:, None] * jnp.concatenate([jnp.diag(alone), together], 1)

    def transition(
        params: Params, points: ErrorInputs, T: jax.Array, u: Forcing | None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        lumped = form == "simple" and motion.lumps_noise  # over an epoch of a second it changes the gains of attitude
        return discretize(partial(motion.dynamics, form=form), params, rows, points, T, u, lumped)

    def with_second_order(nav: Nav, Phi: jax.Array, P: jax.Array, T: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return Phi (n, n) for large attitude errors, and their share of Q of position and velocity, (6, 6)."""
        axes = motion.velocity_axes(nav) if motion.velocity_axes else None
        return second_order(Phi, P, T, motion.vertical, axes)

    def report(nav: Nav, x: jax.Array, P: jax.Array) -> tuple[Nav, jax.Array, jax.Array]:
        if motion.leave is None or motion.enu_rows is None:
            return nav, x, P
        local = motion.leave(nav)
        J = jnp.eye(n).at[:9, :9].set(motion.enu_rows(nav, local))
        P = J @ P @ J.T
        return local, J @ x, 0.5 * (P + P.T)

    def earlier(past: Nav, x: jax.Array) -> jax.Array:
        """Return the errors (w, n) at the samples of ``past``, as they follow from the error x (n,) at the last one."""
        now = jax.tree.map(lambda a: a[-1], past)
        local = motion.leave(now) if motion.leave else now
        J = motion.enu_rows(now, local) if motion.enu_rows else None
        x_enu = x if J is None else jnp.concatenate([J @ x[:9], x[9:]])

        def sample(nav: Nav) -> jax.Array:
            then = motion.leave(nav) if motion.leave else nav
            change = latency.earlier_error(latency.interval(then, local, now.t - nav.t), rows)(x_enu) - x_enu[:9]
            return x.at[:9].add(change if J is None else inverse_rows(J) @ change)

        return jax.vmap(sample)(past)

    renewed = [(m.name, name) for m in measurements for name in m.restarts if name in slices]

    only = references(measurements)
    compared = tuple(m.name in only for m in measurements for _ in m.channels)

    def restart(params: Params, fix: Fix) -> tuple[jax.Array, jax.Array]:
        new, sd = jnp.zeros(n, bool), jnp.zeros(n)
        for measurement, name in renewed:
            place = slices[name]
            new = new.at[place].set(fix.auxiliary[measurement][:, -1] > 0)
            sd = sd.at[place].set(_stationary(params.states[name]))
        return new, sd

    return ErrorModel(
        states, tuple(m.name for m in measurements), n, sum(m.size for m in measurements),
        tuple(value_channels(measurements).tolist()),
        retract, absorb, covariance, transition, with_second_order if form == "full" else None,
        stack(measurements, rows, motion.leave, motion.enu_rows),
        motion.enter or _same, report, earlier, tuple(sorted({name for s in rows for name in s.reads})),
        restart if renewed else None, compared if any(compared) else (),
        tuple((m.name, m.size, len(m.auxiliary)) for m in measurements if m.auxiliary),
    )  # fmt: skip


def _check_seen(states: tuple[State, ...], measurements: tuple[Measurement, ...]) -> None:
    """Raise ValueError for a state that nothing of the filter sees."""
    seen = {name for m in measurements for name in m.states}
    for state in states:
        if state.enters is None and state.name not in seen:
            by = [m.name for m in MEASUREMENTS.values() if state.name in m.states]
            raise ValueError(
                f"state {state.name!r} is seen by no sensor and none of {[m.name for m in measurements]}: "
                f"add a measurement that sees it, {' or '.join(by) or 'none of which exists'}"
            )
