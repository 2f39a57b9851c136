"""FilterSpec: a filter of the catalogue as data; `jaxnav.build` makes the filter."""

from dataclasses import dataclass, fields, replace
from typing import Any

from jaxnav.filters.adapters.adapter import Adapter
from jaxnav.filters.rule import Feedback, Rule
from jaxnav.measurements.measurement import Measurement
from jaxnav.types import Json


@dataclass(frozen=True)
class FilterSpec:
    """A filter by names and numbers; two specs of equal fields are equal and have one filter.

    >>> FilterSpec("ekf15", ("position",)).replace(history=9)
    FilterSpec(name='ekf15', measurements=('position',), history=9)
    """

    name: str  # a key of `FILTERS`
    measurements: tuple[Measurement | str, ...] = ("position", "velocity")  # rows of `MEASUREMENTS`, or their names
    states: tuple[str, ...] = ()  # optional states in addition to the filter's
    cov_stride: int = 1  # IMU samples per point of the error dynamics
    history: int = 2  # samples of navigation kept for late measurements
    frame: str = ""  # a key of `FRAMES`; empty: the filter's
    fast: bool = True  # navigate by the frame's fast form, where it has one
    rule: Rule | None = None  # in place of the filter's
    feedback: Feedback | None = None  # in place of the filter's
    adapter: str | Adapter = ""  # sets noise and measurements of every epoch; a name of `ADAPTERS`, or the part itself

    def __repr__(self) -> str:
        given = [f for i, f in enumerate(fields(self)) if not i or getattr(self, f.name) != f.default]
        return f"FilterSpec({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in given)})"

    def as_dict(self) -> Json:
        """Return the fields as JSON holds them: rows by name, parts of the user by the names of their types."""
        named = {key: _name(getattr(self, key)) for key in ("rule", "feedback", "adapter")}
        rows = {"measurements": list(map(_name, self.measurements)), "states": list(self.states)}
        return {field.name: getattr(self, field.name) for field in fields(self)} | rows | named

    def replace(self, **changes: Any) -> "FilterSpec":
        """Return the spec with other fields.

        Args:
            changes: fields by name.
        """
        return replace(self, **changes)


def _name(part: Any) -> str | None:
    """Return the name of a row or function, of another part that of its type."""
    if part is None or isinstance(part, str):
        return part
    return str(getattr(part, "name", None) or getattr(part, "__qualname__", type(part).__name__))
