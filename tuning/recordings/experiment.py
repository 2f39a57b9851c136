"""An experiment: a recording with hidden windows, on which every candidate is scored the same way.

A candidate is a filter with parameters. The noise that a datasheet states, the numbers of a search and measurements
that are tried are compared by one record of its runs (`Scored`): drift at the ends of hidden windows, hidden fixes
against their stated sd, innovations. `tune`, the choice of measurements, calibration and `solve` read nothing else.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.analysis.windows import drifts
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import rows, with_history
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import LaneRecord, padded_shape, ready, taken, velocity_channels
from jaxnav.filters.parameters import history_for
from jaxnav.filters.scores import innovation_nll, normalized, position_noise, residual_nll
from jaxnav.filters.standstill import Standing
from jaxnav.initialization.bank import most_probable
from jaxnav.initialization.initialize import Initialization
from jaxnav.maths.units import TICK
from jaxnav.measurements import Measurement
from jaxnav.types import Params, Recording
from tuning.recordings.parts import MAX_ADDED_DELAY_S, Layout, Used, ages, parts_of, plan, window_of, windows_of


class Scored(NamedTuple):
    """A candidate, and its runs over a recording with hidden windows."""

    filter: Filter
    params: Params  # with the prior of the start
    used: Used
    error: np.ndarray  # (W, 3) m, ENU, at the end of each window
    info: LaneRecord  # (P, E, ...)

    @property
    def horizontal(self) -> np.ndarray:
        """(W,) m, at the end of each window."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    def judging(self, parts: dict[str, np.ndarray]) -> "Scored":
        """Return it with other windows (W,) in the parts."""
        return self._replace(used=self.used._replace(parts=parts))

    def rms(self, part: str) -> float:
        """Horizontal drift over the windows of a part, m."""
        return float(np.sqrt(np.mean(self.horizontal[self.used.parts[part]] ** 2)))

    def hidden(self, *parts: str) -> "HiddenFixes":
        """Return the hidden fixes of some parts, with their predictions."""
        return self._hidden(parts, None)

    def velocities(self, *parts: str) -> "HiddenFixes | None":
        """Return the hidden velocities of some parts; None of a filter that takes none."""
        channels = velocity_channels(self.filter)
        return None if channels is None else self._hidden(parts, channels)

    def _hidden(self, parts: Sequence[str], velocity: slice | None) -> "HiddenFixes":
        mask = np.any([self.used.parts[part] for part in parts], 0)
        return hidden_fixes(self.params, self.used, self.info, mask, velocity)


class Experiment(NamedTuple):
    """A recording, and the windows that candidates are compared on."""

    recording: Recording
    begin: Initialization  # by the datasheet
    layout: Layout
    standing: Standing
    packed: ep.Packed  # its epochs by ``measurements``
    measurements: tuple[Measurement, ...]
    shape: tuple[int, int] = (0, 0)  # epochs and samples at least, so that recordings share programs
    history: int = 2  # samples of navigation that every filter keeps, so that filters share their programs
    faulty: np.ndarray = np.zeros(0)  # (F,) s, starts of windows with a fault of the receiver, which judge nothing

    @property
    def stop(self) -> float:
        """Return the end of the last epoch, s."""
        return float(self.packed.t[-1])

    @property
    def tested(self) -> bool:
        """Return whether each part has a window that judges."""
        windows = windows_of(self.packed, self.layout, self.packed.t.size)
        return all((mask & self._healthy(windows.start)).any() for mask in parts_of(self.layout, windows).values())

    def without(
        self, stretches: Sequence[tuple[float, float]], recording: Recording, begin: Initialization
    ) -> "Experiment":
        """Return the experiment without the fixes of some stretches.

        A window that begins after a stretch, before fixes have made up for it, judges nothing.

        Args:
            stretches: (begin, end) s.
            recording: without these fixes.
            begin: its start.
        """
        packed = ep.pack_recording(recording, self.measurements, begin.t, 0.0, self.stop, self.standing)
        layout = plan(packed, self.layout.window)._replace(satellites=self.layout.satellites)
        start = windows_of(packed, layout, packed.t.size).start
        after = ep.within(start, [(b - layout.window, b + layout.window) for _, b in stretches])
        return self._replace(recording=recording, begin=begin, packed=packed, layout=layout, faulty=start[after])

    def reaching(self, params: Params) -> "Experiment":
        """Return the experiment with a history for parameters and the delay that tuning may add to theirs."""
        rate, span = 1 / float(np.median(self.recording.imu.dt)), float(np.ptp(self.recording.imu.t))
        return self._replace(history=history_for(params, rate, span, MAX_ADDED_DELAY_S))

    def use(
        self, filt: Filter, params: Params, begin: Initialization | None = None, sees: Collection[str] | None = None
    ) -> Used:
        """Return the recording as a filter takes it.

        Args:
            filt: the filter, with this history.
            params: its parameters, with the lever arm.
            begin: the initialization; by default that of the experiment. Windows before it are left out.
            sees: names of those of its measurements that have fixes, by default all.
        """
        chosen, packed = rows(filt.model.measurements), self.packed
        if begin is not None or sees is not None or chosen != self.measurements:
            t = (self.begin if begin is None else begin).t
            packed = ep.pack_recording(self.recording, chosen, t, 0.0, self.stop, self.standing, sees)
        begin = self.begin if begin is None else begin
        size, samples = np.maximum(self.shape, padded_shape(packed.epochs)).tolist()
        windows = windows_of(packed, self.layout, size)
        parts = {name: mask & self._healthy(windows.start) for name, mask in parts_of(self.layout, windows).items()}
        params = begin.apply_to(params)
        train = taken(packed.epochs, slice(int(np.searchsorted(packed.t, self.layout.train + TICK))))
        nav = most_probable(filt, params, begin.navs, train)
        epochs = ready(filt, params, nav, packed.epochs, (size, samples))
        rec = self.recording
        return Used(rec.name, begin, params, nav, packed, epochs, self.layout, windows, parts, rec.truth)

    def _healthy(self, starts: np.ndarray) -> np.ndarray:
        return ~np.isin(np.round(starts, 6), np.round(self.faulty, 6))

    def score(self, filt: Filter, params: Params, begin: Initialization | None = None) -> Scored:
        """Run a filter over all windows, see `scores`."""
        return self.scores(filt, [params], begin)[0]

    def scores(
        self, filt: Filter, candidates: Sequence[Params], begin: Initialization | None = None,
        sees: Collection[str] | None = None,
    ) -> list[Scored]:  # fmt: skip
        """Run a filter with each of some parameters over all windows, side by side and from the first one's start.

        Args:
            filt: the filter; it is given the experiment's history.
            candidates: its parameters, with the lever arm.
            begin: as of `use`.
            sees: as of `use`.
        """
        filt = with_history(filt, self.history)
        used = self.use(filt, candidates[0], begin, sees)
        return scores(filt, used, [used.initialization.apply_to(params) for params in candidates])


def scores(filt: Filter, used: Used, candidates: Sequence[Params]) -> list[Scored]:
    """Run a filter with each of some parameters over the windows of a recording, side by side.

    Args:
        filt: the filter that the recording was prepared for.
        used: the recording.
        candidates: parameters with the prior of its start.
    """
    runs = drifts(filt, candidates, used.nav, used.epochs, used.windows, rows(filt.model.measurements))
    return [
        Scored(filt, params, used._replace(datasheet=params), error, info)
        for params, (error, info) in zip(candidates, runs, strict=True)
    ]


def experiments_of(
    recs: Sequence[Recording], filt: Filter, begins: Sequence[Initialization], standing: Standing,
    stop: float | None = None, window: float | None = None, satellites: tuple[int, ...] = (0,),
) -> list[Experiment]:  # fmt: skip
    """Return recordings with windows of one length, by default that which the longest takes.

    Args:
        recs: the recordings.
        filt: the filter whose measurements their epochs end with.
        begins: the start of each.
        standing: the detector of standstills.
        stop: s, end of the data.
        window: s, length of the hidden windows.
        satellites: that they keep, by turns.
    """
    chosen = rows(filt.model.measurements)
    cuts = [ep.pack_recording(r, chosen, b.t, 0.0, stop, standing) for r, b in zip(recs, begins, strict=True)]
    window = window_of(cuts) if window is None else window
    E, K = np.max([padded_shape(packed.epochs) for packed in cuts], 0).tolist()
    return [
        Experiment(rec, begin, plan(packed, window)._replace(satellites=satellites), standing, packed, chosen, (E, K))
        for rec, begin, packed in zip(recs, begins, cuts, strict=True)
    ]


def predicted(scored: Sequence[Scored]) -> float:
    """Return how badly a candidate predicts the validation parts of recordings.

    Mean negative log-likelihood of an innovation, plus that of a hidden fix, both by a Student t, so that no fix counts
    without bound.

    Args:
        scored: its runs over each.
    """
    shown: list[list[np.ndarray]] = [[], []]
    for s in scored:
        u, info = s.used, s.info
        part = (u.t > u.layout.train + TICK) & (u.t <= u.layout.validation + TICK)
        counts = part & ~u.windows.hidden & np.asarray(info.valid).any(-1)
        lost = not np.asarray(info.ok)[:, part].all()
        for into, values in zip(shown, (innovation_nll(info)[counts], s.hidden("validation").nll()), strict=True):
            into.append(np.where(lost, np.inf, np.asarray(values)))
    return float(sum(np.mean(np.concatenate(values)) for values in shown))


class HiddenFixes(NamedTuple):
    """K hidden fixes of a run, at `tuning.recordings.parts.AGES` of its windows, and their predictions."""

    residual: np.ndarray  # (K, 3) m or m/s, ENU, predicted minus measured
    covariance: np.ndarray  # (K, 3, 3) m^2 or (m/s)^2, of the residual
    age: np.ndarray  # (K,) s since the window's start

    def nll(self) -> np.ndarray:
        """Negative log-likelihood (K,) of each, by a Student t."""
        return residual_nll(self.residual, self.covariance)

    def nees(self) -> np.ndarray:
        """Horizontal error squared over its covariance, (K,): chi-square of 2 degrees of freedom."""
        return normalized(self.residual[:, :2], self.covariance[:, :2, :2])


def hidden_fixes(
    params: Params, used: Used, info: LaneRecord, mask: np.ndarray, velocity: slice | None = None
) -> HiddenFixes:
    """Return the hidden fixes of some windows: positions, or velocities.

    Args:
        params: parameters of the filter.
        used: the recording.
        info: (P, E, ...) runs with hidden windows.
        mask: (W,) the windows.
        velocity: channels of the velocity, for those of velocities; None: positions.
    """
    fix, windows = used.packed.epochs.fix, used.windows
    name, place, residual, P = "position", slice(3), info.residual, info.P
    if velocity is not None:
        name, place, residual, P = "velocity", velocity, info.velocity, info.velocity_P
    there = np.all(np.asarray(fix.valid)[:, place][:, :2], axis=1)
    at, known = ages(windows, used.packed.t, there, mask, used.layout.window)
    phase, column = np.nonzero(known)
    epoch = at[phase, column]
    noise = position_noise(params, np.asarray(fix.sd)[epoch, place], name=name)
    begins = [windows.start[(windows.phase == p) & mask] for p in range(len(windows.hidden))]
    age = [t - begins[p][begins[p] < t].max() for p, t in zip(phase, used.packed.t[epoch], strict=True)]
    return HiddenFixes(residual[phase, epoch], P[phase, epoch] + noise, np.array(age))
