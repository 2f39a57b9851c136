"""Tables for a terminal."""

import math
from collections.abc import Sequence
from typing import Any


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Text columns; those with numbers to the right."""
    cells = [[str(h) for h in head], *[[cell(v) for v in row] for row in rows]]
    width = [max(len(r[i]) for r in cells) for i in range(len(head))]
    right = [any(isinstance(row[i], (int, float)) for row in rows) for i in range(len(head))]
    pad = [str.rjust if r else str.ljust for r in right]
    lines = ["  ".join(p(c, w) for p, c, w in zip(pad, r, width)).rstrip() for r in cells]
    return "\n".join([lines[0], "  ".join("-" * w for w in width), *lines[1:]])


def cell(value: Any) -> str:
    """Return a number with three significant digits, anything else as it is."""
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:#.3g}".rstrip(".") if 1e-3 <= abs(value) < 1e4 else f"{value:.3g}"
    return str(value)
