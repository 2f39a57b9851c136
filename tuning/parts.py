"""How a recording is used: which part of its time is trained on, which judges, and the windows hidden in each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.analysis.windows import Windows, hidden_windows
from jaxnav.data import epochs as ep
from jaxnav.data.start import Start
from jaxnav.types import Epoch, Nav, Params

PHASES = 5  # runs with windows shifted against each other
AGES = (0.0, 1 / 3, 2 / 3, 1.0)  # of a window: where its hidden fixes are looked at


class Layout(NamedTuple):
    """How a recording is used, s."""

    window: float  # length of hidden windows
    every: float  # their spacing in a run
    settle: float  # nothing counts before this long after the start
    train: float  # time at which the training part ends
    validation: float  # and the validation part


class Used(NamedTuple):
    """A recording that is tuned on; arrays of E epochs, for all recordings the same number."""

    name: str
    begin: Start
    sheet: Params  # the datasheet, with the prior of this start
    nav: Nav  # the start
    packed: ep.Packed  # the recording's own epochs, of which there may be fewer
    epochs: Epoch  # (E, ...), prepared
    layout: Layout
    windows: Windows  # hidden (P, E)
    parts: dict[str, np.ndarray]  # masks (W,) of the windows

    @property
    def t(self) -> np.ndarray:
        """(E,) s, the end of each epoch; what was added comes after all time."""
        return np.pad(self.packed.t, (0, self.windows.hidden.shape[1] - self.packed.t.size), constant_values=np.inf)


def window_of(packed: Sequence[ep.Packed]) -> float:
    """Length of hidden windows, s: by the longest recording."""
    span = max(float(p.t[-1]) - p.start for p in packed)
    return 15.0 if span >= 300 else 10.0 if span >= 120 else 5.0 if span >= 50 else 3.0


def plan(packed: ep.Packed, window: float) -> Layout:
    """Half of the time for training, 15 % for validation, the rest for the test."""
    span = float(packed.t[-1]) - packed.start
    settle = min(30.0, 0.1 * span)
    begin = packed.start + settle
    left = span - settle
    return Layout(window, 3 * window, settle, begin + 0.5 * left, begin + 0.65 * left)


def windows_of(packed: ep.Packed, layout: Layout, size: int) -> Windows:
    """The hidden windows of a recording, over ``size`` epochs of which its own come first."""
    windows = hidden_windows(packed, layout.window, layout.every, PHASES, layout.settle)
    return windows._replace(hidden=np.pad(windows.hidden, [(0, 0), (0, size - packed.t.size)]))


def pooled(used: Sequence[Used]) -> dict[str, np.ndarray]:
    """Masks of the windows of all recordings, one recording after the other."""
    return {name: np.concatenate([each.parts[name] for each in used]) for name in used[0].parts}


def blocks_of(used: Sequence[Used]) -> np.ndarray:
    """The block of time (W,) of every window of all recordings: windows that overlap are one."""
    numbers = [np.floor((u.windows.start - u.layout.validation) / u.layout.every) for u in used]
    return np.concatenate([b + 1e6 * i for i, b in enumerate(numbers)])


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
        known = np.flatnonzero(ep.within(t, [(begin, begin + length)]) & there)
        rows[phase] += sorted({int(known[round(a * (known.size - 1))]) for a in AGES})
    most = max(1, max(len(row) for row in rows))
    at = np.array([row + [0] * (most - len(row)) for row in rows])
    return at, np.array([[True] * len(row) + [False] * (most - len(row)) for row in rows])
