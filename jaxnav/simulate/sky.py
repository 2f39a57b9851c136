"""Satellites over a simulated run: what a scenario states of them."""

import math
from typing import NamedTuple


class Sky(NamedTuple):
    """Satellites over a run, and what stands in their way."""

    satellites: int = 30  # in six planes
    mask_deg: float = 10.0  # elevation below which none is seen
    house_deg: float = 0.0  # elevation of houses on both sides of a street
    street_deg: float = 0.0  # course of that street, from north to the east
    # (start, end, count): s, in which at most so many satellites are seen, the highest
    few: tuple[tuple[float, float, int], ...] = ()
    # m, of satellites below 30 deg: one reflection longer than the direct way, for 20 s of every 60
    multipath_m: float = 0.0
    faulty_from_s: float = math.inf  # the highest satellite at the start of the run has a fault from then on
    fault_m: float = 0.0  # its size at once
    fault_mps: float = 0.0  # and its growth
