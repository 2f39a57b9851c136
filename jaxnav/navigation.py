"""A recording through a filter in one call: start, cut, filter, and the solution on the host."""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jaxnav.analysis import evaluate, usage
from jaxnav.analysis.dense import dense
from jaxnav.analysis.metrics import covered_by
from jaxnav.analysis.noise_scan import NoiseScan, scan_noise, usual_scan
from jaxnav.analysis.observability import state_findings
from jaxnav.analysis.plots import interactive
from jaxnav.checkup import checkup
from jaxnav.checkup.inertial import gap_findings
from jaxnav.checkup.motion import mixups
from jaxnav.checkup.witnesses import headings
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import with_history
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.gaps import holes
from jaxnav.filters.lanes import relative_variance, slow_errors, threads
from jaxnav.filters.parameters import earliest, history_for, installed, later
from jaxnav.filters.run import first_failure, require_params, require_x64
from jaxnav.filters.scores import mean_nis
from jaxnav.filters.smoother import reach_of, smooth_jit
from jaxnav.filters.standstill import Standing
from jaxnav.findings import finding, line
from jaxnav.initialization.going_back import gone_back
from jaxnav.initialization.initialize import Initialization, initialize
from jaxnav.initialization.parked import moves_off
from jaxnav.initialization.starts import Chosen, execute
from jaxnav.io.solution import FORMATS, write_kml, write_solution
from jaxnav.maths.units import TICK
from jaxnav.measurements import AUXILIARY, MEASUREMENTS, Measurement
from jaxnav.measurements.measurement import along_track, references
from jaxnav.states.grades import GRADES
from jaxnav.types import (
    DataError,
    Epoch,
    FilterError,
    Finding,
    Info,
    Json,
    Nav,
    Params,
    Recording,
    Samples,
    Track,
    sample_rows,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


BASES = ("imu", "fixes")  # clocks of written times
MAX_EARLY_S = 0.03  # s, by which a fix may be early: navigation is extrapolated to it
FULL_COVERAGE = 0.98  # share of a run that its truth covers, below which a finding says so
MAX_NIS = 4.0  # over degrees of freedom, of the fixes before a start, beyond which a smoother does not go back to them
MAX_ASIDE = 1_000_000  # samples of the IMU, up to which a run is made ready while the noise is scanned
UNLIKE_DATASHEET = 10.0  # factor on the datasheet's noise above which scale or unit of a gyro may pass for noise


class FilterRun(NamedTuple):
    """A run from an initialization."""

    begin: Initialization
    params: Params  # with the prior of the start
    packed: ep.Packed
    hidden: np.ndarray  # (E,) bool, epochs with hidden fixes
    info: Info  # (E, ...), smoothed if wanted
    about: Chosen
    nav: Nav  # the start that was taken


@dataclass(frozen=True)
class Solution:
    """Solution of a recording: E epochs, times in GNSS time, angles in rad, ENU and FRD as everywhere."""

    t: np.ndarray  # (E,) s
    lla: np.ndarray  # (E, 3) lat rad, lon rad, height m
    vel: np.ndarray  # (E, 3) m/s, ENU
    rph: np.ndarray  # (E, 3) rad, roll, pitch, heading
    sd: np.ndarray  # (E, 9) position m, velocity m/s, attitude rad, each in E, N, U
    innovations: np.ndarray  # (E, m) measurement channels, 0 where there is none
    used: np.ndarray  # (E, m) bool, accepted by the filter
    ok: np.ndarray  # (E,) bool, False from the first epoch that was not finite on
    trace: evaluate.Trace  # the same as figures and writers take it; `trace.info` has everything else
    params: Params
    recording: Recording
    measurements: tuple[Measurement, ...]
    initialization: Initialization
    chosen: Chosen  # of `initialization.navs`
    outages: tuple[tuple[float, float], ...]  # s, windows with hidden fixes
    filter: Filter  # with the history that the latencies needed
    packed: ep.Packed = field(repr=False)  # epochs of the filter, before fixes were hidden
    hidden: np.ndarray = field(repr=False)  # (E,) bool, epochs in `outages`
    smoothed: bool
    lag: float  # s, 0 where it is not of fixed lag
    findings: list[Finding]  # on innovations, streams, noise, states and the initialization
    noise: NoiseScan | None = None  # where the noise was found from the recording
    sd_factor: float = 1.0  # that the filter's sd of positions are multiplied by
    velocity_sd_factor: float = 1.0  # and those of velocities
    delay_sd: float = 0.0  # s, of the delay between the IMU's clock and that of the fixes
    clock_rate_sd: float = 0.0  # s/s, of the growth of that delay, none halfway

    @property
    def nav(self) -> Nav:
        """The navigation state that the filter started from."""
        return jax.tree.map(lambda a: a[self.chosen.best], self.initialization.navs)

    @property
    def epochs(self) -> Epoch:
        """Return the epochs of the filter."""
        return ep.hide(self.packed.epochs, self.hidden, self.measurements)

    @property
    def sd_relative(self) -> np.ndarray:
        """Return the sd of positions (E, 3) m, ENU, but for the slow error of the receiver: from second to second.

        It is that of a position whose slow error were known. ``sd`` is that of the position on the Earth.
        """
        variance = relative_variance(self.trace.info.P, slow_errors(self.filter))
        return self.sd_factor * np.sqrt(np.asarray(variance))

    @property
    def fixes(self) -> Samples:
        """Positions of the recording."""
        return self.recording.aiding["position"]

    def gaps(self) -> list[tuple[float, float]]:
        """Return windows without positions, s: hidden ones, and gaps of over 5 intervals and 3 s.

        The end of the data is where a last gap ends.
        """
        t = self.fixes.t
        long = max(5 * float(np.median(np.diff(t))), 3.0)
        t = np.append(t, max(t[-1], self.packed.t[-1]))
        gaps = np.flatnonzero(np.diff(t) > long)
        return sorted([(float(t[i]), float(t[i + 1])) for i in gaps] + list(self.outages))

    def at_imu_rate(self) -> tuple[Track, np.ndarray]:
        """Return the solution at every sample of the IMU, in GNSS time, and its sd (N, 9), filtered or smoothed."""
        track, sd = dense(self.filter, self.params, self.nav, self.epochs, self.smoothed, self.lag)
        return track, scaled(sd, self.sd_factor, self.velocity_sd_factor)

    def imu_time(self, t: np.ndarray) -> np.ndarray:
        """Return the IMU's stamps (N,) s at some times.

        Args:
            t: (N,) s, by the clock of the fixes, as `t` has them.
        """
        mounting, begin = self.params.mounting, float(self.trace.info.nav.origin.t[0])
        stamps = begin + (t - begin - float(mounting.time_offset)) / (1.0 + float(mounting.clock_drift))
        return np.asarray(stamps + self.recording.early)

    @property
    def stated_params(self) -> Params:
        """Return the parameters for the recording as its file has it, to run it again."""
        return later(self.params, -self.recording.early)

    def at_imu_time(self, track: Track, sd: np.ndarray) -> tuple[Track, np.ndarray]:
        """Return a track at the IMU's stamps, and its sd (N, 9): along the track a delay's sd is one of the position.

        It is that of the delay halfway and of the clock's rate.

        Args:
            track: (N, ...) by the clock of the fixes.
            sd: (N, 9) there.
        """
        away = self.clock_rate_sd * (track.t - float(self.trace.info.nav.origin.t[0]))
        return track._replace(t=self.imu_time(track.t)), along_track(
            sd, track.vel, np.hypot(self.delay_sd, away)[:, None]
        )

    def write(self, path: str | Path, format: str = "", imu_rate: bool = False, base: str = "imu") -> None:
        """Write it as "csv", "kml", "pos" or "nav"; by default the ending of the file's name.

        Args:
            path: the file.
            format: in place of the ending of its name.
            imu_rate: one row for every sample of the IMU, see `at_imu_rate`.
            base: times are the "imu" stamps, or those of the "fixes" as `t` has them.

        Raises:
            DataError: another format or base, or a file that cannot be written.
        """
        kind = format or Path(path).suffix.removeprefix(".")
        if kind not in FORMATS:
            raise DataError(f"{path}: format must be one of {', '.join(FORMATS)}, got {kind!r}")
        if base not in BASES:
            raise DataError(f"{path}: base must be one of {', '.join(BASES)}, got {base!r}")
        track, sd = self.at_imu_rate() if imu_rate else (self.trace.track, self.trace.sd)
        track, sd = self.at_imu_time(track, sd) if base == "imu" else (track, sd)
        if kind == "kml":
            write_kml(path, track, self.fixes, self.recording.name)
        else:
            write_solution(path, track, kind, sd)

    def plot(self) -> "dict[str, Figure]":
        """Figures by name: trajectory, innovations, NIS, biases, and errors where the recording has a truth."""
        rec, states = self.recording, self.filter.model.states
        found = evaluate.figures(self.trace, rec.truth, self.fixes, self.measurements, self.gaps(), rec.errors, states)
        if self.noise is not None and self.noise.fixes:
            found["noise_scan"] = self.noise.figure()
        return found

    def layout(self) -> Any:
        """Return the interactive figures, by bokeh."""
        rec = self.recording
        return interactive.run_layout(
            self.trace, rec.truth, self.fixes, self.measurements, self.gaps(), self.filter.model.states
        )

    @property
    def notes(self) -> list[str]:
        """Return all remarks for a user: initialization, findings, and notes of the reader."""
        return [self.initialization.how, *map(line, self.findings), *self.recording.remarks.splitlines()]

    def metrics(self) -> Json:
        """Return all figures of the run, as metrics.json has them."""
        return metrics(self)


def navigate(
    rec: Recording,
    filt: Filter,
    params: Params | None = None,
    *,
    scan: bool | None = None,
    initialization: Initialization | Callable[[Recording, Params], Initialization] = initialize,
    stop: float | None = None,
    outages: Sequence[Sequence[float]] = (),
    interval: float = 0.0,
    standing: Standing = Standing(),
    smooth: bool = False,
    lag: float = 0.0,
    sd_factor: float = 1.0,
    velocity_sd_factor: float = 1.0,
    delay_sd: float = 0.0,
    clock_rate_sd: float = 0.0,
) -> Solution:
    """Filter a recording from where it can start.

    The filter keeps as much history as the latencies need.

    Args:
        rec: the recording.
        filt: a filter, such as ``jaxnav.build("ekf15")``.
        params: its parameters, such as ``filt.params("consumer")``, a datasheet; None is that one, scanned. The lever
            arm is the recording's unless they state one.
        scan: find noise, latency and errors of the receiver from the recording (`jaxnav.scan_noise`), about
            ``params``, and add the state of slow errors to the filter; None: where params are None.
        initialization: one, or a function that makes it of recording and parameters: `jaxnav.initialize` with other
            settings, ``partial(jaxnav.initialize, heading="course")``. Its sd replace ``params.prior``.
        stop: s, end of the data.
        outages: windows (start, end) s with the receiver's fixes hidden.
        interval: s, length of epochs without a fix; 0 is the median of the position's.
        standing: the detector of standstills.
        smooth: each epoch by all fixes, past and future (`jaxnav.filters.smoother`); innovations stay the filter's. It
            begins with the first fix, where an initialization has to be later (`jaxnav.initialization.going_back`).
        lag: s, in place of that by past fixes and the fixes of the next seconds.
        sd_factor: multiplies the stated sd of positions, such as that of a calibration by hidden fixes.
        velocity_sd_factor: the same of velocities.
        delay_sd: s, of the delay between the IMU's clock and that of the fixes; that of the scan where it is run.
        clock_rate_sd: s/s, of the growth of that delay, none halfway.

    Raises:
        DataError: a recording that cannot be started from or cut, or lacks a stream that the filter takes.
        FilterError: a run that stops being finite; says when.
        ValueError: params that are not the filter's, or a filter that cannot be smoothed.
    """
    clear_caches_if_needed()  # of a script that goes through many recordings
    if (smooth or lag) and not filt.supports_smoothing:
        raise ValueError("this filter's rule corrects by more than the covariance says: it cannot be smoothed")
    if params is not None:
        require_params(filt, params)
    if missing := set(filt.model.reads) - set(rec.aiding):
        raise DataError(f"{rec.name}: has no stream {', '.join(sorted(missing))}, which states of the filter read")
    scan = params is None if scan is None else scan
    stated = filt.params(GRADES["consumer"]) if params is None else params
    params = installed(stated, rec.lever_arm)
    require_x64(params)
    make = initialization if callable(initialization) else lambda rec, params: initialization
    found = None
    runner = partial(_runner, interval=interval, stop=stop, outages=outages, standing=standing, smooth=smooth, lag=lag)
    if scan:
        start = make(rec, params)
        with _aside(partial(_likely_run, runner, rec, filt, params, start), rec.imu.t.size <= MAX_ASIDE):
            found = scan_noise(rec, params, initialization=start, stop=stop, outages=outages)
        filt, params = found.extended(filt, params)
        params = found.applied(params)
    if callable(initialization) and (least := earliest(params, float(np.ptp(rec.imu.t)))) < -MAX_EARLY_S:
        # an epoch ends with its fix: what the IMU reads until the fix is true belongs to it
        moved = not_early(rec, -least)
        rec, params = moved, later(params, moved.early - rec.early)
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    filt, run_from = runner(rec, filt, params)
    done = run_from(make(rec, params))
    if smooth:
        done = _from_the_begin(rec, params, done, run_from, outages)
    begin, params, packed, hidden, info, about, best = done
    trace = evaluate.trace(info, params)
    trace = trace._replace(sd=scaled(trace.sd, sd_factor, velocity_sd_factor))
    nu, used, ok = (np.asarray(a) for a in (trace.info.nu, trace.info.used, trace.info.ok))
    windows = tuple((float(a), float(b)) for a, b in outages)
    findings = usage.consistency_findings(trace.info, usage.nis_by_channel(trace.info, chosen))
    findings += usage.usage_findings(usage.usage(rec, packed, trace.info, chosen, hidden))
    findings += usage.satellite_findings(packed, trace.info, chosen)
    findings += usage.noise_findings(rec.imu, params)
    findings += headings(rec, trace.track.t, trace.track.rph, float(np.median(trace.sd_rph[:, 2])))
    findings += state_findings(filt, params, best, trace.info)
    findings += _chosen(about) + ([] if found is None else found.findings) + gap_findings(holes(rec.imu))
    findings += _installation(stated, rec) + _coverage(trace, rec, chosen)
    if any(f.warns for f in findings) or (found is not None and max(found.gyro, found.accel) > UNLIKE_DATASHEET):
        findings += mixups(rec)
    findings += [f for f in checkup(rec, quick=True) if f.warns or f in rec.findings]
    return Solution(
        *trace.track, trace.sd, nu, used, ok, trace, params, rec, chosen, begin, about, windows, filt, packed, hidden,
        smooth, lag, findings, found, sd_factor, velocity_sd_factor, delay_sd if found is None else found.latency_sd,
        clock_rate_sd,
    )  # fmt: skip


def _runner(
    rec: Recording,
    filt: Filter,
    params: Params,
    *,
    interval: float,
    stop: float | None,
    outages: Sequence[Sequence[float]],
    standing: Standing,
    smooth: bool,
    lag: float,
) -> tuple[Filter, Callable[[Initialization], FilterRun]]:
    """Return the filter with the history that it needs, and its run, smoothed if wanted, from an initialization."""
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    history = history_for(params, 1 / float(np.median(rec.imu.dt)), float(np.ptp(rec.imu.t)))
    filt = with_history(filt, history)

    def run_from(begin: Initialization) -> FilterRun:
        theta = begin.apply_to(params)
        packed = ep.pack_recording(rec, chosen, begin.t, interval, stop, standing)
        hidden = ep.in_windows(packed.t, outages)
        epochs = ep.hide(packed.epochs, hidden, chosen)
        off = moves_off(rec, begin.t) if begin.navs.t.shape[0] > 1 else None
        parked = 0 if off is None else int(np.searchsorted(packed.t, off))
        info, about = execute(filt, theta, begin.navs, epochs, parked)
        failure = first_failure(info, packed.t)
        if failure:
            raise FilterError(f"run {rec.name}: {failure}")
        best = jax.tree.map(lambda a: a[about.best], begin.navs)
        if smooth or lag:
            info = smoothed(filt, theta, best, epochs, packed.t, 0.0 if smooth else lag)
        return FilterRun(begin, theta, packed, hidden, info, about, best)

    return filt, run_from


def _likely_run(
    runner: Callable[[Recording, Filter, Params], tuple[Filter, Callable[[Initialization], FilterRun]]],
    rec: Recording,
    filt: Filter,
    params: Params,
    begin: Initialization,
) -> None:
    """Run by the parameters that a scan is likely to find, so that the run after it is compiled."""
    usual = usual_scan(rec, params, 0.0 if begin.alignment is None else begin.alignment.delay)
    filt, params = usual.extended(filt, params)
    runner(rec, filt, usual.applied(params))[1](begin)


@contextmanager
def _aside(work: Callable[[], Any], wanted: bool) -> Iterator[None]:
    """Do work in a thread that has ended with the ``with`` block; its result and errors are dropped."""
    with ThreadPoolExecutor(1) as side:
        if wanted and threads() > 1:
            side.submit(work)
        yield


def not_early(rec: Recording, by: float) -> Recording:
    """Return the recording with the IMU's stamps at least ``by`` s earlier, so that fixes are so much later.

    By whole samples: fixes that come with one still do.
    """
    step = float(np.median(rec.imu.dt))
    by = math.ceil(by / step - 1e-6) * step
    return rec._replace(imu=rec.imu._replace(t=rec.imu.t - by), early=rec.early + by)


def smoothed(filt: Filter, params: Params, nav: Nav, epochs: Epoch, t: np.ndarray, lag: float) -> Info:
    """Return a run (E, ...) by past fixes and those of the next ``lag`` s, 0 for all; its epochs end at t (E,) s.

    Epochs are padded to a size that runs share.
    """
    longer = ep.bucket_size(t.size) - t.size
    within = reach_of(np.append(t, t[-1] + 2 * lag * np.arange(1, longer + 1)), lag) if lag else ()
    _, info = smooth_jit(filt, params, nav, ep.pad_to_bucket(epochs), *within)
    return jax.tree.map(lambda a: np.asarray(a)[: t.size], info)


def _from_the_begin(
    rec: Recording,
    params: Params,
    done: FilterRun,
    run_from: Callable[[Initialization], FilterRun],
    outages: Sequence[Any],
) -> FilterRun:
    """Return a smoothed run that begins with the recording; the same one where its first fixes contradict that."""
    fixes = rec.aiding["position"]
    shown = sample_rows(fixes, ~ep.within(fixes.t, outages))
    seen = rec._replace(aiding=rec.aiding | {"position": shown})
    earlier = gone_back(seen, params, done.begin, done.info, float(done.packed.t[0]))
    if earlier is None:
        return done
    try:
        longer = run_from(earlier)
    except (DataError, FilterError):
        return done
    new = longer.packed.t <= done.begin.t
    return done if mean_nis(longer.info, new) > MAX_NIS else longer


def _chosen(about: Chosen) -> list[Finding]:
    """Return the heading that was taken, where there were several."""
    if math.isnan(about.heading_deg):
        return []
    return [finding("heading.hypotheses", value=about.heading_deg, probability=about.probability)]


def _installation(stated: Params, rec: Recording) -> list[Finding]:
    """Return which lever arm counts, where the recording's and the stated one differ."""
    arm, mine = np.asarray(rec.lever_arm, float), np.broadcast_to(np.asarray(stated.mounting.lever_arm, float), 3)
    if not arm.any() or np.allclose(arm, mine):
        return []
    vector = lambda a: "(" + ", ".join(f"{x:g}" for x in a) + ")"
    if mine.any():
        return [finding("lever_arm.stated", vector=vector(mine), other=vector(arm))]
    return [finding("lever_arm.recorded", vector=vector(arm))]


def _coverage(trace: evaluate.Trace, rec: Recording, measurements: tuple[Measurement, ...]) -> list[Finding]:
    """Return streams that no measurement takes, and a truth that covers a part of the run."""
    used = {m.name for m in measurements}
    unused = sorted(set(rec.aiding) - used - set(references(measurements)) - set(AUXILIARY))
    found = [finding("stream.extra", ", ".join(unused))] if unused else []
    if rec.truth is not None:
        share = float(np.mean(covered_by(trace.track.t, rec.truth.t)))
        found += [finding("truth.share", value=100 * share)] if share < FULL_COVERAGE else []
    return found


def scaled(sd: np.ndarray, position: float, velocity: float) -> np.ndarray:
    """Return the sd (N, 9) of position, velocity and attitude with factors on those of position and velocity."""
    return sd * np.repeat([position, velocity, 1.0], 3)


def accuracy(sol: Solution) -> dict[str, float]:
    """Return the stated horizontal sd (m), medians: on the Earth at the IMU's time, and from second to second."""
    level = lambda sd: float(np.median(np.hypot(*sd[sol.ok, :2].T))) if sol.ok.any() else math.nan
    return {"earth_m": level(sol.at_imu_time(sol.trace.track, sol.sd)[1]), "relative_m": level(sol.sd_relative)}


def metrics(sol: Solution) -> Json:
    """Return errors where there is a truth, innovations, errors at the ends of gaps, and the use of the streams."""
    rec, info = sol.recording, sol.trace.info
    found: Json = {"start_s": sol.packed.start}
    error = None
    if rec.truth is not None:
        error, sd = evaluate.ned_errors(sol.trace, rec.truth)
        share = float(np.isfinite(error[:, 0]).mean())
        dark = sol.hidden | ep.within(sol.packed.t, sol.gaps())
        found |= {"errors": evaluate.error_metrics(error, sd, dark), "scored_share": share}
    found |= {"accuracy": accuracy(sol)} | evaluate.innovation_metrics(info, sol.measurements)
    ends = [
        {"start_s": a, "end_s": b, "horizontal_m": at_end}
        for a, b in sol.gaps()
        if np.isfinite(at_end := _end_error(sol, a, b, error))
    ]
    uses = usage.usage(rec, sol.packed, info, sol.measurements, sol.hidden)
    found |= ({"outages": ends} if ends else {}) | usage.as_json(uses, usage.nis_by_channel(info, sol.measurements))
    if _chosen(sol.chosen):
        at = {"start_heading_deg": sol.chosen.heading_deg, "start_heading_probability": sol.chosen.probability}
        found["heading_bank"] = at
    if sol.noise is not None:
        found["noise_scan"] = sol.noise.metrics()
    return found | {
        "findings": [asdict(f) for f in sol.findings],
        "initialization": sol.initialization.how,
        "start": [asdict(f) for f in sol.initialization.findings],
        "notes": sol.recording.notes.splitlines(),
    }


def _end_error(sol: Solution, start: float, end: float, error: np.ndarray | None) -> float:
    """Return the horizontal error (m) at the last epoch of a gap without a fix; nan where nothing shows it.

    By ``error`` (E, 9) where there is a truth, else by the first fix behind it.
    """
    t, info = sol.packed.t, sol.trace.info
    valid, used = np.asarray(sol.packed.epochs.fix.valid)[:, :2], np.asarray(info.valid)[:, :2]
    lost = np.flatnonzero((t > start + TICK) & (t <= end + TICK) & ~used.all(axis=1))
    if not lost.size:
        return float("nan")
    i = int(lost[-1])
    if error is not None:
        return float(np.hypot(*error[i, :2]))
    return float(np.hypot(*np.asarray(info.residual)[i, :2])) if valid[i].all() else float("nan")
