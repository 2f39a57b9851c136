"""What was read, checked against itself: `checkup` of a recording, a row of `CHECKS` for each question."""

from jaxnav.checkup.table import CHECKS, checkup

__all__ = ["CHECKS", "checkup"]
