"""Hidden windows: how far a filter drifts without fixes that are there, all along a recording."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.filters import epochs as ep
from jaxnav.filters.core import Filter, Prepared
from jaxnav.filters.lanes import LaneRecord, lanes, ready, repeated, stacked, taken
from jaxnav.measurements import Measurement
from jaxnav.types import Epoch, Nav, Params


class Windows(NamedTuple):
    """W windows in P runs: start < t <= start + length, in which no fix of the receiver is used."""

    hidden: np.ndarray  # (P, E) bool
    phase: np.ndarray  # (W,) int, the run
    start: np.ndarray  # (W,) s
    end: np.ndarray  # (W,) int, the window's last epoch with a position, where the drift is measured
    satellites: tuple[int, ...] = (0,)  # how many of the highest each run keeps in them, by turns

    @property
    def kept(self) -> np.ndarray:
        """Return the number of satellites that each window keeps, (W,)."""
        return np.array(self.satellites)[self.phase % len(self.satellites)]

    def hide(self, epochs: Epoch, measurements: tuple[Measurement, ...]) -> list[Epoch]:
        """Return epochs (E, ...) of each run, without the fixes in its windows."""
        size = np.shape(epochs.fix.valid)[0]
        hidden = np.pad(self.hidden, ((0, 0), (0, max(0, size - self.hidden.shape[1]))))[:, :size]
        return [
            ep.hide(epochs, h, measurements, self.satellites[p % len(self.satellites)]) for p, h in enumerate(hidden)
        ]


def hidden_windows(
    packed: ep.Packed, length: float, every: float, phases: int = 1, settle: float = 30.0, guard: float = 0.0
) -> Windows:
    """Windows of ``length`` s, ``every`` s, from ``settle`` s after the start on; each phase shifted by an equal part.

    ``guard``: s left at the end of the data. Windows without a position to measure the drift by are left out.
    """
    t, there = packed.t, np.asarray(packed.epochs.fix.valid)[:, :2].all(1)
    hidden, phase, begin, end = np.zeros((phases, t.size), bool), [], [], []
    for p in range(phases):
        for start in np.arange(packed.start + settle + p * every / phases, t[-1] - guard - length, every):
            inside = ep.within(t, [(start, start + length)])
            known = np.flatnonzero(inside & there)
            if known.size and t[known[-1]] > start + 0.5 * length:
                hidden[p] |= inside
                phase.append(p)
                begin.append(start)
                end.append(known[-1])
    return Windows(hidden, np.array(phase, int), np.array(begin), np.array(end, int))


def drift(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, windows: Windows, measurements: tuple[Measurement, ...]
) -> tuple[np.ndarray, LaneRecord]:
    """Return the drift of one candidate, see `drifts`."""
    return drifts(filt, [params], nav, epochs, windows, measurements)[0]


def drifts(
    filt: Filter,
    candidates: Sequence[Params],
    nav: Nav,
    epochs: Epoch,
    windows: Windows,
    measurements: tuple[Measurement, ...],
) -> list[tuple[np.ndarray, LaneRecord]]:
    """Return the predicted minus the measured position at each window's end, and the runs.

    Through the measurement model of a position, the first three channels, with a receiver's slow error where the filter
    estimates one: a fix tells how far a prediction of it has drifted, not how far it is itself from the truth.

    Args:
        filt: the filter.
        candidates: its parameters, of each candidate.
        nav: the start.
        epochs: (E, ...) of the recording, as they were cut or by `jaxnav.filters.lanes.ready`.
        windows: the hidden windows.
        measurements: the filter's, the position first.

    Returns:
        For each candidate (W, 3) m, ENU, inf where the run failed; and the record of the runs (P, E, ...).
    """
    epochs = epochs if isinstance(epochs.imu, Prepared) else ready(filt, candidates[0], nav, epochs)
    phases = len(windows.hidden)
    valid = np.stack([np.asarray(run.fix.valid) for run in windows.hide(epochs, measurements)])
    many, count = [params for params in candidates for _ in range(phases)], len(candidates)
    record = lanes(filt, stacked(many), repeated(nav, len(many)), epochs, np.concatenate([valid] * count))
    errors = np.where(record.ok[..., None], record.residual, np.inf)
    return [
        (errors[c * phases + windows.phase, windows.end], taken(record, slice(c * phases, (c + 1) * phases)))
        for c in range(count)
    ]
