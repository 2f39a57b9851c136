"""The error state: what it is made of, how it moves from fix to fix, and what datasheets say of it.

Position, velocity and attitude belong to the frame (`jaxnav.strapdown.errors`). What else may be estimated is a row of
`STATES`, one file each; a filter is built with those that it is to have.
"""

from jaxnav.states.state import State
from jaxnav.states.table import BIASES, STATES

__all__ = ["BIASES", "STATES", "State"]
