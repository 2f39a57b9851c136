"""What a recording's training part shows of free parameters: J of `tuning.recorded` and its information."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.analysis.windows import Windows
from jaxnav.data import epochs as ep
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.run import run
from jaxnav.measurements import MEASUREMENTS
from jaxnav.states import table
from jaxnav.types import Epoch, Nav, Params
from tuning.parts import Layout, ages
from tuning.transforms import Spec, join, split
from tuning.uncertainty import Information, gaussian, pushed, rejected

TINY = 1e-4  # of an sd: a parameter that is held
SLOW = "gnss_position_error"


class Evidence(NamedTuple):
    """Sums over what the training part shows: value (), score (P,), information (P, P), and of how many."""

    value: jax.Array
    score: jax.Array
    fisher: jax.Array
    number: jax.Array


class Seen(NamedTuple):
    """What is kept of an epoch."""

    nu: jax.Array
    S: jax.Array
    valid: jax.Array
    far: jax.Array  # the rule rejected some of it
    ok: jax.Array
    residual: jax.Array  # (3,) of the position
    P: jax.Array  # (3, 3) of what a fix tells, its own noise apart


def _keep(slow: slice | None, step: Step, beside: Any) -> Seen:
    info = step.info
    P = seen_by_position(info.P, slow)
    return Seen(info.nu, info.S, info.valid, rejected(info), info.ok, info.residual[:3], P)


@partial(jax.jit, static_argnums=(0, 1))
def _evidence(
    filt: Filter, items: tuple, flat: jax.Array, like: Any, params: Params, nav: Nav, epochs: Epoch, valid: jax.Array,
    keep: jax.Array, at: jax.Array, there: jax.Array, sd: jax.Array,
) -> tuple[Evidence, Evidence]:  # fmt: skip
    """Of innovations and of hidden fixes; valid (P, E, m), keep (P, E), at and there (P, A), sd (P, A, 3)."""
    spec, (_, back) = dict(items), ravel_pytree(like)
    keep_seen = partial(_keep, table.layout(table.chosen(filt.model.states)).get(SLOW))

    def phase(valid, keep, at, there, sd):
        def outputs(r):
            own = join(spec, back(r), params)
            seen = run(filt, own, nav, epochs._replace(fix=epochs.fix._replace(valid=valid)), keep_seen)
            scale = own.measurements["position"].scale
            size = jnp.linalg.norm(scale, axis=-1) if jnp.ndim(scale) == 2 else jnp.broadcast_to(scale, (3,))
            R = jax.vmap(jnp.diag)((size * sd) ** 2)
            return (seen.nu, seen.S, seen.residual[at], seen.P[at] + R), (seen.valid, seen.far, seen.ok)

        ((nu, S, y, C), (seen, outlying, ok)), (dnu, dS, dy, dC) = pushed(outputs, flat)
        own = jax.vmap(gaussian, (0, 0, 0, 1, 1, 0))(nu, S, seen, dnu, dS, outlying)
        three = jnp.ones((at.size, 3), bool)
        far = jax.vmap(partial(gaussian, heavy=True), (0, 0, 0, 1, 1))(y, C, three, dy, dC)
        lost = jnp.where((keep & ~ok).any(), jnp.inf, 0.0)
        counts = keep & seen.any(-1)

        def total(parts, mask):
            value, score, fisher = (jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0).sum(0) for a in parts)
            return Evidence(value, score, fisher, mask.sum())

        innovations = total(own, counts)
        return innovations._replace(value=innovations.value + lost), total(far, there)

    both = jax.vmap(phase)(valid, keep, at, there, sd)
    return jax.tree.map(lambda a: a.sum(0), both)


def seen_by_position(P: jax.Array, slow: slice | None) -> jax.Array:
    """Covariance (..., 3, 3) m^2, ENU, of what a fix tells, its own noise apart: position and the receiver's error."""
    if slow is None:
        return P[..., :3, :3]
    cross = P[..., :3, slow]
    return P[..., :3, :3] + cross + jnp.swapaxes(cross, -1, -2) + P[..., slow, slow]


class Job:
    """The objective of one recording, for a search."""

    def __init__(
        self, filt: Filter, spec: Spec, sheet: Params, nav: Nav, epochs: Epoch, packed: ep.Packed, windows: Windows,
        training: np.ndarray, layout: Layout,
    ):  # fmt: skip
        E = int(np.searchsorted(packed.t, layout.train + ep.TICK))
        chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
        self.filt, self.spec, self.sheet, self.nav = filt, spec, sheet, nav
        self.raw = split(spec, sheet)
        self.flat, self.back = ravel_pytree(self.raw)
        self.items = tuple(spec.items())
        self.epochs = jax.tree.map(lambda a: a[:E], epochs)
        hidden = windows.hidden[:, :E]
        self.valid = jnp.stack([ep.hide(self.epochs, h, chosen).fix.valid for h in hidden])
        self.keep = jnp.asarray((packed.t[:E] >= packed.start + layout.settle) & ~hidden)
        there = np.all(np.asarray(packed.epochs.fix.valid)[:, :2], axis=1)
        self.at, self.there = ages(windows, packed.t, there, training, layout.window)
        self.sd = jnp.asarray(np.asarray(packed.epochs.fix.sd)[:, :3][self.at])
        self.effective = max(1.0, float(layout.train - packed.start - layout.settle) / layout.window)
        self.centre = self.flat
        self.width = np.concatenate([np.full(np.size(self.raw[name]), _width(spec, name)) for name in sorted(spec)])

    def evidence(self, flat: jax.Array) -> tuple[Evidence, Evidence]:
        """Of innovations, of hidden fixes."""
        return _evidence(
            self.filt, self.items, flat, self.raw, self.sheet, self.nav, self.epochs, self.valid, self.keep,
            jnp.asarray(self.at), jnp.asarray(self.there), self.sd,
        )  # fmt: skip

    def objective(self, horizon: bool = True, held: Sequence[str] = ()) -> Callable[[jax.Array], Information]:
        """J and its information, as `tuning.scoring.maximise` takes it."""
        names = [name for name in sorted(self.spec) for _ in range(np.size(self.raw[name]))]
        width = np.where(np.isin(names, held), TINY * self.width, self.width)

        def inform(flat: jax.Array) -> Information:
            parts = self.evidence(flat)[: 2 if horizon else 1]
            mean = [jax.tree.map(lambda a, e=e: a / jnp.maximum(e.number, 1), e) for e in parts]
            off = (flat - self.centre) / width
            value = self.effective * sum(e.value for e in mean) + 0.5 * jnp.sum(off**2)
            score = self.effective * sum(e.score for e in mean) + off / width
            fisher = self.effective * sum(e.fisher for e in mean) + jnp.diag(1 / jnp.asarray(width) ** 2)
            return Information(value, score, fisher, jnp.zeros((1, flat.size)))

        return inform

    def numbers(self, params: Params) -> jax.Array:
        """The unconstrained numbers of other parameters; what they lack is the datasheet's."""
        states = self.sheet.states | params.states
        return ravel_pytree(split(self.spec, params._replace(states=states)))[0]

    def params(self, flat: jax.Array) -> Params:
        """The parameters that unconstrained numbers stand for."""
        return join(self.spec, self.back(flat), self.sheet)


def _width(spec: Spec, name: str) -> float:
    belief = spec[name].belief
    return 1e3 if belief is None else belief.sd
