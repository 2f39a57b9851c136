"""Navigation messages bit by bit: LNAV of GPS and QZSS, I/NAV of Galileo, as a receiver passes them on."""

import math
from typing import NamedTuple

import numpy as np

from jaxnav.gnss.corrections import Ionosphere
from jaxnav.gnss.orbits import Ephemeris
from jaxnav.gnss.ranges import number
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK

SEMICIRCLE = math.pi  # rad


class Field(NamedTuple):
    """A number of a message."""

    name: str
    start: int  # bit, from 0
    bits: int
    scale: float = 1.0
    signed: bool = False


def _fields(start: int, *parts: tuple[str, int, float]) -> tuple[Field, ...]:
    """Return fields that follow each other; of negative bits signed, without a name skipped."""
    found = []
    for name, bits, scale in parts:
        if name:
            found.append(Field(name, start, abs(bits), scale, bits < 0))
        start += abs(bits)
    return tuple(found)


_SC = SEMICIRCLE
LNAV: dict[int, tuple[Field, ...]] = {
    1: _fields(48, ("", 16, 1), ("health", 6, 1), ("", 90, 1), ("group_delay", -8, 2**-31), ("iode", 8, 1),
               ("toc", 16, 16), ("af2", -8, 2**-55), ("af1", -16, 2**-43), ("af0", -22, 2**-31)),
    2: _fields(48, ("iode", 8, 1), ("crs", -16, 2**-5), ("delta_n", -16, 2**-43 * _SC), ("m0", -32, 2**-31 * _SC),
               ("cuc", -16, 2**-29), ("e", 32, 2**-33), ("cus", -16, 2**-29), ("sqrt_a", 32, 2**-19), ("toe", 16, 16)),
    3: _fields(48, ("cic", -16, 2**-29), ("omega0", -32, 2**-31 * _SC), ("cis", -16, 2**-29),
               ("i0", -32, 2**-31 * _SC), ("crc", -16, 2**-5), ("omega", -32, 2**-31 * _SC),
               ("omega_dot", -24, 2**-43 * _SC), ("iode", 8, 1), ("idot", -14, 2**-43 * _SC)),
    4: _fields(50, ("page", 6, 1), ("a0", -8, 2**-30), ("a1", -8, 2**-27), ("a2", -8, 2**-24), ("a3", -8, 2**-24),
               ("b0", -8, 2**11), ("b1", -8, 2**14), ("b2", -8, 2**16), ("b3", -8, 2**16)),
}  # fmt: skip
"""Subframes of 240 bits without parity (IS-GPS-200N, figures 20-1 and 20-5)."""
IONOSPHERE_PAGE = 56  # of subframe 4, with the coefficients of Klobuchar's model
INAV: dict[int, tuple[Field, ...]] = {
    1: _fields(6, ("iode", 10, 1), ("toe", 14, 60), ("m0", -32, 2**-31 * _SC), ("e", 32, 2**-33),
               ("sqrt_a", 32, 2**-19)),
    2: _fields(6, ("iode", 10, 1), ("omega0", -32, 2**-31 * _SC), ("i0", -32, 2**-31 * _SC),
               ("omega", -32, 2**-31 * _SC), ("idot", -14, 2**-43 * _SC)),
    3: _fields(6, ("iode", 10, 1), ("omega_dot", -24, 2**-43 * _SC), ("delta_n", -16, 2**-43 * _SC),
               ("cuc", -16, 2**-29), ("cus", -16, 2**-29), ("crc", -16, 2**-5), ("crs", -16, 2**-5)),
    4: _fields(6, ("iode", 10, 1), ("svid", 6, 1), ("cic", -16, 2**-29), ("cis", -16, 2**-29), ("toc", 14, 60),
               ("af0", -31, 2**-34), ("af1", -21, 2**-46), ("af2", -6, 2**-59)),
    5: _fields(6, ("", 41, 1), ("", 10, 1), ("group_delay", -10, 2**-32), ("", 2, 1), ("health", 2, 1)),
}  # fmt: skip
"""Words of 128 bits (Galileo OS SIS ICD 2.1, tables 42 to 46)."""


def extract(message: int, length: int, fields: tuple[Field, ...]) -> dict[str, float]:
    """Return the numbers of a message of ``length`` bits by name."""
    found = {}
    for name, start, bits, scale, signed in fields:
        value = (message >> (length - start - bits)) & ((1 << bits) - 1)
        if signed and value >> (bits - 1):
            value -= 1 << bits
        found[name] = value * scale
    return found


def lnav_bits(words: list[int]) -> int:
    """Return the 240 bits of a subframe of ten words, of 30 bits each with parity in the last six."""
    message = 0
    for word in words[:10]:
        message = message << 24 | (word >> 6) & 0xFFFFFF
    return message


def inav_bits(words: list[int]) -> tuple[int, int] | None:
    """Return type and 128 bits of a word of two pages, each of four 32-bit words; None for another page."""
    even, odd = (sum(word << 32 * (3 - i) for i, word in enumerate(part)) for part in (words[:4], words[4:8]))
    if even >> 126 != 0b00 or odd >> 126 != 0b10:  # even and odd, both nominal
        return None
    message = ((even >> 14) & ((1 << 112) - 1)) << 16 | (odd >> 110) & 0xFFFF
    return message >> 122, message


class Messages:
    """Collects the parts of ephemerides as they come in."""

    def __init__(self) -> None:
        self.parts: dict[str, dict[int, dict[str, float]]] = {}
        self.found: dict[tuple[str, float, float], Ephemeris] = {}
        self.ionosphere: Ionosphere | None = None

    def take(self, satellite: str, words: list[int], t: float) -> None:
        """Take a part of a message, received at ``t`` s GPS since 1970."""
        system = satellite[0]
        if system in "GJ" and len(words) >= 10:
            message = lnav_bits(words)
            kind, fields, length = (message >> 194) & 7, LNAV, 240  # bits 20 to 22 of the second word
        elif system == "E" and len(words) >= 8 and (word := inav_bits(words)) is not None:
            (kind, message), fields, length = word, INAV, 128
        else:
            return
        if kind not in fields:
            return
        values = extract(message, length, fields[kind])
        if system in "GJ" and kind == 4:
            if values["page"] == IONOSPHERE_PAGE and system == "G":
                alpha, beta = (np.array([values[f"{c}{k}"] for k in range(4)]) for c in "ab")
                self.ionosphere = Ionosphere(alpha, beta)
            return
        received = self.parts.setdefault(satellite, {})
        received[kind] = values
        self._complete(satellite, received, t)

    def _complete(self, satellite: str, parts: dict[int, dict[str, float]], t: float) -> None:
        """Keep an ephemeris where all parts are of one issue."""
        needed = (1, 2, 3) if satellite[0] in "GJ" else (1, 2, 3, 4, 5)
        if not set(needed) <= set(parts) or len({p["iode"] for p in parts.values() if "iode" in p}) > 1:
            return
        v = {name: value for part in needed for name, value in parts[part].items()}
        near = lambda second: second + round((t - GPS_EPOCH - second) / WEEK) * WEEK + GPS_EPOCH
        key = (satellite, v["toe"], v["toc"])
        self.found[key] = Ephemeris(*(np.asarray(x) for x in (
            number(satellite), near(v["toe"]), near(v["toc"]), v["sqrt_a"], v["e"], v["i0"], v["idot"], v["omega0"],
            v["omega_dot"], v["omega"], v["m0"], v["delta_n"], v["cuc"], v["cus"], v["crc"], v["crs"], v["cic"],
            v["cis"], v["af0"], v["af1"], v["af2"], v["group_delay"], v["toe"], v["health"],
        )))  # fmt: skip
