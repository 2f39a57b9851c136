"""Error states beyond position, velocity and attitude, as objects: what each is, and where it enters."""

from collections.abc import Callable
from typing import NamedTuple

import jax

from jaxnav.maths.units import Unit
from jaxnav.types import StateParams


class State(NamedTuple):
    """One optional error state: a row of `STATES`.

    The truth of a sensor that it enters is w, that of the other sensor o, and what is read is w + M(w, o) s, where s is
    the state.
    """

    name: str
    axes: tuple[str, ...]  # names of its components, as many as it is long
    enters: str | None  # "gyro" or "accel", whose reading it changes; None: only measurements see it
    # w, o (..., 3) -> M (..., 3, size), linear in them: rad/s of the gyro, m/s^2 of the accelerometer; None: M = I
    effect: Callable[[jax.Array, jax.Array], jax.Array] | None
    defaults: StateParams  # plain numbers: what is believed where no datasheet says anything
    units: StateParams  # of `Unit`: how each leaf is stated at the border

    @property
    def size(self) -> int:
        """Its length."""
        return len(self.axes)


BODY = ("forward", "right", "down")


def state_units(
    name: str, unit: str, factor: float, size: int, text: str, drive: tuple[str, float, str]
) -> StateParams:
    """The border's names of a state's leaves: ``prior_NAME_UNIT``, NAME_DRIVE and ``NAME_tau_s``."""
    shape = (size,) if size > 1 else ()
    key, per_second, drive_text = drive
    return StateParams(
        Unit(f"prior_{name}_{unit}", factor, shape, text),
        Unit(key, per_second, shape, drive_text, root=size == 3),
        Unit(f"{name.removesuffix('_bias')}_tau_s", 1.0, shape, "s", endless=True),
    )


def constant(
    name: str, axes: tuple[str, ...], sd: float, unit: tuple[str, float, str], enters: str | None = None,
    effect: Callable[[jax.Array, jax.Array], jax.Array] | None = None,
) -> State:  # fmt: skip
    """A state that stays what it is unless it is driven; ``unit``: as its keys end, its factor to SI, in words."""
    key, factor, text = unit
    drive = (f"{name}_{key}_per_sqrt_s", factor, f"{text}/sqrt(s)")
    units = state_units(name, key, factor, len(axes), text, drive)
    return State(name, axes, enters, effect, StateParams(sd * factor, 0.0, float("inf")), units)
