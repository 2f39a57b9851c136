"""The parts of a filter after its mechanization and error model: a rule and a feedback, and their arguments."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import lax

from jaxnav.types import Array, Forcing, Nav, Tree

NEVER_USED_AGE = 1e9  # s, age of an event that has not happened yet: a rule's memory is finite


class Transition(NamedTuple):
    """How the error state moved over an epoch: x -> Phi x + d, with noise of covariance Q."""

    Phi: jax.Array  # (n, n)
    Q: jax.Array  # (n, n)
    d: jax.Array  # (n,)


class Innovation(NamedTuple):
    """A fix for a rule; the rows of missing channels are zero in nu and H, and identity in R."""

    nu: jax.Array  # (m,) y - H x
    H: jax.Array  # (m, n)
    R: jax.Array  # (m, m)
    P: jax.Array  # (n, n) predicted covariance
    valid: jax.Array  # (m,) bool
    T: jax.Array  # () s, length of this epoch
    age: jax.Array  # (m,) s since each channel was last used
    swept: tuple[jax.Array, ...] = ()  # H, R and P, and the inverse of H P H' + R

    @property
    def inverse(self) -> jax.Array | None:
        """Return the inverse of H P H' + R, (m, m); None where one of them has been replaced since it was swept."""
        same = self.swept and all(a is b for a, b in zip((self.H, self.R, self.P), self.swept[:3], strict=True))
        return self.swept[3] if same else None


class Correction(NamedTuple):
    """Result of a rule."""

    delta: jax.Array  # (n,) change of x
    P: jax.Array  # (n, n) covariance after the correction
    memory: Tree  # the rule's state
    used: jax.Array  # (m,) bool, channels that it accepted
    fade: Array = 1.0  # () or (n,): fade P fade is carried on to the next prediction
    drive: Forcing | None = None  # a model error for the sensors to absorb


class Correct(Protocol):
    """A rule's correction by a fix."""

    def __call__(self, theta: Tree, memory: Tree, z: Innovation, /) -> Correction:
        """Return the correction by ``z``, with the rule's parameters ``theta`` and its ``memory``."""


class Extrapolate(Protocol):
    """A rule's prediction, at every epoch, with a fix or without."""

    def __call__(self, theta: Tree, memory: Tree, x0: jax.Array, x: jax.Array, /) -> tuple[jax.Array, Any]:
        """``x0`` (n,) after the last feedback, ``x`` (n,) predicted from it -> x and the memory to go on with."""


class Transport(Protocol):
    """How error states that a rule holds move: over every epoch, and with T = 0 at the reset of the attitude."""

    def __call__(self, theta: Tree, memory: Tree, transition: Transition, T: jax.Array, /) -> Any:
        """``T`` () s, the epoch's length -> memory."""


class Feedback(Protocol):
    """Use of an estimated error: taken out of navigation, kept, or handed on in part."""

    def __call__(
        self, theta: Tree, retract: Callable[[Nav, jax.Array], Nav], nav: Nav, x: jax.Array, T: jax.Array, /
    ) -> tuple[Nav, jax.Array, Any]:
        """``x`` (n,) error, ``T`` () s since the last one -> navigation, the error that is left, the drive or None."""

    def __hash__(self) -> int: ...


class Rule(NamedTuple):
    """The part that a paper changes. Must be finite with H = 0 and T = 0: discarded where nothing is valid."""

    init: Callable[[int, int], Any]  # (n, m) -> memory
    correct: Correct
    extrapolate: Extrapolate = lambda theta, memory, x0, x: (x, memory)
    estimates: tuple[str, ...] = ()  # optional states that it moves by itself, without their being in x
    supports_smoothing: bool = False  # its correction is one of the covariance, so that a smoother can go back over it
    transport: Transport | None = None


def select(flag: jax.Array, a: Tree, b: Tree) -> Tree:
    """Return ``a`` where the flag is true, else ``b``, leaf by leaf; its axes, if any, are the first of each leaf."""

    def leaf(a: Any, b: Any) -> jax.Array:
        shape, dtype = jnp.broadcast_shapes(jnp.shape(a), jnp.shape(b)), jnp.result_type(a, b)
        a, b = (jnp.broadcast_to(jnp.asarray(x, dtype), shape) for x in (a, b))
        if flag.ndim == 0:
            return lax.select(flag, a, b)  # one equation, with a flag of any size three
        return jnp.where(jnp.expand_dims(flag, range(flag.ndim, a.ndim)), a, b)

    return jax.tree.map(leaf, a, b)


def only_if(flag: jax.Array, c: Correction, z: Innovation, memory: Tree) -> Correction:
    """Return the correction where the flag is true, else one that changes nothing."""
    nothing = jax.tree.map(jnp.zeros_like, c.drive)
    return select(flag, c, Correction(jnp.zeros(z.P.shape[0]), z.P, memory, jnp.zeros_like(z.valid), drive=nothing))
