"""CHECKS: a row for each question; a new one is a function and a line here."""

from collections.abc import Callable
from typing import NamedTuple

from jaxnav.checkup import compass, inertial, motion, standstill, streams, times
from jaxnav.types import Finding, Recording, require_double


class Check(NamedTuple):
    """A question to a recording."""

    answer: Callable[[Recording], list[Finding]]  # nothing where it cannot be asked
    quick: bool = True  # milliseconds: asked at every read


CHECKS: dict[str, Check] = {
    "sampling": Check(inertial.sampling),
    "axes": Check(inertial.axes),
    "gravity": Check(inertial.gravity),
    "noise": Check(inertial.noise),
    "overlap": Check(times.overlap),
    "ends": Check(times.ends),
    "rhythm": Check(times.rhythm),
    "stream_offset": Check(times.stream_offset),
    "fixes": Check(streams.fixes),
    "stated": Check(streams.stated),
    "velocity": Check(streams.velocity),
    "heading": Check(streams.heading),
    "speed": Check(streams.speed),
    "barometer": Check(streams.barometer),
    "compass": Check(compass.compass),
    "standstill": Check(standstill.standstill, False),
    "turns": Check(motion.turns, False),
    "together": Check(motion.together, False),
}


def checkup(rec: Recording, quick: bool = False) -> list[Finding]:
    """Return the findings of the reader and of the checks on a recording; ``quick``: only of the fast ones.

    Raises:
        DataError: positions in float32.
    """
    for name, samples in rec.aiding.items():
        require_double(name, samples.value)
    asked = (check for check in CHECKS.values() if check.quick or not quick)
    found = [finding for check in asked for finding in check.answer(rec)]
    again = {(f.code, f.subject) for f in found}  # of a part of the recording, for instance
    return [*(f for f in rec.findings if (f.code, f.subject) not in again), *found]
