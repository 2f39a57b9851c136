"""Error states beyond position, velocity and attitude, as objects: quantity, unit, process and effect of each."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax

from jaxnav.maths.units import Unit
from jaxnav.types import StateParams


class Reading(NamedTuple):
    """Arguments of the effect of an error state."""

    this: jax.Array  # (..., 3) w: rad/s of the gyro, or m/s^2 of the accelerometer
    other: jax.Array  # (..., 3) o: of the other sensor
    auxiliary: Mapping[str, jax.Array] = {}  # a: (...) each


Effect = Callable[[Reading], jax.Array]


class State(NamedTuple):
    """One optional error state: a row of `STATES`.

    The truth of a sensor that it enters is w, that of the other sensor o, and its reading w + M(w, o, a) s, where s
    is the state and a are auxiliary values, such as a temperature.
    """

    name: str
    axes: tuple[str, ...]  # names of its components, as many as it is long
    enters: str | None  # "gyro" or "accel", whose reading it changes; None: only measurements see it
    effect: Effect | None  # -> M (..., 3, size), linear in w, o and a together; None: M = I
    defaults: StateParams  # plain numbers, used where no datasheet gives a value
    units: StateParams  # of `Unit`: how each leaf is stated at the border
    reads: tuple[str, ...] = ()  # auxiliary values, by name of `jaxnav.measurements.auxiliary.AUXILIARY`
    rate_of: str = ""  # the state that grows by this one per second, where a filter has both

    @property
    def size(self) -> int:
        """Its length."""
        return len(self.axes)


BODY = ("forward", "right", "down")


class UserUnit(NamedTuple):
    """A unit of users: as keys end, its factor to SI, in words."""

    suffix: str
    factor: float
    text: str


def state_units(size: int, unit: UserUnit, noise: UserUnit | None = None) -> StateParams:
    """Return how users state a state: sd, driving noise per sqrt(s), in ``noise`` if that is another unit, and tau."""
    shape, per = (size,) if size > 1 else (), noise or unit
    return StateParams(
        Unit(unit.suffix, unit.factor, shape, unit.text),
        Unit(f"{per.suffix}_per_sqrt_s", per.factor, shape, f"{per.text}/sqrt(s)", root=size == 3, zero=True),
        Unit("s", 1.0, shape, "s", endless=True),
    )


def constant(
    name: str,
    axes: tuple[str, ...],
    sd: float,
    unit: UserUnit,
    enters: str | None = None,
    effect: Effect | None = None,
    reads: tuple[str, ...] = (),
) -> State:
    """Return a state that stays constant unless driven; ``sd`` in ``unit``."""
    units = state_units(len(axes), unit)
    return State(name, axes, enters, effect, StateParams(sd * unit.factor, 0.0, float("inf")), units, reads)
