"""What a column holds by its name: quantity, axis and unit, in the words that loggers use."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxnav.io.sheet import TICKS, Sheet, numbers
from jaxnav.io.units import UNITS

WORDS: dict[str, tuple[str, ...]] = {
    "gyro": ("gyro", "gyr", "gyroscope", "omega", "w", "angular velocity", "angular rate", "rotation rate", "angvel",
             "rotation", "rate", "g", "wb"),
    "accel": ("acc", "accel", "accelerometer", "acceleration", "specific force", "f", "a", "force", "g f", "fb"),
    "lat": ("lat", "latitude"),
    "lon": ("lon", "lng", "long", "longitude"),
    "height": ("alt", "altitude", "height", "hgt", "h", "ellipsoidal height", "altitude ellipsoid", "hmsl", "msl",
               "ele"),
    "speed": ("speed", "spd", "velocity", "ground speed", "groundspeed", "gspeed", "sog", "speed over ground"),
    "course": ("course", "cog", "direction", "bearing", "track", "head mot", "headmot",
               "course over ground", "ground course"),
    "east": ("ve", "vel e", "vel ned e", "vele", "velocity east", "v east", "east velocity", "vel east", "v e"),
    "north": ("vn", "vel n", "vel ned n", "veln", "velocity north", "v north", "north velocity", "vel north", "v n"),
    "down": ("vd", "vel d", "vel ned d", "veld", "velocity down", "v down", "down velocity", "vel down", "v d"),
    "up": ("vu", "vel u", "velu", "velocity up", "v up", "up velocity", "vel up", "v u", "climb", "climb rate"),
    "level sd": ("hacc", "h acc", "acc h", "horizontal accuracy", "eph", "location accuracy", "gps accuracy",
                 "position accuracy", "accuracy", "sd h", "hor accuracy", "pos acc"),
    "height sd": ("vacc", "v acc", "acc v", "vertical accuracy", "epv", "sd v"),
    "speed sd": ("sacc", "s acc", "speed accuracy", "acc s", "vel acc"),
    "hdop": ("hdop",),
    "time": ("time", "timestamp", "stamp", "t", "ts", "tow", "unix time", "unix", "utc", "epoch", "ticks", "elapsed",
             "clock", "date time", "datetime", "time stamp", "utc time", "gps time", "system time", "seconds",
             "time startup", "startup", "time since boot", "since boot", "uptime"),
    "date": ("date", "day", "utc date"),
}  # fmt: skip
"""Names of quantities, in lower case and split into words; an axis stands behind those of three."""
STATED: dict[str, tuple[str, ...]] = {
    "rad/s": ("rad s", "rads", "radps", "rad sec", "radian s", "radians s"),
    "deg/s": ("deg s", "dps", "degps", "deg sec", "degs", "degrees s"), "mdeg/s": ("mdps", "mdeg s"),
    "m/s^2": ("m s 2", "ms 2", "mps 2", "m s s", "m s"), "g": ("g", "gs"), "mg": ("mg",),
    "rad": ("rad", "radians"), "deg": ("deg", "degrees"), "1e-7 deg": ("1 e 7 deg", "1 e 7", "e 7", "deg e 7"),
    "m": ("m", "metres", "meters"), "mm": ("mm",), "cm": ("cm",), "ft": ("ft", "feet"),
    "m/s": ("m s", "mps", "ms"), "km/h": ("km h", "kmh", "kph", "kmph"), "knots": ("knots", "kn", "kt", "kts"),
    "mph": ("mph",), "mm/s": ("mm s", "mmps"), "cm/s": ("cm s", "cmps"),
    "s": ("s", "sec", "secs", "seconds"), "ms": ("ms", "msec", "millis", "milliseconds"),
    "us": ("us", "usec", "micros", "microseconds", "µs"), "ns": ("ns", "nsec", "nanos", "nanoseconds"),
}  # fmt: skip
"""Units as names and lines of units state them, split into words."""
KIND = {
    "gyro": "rate", "accel": "acceleration", "lat": "angle", "lon": "angle", "height": "length",
    "speed": "speed", "course": "angle", "east": "speed", "north": "speed", "down": "speed", "up": "speed",
    "level sd": "length", "height sd": "length", "speed sd": "speed",
}  # fmt: skip
THREE = ("gyro", "accel")
ROTATED = {"roll": "x", "pitch": "y", "yaw": "z"}
VAGUE = {"accuracy", "rate", "rotation", "velocity", "direction"}  # words that say something else behind another word


MIN_ROWS, MAX_VALUE = 5, 1e15  # numbers of a column that counts, and their largest size


class Column(NamedTuple):
    """A column whose name says what it holds."""

    file: str
    name: str
    quantity: str  # a key of `WORDS`
    axis: str  # "x", "y", "z", or "" of a quantity that has none
    unit: str  # as its name or a line of units states it, or ""
    group: str  # the name without its axis
    values: np.ndarray  # (N,), nan where there is no number


def words_of(name: str) -> tuple[list[str], str]:
    """Return the words of a column's name in lower case, and those of a unit that stands in brackets behind it.

    A last number in brackets or behind a point is that of an axis, from 0, as in a table of a ``.mat`` file or a list
    of JSON.
    """
    if index := re.fullmatch(r"(.*)[.\[]([012])\]?", name):
        name = f"{index[1]} {'xyz'[int(index[2])]}"
    base, _, rest = re.sub(r"[\[({<]", "\0", name, count=1).partition("\0")
    parts = r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])"
    split = lambda text: re.findall(r"[a-zµ]+|\d+", re.sub(parts, " ", text).lower().replace("°", "deg "))
    words = split(base)
    return (words if words else split(rest)), " ".join(split(rest)) if words else ""


def unit_of(text: str, kind: str) -> str:
    """Return the unit of a kind that words state, "" where they state none."""
    allowed = TICKS if kind == "time" else UNITS[kind]
    return next((unit for unit, said in STATED.items() if unit in allowed and text in said), "")


def named_columns(file: str, sheet: Sheet) -> Iterable[Column]:
    """Yield the columns of a table whose names say what they hold."""
    for name in sheet.columns:
        if name.isdigit() or name in sheet.twice:
            continue
        for words, bracket in readings(name, file):
            stated = bracket or " ".join(words_of(sheet.units.get(name, ""))[0])
            if found := named_column(file, name, words, stated):
                if found.quantity in ("time", "date"):
                    yield found
                else:
                    cells = numbers(sheet, name)
                    cells = np.where(np.abs(cells) < MAX_VALUE, cells, np.nan)
                    if np.isfinite(cells).sum() >= MIN_ROWS:
                        yield found._replace(values=cells)
                break


def readings(name: str, file: str) -> list[tuple[list[str], str]]:
    """Return words and unit of a name: of a dotted path by its last part, then by all; x alone with the file's name."""
    words, bracket = words_of(name)
    if len(words) == 1 and words[0] in ("x", "y", "z"):
        return [([*words_of(Path(file).stem)[0], *words], bracket)]
    last = [words_of(name.rpartition(".")[2])] if re.search(r"\w\.[A-Za-z]", name) else []
    return [*last, (words, bracket)]


def named_column(file: str, name: str, words: list[str], stated: str) -> Column | None:
    """Return what a column holds by its words, of which those behind the quantity have to be a unit."""
    for cut in range(len(words), 0, -1):
        if found := _quantity(words[:cut]):
            quantity, axis, group = found
            kind = KIND.get(quantity, "time")
            unit = "" if quantity == "hdop" else unit_of(stated or " ".join(words[cut:]), kind)
            if unit or cut == len(words):
                return Column(file, name, quantity, axis, unit, " ".join((group, *words[cut:])), np.zeros(0))
    return None


def _quantity(words: list[str]) -> tuple[str, str, str] | None:
    """Return quantity, axis and the words without it."""
    last = words[-1]
    axes = [(last, words[:-1])] if last in ("x", "y", "z") else []
    if len(last) > 1 and last[-1] in "xyz":
        axes.append((last[-1], [*words[:-1], last[:-1]]))
    if last in ("rate", "speed", "velocity", "gyro") and len(words) > 1 and words[-2] in ROTATED:
        axes.append((ROTATED[words[-2]], ["gyro"]))
    for axis, rest in axes:
        for kind in THREE:
            if any(_ends(rest, said) for said in WORDS[kind]):
                return kind, axis, " ".join(rest)
    text, fits = " ".join(words), [(0, "")]
    for quantity, said in WORDS.items():
        if quantity not in THREE:
            fits += [(len(each), quantity) for each in said if text == each or (len(each) > 2 and _ends(words, each))]
    longest = max(fits)
    return (longest[1], "", text) if longest[1] else None


def _ends(words: list[str], said: str) -> bool:
    own = said.split()
    whole = len(words) == len(own)
    return words[-len(own) :] == own and (whole or (len(said) > 1 and said not in VAGUE))
