"""The one predict/correct path: filter = mechanization x error model x rule x feedback. Names no paper.

An epoch is the IMU samples since the last fix and the fix that ends them. `predict` moves the navigation state through
its samples, sums the error dynamics along that path up to one transition, and moves x and P once; `correct` forms the
innovation, lets the rule correct, and feeds back. Splitting it so is exact, because between two fixes navigation does
not depend on P.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.filters.adapters.adapter import Adapter, Window, adapted, with_factor
from jaxnav.filters.error_model import ErrorModel
from jaxnav.filters.parameters import datasheet_params
from jaxnav.filters.rule import Correction, Feedback, Innovation, Rule, Transition, only_if, select
from jaxnav.filters.spec import FilterSpec
from jaxnav.maths import linalg
from jaxnav.measurements.measurement import as_rows
from jaxnav.states.motion import A, reset_covariance, reset_rows
from jaxnav.states.sensitivity import sensitivity_noise
from jaxnav.states.table import BIASES, chosen, layout, zeros
from jaxnav.strapdown.mechanization import Preintegrate, Propagate
from jaxnav.types import Epoch, Fix, Forcing, Imu, Info, Nav, Noise, Params, Tree


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Prepared:
    """The samples of an epoch with every quantity that needs no state, computed once for all runs of a filter."""

    n: jax.Array  # () int, samples that are not padding
    keep: jax.Array  # (w,) int, the last of them
    T: jax.Array  # (b,) s, of each point of the path
    samples: Any  # argument of `propagate`
    imu: Imu | None  # (k, ...) as they were, for an adapter
    stride: int = field(metadata={"static": True})  # samples of a point: only filters of the same take it


class FilterState(NamedTuple):
    """State that one step hands to the next."""

    past: Nav  # (w, ...) navigation at the last w samples, newest last: delayed measurements are compared with it
    x: jax.Array  # (n,) error state that is not fed back
    P: jax.Array  # (n, n)
    u: Forcing | None  # feedback in force, of an observer
    memory: Tree  # the rule's
    x0: jax.Array  # (n,) x after the last feedback
    T: jax.Array  # () s since then
    age: jax.Array  # (m,) s from each channel's last use to then
    ok: jax.Array  # () bool: everything has been finite so far; the state is frozen from the first failure on
    adapter: Tree = ()  # the adapter's memory


class Step(NamedTuple):
    """One epoch, as `jaxnav.filters.run.run` may record it."""

    before: FilterState
    predicted: FilterState
    transition: Transition
    after: FilterState
    info: Info
    corrected: jax.Array  # (n,) estimate after the correction, before the feedback, in the filter's frame


class Composition(NamedTuple):
    """Arguments of `make_filter`."""

    propagate: Propagate
    model: ErrorModel
    rule: Rule
    feedback: Feedback
    cov_stride: int
    history: int
    preintegrate: Preintegrate | None
    adapter: Adapter | None


class Filter(NamedTuple):
    """Pure functions; `step` is `correct` after `predict`, which also stream sample by sample, without an adapter.

    `step` freezes a run that stops being finite; who streams looks at `Info.ok` after each `correct`.
    """

    init: Callable[[Params, Nav], FilterState]
    predict: Callable[[Params, FilterState, Imu | Prepared], FilterState]
    correct: Callable[[Params, FilterState, Fix], tuple[FilterState, Info]]
    step: Callable[[Params, FilterState, Epoch], tuple[FilterState, Info]]
    model: ErrorModel
    prepare: Callable[[Epoch], Epoch]  # epochs (E, ...) of one run -> the same with `Prepared` samples
    transition: Callable[[Params, FilterState, Imu | Prepared], tuple[FilterState, Transition]]
    advance: Callable[[Params, FilterState, Epoch], "Step"]  # `step`, with the intermediate results
    # (grade or its name, **arguments of `jaxnav.filters.parameters.datasheet_params`) -> parameters for this filter
    params: Callable[..., Params] = datasheet_params
    supports_smoothing: bool = False  # see `Rule`
    made: Composition | None = None  # None: of functions that `make_filter` has not composed
    spec: FilterSpec | None = None  # None: composed by `make_filter`

    @property
    def name(self) -> str:
        """Return the filter's name in the catalogue; empty where its rule is not of there."""
        return "" if self.spec is None or self.spec.rule is not None else self.spec.name


def _require_shapes(c: Correction, z: Innovation) -> None:
    """Raise ValueError, when traced, for a correction whose shapes do not fit the innovation."""
    n, m = z.P.shape[0], z.nu.shape[0]
    for name, shape in (("delta", (n,)), ("P", (n, n)), ("used", (m,))):
        if jnp.shape(found := getattr(c, name)) != shape:
            raise ValueError(f"the rule's Correction.{name} has shape {jnp.shape(found)}, expected {shape}")


@jax.custom_jvp
def with_structural_derivative(params: Params, a: jax.Array) -> jax.Array:
    """Return ``a`` with a derivative in all parameters: numerically zero, symbolically not.

    A scan differentiates its body again and again until it knows which parts of its carry have a derivative. Where the
    same parts of its start have one it knows at once, and a gradient takes an eighth to a quarter less time to trace.
    """
    return a


@with_structural_derivative.defjvp
def _depending_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    leaves = [t.sum() for t in jax.tree.leaves(tangents[0]) if t.dtype != jax.dtypes.float0]
    return primals[1], tangents[1] + jnp.where(False, sum(leaves), 0.0)


def without_nan(fix: Fix, value_channels: Sequence[int]) -> Fix:
    """Return a fix with finite numbers in missing channels: a masked nan still makes the gradient nan.

    Args:
        fix: (m,), its sd and correlations in the order of its channels.
        value_channels: (m,) channel that each entry of its value shows: a latitude shows north, the second one.
    """
    filled = lambda a, number, valid=fix.valid: jnp.where(valid | jnp.isfinite(a), a, number)
    value = filled(fix.value, 1.0, fix.valid[np.array(value_channels)])
    return fix._replace(value=value, sd=filled(fix.sd, 1.0), corr=filled(fix.corr, 0.0))


def masked(y: jax.Array, H: jax.Array, R: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Make missing channels exact no-ops: zero residual and row of H, identity in R."""
    both = valid[:, None] & valid
    return jnp.where(valid, y, 0.0), jnp.where(valid[:, None], H, 0.0), jnp.where(both, R, jnp.eye(valid.shape[0]))


def padded(imu: Imu, stride: int) -> Imu:
    """Pad samples (k,) to a multiple of ``stride``: padding repeats the last one and lasts no time."""
    more = -imu.dt.shape[0] % stride
    if not more:
        return imu
    held = lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], more, 0)])
    return Imu(jnp.concatenate([imu.dt, jnp.zeros(more, imu.dt.dtype)]), held(imu.gyro), held(imu.accel))


def inflate_noise(noise: Noise, more: jax.Array) -> Noise:
    """Return the noise with root PSDs ``more`` (2,) of gyro and accelerometer added, independent on all axes."""

    def both(root: jax.Array, extra: jax.Array) -> jax.Array:
        if jnp.ndim(root) == 2:
            return jnp.concatenate([root, extra * jnp.eye(3)], 1)
        return jnp.where(extra > 0, jnp.hypot(root, jnp.where(extra > 0, extra, 1.0)), root)

    return noise._replace(gyro=both(noise.gyro, more[0]), accel=both(noise.accel, more[1]))


def shift(past: Nav, recent: Nav, n: jax.Array) -> Nav:
    """Return the last w of the samples ``past`` (w, ...) and n further ones, ``recent`` (w, ...) with their last w."""
    (old, _), (new, back), w = as_rows(past), as_rows(recent), past.t.size
    i = n + jnp.arange(w)
    stays, at = i < w, jnp.minimum(i, w - 1)
    moved = jax.vmap(back)(jnp.where(stays[:, None], old[at], new))
    return moved._replace(t=jnp.where(stays, past.t[at], recent.t))


def with_auxiliary(past: Nav, values: Mapping[str, jax.Array]) -> Nav:
    """Return the samples ``past`` (w, ...) with the auxiliary values () of an epoch in the last of them."""
    held = {name: a.at[-1].set(values[name]) for name, a in past.auxiliary.items()}
    return past._replace(auxiliary=held)


@cache
def make_filter(
    propagate: Propagate,
    model: ErrorModel,
    rule: Rule,
    feedback: Feedback,
    cov_stride: int = 1,
    history: int = 2,
    preintegrate: Preintegrate | None = None,
    adapter: Adapter | None = None,
) -> Filter:
    """Compose a filter.

    Args:
        propagate: mechanization of a frame.
        model: error state and its transition.
        rule: correction by a fix.
        feedback: use of the corrected error state.
        cov_stride: IMU samples per point of the error dynamics, which are means over them. From 2 to 10 local level
            navigation adds gravity and Coriolis once per point, while attitude and velocity are integrated at every
            sample. 10 instead of 1 costs less than a millimetre at 100 Hz.
        history: samples of navigation kept for measurements older than the end of the epoch; must cover the largest
            latency, beyond it the oldest two are extrapolated linearly.
        preintegrate: state-free part of a fast mechanization.
        adapter: sets noise and measurements of every epoch, see `jaxnav.filters.adapters`.

    Raises:
        ValueError: ``history`` below 2; when traced, epochs that were prepared for a filter with another stride or
            history.
    """
    if history < 2:
        raise ValueError(f"history must be at least 2 samples, got {history}")

    def estimates(given: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Return zero for estimated states, and the known values of the start."""
        blank = zeros((*model.states, *(name for name in rule.estimates if name not in model.states)))
        for state in chosen(given):
            if jnp.shape(given[state.name]) != (state.size,):
                raise ValueError(
                    f"{state.name} of the start has shape {jnp.shape(given[state.name])}, not ({state.size},)"
                )
        return blank | given

    def init(params: Params, nav: Nav) -> FilterState:
        unknown = {name: jnp.zeros(()) for name in model.reads}  # until the first epoch
        nav, T = model.enter(nav._replace(errors=estimates(nav.errors), auxiliary=unknown)), jnp.zeros(())
        P = with_structural_derivative(params, model.covariance(params, nav))
        # feeding back an error of zero changes nothing, but gives u and a derivative to all that an error reaches
        x = with_structural_derivative(params, jnp.zeros(model.n_states))
        start, x, u = feedback(params.feedback, model.retract, nav, x, T)
        moved = {
            sensor: sum(
                (nav.errors[s.name] - start.errors[s.name]).sum() for s in chosen(model.states) if s.enters == sensor
            )
            for sensor in ("gyro", "accel")
        }
        start = start._replace(omega=nav.omega + moved["gyro"], force=nav.force + moved["accel"])
        past = jax.tree.map(lambda a: jnp.broadcast_to(a, (history, *jnp.shape(a))), start)
        memory = rule.init(model.n_states, model.n_channels)
        first = () if adapter is None else adapter.memory()
        return FilterState(past, x, P, u, memory, x, T, jnp.zeros(model.n_channels), jnp.array(True), first)

    def counted(imu: Imu) -> Prepared:
        raw = None if adapter is None else imu
        n, imu = jnp.sum(imu.dt > 0), padded(imu, cov_stride)
        keep = jnp.maximum(n - history + jnp.arange(history), 0)
        return Prepared(n, keep, imu.dt.reshape(-1, cov_stride).sum(1), imu, raw, cov_stride)

    def prepare(epochs: Epoch) -> Epoch:
        def one(imu: Imu, last: tuple[jax.Array, jax.Array]) -> Prepared:
            given = counted(imu)
            return (
                replace(given, samples=preintegrate(given.samples, last, cov_stride, given.keep))
                if preintegrate
                else given
            )

        # an epoch's padding repeats its last sample; the first sample of all is taken for the one before it
        before = lambda a: jnp.concatenate([a[:1, 0], a[:-1, -1]])
        last = before(epochs.imu.gyro), before(epochs.imu.accel)
        return epochs._replace(imu=lax.map(lambda x: one(*x), (epochs.imu, last)))

    def transition(params: Params, state: FilterState, imu: Imu | Prepared) -> tuple[FilterState, Transition]:
        nav = jax.tree.map(lambda a: a[-1], state.past)
        given = imu if isinstance(imu, Prepared) else counted(imu)
        if (given.stride, given.keep.size) != (cov_stride, history):
            raise ValueError(
                f"the epochs were prepared for a stride and history of {given.stride, given.keep.size} samples, "
                f"the filter has {cov_stride, history}"
            )
        recent, points = propagate(nav, state.u, given.samples, cov_stride, given.keep)
        noise, length = params.noise, jnp.where(given.T.sum() > 0, given.T.sum(), 1.0)
        if model.second_order:
            acceleration = (recent.vel[-1] - nav.vel) / length
            noise = inflate_noise(noise, sensitivity_noise(noise.scale, given.T @ points.gyro / length, acceleration))
        Phi, Q, d = model.discretize(params._replace(noise=noise), points, given.T, state.u)
        if model.second_order:
            Phi, large = model.second_order(nav, Phi, state.P, given.T.sum())
            Q = Q.at[:6, :6].add(large)
        x, P = Phi @ state.x + d, linalg.sandwich(Phi, state.P) + Q
        moved, T = Transition(Phi, Q, d), given.T.sum()
        memory = rule.transport(params.rule, state.memory, moved, T) if rule.transport else state.memory
        predicted = state._replace(past=shift(state.past, recent, given.n), x=x, P=P, T=state.T + T, memory=memory)
        return predicted, moved

    def predict(params: Params, state: FilterState, imu: Imu | Prepared) -> FilterState:
        return transition(params, state, imu)[0]

    def correct(params: Params, state: FilterState, fix: Fix) -> tuple[FilterState, Info]:
        if model.restart:
            state, _ = restarted(params, state, Transition(state.P, state.P, state.x), fix)
        return corrected(params, state, fix)[:2]

    places = layout(chosen(model.states))

    def restarted(params: Params, state: FilterState, moved: Transition, fix: Fix) -> tuple[FilterState, Transition]:
        """Return the predicted state, and the transition to it, where states of new channels restart."""
        assert model.restart is not None
        new, sd = model.restart(params, fix)
        kept, prior = jnp.where(new, 0.0, 1.0), jnp.diag(jnp.where(new, sd**2, 0.0))
        only_kept = lambda M: kept[:, None] * M * kept + prior
        errors = {name: state.past.errors[name] * kept[place] for name, place in places.items()}
        past = state.past._replace(errors=state.past.errors | errors)
        state = state._replace(past=past, x=kept * state.x, P=only_kept(state.P))
        return state, Transition(kept[:, None] * moved.Phi, only_kept(moved.Q), kept * moved.d)

    def corrected(params: Params, state: FilterState, fix: Fix) -> tuple[FilterState, Info, jax.Array]:
        nav, age = jax.tree.map(lambda a: a[-1], state.past), state.age + state.T
        fix = without_nan(fix, model.value_channels)
        if model.compared:  # its residual is reported all the same
            fix = fix._replace(valid=fix.valid & ~np.array(model.compared))
        x, memory = rule.extrapolate(params.rule, state.memory, state.x0, state.x)
        y, H, R = model.observe(params, state.past, fix, state.P if model.second_order else None)
        residual = y - H @ x
        y, H, R = masked(y, H, R, fix.valid)
        S = linalg.sandwich(H, state.P) + R
        inverse, log_det = linalg.swept(S)
        z = Innovation(y - H @ x, H, R, state.P, fix.valid, state.T, age, (H, R, state.P, inverse))
        c = rule.correct(params.rule, memory, z)
        _require_shapes(c, z)
        c = only_if(fix.valid.any(), c, z, memory)
        x = x + c.delta
        nis = linalg.normalized(z.nu, S, inverse)
        # how long an observer's drive may have to last: with two streams a short epoch can come before a long one
        until = jnp.maximum(state.T, jnp.max(jnp.where(c.used, age, 0.0)))
        feed = partial(feedback, params.feedback, model.retract)
        if c.drive and not set(BIASES) <= set(state.past.errors):
            raise ValueError(f"a rule with a drive that the sensors absorb needs Rule(..., estimates={BIASES})")
        past = jax.vmap(model.absorb, (0, None))(state.past, c.drive) if c.drive else state.past
        # with a history, earlier samples have had other errors; two samples are one sample time from each other
        xs = model.earlier(past, x) if history > 2 else jnp.broadcast_to(x, (history, *x.shape))
        after, xs_after, us = jax.vmap(feed, (0, 0, None))(past, xs, until)
        x_after, u = xs_after[-1], jax.tree.map(lambda a: a[-1], us)
        P_after = reset_covariance((x - x_after)[A], c.P)
        memory = c.memory
        if rule.transport:  # a rule's covariances refer to the corrected attitude as P does
            J = reset_rows((x - x_after)[A], jnp.eye(x.size))
            turned = Transition(J, jnp.zeros_like(J), jnp.zeros_like(x))
            memory = rule.transport(params.rule, memory, turned, jnp.zeros(()))
        f = jnp.broadcast_to(c.fade, x.shape)
        age = jnp.where(c.used, 0.0, age)
        new = FilterState(
            after,
            x_after,
            f[:, None] * P_after * f,
            u,
            memory,
            x_after,
            jnp.zeros(()),
            age,
            jnp.array(True),
            state.adapter,
        )
        ok = state.ok & finite(new) & jnp.all(jnp.diag(c.P) >= 0)
        reported, x_enu, P_enu = model.report(model.retract(nav, x), x, reset_covariance(x[A], c.P))
        return (
            new._replace(ok=ok),
            Info(reported, P_enu, x_enu, z.nu, S, residual, fix.valid, c.used, nis, ok, log_det),
            x,
        )

    def adapt(params: Params, state: FilterState, epoch: Epoch) -> tuple[FilterState, Params, Epoch]:
        """Return the state with the adapter's memory, and the parameters and the epoch to go on with."""
        if adapter is None:
            return state, params, epoch
        imu: Any = epoch.imu.imu if isinstance(epoch.imu, Prepared) else epoch.imu
        nav, _, P = model.report(jax.tree.map(lambda a: a[-1], state.past), state.x, state.P)
        window = Window(imu, nav, P, state.age + state.T + imu.dt.sum(), epoch.fix)
        memory, fix, factor = adapted(adapter, params.adapter, state.adapter, window, model.value_channels)
        params = params._replace(noise=with_factor(params.noise, factor))
        return state._replace(adapter=memory), params, epoch._replace(fix=fix)

    def advance(params: Params, state: FilterState, epoch: Epoch) -> Step:
        before = state
        state, params, epoch = adapt(params, state, epoch)
        noise = params.noise if epoch.gap is None else inflate_noise(params.noise, epoch.gap)
        if model.reads:
            state = state._replace(past=with_auxiliary(state.past, epoch.auxiliary))
        predicted, moved = transition(params._replace(noise=noise), state, epoch.imu)
        if model.restart:
            predicted, moved = restarted(params, predicted, moved, epoch.fix)
        new, info, x_after = corrected(params, predicted, epoch.fix)
        # a run that fails freezes at its last good state, so that the others of a batch go on and nothing is nan
        frozen = before._replace(ok=jnp.array(False))
        last, x, P = model.report(jax.tree.map(lambda a: a[-1], state.past), state.x, state.P)
        quiet = Info(
            nav=last,
            P=P,
            x=x,
            nu=jnp.zeros_like(info.nu),
            S=jnp.eye(model.n_channels),
            residual=jnp.zeros_like(info.nu),
            valid=jnp.zeros_like(info.valid),
            used=jnp.zeros_like(info.used),
            nis=jnp.zeros(()),
            ok=info.ok,
            log_det=jnp.zeros(()),
        )
        return Step(before, predicted, moved, select(info.ok, new, frozen), select(info.ok, info, quiet), x_after)

    def step(params: Params, state: FilterState, epoch: Epoch) -> tuple[FilterState, Info]:
        new = advance(params, state, epoch)
        return new.after, new.info

    return Filter(
        init,
        predict,
        correct,
        step,
        model,
        prepare,
        transition,
        advance,
        supports_smoothing=rule.supports_smoothing,
        made=Composition(propagate, model, rule, feedback, cov_stride, history, preintegrate, adapter),
    )


def finite(tree: Tree) -> jax.Array:
    """() bool: every leaf is finite."""
    return jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]).all()
