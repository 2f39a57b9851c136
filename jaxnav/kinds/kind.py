"""Kind: the texts of one kind of finding."""

from typing import NamedTuple

from jaxnav.types import Severity

INFO, WARNING = Severity.INFO, Severity.WARNING


class Kind(NamedTuple):
    """A kind of finding; in its texts stand the numbers of `finding` by name."""

    severity: Severity
    message: str  # one sentence: quantity, value, limit
    causes: tuple[str, ...] = ()  # the likely ones first
    actions: tuple[str, ...] = ()  # settings or commands
    unit: str = ""  # of value and limit
    breaks_solution: bool = False  # as a warning: there is no right trajectory with it
    exceeds_sd: bool = False  # errors may be above the stated sd
