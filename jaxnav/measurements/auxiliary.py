"""AUXILIARY: streams of a recording that measure no navigation state, and that effects of optional states read."""

from typing import NamedTuple

from jaxnav.measurements.columns import Column, column


class Auxiliary(NamedTuple):
    """A row of `AUXILIARY`: one value, held from sample to sample."""

    name: str
    columns: tuple[Column, ...]
    correlated: bool = False  # as of a `jaxnav.measurements.measurement.Measurement`

    @property
    def size(self) -> int:
        """How many values it has."""
        return len(self.columns)


TEMPERATURE = Auxiliary("temperature", (column("temperature_degc", "temperature", 1.0, plausible=(-100.0, 200.0)),))
"""Temperature of the IMU, deg C."""

AUXILIARY: dict[str, Auxiliary] = {each.name: each for each in (TEMPERATURE,)}
