"""How a recording is used: which part of its time is trained on, which judges, and the windows hidden in each."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis.metrics import covered_by
from jaxnav.analysis.windows import Windows, hidden_windows
from jaxnav.filters import epochs as ep
from jaxnav.filters.core import Filter
from jaxnav.initialization.initialize import Initialization
from jaxnav.maths import earth
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import TICK
from jaxnav.measurements import MEASUREMENTS, clock_offset
from jaxnav.types import Epoch, Fix, Json, Nav, Params, Track
from tuning.recordings.runs import Run, Truth, many

PHASES = 5  # runs with windows shifted against each other
MAX_ADDED_DELAY_S = 0.3  # s, of delay that tuning may add to the known one
SLOPE_S = 0.05  # s, half of the time over which a true velocity is taken
AGES = (0.0, 1 / 3, 2 / 3, 1.0)  # of a window: where its hidden fixes are looked at


class Layout(NamedTuple):
    """How a recording is used, s."""

    window: float  # length of hidden windows
    every: float  # their spacing in a run
    settle: float  # nothing counts before this long after the start
    train: float  # time at which the training part ends
    validation: float  # and the validation part
    satellites: tuple[int, ...] = (0,)  # that hidden windows keep, by turns
    start: float | None = None  # that windows are counted from; None: the start of navigation


class Used(NamedTuple):
    """A recording that is tuned on; arrays of E epochs, for all recordings the same number."""

    name: str
    initialization: Initialization
    datasheet: Params  # the datasheet, with the prior of this start
    nav: Nav  # the start
    packed: ep.Packed  # the recorded epochs, of which there may be fewer
    epochs: Epoch  # (E, ...), prepared
    layout: Layout
    windows: Windows  # hidden (P, E)
    parts: dict[str, np.ndarray]  # masks (W,) of the windows
    truth: Track | None  # of the recording
    known: dict[str, float] = {}  # true values of parameters, by leaf: a recording states none

    @property
    def t(self) -> np.ndarray:
        """(E,) s, the end of each epoch; inf in padding."""
        return np.pad(self.packed.t, (0, self.windows.hidden.shape[1] - self.packed.t.size), constant_values=np.inf)

    @property
    def fix(self) -> Fix:
        """The recording's fixes."""
        return self.packed.epochs.fix

    @property
    def starts(self) -> np.ndarray:
        """(W,) start of each window, s."""
        return self.windows.start

    @property
    def facts(self) -> Json:
        """Return the facts of the recording for metrics.json."""
        return {"layout_s": self.layout._asdict(), "initialization": self.initialization.how}

    @property
    def windows_hidden(self) -> bool:
        """Are fixes hidden, so that drifts are scored?"""
        return True

    def needs(self, blocks: int) -> str:
        """Return the length of recording that an interval of so many blocks needs."""
        return f"{blocks * self.layout.every / 0.35:.0f} s of recording"


def window_of(packed: Sequence[ep.Packed]) -> float:
    """Length of hidden windows, s: by the longest recording."""
    span = max(float(p.t[-1]) - p.start for p in packed)
    return 15.0 if span >= 300 else 10.0 if span >= 120 else 5.0 if span >= 50 else 3.0


def plan(packed: ep.Packed, window: float) -> Layout:
    """Half of the time with fixes for training, 15 % for validation, the rest for the test.

    Time without fixes is that of gaps longer than a window.
    """
    span = float(packed.t[-1]) - packed.start
    settle = min(30.0, 0.1 * span)
    begin = packed.start + settle
    fixes = packed.t[np.asarray(packed.epochs.fix.valid)[:, :2].all(1)]
    t = np.concatenate([[begin], fixes[fixes > begin], packed.t[-1:]])
    counted = np.diff(t) * (np.diff(t) <= window)
    passed = np.concatenate([[0.0], np.cumsum(counted)])
    after = lambda share: float(np.interp(share * passed[-1], passed, t))
    return Layout(window, 3 * window, settle, after(0.5), after(0.65), start=packed.start)


def windows_of(packed: ep.Packed, layout: Layout, size: int) -> Windows:
    """Return the hidden windows of a recording, over ``size`` epochs with the recorded ones first.

    They are counted from the layout's start: with a later start of navigation those before it are left out.
    """
    counted = packed if layout.start is None else packed._replace(start=layout.start)
    windows = hidden_windows(counted, layout.window, layout.every, PHASES, layout.settle)
    hidden = np.pad(windows.hidden, [(0, 0), (0, size - packed.t.size)])
    return windows._replace(hidden=hidden, satellites=layout.satellites)


def pooled(used: Sequence[Used]) -> dict[str, np.ndarray]:
    """Masks of the windows of all recordings, one recording after the other."""
    return {name: np.concatenate([each.parts[name] for each in used]) for name in used[0].parts}


def blocks_of(used: Sequence[Used]) -> np.ndarray:
    """Return the block of time (W,) of every window of all recordings: windows that overlap are one."""
    numbers = [np.floor((u.windows.start - u.layout.validation) / u.layout.every) for u in used]
    return np.concatenate([b + 1e6 * i for i, b in enumerate(numbers)])


def parts_of(layout: Layout, windows: Windows) -> dict[str, np.ndarray]:
    """Return masks (W,) of the windows inside each part."""
    end = windows.start + layout.window
    return {
        "training": end <= layout.train + TICK,
        "validation": (windows.start >= layout.train - TICK) & (end <= layout.validation + TICK),
        "test": windows.start >= layout.validation - TICK,
    }


def runs_of(used: Used, filt: Filter, part: str, size: int) -> Run:
    """Return a recording's runs (P, ...) for a gradient: the windows of a part, hidden, over its first epochs.

    Args:
        used: the recording.
        filt: the filter.
        part: "training" or "validation", which ends the runs: nothing later can enter an objective.
        size: epochs of each run; those after the part do not count.
    """
    layout, windows, t = used.layout, used.windows, used.t[:size]
    begin, end = {
        "training": (used.packed.start + layout.settle, layout.train),
        "validation": (layout.train, layout.validation),
    }[part]
    inside, hidden, phases = (t > begin) & (t <= end + TICK), windows.hidden[:, :size], len(windows.hidden)
    epochs = jax.tree.map(lambda a: a[:size], used.epochs)
    measurements = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    runs = windows.hide(epochs, measurements)
    rows = [np.flatnonzero((windows.phase == p) & used.parts[part]) for p in range(phases)]
    most = max(1, *(len(row) for row in rows))
    ends = np.array([np.pad(windows.end[row], (0, most - len(row))) for row in rows])
    scored = np.array([np.arange(most) < len(row) for row in rows])
    truth = truth_of(used, t)
    return Run(
        many(used.datasheet, phases), many(used.nav, phases), jax.tree.map(lambda *a: jnp.stack(a), *runs),
        jnp.asarray(ends), jnp.asarray(scored), jnp.asarray(inside & ~hidden), many(inside, phases),
        None if truth is None else many(truth, phases),
    )  # fmt: skip


def truth_of(used: Used, t: np.ndarray) -> Truth | None:
    """Return the truth at the ends ``t`` (E,) s of epochs; None without one that covers any of them."""
    if used.truth is None:
        return None
    t = np.where(np.isfinite(t), t, used.packed.t[-1])
    t = t + np.asarray(clock_offset(used.datasheet.mounting, used.nav._replace(t=jnp.asarray(t))))
    known = covered_by(t, used.truth.t)
    if not known.any():
        return None
    at = lambda t: columns_at(t, used.truth.t, earth.continuous(used.truth.lla))
    rate = (at(t + SLOPE_S) - at(t - SLOPE_S)) / (2 * SLOPE_S)
    return Truth(jnp.asarray(at(t)), jnp.asarray(rate), jnp.asarray(known))


def describe_parts(layout: Layout, parts: Mapping[str, np.ndarray], packed: ep.Packed) -> str:
    """Return the split, in a sentence."""
    counts = ", ".join(f"{int(mask.sum())} {name}" for name, mask in parts.items())
    return (
        f"training to {layout.train:.0f} s, validation to {layout.validation:.0f} s, test to {packed.t[-1]:.0f} s; "
        f"hidden windows of {layout.window:g} s: {counts}"
    )


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
