"""A recording through a filter in one call: start, cut, filter, and the solution on the host."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from jaxnav.analysis import evaluate, usage
from jaxnav.analysis.dense import dense
from jaxnav.analysis.noise_scan import NoiseScan, scan_noise
from jaxnav.analysis.observability import states_in_words
from jaxnav.data import epochs as ep
from jaxnav.data import gaps
from jaxnav.data.bank import bank_jit
from jaxnav.data.solution import FORMATS, write_kml, write_solution
from jaxnav.data.start import Start, start
from jaxnav.filters.compiler import require_memory
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import history_for, installed
from jaxnav.filters.run import first_failure, require_params, require_x64, run_jit
from jaxnav.filters.smoother import reach_of, smooth_jit
from jaxnav.measurements import MEASUREMENTS, Measurement
from jaxnav.states.grades import GRADES
from jaxnav.types import DataError, Epoch, Info, Nav, Params, Recording, Track

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Solution:
    """What a filter made of a recording: E epochs, times in GNSS time, angles in rad, ENU and FRD as everywhere."""

    t: np.ndarray  # (E,) s
    lla: np.ndarray  # (E, 3) lat rad, lon rad, height m
    vel: np.ndarray  # (E, 3) m/s, ENU
    rph: np.ndarray  # (E, 3) rad, roll, pitch, heading
    sd: np.ndarray  # (E, 9) position m, velocity m/s, attitude rad, each in E, N, U
    innovations: np.ndarray  # (E, m) measurement channels, 0 where there is none
    used: np.ndarray  # (E, m) bool, what the filter accepted
    ok: np.ndarray  # (E,) bool, False from the first epoch that was not finite on
    trace: evaluate.Trace  # the same as figures and writers take it; `trace.info` has everything else
    params: Params
    recording: Recording
    measurements: tuple[Measurement, ...]
    start: Start
    outages: tuple[tuple[float, float], ...]
    filter: Filter  # with the history that the latencies needed
    best: int  # the start that was taken, of `start.navs`
    notes: list[str]  # a sentence for everything that a user should know of
    epochs: Epoch = field(repr=False)  # what the filter ran over
    smoothed: bool
    lag: float  # s, 0 where it is not of fixed lag
    noise: NoiseScan | None = None  # where the noise was found from the recording

    def at_imu_rate(self) -> tuple[Track, np.ndarray]:
        """The solution at every sample of the IMU, in GNSS time, and its sd (N, 9), as filtered or as smoothed."""
        nav = jax.tree.map(lambda a: a[self.best], self.start.navs)
        return dense(self.filter, self.params, nav, self.epochs, self.smoothed, self.lag)

    def write(self, path: str | Path, format: str = "") -> None:
        """Write it as "csv", "kml", "pos" or "nav"; by default what the file's name ends with.

        Raises:
            DataError: another format, or a file that cannot be written.
        """
        kind = format or Path(path).suffix.removeprefix(".")
        if kind not in FORMATS:
            raise DataError(f"{path}: format must be one of {', '.join(FORMATS)}, got {kind!r}")
        if kind == "kml":
            write_kml(path, self.trace.track, self.recording.aiding["position"], self.recording.name)
        else:
            write_solution(path, self.trace.track, kind, self.trace.sd)

    def plot(self) -> "dict[str, Figure]":
        """Figures by name: trajectory, innovations, NIS, and errors where the recording has a truth."""
        rec = self.recording
        outages = [(a, b) for a, b in self.outages]
        states = self.filter.model.states
        return evaluate.figures(
            self.trace, rec.truth, rec.aiding.get("position"), self.measurements, outages, states=states
        )


def navigate(
    rec: Recording,
    filt: Filter,
    params: Params | None = None,
    *,
    begin: Start | None = None,
    stop: float | None = None,
    outages: Sequence[tuple[float, float]] = (),
    interval: float = 0.0,
    standing: ep.Standing = ep.Standing(),
    smooth: bool = False,
    lag: float = 0.0,
) -> Solution:
    """Filter a recording from where it can start.

    ``params``: such as ``filt.params("consumer")``, a datasheet; None: noise and latency are found from the recording
    (`jaxnav.scan_noise`). The lever arm is the recording's unless they state one.
    ``begin``: `jaxnav.start` with settings of your own; its standard deviations replace those of ``params.prior``.
    ``stop``: s. ``outages``: windows (start, end) s whose receiver's fixes are hidden. ``interval``: s, the length of
    epochs without a fix; 0 is the median of the position's. ``smooth``: each epoch by all fixes, those after it too
    (`jaxnav.filters.smoother`); innovations stay the filter's. ``lag``: s, by those of the next seconds alone. The
    filter keeps as much history as the latencies need.

    Raises:
        DataError: a recording that cannot be started from or cut, or lacks a stream that the filter takes.
        ValueError: params that are not the filter's, or a run that stops being finite; says when.
    """
    scan, stated = None, params
    if stated is not None:
        require_params(filt, stated)
    params, installation = installed(filt.params(GRADES["consumer"]) if stated is None else stated, rec.lever_arm)
    require_x64(params)
    if stated is None:
        scan = scan_noise(rec, params, begin=begin, stop=stop, outages=outages)
        params = scan.applied(params)
    begin = start(rec, params) if begin is None else begin
    params = begin.given(params)
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    packed = ep.pack_recording(rec, chosen, begin.t, interval, stop, standing)
    if filt.keeping:
        filt = filt.keeping(history_for(params, 1 / float(np.median(rec.imu.dt)), float(np.ptp(rec.imu.t))))
    hidden = ep.in_windows(packed.t, outages)
    epochs = ep.hide(packed.epochs, hidden, chosen)
    info, about = execute(filt, params, begin.navs, epochs)
    failure = first_failure(info, packed.t)
    if failure:
        raise ValueError(f"run {rec.name}: {failure}")
    best = jax.tree.map(lambda a: a[about.best], begin.navs)
    if smooth or lag:
        within = () if smooth else reach_of(packed.t, lag)
        _, info = smooth_jit(filt, params, best, epochs, *within)
    trace = evaluate.trace(info, params)
    nu, used, ok = (np.asarray(a) for a in (trace.info.nu, trace.info.used, trace.info.ok))
    windows = tuple((float(a), float(b)) for a, b in outages)
    order, names, _ = evaluate.channels(chosen)
    remarks = usage.consistency_in_words(trace.info, usage.expected(trace.info, names, order))
    remarks += usage.noise_in_words(rec.imu, params)
    remarks += states_in_words(filt, params, best, trace.info)
    remarks += usage.usage_in_words(usage.usage(rec, packed, trace.info, chosen, hidden))
    notes = [
        begin.how,
        about.words,
        installation,
        "" if scan is None else scan.words,
        *remarks,
        *rec.notes.splitlines(),
        gaps.in_words(gaps.holes(rec.imu)),
    ]
    return Solution(
        *trace.track, trace.sd, nu, used, ok, trace, params, rec, chosen, begin, windows, filt, about.best,
        [note for note in notes if note], epochs, smooth, lag, scan,
    )  # fmt: skip


class Chosen(NamedTuple):
    """Which of several starts was taken."""

    best: int = 0
    heading_deg: float = math.nan
    probability: float = 1.0

    @property
    def words(self) -> str:
        """A sentence where there were several."""
        if math.isnan(self.heading_deg):
            return ""
        return f"heading unknown: {self.heading_deg:g} deg at the start is the most probable ({self.probability:.2f})"


def execute(filt: Filter, params: Params, navs: Nav, epochs: Epoch) -> tuple[Info, Chosen]:
    """The run from ``navs`` (B, ...); of several starts the most probable one.

    Epochs are padded to sizes that recordings share, so that the compiled program is found again.
    """
    E, K = epochs.imu.dt.shape
    n, m = filt.model.n_states, filt.model.n_channels
    starts = navs.t.shape[0]
    require_memory(
        8.0 * E * (starts * (2 * n**2 + 2 * m**2 + 100) + 14 * K), f"a run of {E:,} epochs from {starts} starts"
    )
    own, epochs = slice(epochs.imu.dt.shape[0]), ep.of_shared_size(epochs)
    if navs.t.shape[0] == 1:
        info = jax.device_get(run_jit(filt, params, jax.tree.map(lambda a: a[0], navs), epochs))
        return jax.tree.map(lambda a: a[own], info), Chosen()
    bank = jax.device_get(bank_jit(filt, params, navs, epochs))
    best = int(bank.best)
    about = Chosen(best, 360.0 * best / navs.t.shape[0], float(bank.probability[best]))
    return jax.tree.map(lambda a: a[best][own], bank.info), about
