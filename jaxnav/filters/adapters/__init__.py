"""ADAPTERS: parts of a filter that set its noise and its measurements epoch by epoch, by name."""

from collections.abc import Callable
from typing import NamedTuple

from jaxnav.filters.adapters.adapter import Adapter
from jaxnav.filters.adapters.mlp_noise import mlp_noise
from jaxnav.filters.adapters.window_constraints import window_constraints
from jaxnav.measurements.measurement import Measurement
from jaxnav.types import Table


class Entry(NamedTuple):
    """An adapter. Adding one is a file and a row in `ADAPTERS`."""

    make: Callable[[tuple[Measurement, ...]], Adapter]  # for a filter with these measurements
    citation: str
    needs: tuple[str, ...] = ()  # measurements of the filter


ADAPTERS: Table[Entry] = Table(
    {
        "mlp_noise": Entry(mlp_noise, "this package: a network of two layers gives factors on the stated sd of fixes"),
        "window_constraints": Entry(
            window_constraints, "Brossard, Barrau & Bonnabel 2020, section IV-B", ("nonholonomic",)
        ),
    }
)
