"""KINDS: findings of a reader, a check, a run or a tuning, and their texts; numerics give the numbers.

A new kind is a row of one of the tables. docs/findings.md lists them.
"""

from jaxnav.kinds import readers, recordings, runs
from jaxnav.kinds.kind import Kind

KINDS: dict[str, Kind] = readers.KINDS | recordings.KINDS | runs.KINDS
