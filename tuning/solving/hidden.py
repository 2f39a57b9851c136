"""A filter over a recording with hidden windows, for several filters that are compared on the same windows."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.analysis.windows import drifts
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import with_history
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import LaneRecord, velocity_channels
from jaxnav.filters.parameters import history_for
from jaxnav.filters.standstill import Standing
from jaxnav.initialization.initialize import Initialization
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import Params, Recording
from tuning.recordings.evidence import HiddenFixes, hidden_fixes
from tuning.recordings.parts import MAX_ADDED_DELAY_S, Layout, Used
from tuning.recordings.recorded import prepare_recordings

COV_STRIDE = 5  # IMU samples per point of the error dynamics, as in the configuration


class Scored(NamedTuple):
    """A filter with parameters, and its runs with hidden windows."""

    filter: Filter
    params: Params  # with the prior of the start
    used: Used
    error: np.ndarray  # (W, 3) m, ENU, at the end of each window
    info: LaneRecord  # (P, E, ...)

    @property
    def horizontal(self) -> np.ndarray:
        """(W,) m, at the end of each window."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    def rms(self, part: str) -> float:
        """Horizontal drift over the windows of a part, m."""
        return float(np.sqrt(np.mean(self.horizontal[self.used.parts[part]] ** 2)))

    def hidden(self, *parts: str) -> HiddenFixes:
        """Return the hidden fixes of some parts, with their predictions."""
        return self._hidden(parts, None)

    def velocities(self, *parts: str) -> HiddenFixes | None:
        """Return the hidden velocities of some parts; None of a filter that takes none."""
        channels = velocity_channels(self.filter)
        return None if channels is None else self._hidden(parts, channels)

    def _hidden(self, parts: Sequence[str], velocity: slice | None) -> HiddenFixes:
        mask = np.any([self.used.parts[part] for part in parts], 0)
        return hidden_fixes(self.params, self.used, self.info, mask, velocity)


class Bench(NamedTuple):
    """A recording, and the windows that filters are compared on."""

    recording: Recording
    initialization: Callable[[Recording, Params], Initialization]
    begin: Initialization  # by the datasheet
    layout: Layout
    standing: Standing
    stop: float  # s, the last epoch
    history: int = 2  # samples of navigation that every filter keeps, so that filters share their programs
    faulty: np.ndarray = np.zeros(0)  # (F,) s, starts of windows with a fault of the receiver, which judge nothing

    def reaching(self, params: Params) -> "Bench":
        """Return the bench with a history for parameters and the delay that tuning may add to theirs."""
        rate, span = 1 / float(np.median(self.recording.imu.dt)), float(np.ptp(self.recording.imu.t))
        return self._replace(history=history_for(params, rate, span, MAX_ADDED_DELAY_S))

    def score(self, filt: Filter, params: Params, begin: Initialization | None = None) -> Scored:
        """Run a filter over all windows.

        Args:
            filt: the filter.
            params: its parameters, with the lever arm.
            begin: the initialization; by default that of the bench. Windows before it are left out.
        """
        return self.scores(filt, [params], begin)[0]

    def scores(self, filt: Filter, candidates: Sequence[Params], begin: Initialization | None = None) -> list[Scored]:
        """Run a filter with each of some parameters, as `score` does, side by side and from the first one's start."""
        begin = self.begin if begin is None else begin
        rec, chosen = self.recording, tuple(MEASUREMENTS[name] for name in filt.model.measurements)
        packed = ep.pack_recording(rec, chosen, begin.t, 0.0, self.stop, self.standing)
        filt = with_history(filt, self.history)
        (used,) = prepare_recordings([rec], filt, candidates[:1], [begin], [packed], [self.layout], lambda line: None)
        each = [begin.apply_to(params) for params in candidates]
        runs = drifts(filt, each, used.nav, used.epochs, used.windows, chosen)
        healthy = ~np.isin(np.round(used.starts, 6), np.round(self.faulty, 6))
        used = used._replace(parts={name: mask & healthy for name, mask in used.parts.items()})
        return [
            Scored(filt, params, used._replace(datasheet=params), error, info)
            for params, (error, info) in zip(each, runs, strict=True)
        ]
