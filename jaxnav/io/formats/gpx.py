"""GPX: the track of a watch or an app: fixes for the file of an IMU."""

import os
import re
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jaxnav.findings import finding
from jaxnav.io.files import read_bytes
from jaxnav.io.parts import Parts, Stream, TimeScale, scaled
from jaxnav.io.sheet import date
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, Note


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the root of an XML text is gpx."""
    return bool(re.search(rb"<(\w+:)?gpx[\s>]", head))


def read(path: Path) -> Parts:
    """Position of track points with a time, UTC since 1970; the height is the app's, above which zero it does not say.

    Raises:
        DataError: no XML, or no track point with a time.
    """
    rows: list[tuple[float, ...]] = []
    points, cut = 0, list[Note]()
    try:
        for _, element in ElementTree.iterparse(BytesIO(read_bytes(path))):
            if element.tag.rpartition("}")[2] != "trkpt":
                continue
            points += 1
            said = {child.tag.rpartition("}")[2]: child.text for child in element}
            row = date(said.get("time")), *map(_number, (element.get("lat"), element.get("lon"), said.get("ele")))
            if np.isfinite(row[:3]).all():
                rows.append(row)
            element.clear()
    except ElementTree.ParseError as error:
        if not rows:
            raise DataError(f"{path}: cannot be read as XML: {error}") from error
        cut = [finding("file.partly", path.name, words=f" behind {len(rows)} track points, {error}")]
    if not rows:
        raise DataError(f"{path}: {points} track points, none with a time, latitude and longitude")
    t, lat, lon, height = np.array(rows).T
    position = Stream(t, np.stack([lat * DEG, lon * DEG, height], axis=1))
    if left := points - len(rows):
        words = f"of {points} track points, without a time or a position,"
        cut = [finding("file.left_out", "position", count=left, words=words), *cut]
    return scaled(Parts(os.fspath(path), aiding={"position": position}, notes=tuple(cut)), TimeScale.UTC)


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")
