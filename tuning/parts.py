"""How a recording is used: which part of its time is trained on, which judges, and the windows hidden in each."""

from typing import NamedTuple

import numpy as np

from jaxnav.analysis.windows import Windows
from jaxnav.data import epochs as ep

AGES = (0.0, 1 / 3, 2 / 3, 1.0)  # of a window: where its hidden fixes are looked at


class Layout(NamedTuple):
    """How a recording is used, s."""

    window: float  # length of hidden windows
    every: float  # their spacing in a run
    settle: float  # nothing counts before this long after the start
    train: float  # time at which the training part ends
    validation: float  # and the validation part


def plan(packed: ep.Packed, window: float | None = None) -> Layout:
    """Half of the time for training, 15 % for validation, the rest for the test; windows by the length of it all."""
    span = float(packed.t[-1]) - packed.start
    if window is None:
        window = 15.0 if span >= 300 else 10.0 if span >= 120 else 5.0 if span >= 50 else 3.0
    settle = min(30.0, 0.1 * span)
    begin = packed.start + settle
    left = span - settle
    return Layout(window, 3 * window, settle, begin + 0.5 * left, begin + 0.65 * left)


def parts_of(layout: Layout, windows: Windows) -> dict[str, np.ndarray]:
    """Masks (W,): windows that lie within a part."""
    end = windows.start + layout.window
    return {
        "training": end <= layout.train + ep.TICK,
        "validation": (windows.start >= layout.train - ep.TICK) & (end <= layout.validation + ep.TICK),
        "test": windows.start >= layout.validation - ep.TICK,
    }


def ages(
    windows: Windows, t: np.ndarray, there: np.ndarray, mask: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Epochs of hidden fixes at `AGES` of each window of a mask, (P, A) int, and which are any, (P, A) bool."""
    rows: list[list[int]] = [[] for _ in windows.hidden]
    for phase, begin in zip(windows.phase[mask], windows.start[mask], strict=True):
        known = np.flatnonzero((t > begin + ep.TICK) & (t <= begin + length + ep.TICK) & there)
        rows[phase] += sorted({int(known[round(a * (known.size - 1))]) for a in AGES})
    most = max(1, max(len(row) for row in rows))
    at = np.array([row + [0] * (most - len(row)) for row in rows])
    return at, np.array([[True] * len(row) + [False] * (most - len(row)) for row in rows])
