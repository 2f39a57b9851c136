"""Values of a stream of data: their columns in files, quantity, and the sd assumed where a file states none."""

import math
from typing import NamedTuple

from jaxnav.maths.units import DEG

Names = tuple[tuple[str, float], ...]
"""Names that a column may have in a CSV file, each with the factor to SI; the first is written."""

QUANTITIES = {"length": ("m", "m"), "speed": ("m/s", "m/s"), "angle": ("rad", "deg"), "rate": ("rad/s", "rad/s"),
              "field": ("uT", "uT"), "temperature": ("degC", "degC")}  # fmt: skip
"""By quantity: the unit in a recording, and the one that a column map takes by default."""
_ALSO = {"rad": (("rad", 1.0), ("deg", DEG)), "radps": (("radps", 1.0), ("degps", DEG))}


class Column(NamedTuple):
    """One value of a stream."""

    names: Names
    sd_names: Names
    quantity: str  # of its sd; a key of `QUANTITIES`
    sd: float  # assumed where none is stated, in the unit of the quantity
    plausible: tuple[float, float] = (-math.inf, math.inf)  # range of its value in a recording; beyond it there is none
    marks: tuple[float, ...] = ()  # values that loggers write where they have none

    @property
    def unit(self) -> str:
        """The unit of its sd in a recording."""
        return QUANTITIES[self.quantity][0]


def column(
    name: str,
    quantity: str,
    sd: float,
    sd_name: str = "",
    plausible: tuple[float, float] = (-math.inf, math.inf),
    marks: tuple[float, ...] = (),
) -> Column:
    """Return a column of a file; the unit is the last part of its name.

    Args:
        name: name in files, ``height_m``; a column in rad is also read in deg.
        quantity: a key of `QUANTITIES`.
        sd: assumed where none is stated, in the unit of the quantity.
        sd_name: of the column of its sd; the default is ``sd_`` and the unit.
        plausible: range of its value in a recording, in SI.
        marks: values that stand for none, in SI.
    """
    return Column(_names(name), _names(sd_name or f"sd_{name.rpartition('_')[2]}"), quantity, sd, plausible, marks)


def _names(name: str) -> Names:
    stem, _, unit = name.rpartition("_")
    return tuple((f"{stem}_{other}", factor) for other, factor in _ALSO.get(unit, ((unit, 1.0),)))
