"""`tune`: a filter's noise, fixes and clocks from recordings without truth, in a way that does no harm.

A recording is split in time: training, validation, and a test that is used only at the end. The objective
over the training part is

    J(x) = N (mean negative log-likelihood of an innovation + H(x)) + 1/2 sum ((x - datasheet) / sd)^2

with x the unconstrained numbers (`tuning.recordings.priors`). The likelihood is *tempered*: it counts as N
observations, the number of hidden windows that fit into the training parts, and not as thousands of epochs, for
innovations are not white where a receiver's errors are not, and then no prior would have any weight. H is
the *horizon likelihood*: the mean negative log-likelihood of hidden fixes at several ages of hidden windows, by a
Student t, a proper score of the error that a user sees. Both have an information matrix, so that the method of
scoring minimises J.

The search starts at the noise scan's numbers (`jaxnav.analysis.noise_scan`, of the training part), and the prior of a
delay is centred there. The filter estimates slow errors of the receiver, with the share and correlation time that the
scan finds; the white rest is free. The datasheet takes all that a receiver states for white noise. The candidate that
predicts the validation part best, its innovations and its hidden fixes, wins, if neither the datasheet nor the scan
drifts less over the hidden windows of training and validation. The winner is judged once, on the test.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxnav.analysis.noise_scan import NoiseScan, scan_noise
from jaxnav.analysis.receiver_errors import alike, without_slow_errors
from jaxnav.checkup.streams import velocity
from jaxnav.filters.catalogue import rows, with_history
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import RECEIVER_ERROR
from jaxnav.filters.parameters import installed, put, with_prior_of
from jaxnav.filters.run import require_params, require_x64
from jaxnav.filters.standstill import Standing
from jaxnav.findings import finding, line
from jaxnav.initialization.initialize import Initialization, initialize
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import ConfigError, DataError, Finding, Json, Params, Recording, sample_rows
from tuning.recordings.choice import choose
from tuning.recordings.evidence import Evidence
from tuning.recordings.experiment import Experiment, experiments_of, predicted, scores
from tuning.recordings.faults import suspect_windows, without_faults
from tuning.recordings.free import leaves_of
from tuning.recordings.parts import MAX_ADDED_DELAY_S, Used, blocks_of, describe_parts, pooled
from tuning.recordings.priors import PRIORS, kind_of, spec_of
from tuning.recordings.report import (
    MIN_WINDOWS,
    Row,
    Trial,
    Tuned,
    channels,
    ratios,
    reported_candidate,
    rows_of,
    spread,
)
from tuning.recordings.runs import Descent
from tuning.recordings.search import Checkpoints, descent, search
from tuning.recordings.validation import block_ratio, paired_gain
from tuning.uncertainty import Covariance

DELAY = "mounting.time_offset"
VELOCITY_DELAY = "measurements.velocity.latency"
KNOWN_DELAY_SIGMAS = 3.0  # sd of an alignment's delay, from which on it is known
SCALE, SCANNED = "noise.scale", ("noise.gyro", "noise.accel", DELAY)  # estimated by the noise scan
FAR_SIGMAS = 2.0  # sd of a prior beyond which a parameter is said to be far


# ---------------------------------------------------------------------------- the function


def tune(
    rec: Recording | Sequence[Recording] | Sequence[Experiment],
    filt: Filter,
    params: Params | Sequence[Params],
    *,
    free: Sequence[str] = ("noise", "fixes", "timing"),
    per_recording: Sequence[str] = (),
    prior_sd: Mapping[str, float] | None = None,
    initialization: Initialization | Sequence[Initialization] | None = None,
    stop: float | None = None,
    window: float | None = None,
    hidden_satellites: int | Sequence[int] = 0,
    priors: bool = True,
    observations: float | None = None,
    extend: bool = True,
    standing: Standing = Standing(),
    scans: Sequence[NoiseScan] | None = None,
    how: Descent | None = None,
    checkpoints: Checkpoints | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> Tuned:
    """Tune ``params`` (such as ``filt.params("consumer")``, the datasheet) on a recording, or on several together.

    Args:
        rec: a recording, or several, each with an initialization; or experiments on them, whose start and windows
            count.
        filt: the filter.
        params: the datasheet, ``filt.params("consumer")``; one for each recording where lever arms differ.
        free: groups of `tuning.recordings.free.groups`, dotted leaves or their keys; one value for all recordings.
        per_recording: free parameters with one value for each recording: "timing" of loggers with separate clocks,
            "noise" of several IMUs on one vehicle.
        prior_sd: priors by leaf, one sd about ``params``: a factor where the parameter is positive, else in SI.
        initialization: one per recording, or one for all; by default `jaxnav.initialize`.
        stop: s, end of the data.
        window: s, length of the hidden windows; by default 3 to 15 by the recording's length.
        hidden_satellites: satellites, the highest, that a hidden window keeps, or several numbers by turns: what
            is tuned must do no harm with any of them.
        priors: False: maximum likelihood.
        observations: N, by default the windows that fit into the training parts.
        extend: estimate slow errors of the receiver where the scan finds some.
        standing: the detector of standstills.
        scans: noise scans of the training parts, one per recording; by default they are made.
        how: minimise an objective by gradient over the training windows, in place of J.
        checkpoints: where the searches keep the best so far, after each evaluation.
        log: called with a line on each step.

    Raises:
        DataError: a recording that cannot be started from, or is too short for windows in every part.
        ValueError: the filter stops being finite with ``params``, or an unknown name.
        CheckpointError: nothing usable to resume from.
    """
    clear_caches_if_needed()
    several = lambda value: type(value) in (list, tuple)  # each of them is a named tuple itself
    given: list[Any] = list(rec) if several(rec) else [rec]
    experiments: list[Experiment] = given if all(isinstance(each, Experiment) for each in given) else []
    recs: list[Recording] = [x.recording for x in experiments] or given
    datasheets: list[Any] = list(params) if several(params) else [params] * len(recs)
    starts: Any = initialization
    begins: list[Any] = list(starts) if several(starts) else [starts] * len(recs)
    begins = [x.begin for x in experiments] or begins
    if not recs or not len(recs) == len(datasheets) == len(begins):
        raise ValueError(
            f"{len(recs)} recordings, {len(datasheets)} params and {len(begins)} initializations: expected one each"
        )
    for datasheet in datasheets:
        require_params(filt, datasheet)
    datasheets = [installed(p, r.lever_arm) for r, p in zip(recs, datasheets, strict=True)]
    require_x64(datasheets[0])
    begins = [initialize(r, p) if b is None else b for r, p, b in zip(recs, datasheets, begins, strict=True)]
    separate = leaves_of(filt, datasheets[0], per_recording, "per_recording")
    if separate and how is not None:
        raise ConfigError("tune.per_recording goes with the tempered method, not with a gradient search")
    warnings = clocks(recs, begins) if DELAY not in separate else []
    for warning in warnings:
        log(line(warning))
    if not experiments:
        satellites = tuple(np.atleast_1d(hidden_satellites).tolist())
        experiments = experiments_of(recs, filt, begins, standing, stop, window, satellites)
    if scans is None and not set(SCANNED) & set(leaves_of(filt, datasheets[0], free)):
        scans = [NoiseScan()] * len(recs)
    elif scans is None:
        scans = [scan(x, sheet, log) for x, sheet in zip(experiments, datasheets, strict=True)]
    filt = with_history(filt, max(x.reaching(s.applied(p)).history for x, p, s in zip(experiments, datasheets, scans)))
    if "measurements.position.scale" not in separate:
        scans = [s._replace(receiver=r) for s, r in zip(scans, alike([s.receiver for s in scans]), strict=True)]
    shared = 1.0 if SCALE in leaves_of(filt, datasheets[0], free) else max(s.scale for s in scans)
    scans = [s._replace(scale=shared) for s in scans]
    plain, slowly = filt, [each for each in scans if extend and each.receiver.share.any()]
    wide = [slowly[0].extended(filt, p) for p in datasheets] if slowly else []
    filt = wide[0][0] if slowly else filt
    slow = bool(slowly) and RECEIVER_ERROR in filt.model.states
    bases = [without_slow_errors(p) for _, p in wide] if slow else datasheets
    used = [x.use(filt, base) for x, base in zip(experiments, bases, strict=True)]
    for u in used:
        log((f"{u.name}: " if len(used) > 1 else "") + describe_parts(u.layout, u.parts, u.packed))
    known = [u._replace(datasheet=stays(s, u.datasheet, slow)) for u, s in zip(used, scans, strict=True)]
    parts = pooled(used)
    for name, mask in parts.items():
        if not mask.any():
            raise DataError(
                f"{', '.join(u.name for u in used)}: no hidden window of {used[0].layout.window:g} s fits into the "
                f"{name} part of {sum(u.packed.t[-1] - u.packed.start for u in used):.0f} s: it is too short to tune on"
            )
    leaves = measured(leaves_of(filt, known[0].datasheet, free), recs)
    leaves = [leaf for leaf in leaves if not (slow and leaf.startswith(f"states.{RECEIVER_ERROR}."))]  # the scan's
    spec = spec_of(filt, known[0].datasheet, leaves, prior_sd, priors)
    job = Evidence(filt, spec, known, separate, observations)
    white = Evidence(filt, spec, used, separate, observations) if slow or shared != 1.0 else job
    log(f"free: {', '.join(spec)}")
    history: list[Json] = []
    auto = job.numbers([each.applied(u.datasheet) for each, u in zip(scans, used, strict=True)])
    centre = job.numbers([initialized(*each) for each in zip(scans, used, recs, strict=True)])
    job.centre_delays(centre)
    stated = datasheets if plain is not filt else [white.params(white.flat, r) for r in range(len(used))]
    candidates = {"datasheet": Candidate(white, white.flat, plain, stated)}
    if any(each.fixes for each in scans):
        candidates["auto"] = Candidate(job, auto, filt, job.each(auto))
    search_tuned = partial(search, checkpoints=checkpoints) if how is None else partial(descent, how=how)
    best, status = search_tuned("tuned", job, centre, history, log)
    candidates["tuned"] = Candidate(job, best, filt, job.each(best))
    log("scoring the candidates on hidden windows")
    # a datasheet knows nothing of slow errors
    priors_of = [
        d._replace(states={n: s for n, s in d.states.items() if not slow or n != RECEIVER_ERROR}) for d in datasheets
    ]
    found = judged(candidates, parts, priors_of)
    return replace(
        found,
        findings=[*warnings, *found.findings],
        history=history,
        status=status,
        effective=job.effective if how is None else math.nan,
    )


# ---------------------------------------------------------------------------- candidates


class Candidate(NamedTuple):
    """Numbers of an objective, and what they stand for."""

    job: Evidence
    flat: jax.Array  # (G,)
    filter: Filter  # that other runs take
    params: list[Params]  # for it, of each recording


def judged(candidates: Mapping[str, Candidate], parts: Mapping[str, np.ndarray], datasheets: Sequence[Params]) -> Tuned:
    """Score candidates on the hidden windows of all recordings, choose one and judge it on the test.

    Args:
        candidates: by name, the datasheet the first.
        parts: masks (W,) of the windows of all recordings, one after the other.
        datasheets: of each recording, with the priors that kept parameters have.
    """
    job = candidates["datasheet"].job
    used, filt, chosen = job.used, job.filt, rows(job.filt.model.measurements)
    params_of = lambda r: [each.job.params(each.flat, r) for each in candidates.values()]
    runs = [scores(filt, u, params_of(r)) for r, u in enumerate(used)]
    scored = dict(zip(candidates, map(list, zip(*runs, strict=True)), strict=True))
    drift = {name: np.concatenate([s.horizontal for s in each]) for name, each in scored.items()}
    untuned = [scored[name] for name in ("datasheet", "auto") if name in scored]
    suspect = np.concatenate([suspect_windows(each) for each in zip(*untuned, strict=True)])
    parts, faults = without_faults(parts, suspect, np.concatenate([u.starts for u in used]))
    split = np.cumsum([len(u.starts) for u in used])[:-1]
    masks = [dict(zip(parts, each)) for each in zip(*(np.split(mask, split) for mask in parts.values()))]
    left = np.concatenate([u.windows.kept for u in used])
    kept = {
        name: [with_prior_of(p, d, job.spec) for p, d in zip(each.params, datasheets, strict=True)]
        for name, each in candidates.items()
    }
    trials = {
        name: Trial(
            each.filter,
            kept[name][0],
            drift[name],
            ratios(drift["datasheet"], drift[name], parts, left),
            predicted([s.judging(mask) for s, mask in zip(scored[name], masks, strict=True)]),
        )
        for name, each in candidates.items()
    }
    best = choose(trials, parts, blocks_of(used))
    test, blocks = parts["test"], blocks_of(used)[parts["test"]]
    gain = None
    if best != "datasheet" and np.unique(blocks).size >= MIN_WINDOWS and np.isfinite(drift[best]).all():
        gain = paired_gain(drift["datasheet"][test], drift[best][test], blocks)
    interval = block_ratio(drift["datasheet"][test], drift[best][test], blocks)
    late = [u.t > u.layout.validation for u in used]
    nis = {name: channels([s.info for s in each], late, chosen) for name, each in scored.items()}
    spreads = {name: spread(off[test]) for name, off in drift.items()}
    shown = candidates[reported_candidate(best)]
    return Tuned(
        trials[best].params, kept[best], trials[best].filter, best,
        table(shown.job, shown.flat), trials, used, parts, int(np.unique(blocks).size), gain, spreads, nis,
        candidates[best].job.spec, faults, interval=interval,
    )  # fmt: skip


# ---------------------------------------------------------------------------- parts of the recording


def clocks(recs: Sequence[Recording], begins: Sequence[Initialization]) -> list[Finding]:
    """Return a warning where recordings that are to share one delay were logged by clocks that do not agree."""
    seen = [(r.name, b.alignment.delay, b.alignment.sd[9]) for r, b in zip(recs, begins, strict=True) if b.alignment]
    if not seen:
        return []
    low, high = min(seen, key=lambda each: each[1]), max(seen, key=lambda each: each[1])
    if high[1] - low[1] < max(0.1, 4 * float(np.hypot(low[2], high[2]))):
        return []
    return [
        finding("time.clocks", vector=", ".join(f"{name} {delay:+.2f} s (sd {sd:.2f})" for name, delay, sd in seen))
    ]


def scan(experiment: Experiment, datasheet: Params, log: Callable[[str], None]) -> NoiseScan:
    """Return the noise scan of a training part, by the filter's measurements alone."""
    rec, begin, end = experiment.recording, experiment.begin, experiment.layout.train
    seen = rec._replace(aiding={m.name: rec.aiding[m.name] for m in experiment.measurements if m.name in rec.aiding})
    found = scan_noise(seen, datasheet, initialization=begin, stop=end, reach=MAX_ADDED_DELAY_S)
    for each in found.findings:
        log(f"{rec.name}: {line(each)}")
    return found


def stays(scan: NoiseScan, datasheet: Params, slow: bool) -> Params:
    """Return the datasheet with what a search leaves as the scan has it: scale errors, and ``slow`` ones of fixes."""
    scale = put(datasheet, SCALE, datasheet.noise.scale * scan.scale)
    return scan.receiver._replace(velocity=1.0).applied(scale) if slow else scale  # the sd of velocities is free


def measured(leaves: Sequence[str], recs: Sequence[Recording]) -> list[str]:
    """Return the leaves without those of measurements that no recording has."""
    streams = {name for rec in recs for name in rec.aiding}
    lacking = {name for name, row in MEASUREMENTS.items() if row.columns and name not in streams}
    return [leaf for leaf in leaves if not (leaf.startswith("measurements.") and leaf.split(".")[1] in lacking)]


def initialized(scan: NoiseScan, used: Used, rec: Recording) -> Params:
    """Return the datasheet with the scan's noise and the delays that are known before a search, per stream.

    The fixes' by the scan, else by the alignment at the start; beyond it the velocity's against positions, in the
    training part.
    """
    params, found = scan.applied(used.datasheet), used.initialization.alignment
    if not scan.fixes and found is not None and abs(found.delay) > KNOWN_DELAY_SIGMAS * found.sd[9]:
        params = put(params, DELAY, params.mounting.time_offset + found.delay)
    early = {name: sample_rows(s, s.t <= used.layout.train) for name, s in rec.aiding.items()}
    late = [f.value for f in velocity(rec._replace(aiding=early)) if f.code == "velocity.latency"]
    if late and "velocity" in params.measurements:
        params = put(params, VELOCITY_DELAY, params.measurements["velocity"].latency + late[0])
    return params


# ---------------------------------------------------------------------------- in words


def table(job: Evidence, flat: jax.Array) -> list[Row]:
    """Return every free number with the 95 % of the tempered posterior, its prior, and a remark."""
    cov = np.linalg.inv(np.asarray(job.inform(flat).fisher))
    sd, far = np.sqrt(np.diag(cov)), np.abs(np.asarray(flat - job.centre)) / job.width
    rows = []
    for r, (at, used) in enumerate(zip(job.places, job.used, strict=True)):
        local = Covariance(cov[np.ix_(at, at)], cov[np.ix_(at, at)], 0)
        for i, row in zip(at, rows_of(job.spec, job.back(flat[at]), local, job.back(job.flat[at])), strict=True):
            if job.owner[i] != r:
                continue
            remark = "the data add nothing to the prior" if sd[i] > 0.9 * job.width[i] else ""
            if far[i] > FAR_SIGMAS:
                remark = f"{far[i]:.1f} sd from the datasheet: {PRIORS[kind_of(job.leaves[job.origin[i]])].far}"
            rows.append(row._replace(name=row.name + (f" of {used.name}" if r else ""), remark=remark))
    return rows
