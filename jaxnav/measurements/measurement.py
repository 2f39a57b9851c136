"""Measurement models, written once for every frame: a residual and its rows by state, channels, parameters, columns.

A filter is made with a tuple of these, and a `Fix` then carries their channels side by side. Each works on
`Kinematics`, a navigation state in ENU; x = estimate - truth, residual y = H x + noise.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from scipy.linalg import block_diag

from jaxnav.maths import rotations
from jaxnav.measurements import latency
from jaxnav.measurements.columns import Column
from jaxnav.states.motion import MOTION
from jaxnav.states.second_order import SECOND_ORDER_S, reliability
from jaxnav.states.sensors import OTHER
from jaxnav.states.state import Reading, State
from jaxnav.types import Fix, ImuLog, Mounting, Nav, Params, Tree

FIXES_ALIKE = 2 * SECOND_ORDER_S
"""Factor on second-order noise of a fix: consecutive fixes see one attitude error, as `second_order` at 1 Hz."""


class Kinematics(NamedTuple):
    """A navigation state in ENU."""

    lla: jax.Array  # (3,) rad, rad, m
    vel: jax.Array  # (3,) m/s ENU
    C: jax.Array  # (3, 3) body -> ENU


class Observation(NamedTuple):
    """Residual (estimate minus measurement), its derivative and its noise, of one measurement of size s.

    ``rows`` has d y / d error, (s, k), by quantity: "position" m, "velocity" m/s and "attitude" rad in ENU,
    "gyro" or "accel" for the body rate or specific force that navigation goes by, or an optional state by its name.
    """

    y: jax.Array  # (s,)
    rows: dict[str, jax.Array]
    sd: jax.Array  # (s,) of the noise
    root: jax.Array | float = 1.0  # (), (s,) or lower triangular (s, s): factor on noise of that sd
    reading: jax.Array | None = None  # (3,) true reading that "gyro" or "accel" means; None: navigation's last one


class Observe(Protocol):
    """The model of one measurement."""

    def __call__(self, theta: Tree, mounting: Mounting, nav: Nav, kin: Kinematics, fix: Fix) -> Observation:
        """``theta``: its parameters. ``nav``, ``kin``: the estimate at its time. ``fix``: its channels (s,)."""


class Measurement(NamedTuple):
    """A named kind of measurement: a row of `jaxnav.measurements.MEASUREMENTS`."""

    name: str
    channels: tuple[str, ...]  # their names, in the order of a `Fix`
    observe: Observe
    defaults: Any  # its parameters, a NamedTuple of plain numbers; a leaf ``latency`` (s) is its age at its stamp
    units: Any  # the same of `Unit`
    receiver: bool = False  # from a GNSS receiver: a paper's rule is for these, and an outage hides them
    states: tuple[str, ...] = ()  # optional states that its rows may name
    columns: tuple[Column, ...] = ()  # of its values in files, one a channel; () for a constraint without data
    correlated: bool = False  # its files may state the correlations of three axes
    reported: tuple[str, ...] = ()  # names of its channels in reports, in their order; () is as ``channels``
    auxiliary: tuple[str, ...] = ()  # values of each channel that its model reads; a gate then tests its channels alone
    needs: tuple[str, ...] = ()  # optional states that a filter with it has
    replaces: tuple[str, ...] = ()  # measurements of the same signals, which a filter with it is only compared with
    restarts: tuple[str, ...] = ()  # states of its channels that restart where the last auxiliary value is 1
    shows: tuple[int, ...] = ()  # channel that each entry of a fix's value shows; () where they are in one order
    at_rest: bool = False  # a constraint that holds where the vehicle stands, not at the end of every epoch
    # of a constraint: (imu, ends of epochs (E,) s, s before each) -> its values (E, m); None: they are zero
    pseudo: Callable[[ImuLog, np.ndarray, float], np.ndarray] | None = None

    @property
    def size(self) -> int:
        """How many channels it has."""
        return len(self.channels)

    @property
    def has_data(self) -> bool:
        """Has it a stream in a recording? A constraint has none."""
        return bool(self.columns or self.auxiliary)


def along_track(sd: np.ndarray, vel: np.ndarray, delay_sd: float | np.ndarray) -> np.ndarray:
    """Return the sd (..., 9) at the IMU's time: along the track that of a delay is one of the position.

    Args:
        sd: (..., 9) m, m/s, rad, ENU, by the clock of the fixes.
        vel: (..., 3) m/s, ENU.
        delay_sd: s, of the delay between both clocks; () or (..., 1).
    """
    return np.concatenate([np.hypot(sd[..., :3], delay_sd * vel), sd[..., 3:]], -1)


def clock_offset(mounting: Mounting, nav: Nav) -> jax.Array:
    """GNSS time minus the IMU's stamps ``nav.t``, s, of their shape.

    The motion between two fixes is still measured by the IMU's clock: of the displacement without fixes the share
    ``clock_drift`` is lost, 1 m in 10 km at 100 ppm.
    """
    return mounting.time_offset + mounting.clock_drift * (nav.t - nav.origin.t)


def counted_from(nav: Nav, t: ArrayLike) -> Nav:
    """Return navigation with no clock drift at stamp ``t`` s: halfway, offset and drift are least correlated."""
    return nav._replace(origin=nav.origin._replace(t=jnp.broadcast_to(jnp.asarray(t, float), nav.origin.t.shape)))


def layout(measurements: Iterable[Measurement]) -> dict[str, slice]:
    """Name -> its channels in a `Fix` of these measurements."""
    measurements = tuple(measurements)
    stops = np.cumsum([m.size for m in measurements]).tolist()
    return {m.name: slice(stop - m.size, stop) for m, stop in zip(measurements, stops, strict=True)}


def references(measurements: Iterable[Measurement]) -> tuple[str, ...]:
    """Return what a filter of these measurements is only compared with: fixes of a receiver whose ranges it takes."""
    return tuple(dict.fromkeys(name for m in measurements for name in m.replaces))


def tested_alone(measurements: Iterable[Measurement]) -> np.ndarray:
    """Return which channels (m,) bool of a filter a gate tests one by one: those of satellites."""
    return np.array([bool(m.auxiliary) for m in measurements for _ in m.channels])


def value_channels(measurements: Iterable[Measurement]) -> np.ndarray:
    """Return the channel that each entry of the value of a filter's fix shows, (m,) int."""
    measurements = tuple(measurements)
    firsts = [place.start for place in layout(measurements).values()]
    own = [m.shows or range(m.size) for m in measurements]
    return np.array([first + k for first, channels in zip(firsts, own, strict=True) for k in channels], int)


def part_of(fix: Fix, name: str, place: slice) -> Fix:
    """Return the channels ``place`` of a fix, with the auxiliary values of measurement ``name``."""
    return Fix(fix.value[place], fix.sd[place], fix.corr[place], fix.valid[place], fix.auxiliary.get(name))


def as_rows(past: Nav) -> tuple[jax.Array, Callable[[jax.Array], Nav]]:
    """Return samples ``past`` (w, ...) as one array (w, k), and the function of a row (k,) to a sample.

    Time, origin and auxiliary values are those of the last sample: they have no derivative, or are the same at all.
    """
    last = jax.tree.map(lambda leaf: leaf[-1], past)
    moving = lambda nav: nav._replace(t=None, origin=None, auxiliary={})
    back = ravel_pytree(moving(last))[1]
    rows = jax.vmap(lambda nav: ravel_pytree(nav)[0])(moving(past))
    return rows, lambda row: back(row)._replace(t=last.t, origin=last.origin, auxiliary=last.auxiliary)


def at(past: Nav, t: jax.Array) -> Nav:
    """Return the navigation state at time ``t`` by linear interpolation between the samples of ``past`` (w, ...).

    Outside of them the nearest two are extended, but rate and specific force are held: they are noisy.
    """
    rows, back = as_rows(past)
    (w, k), times = rows.shape, past.t
    if w > 2:
        i = jnp.clip(jnp.sum(times <= t) - 1, 0, w - 2)
        rows, times = (lax.dynamic_slice_in_dim(a, i, 2) for a in (rows, times))
    (before, after), (first, last) = rows, times
    gap = last - first
    share = jnp.where(gap > 0, (t - first) / jnp.where(gap > 0, gap, 1.0), 1.0)
    held = np.isin(np.arange(k), np.arange(10, 16))  # rate and force, behind position, velocity and quaternion
    nav = back(before + jnp.where(held, jnp.clip(share, 0.0, 1.0), share) * (after - before))
    return nav._replace(t=t, q=rotations.normalize(nav.q))


def covariance(
    roots: Sequence[jax.Array | float], sizes: Sequence[int], sd: jax.Array, corr: jax.Array, valid: jax.Array
) -> jax.Array:
    """Return R = L D C D L' (m, m) of a fix with stated sd D and correlations C (`Fix`).

    The correlation of two channels is dropped if one is missing. The sd of a missing channel means
    nothing, so with a full L its share in another channel is taken at that channel's sd: R of the present channels
    does not depend on those that are not.

    Args:
        roots: L of each measurement, (s, s), or its diagonal, () or (s,).
        sizes: s of each measurement; correlations are of those with three channels.
        sd: (m,) of all channels, side by side.
        corr: (m,) likewise.
        valid: (m,) bool, likewise.
    """
    cyclic = np.eye(3)[[1, 2, 0]]
    following = block_diag(*(cyclic if s == 3 else np.zeros((s, s)) for s in sizes))
    half = jnp.where(valid[:, None] & valid, following * corr[:, None], 0.0)
    C = jnp.eye(sd.size) + half + half.T
    if all(jnp.ndim(root) < 2 for root in roots):
        sd = jnp.concatenate([jnp.broadcast_to(root, (s,)) for root, s in zip(roots, sizes, strict=True)]) * sd
        return C * (sd[:, None] * sd)
    full = [root if jnp.ndim(root) == 2 else root * jnp.eye(s) for root, s in zip(roots, sizes, strict=True)]
    M = jax.scipy.linalg.block_diag(*full) * jnp.where(valid, sd, sd[:, None])
    R = M @ C @ M.T
    return 0.5 * (R + R.T)


def measurement_matrix(o: Observation, nav: Nav, states: Sequence[State]) -> jax.Array:
    """Return H (s, n) of an observation, its motion in ENU; rows of states that the filter lacks are dropped.

    A state that enters the gyro or the accelerometer lowers the reading of navigation, d w / d s = -M.
    """
    s = o.y.shape[0]
    blocks = [o.rows.get(name, jnp.zeros((s, 3))) for name in MOTION]
    readings = {"gyro": nav.omega, "accel": nav.force}
    for state in states:
        row = o.rows.get(state.name, jnp.zeros((s, state.size)))
        if state.enters in o.rows:
            through = o.rows[state.enters]
            w = readings[state.enters] if o.reading is None else o.reading
            other = readings[OTHER[state.enters]]
            row = row - (through if state.effect is None else through @ state.effect(Reading(w, other, nav.auxiliary)))
        blocks.append(row)
    return jnp.concatenate(blocks, 1)


class ObserveFix(Protocol):
    """All measurements of a filter at once."""

    def __call__(
        self, params: Params, past: Nav, fix: Fix, P: jax.Array | None = None, /
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return y (m,), H (m, n), R (m, m) by navigation ``past`` (w, ...) and the predicted covariance P (n, n)."""


def stack(
    measurements: tuple[Measurement, ...],
    states: tuple[State, ...],
    leave: Callable[[Nav], Nav] | None = None,
    enu_rows: Callable[[Nav, Nav], jax.Array] | None = None,
) -> ObserveFix:
    """Return ``observe(params, past, fix, P=None) -> y (m,), H (m, n), R (m, m)`` of these measurements.

    Each measurement is compared with navigation at its time of validity: the end of ``past`` minus clock offset and
    latency. H refers to the error at the end (`jaxnav.measurements.latency`). R is `covariance` of each. With the
    predicted covariance P (n, n) the R of a receiver's vectors holds the second-order effect of a large attitude error,
    by lever arm and age: -phi x (H (phi / 2, s)), see `jaxnav.states.second_order.reliability`.

    Args:
        measurements: the rows, in the order of their channels.
        states: optional states of the filter, in their order.
        leave: navigation of the filter's frame -> local level; None in local level itself.
        enu_rows: (navigation, the same in local level) -> d(error in ENU) / d(error in the frame), (9, 9); likewise.
    """
    slices, sizes = layout(measurements), [each.size for each in measurements]
    rates = [s for s in states if s.rate_of in {other.name for other in states}]
    # of attitude and the optional states, the ones with an effect that turns with the attitude
    in_body = np.concatenate([np.ones(3), *(np.full(s.size, float(s.enters is not None)) for s in states)])
    vectors = [each.name for each in measurements if each.receiver and each.size == 3]

    def observe(
        params: Params, past: Nav, fix: Fix, P: jax.Array | None = None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        now = jax.tree.map(lambda a: a[-1], past)
        local_now = leave(now) if leave else now
        J = enu_rows(now, local_now) if enu_rows else None
        if J is not None and P is not None:
            wide = jnp.eye(P.shape[0]).at[:9, :9].set(J)
            P = wide @ P @ wide.T
        offset = clock_offset(params.mounting, now)
        mounting = params.mounting._replace(time_offset=offset)

        def then(age: jax.Array) -> tuple[Nav, Kinematics, jax.Array]:
            """Return navigation before ``age`` s, the same in ENU, and d(error then) / d(error now)."""
            nav = at(past, now.t - age)
            local = leave(nav) if leave else nav
            kin = Kinematics(local.pos, local.vel, rotations.to_dcm(local.q))
            return nav, kin, latency.error_then(latency.interval(local, local_now, age), states)

        drifts = "clock_offset" in now.errors
        late = [offset + getattr(params.measurements[each.name], "latency", 0.0) for each in measurements]
        if drifts:
            known = now.errors["clock_offset"][0]
            late = [age + known if each.receiver else age for age, each in zip(late, measurements, strict=True)]
        ages = jnp.stack(late)
        thens = jax.vmap(then)(ages)
        seen, rows = [], {}
        for i, each in enumerate(measurements):
            part = part_of(fix, each.name, slices[each.name])
            model = partial(each.observe, params.measurements[each.name], mounting, fix=part)
            nav, kin, B = jax.tree.map(lambda a, i=i: a[i], thens)
            o = model(nav, kin)
            if each.receiver and drifts:
                slope = jax.jvp(lambda age, model=model: model(*then(age)[:2]).y, (ages[i],), (jnp.ones_like(offset),))
                o = o._replace(rows=o.rows | {"clock_offset": slope[1][:, None]})
            for rate in rates:  # the state that it is the rate of was less at the measurement's time
                if (row := o.rows.get(rate.rate_of)) is not None:
                    o = o._replace(
                        y=o.y - ages[i] * row @ now.errors[rate.name],
                        rows=o.rows | {rate.name: o.rows.get(rate.name, 0.0) - ages[i] * row},
                    )
            H = measurement_matrix(o, nav, states)
            rows[each.name] = H[:, :9] @ B + jnp.pad(H[:, 9:], ((0, 0), (9, 0)))
            seen.append(o)
        R = covariance([o.root for o in seen], sizes, jnp.concatenate([o.sd for o in seen]), fix.corr, fix.valid)
        if P is not None and vectors:
            effects = jnp.stack([rows[name][:, 6:] for name in vectors]) * in_body
            reliable, moments = jax.vmap(lambda L: reliability(L, P))(effects)
            for name, ratio, moment in zip(vectors, reliable, moments, strict=True):
                rows[name] = rows[name].at[:, 8].multiply(ratio)
                R = R.at[slices[name], slices[name]].add(FIXES_ALIKE * moment)
        H = jnp.concatenate([rows[each.name] for each in measurements])
        if J is not None:
            H = jnp.concatenate([H[:, :9] @ J, H[:, 9:]], 1)
        return jnp.concatenate([o.y for o in seen]), H, R

    return observe
