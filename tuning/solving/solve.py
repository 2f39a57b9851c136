"""`solve`: from a recording to its best trajectory, with stated sd that are calibrated and a verdict."""

import math
from collections.abc import Callable, Sequence, Set
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from jaxnav.analysis import usage
from jaxnav.analysis.evaluate import innovation_metrics
from jaxnav.analysis.noise_scan import NoiseScan, known_delay, usual_scan
from jaxnav.analysis.receiver_errors import without_slow_errors
from jaxnav.checkup import checkup
from jaxnav.checkup.support import options
from jaxnav.filters.adapters.adapter import Adapter
from jaxnav.filters.catalogue import build
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import installed, later
from jaxnav.filters.scores import mean_nis
from jaxnav.filters.standstill import Standing
from jaxnav.findings import finding
from jaxnav.initialization.initialize import Initialization, initialize, require_positions
from jaxnav.kinds import KINDS
from jaxnav.maths.units import PPM
from jaxnav.measurements import GNSS, Measurement, layout
from jaxnav.navigation import MAX_EARLY_S, Solution, navigate, not_early
from jaxnav.types import Finding, Info, Json, Params, Recording
from tuning.fit.status import Status
from tuning.recordings.experiment import Experiment, Scored, experiments_of
from tuning.recordings.faults import suspect_windows, without_faults
from tuning.recordings.recorded import scan, tune
from tuning.recordings.report import Tuned
from tuning.solving.calibration import Calibration, calibrate
from tuning.solving.corrections import DRIFT, Corrections, check_and_correct
from tuning.solving.sensors import Tried, choose_measurements, finding_of, standing_of
from tuning.solving.settled import settled
from tuning.solving.stages import Stage, Stages
from tuning.solving.stretches import Stretch, as_likely, faulty_stretches, finding_of_jump, jumps_of, without
from tuning.solving.stretches import finding_of as finding_of_fault

COV_STRIDE = 5  # IMU samples per point of the error dynamics, as in the configuration
CONSISTENT, CARE, UNUSABLE = "consistent", "usable with care", "not usable"
NIS_LIMITS = 0.7, 1.4  # of a consistent solution, on the test part
MORE_EARLY_S = 0.05  # s, by which fixes may be earlier than the check found
INNOVATIONS = ("nis.high", "nis.low", "nis.overall", "innovations.correlated")  # by `usage.consistency_findings`
MAX_NIS, MIN_INSIDE = 4.0, 0.6  # beyond these a solution is not usable
CHECK, FIRST = Stage("check", 1.5), Stage("first answer", 0.5)
NOISE, SCORES = Stage("noise by likelihood", 4.0), Stage("drift without fixes", 3.5)
OPTION_WEIGHT = 3.5
TUNE, CALIBRATE = Stage("tuning", 15.0), Stage("calibration of the stated sd", 0.1)
WHOLE = Stage("the whole recording", 2.5)
MIN_SPAN_S = 120.0  # s, of a recording with several windows in every part


@dataclass(frozen=True)
class Solved:
    """The best trajectory of a recording, and how far it can be trusted."""

    solution: Solution  # smoothed; stated sd with the factor of the calibration
    params: Params  # the filter's, without the prior of the start
    verdict: str  # "consistent", "usable with care", "not usable"
    why: str  # in one line
    findings: list[Finding]
    settings: dict[str, float | str]  # that the check of the recording established
    standing: Standing
    tried: list[Tried]  # measurements
    tuned: Tuned | None  # None where nothing was tuned
    calibration: Calibration | None  # None where no window could be hidden
    left_out: tuple[Stretch, ...]  # s, stretches with a fault of the receiver, whose fixes are not used
    drift_m: dict[str, float]  # RMS over the test windows: of the datasheet, of the noise scan, of the solution
    window_s: float  # length of these windows
    test_nis: float  # NIS over degrees of freedom on the test part, of the receiver's fixes
    status: Status = Status.CONVERGED

    def metrics(self) -> Json:
        """All figures, as metrics.json has them."""
        c, drift = self.calibration, self.drift_m
        ratio = lambda over: drift["solution"] / drift[over] if drift.get(over) else None
        return self.solution.metrics() | {
            "verdict": self.verdict, "why": self.why, "left_out": self.left_out, "test_nis": self.test_nis,
            "settings": self.settings,
            "calibration": None if c is None else c._asdict() | {
                "before": c.before._asdict(), "after": c.after._asdict(), "ages": [a._asdict() for a in c.ages],
                "velocity": None if c.velocity is None else c.velocity._asdict()},
            "drift_m": drift, "drift_ratio": ratio("datasheet"), "against_auto": ratio("auto"),
            "measurements": [{"names": row.option.names, "drift_ratio": row.drift_ratio, "gain": row.gain,
                              "taken": row.taken, "sd_factor": row.sd} for row in self.tried],
            "tuning": None if self.tuned is None else self.tuned.verdict, "status": self.status.value,
            "findings": [asdict(f) for f in self.findings],
        }  # fmt: skip


def consumer(filt: Filter) -> Params:
    """Return the datasheet that noise is scaled from."""
    return filt.params("consumer")


def solve(
    rec: Recording,
    datasheet: Callable[[Filter], Params] = consumer,
    *,
    adapter: str | Adapter = "",
    fast: bool = False,
    smooth: bool = True,
    initialization: Callable[[Recording, Params], Initialization] = initialize,
    stop: float | None = None,
    check: Callable[[Recording], Corrections] = check_and_correct,
    log: Callable[[str], None] = lambda line: None,
    so_far: Callable[[Callable[[], Solved]], None] | None = None,
    limit: float = math.inf,
) -> Solved:
    """Find the best trajectory of a recording, without settings and without truth.

    The recording is checked and its clock corrected (`tuning.solving.corrections`); noise is found by likelihood;
    measurements that predict better are added (`tuning.solving.sensors`); the filter is tuned (`tuning.tune`), and runs
    over the whole recording by all fixes. A test part that none of this uses says how far the stated sd are right.

    Args:
        rec: the recording, with positions.
        datasheet: from a filter to its parameters, which noise and scales are found about; lever arms are the
            recording's unless it states one.
        adapter: a learned part of the filter, see `jaxnav.build`; its weights are those of ``datasheet``.
        fast: do not tune.
        smooth: each epoch by all fixes, past and future.
        initialization: makes the initialization of a recording and parameters.
        stop: s, end of the data.
        check: checks and corrects the recording, ``partial(check_and_correct, kept=...)`` of `corrections`.
        log: called with a line on each step.
        so_far: called with functions that make answers before the best one, each better than the one before: by the
            datasheet with the delay that alignments show, by the noise scan, by the chosen measurements. It may call
            them in another thread, and the search goes on meanwhile. None: no such answer is made.
        limit: s; no step begins that cannot end in it, see the finding ``solve.time``.

    Raises:
        DataError: a recording without positions, or that cannot be started from.
        FilterError: the filter stops being finite.
    """
    require_positions(rec)
    clear_caches_if_needed()  # of a script that goes through many recordings
    stages = Stages([CHECK, FIRST, NOISE, SCORES, TUNE, CALIBRATE, WHOLE], log, limit=limit)
    stages.next()
    checked = check(rec)
    rec, standing = _not_early(checked), standing_of(checked.found)
    names = [m.name for m in GNSS if m.name in rec.aiding]
    filt = build("ekf15", names, COV_STRIDE, adapter=adapter)
    datasheet_of = lambda f: installed(checked.clock(datasheet(f)), rec.lever_arm)
    begin = initialization(rec, datasheet_of(filt))
    (experiment,) = experiments_of([rec], filt, [begin], standing, stop)
    findings = [*checked.applied, *(f for f in checked.found if f.warns)]
    untested = partial(
        _untested, settings=checked.settings, standing=standing, window=experiment.layout.window, early=rec.early
    )
    tried_ones = options(rec, checked.found)
    each = [Stage(", ".join(option.names), OPTION_WEIGHT) for option in tried_ones]
    rest = [NOISE, SCORES, *each, *([] if fast else [TUNE]), CALIBRATE, WHOLE]
    stages.replace([FIRST, *rest] if experiment.tested else [FIRST, NOISE])
    stages.next()
    first: Callable[[], tuple[Solution, Params]] = partial(_first, filt, datasheet_of(filt), experiment)
    if math.isfinite(limit):
        known = first()  # its time shows how fast the machine is
        if not stages.fits(NOISE, *([SCORES, CALIBRATE, WHOLE] if experiment.tested else [])):
            left = finding("solve.time", ", ".join(stage.name for stage in stages.stages[stages.done :]), limit=limit)
            return untested(*known, [*findings, left], "not tested: no time for it")
        first = lambda: known

    def answer(made: Callable[[], tuple[Solution, Params]], gone: Set[str] = frozenset()) -> None:
        """Offer an answer by the findings so far."""
        if so_far is not None:
            said, why = tuple(findings), f"not tested yet: {stages.coming()}"
            so_far(lambda: untested(*made(), said, why, gone=gone))

    answer(first)
    if not experiment.tested:
        stages.next()
        return _short(filt, datasheet_of(filt), experiment, initialization, smooth, findings, untested)
    stages.next()
    found, experiment, plain = _untuned(filt, datasheet_of, experiment, stages.next, log)
    gone: set[str] = set()
    jumps = jumps_of(best := plain.get("auto", plain["datasheet"]))
    left_out, gain = faulty_stretches(best, jumps)
    other = None
    if left_out:
        healthy = without(rec, left_out)
        other = experiment.without(left_out, healthy, initialization(healthy, datasheet_of(filt)))
    if other is not None and other.tested:
        found, experiment, plain = _untuned(filt, datasheet_of, other, lambda: None, log)
        gone = {f.code for f in checked.found} - {f.code for f in checkup(experiment.recording)}  # those of the fault
        findings.append(finding_of_fault(left_out, gain))
        jumps = as_likely(jumps, gain) or jumps_of(plain.get("auto", plain["datasheet"]))
    else:
        left_out = []
    experiment, plain, suspect = _without_faults(experiment, plain)
    findings += [*found.findings, *suspect, *map(finding_of_jump, jumps)]
    level = plain.get("auto", plain["datasheet"])
    run = partial(
        navigate, rec, scan=False, initialization=initialization, stop=stop, standing=standing, outages=left_out
    )
    by_now = lambda filt, params: (run(filt, params, smooth=smooth), params)
    answer(partial(by_now, level.filter, level.params), gone)
    count = next((k for k in range(len(each), 0, -1) if stages.fits(*each[:k], CALIBRATE, WHOLE)), 0)
    fast = fast or not stages.fits(*each[:count], TUNE, CALIBRATE, WHOLE)
    ends = [*each[:count], *([] if fast else [TUNE]), CALIBRATE, WHOLE]
    if skipped := [stage.name for stage in stages.stages[stages.done :] if stage not in ends]:
        findings.append(finding("solve.time", ", ".join(skipped), limit=limit))
    stages.replace(ends)
    choice = choose_measurements(
        experiment, level, lambda f: found.applied(datasheet_of(f)), tried_ones[:count], stages.next
    )
    findings += [finding_of(row) for row in choice.tried]
    filt, start = choice.filter, choice.applied(datasheet_of(choice.filter))
    tuned, params = None, found.applied(start)
    if not fast:
        if filt != level.filter:
            answer(partial(by_now, filt, params), gone)
        stages.next()
        tuned = tune([experiment], filt, start, scans=[found], log=log)
        findings += tuned.findings
        filt, params = tuned.filter, tuned.params
    stages.next()
    # what is judged is what is delivered: the same start, filter and parameters
    delivered = initialization(experiment.recording, params)
    final = experiment.score(filt, params, delivered)
    calibration = calibrate(final)
    for name, factor, counted in (
        ("positions", calibration.factor, calibration.after),
        ("velocities", calibration.velocity_factor, calibration.velocity),
    ):
        if factor > 1.0 and counted is not None:
            findings.append(finding("solve.inflated", f"stated sd of {name}", factor, count=counted.fixes))
    stages.next()
    sol = run(
        filt, params, initialization=delivered, smooth=smooth, sd_factor=calibration.factor,
        velocity_sd_factor=calibration.velocity_factor, delay_sd=found.latency_sd, clock_rate_sd=checked.rate_sd,
    )  # fmt: skip
    nis = receiver_nis(sol.trace.info, sol.measurements, sol.packed.t > experiment.layout.validation)
    said = [f for f in distinct([*findings, *unwidened(sol, choice.tried)]) if f.code not in gone]
    params = later(params, -rec.early)
    findings = settled(said, params, tuned is not None)
    drift = {name: each.rms("test") for name, each in (*plain.items(), ("solution", final))}
    verdict, why = judge(nis, calibration, findings)
    status = Status.CONVERGED if tuned is None else tuned.status
    return Solved(
        sol, params, verdict, why, findings, checked.settings, standing, choice.tried, tuned, calibration,
        tuple(left_out), drift, experiment.layout.window, nis, status,
    )  # fmt: skip


def _not_early(checked: Corrections) -> Recording:
    """Return the recording in which no fix is early by the delay that its check found."""
    rec, late = checked.recording, [f.value or 0.0 for f in checked.found if f.code in ("time.late", "time.delay")]
    drift = abs(float(checked.settings.get(DRIFT, 0.0))) * PPM
    least = min(late, default=0.0) - 0.5 * drift * float(np.ptp(rec.imu.t))
    return not_early(rec, MORE_EARLY_S - least) if least < -MAX_EARLY_S else rec


def _untuned(
    filt: Filter,
    datasheet_of: Callable[[Filter], Params],
    experiment: Experiment,
    scanned: Callable[[], None],
    log: Callable[[str], None],
) -> tuple[NoiseScan, Experiment, dict[str, Scored]]:
    """Return the noise scan, the windows with its history, and the scores of datasheet and scan.

    ``scanned`` is called between the two.
    """
    found = scan(experiment, datasheet_of(filt), log)
    scanned()
    filt, sheet = found.extended(filt, datasheet_of(filt))
    noise = found.applied(datasheet_of(filt))
    experiment = experiment.reaching(noise)
    plain = {"datasheet": experiment.score(filt, without_slow_errors(sheet))}
    if found.fixes:
        plain["auto"] = experiment.score(filt, noise)
    return found, experiment, plain


def _without_faults(
    experiment: Experiment, plain: dict[str, Scored]
) -> tuple[Experiment, dict[str, Scored], list[Finding]]:
    """Leave windows with a receiver's fault out of the parts."""
    used = plain["datasheet"].used
    suspect = suspect_windows(list(plain.values()))
    parts, faults = without_faults(used.parts, suspect, used.starts)
    counted, left = (np.any(list(masks.values()), 0) for masks in (used.parts, parts))
    experiment = experiment._replace(faulty=np.union1d(experiment.faulty, used.starts[counted & ~left]))
    return experiment, {name: s._replace(used=s.used._replace(parts=parts)) for name, s in plain.items()}, faults


def _first(filt: Filter, params: Params, experiment: Experiment) -> tuple[Solution, Params]:
    """Return the first answer and its parameters: the datasheet, the delay that alignments show, usual slow errors."""
    rec = experiment.recording
    usual = usual_scan(rec, params, known_delay(rec, params, experiment.stop, ()).mean)
    filt, params = usual.extended(filt, params)
    params = usual.applied(params)
    sol = navigate(
        rec,
        filt,
        params,
        scan=False,
        initialization=experiment.begin,
        stop=experiment.stop,
        standing=experiment.standing,
    )
    return sol, params


def _short(
    filt: Filter,
    params: Params,
    experiment: Experiment,
    initialization: Callable[[Recording, Params], Initialization],
    smooth: bool,
    findings: Sequence[Finding],
    untested: Callable[..., Solved],
) -> Solved:
    """Solve a recording that is too short for windows in every part: noise by likelihood, no test."""
    sol = navigate(
        experiment.recording, filt, params, scan=True, initialization=initialization,
        stop=experiment.stop, standing=experiment.standing, smooth=smooth,
    )  # fmt: skip
    if sol.noise is not None:
        params = sol.noise.applied(sol.noise.extended(filt, params)[1])
    short = finding("solve.short", "", float(sol.t[-1] - sol.t[0]), MIN_SPAN_S)
    return untested(sol, params, [*findings, short], "too short to test the stated standard deviations")


def _untested(
    sol: Solution, params: Params, findings: Sequence[Finding], why: str, settings: dict[str, float | str],
    standing: Standing, window: float, early: float = 0.0, gone: Set[str] = frozenset(),
) -> Solved:  # fmt: skip
    """Return a solution without a test of its sd, and ``why`` there is none; ``gone``: findings of a left-out fault."""
    said = [f for f in distinct([*findings, *sol.findings]) if f.code not in gone]
    found = settled(said, sol.stated_params, False)
    nis = innovation_metrics(sol.trace.info, sol.measurements)["nis_per_dof"]
    verdict, how = judge(nis, None, found)
    return Solved(sol, later(params, -early), verdict, f"{how}, {why}", found, settings, standing, [], None, None,
                  tuple(sol.outages), {}, window, nis)  # fmt: skip


def distinct(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings, each once."""
    return list({(f.code, f.subject, f.message): f for f in findings}.values())


def unwidened(sol: Solution, tried: Sequence[Tried]) -> list[Finding]:
    """Return the findings of a solution, without those on innovations of sensors whose sd are larger for a reason.

    Args:
        sol: the solution.
        tried: options; those that are taken with more than their stated sd have errors that last.
    """
    wide = {name.replace("_", " ") for row in tried if row.taken and row.sd > 1.0 for name in row.option.measurements}
    if not wide:
        return sol.findings
    channels = usage.nis_by_channel(sol.trace.info, sol.measurements)
    kept = {name: each for name, each in channels.items() if name.rpartition(" ")[0] not in wide}
    innovations = usage.consistency_findings(sol.trace.info, kept)
    return innovations + [f for f in sol.findings if f.code not in INNOVATIONS]


def receiver_nis(info: Info, measurements: Sequence[Measurement], late: np.ndarray) -> float:
    """Return NIS over degrees of freedom of the receiver's channels.

    Those of other sensors may have sd above their noise, for errors that last (`tuning.solving.sensors`).

    Args:
        info: of a run (E, ...).
        measurements: of its filter, in their order.
        late: (E,) bool, the epochs that count.
    """
    places = layout(tuple(measurements))
    own = np.concatenate([np.arange(places[m.name].start, places[m.name].stop) for m in measurements if m.receiver])
    return mean_nis(info, late, own)


def judge(nis: float, c: Calibration | None, findings: Sequence[Finding]) -> tuple[str, str]:
    """Return the verdict on a solution, and why in one line.

    Args:
        nis: over degrees of freedom, on the test part.
        c: hidden fixes of the test part; None where there is none.
        findings: all of the run.
    """
    broken = [f for f in findings if f.warns and KINDS[f.code].breaks_solution]
    if broken:
        return UNUSABLE, f"{broken[0].code}: {', '.join(broken[0].causes) or broken[0].message}"
    off = "".join(f": {f.message}" for f in findings if KINDS[f.code].exceeds_sd)
    if c is None:
        said = f"NIS/dof {nis:.2g}"
        return (UNUSABLE, f"{said}: IMU and fixes contradict each other") if nis > MAX_NIS else (CARE, said + off)
    inside = c.after.inside_95
    said = f"NIS/dof {nis:.2f}, {100 * inside:.0f} % of {c.after.fixes} hidden fixes inside the stated 95 %"
    if nis > MAX_NIS or inside < MIN_INSIDE:
        return UNUSABLE, f"{said}: IMU and fixes contradict each other"
    if off:
        return CARE, said + off
    low, high = NIS_LIMITS
    if not low <= nis <= high:
        return CARE, f"{said}: innovations are {'larger' if nis > high else 'smaller'} than their sd"
    if c.after.too_small or c.after.too_large:
        return CARE, f"{said}: stated sd are too {'small' if c.after.too_small else 'large'} without fixes"
    return CONSISTENT, said
