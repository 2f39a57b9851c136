"""The error state: its parts, its motion from fix to fix, and its parameters by datasheet.

Position, velocity and attitude belong to the frame (`jaxnav.strapdown.errors`). Every other state is a row of
`STATES`, one file each; a filter is built with the states that it is to have.
"""

from jaxnav.states.state import State
from jaxnav.states.table import BIASES, STATES

__all__ = ["BIASES", "STATES", "State"]
