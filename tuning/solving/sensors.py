"""Choice of measurements in addition to the receiver's: those that the recording supports and that predict better."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxnav.analysis.noise_scan import MAX_HARM_RATIO
from jaxnav.checkup.support import Option
from jaxnav.filters.catalogue import changed, rows, with_states
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import get, has, put, without_states
from jaxnav.filters.scores import squares
from jaxnav.filters.standstill import Standing
from jaxnav.findings import finding
from jaxnav.maths.units import DEG, TICK
from jaxnav.measurements import GNSS, MEASUREMENTS, layout
from jaxnav.types import Finding, Params
from tuning.recordings.experiment import Experiment, Scored
from tuning.recordings.parts import blocks_of
from tuning.recordings.validation import block_ratio, drifts_less

SDS = (1.0, 3.0, 10.0)  # times the stated sd, that a measurement is tried with: its errors last, those of noise do not
MAX_GROWTH = 1.5  # of an sd, that innovations may ask for beyond those that are taken
MIN_NIS, ROUNDS = 1.2, 2  # NIS of a measurement's channels from which on its sd grows, in so many rounds
MAX_YAW_SCATTER_DEG = 5.0  # of an IMU whose x axis is the vehicle's


RECEIVER = {m.name for m in GNSS}


class Choice(NamedTuple):
    """The filter with the taken measurements."""

    filter: Filter
    tried: list["Tried"]
    factors: dict[str, float]  # on sd of measurements, by leaf, where the recording asks for larger ones

    def applied(self, params: Params) -> Params:
        """Return parameters with these sd."""
        return larger(params, self.factors)


class Tried(NamedTuple):
    """An option, and what it did."""

    option: Option
    drift_ratio: float  # horizontal, on training and validation windows, over that without it
    gain: float  # log-likelihood of a hidden fix of the validation part
    taken: bool
    sd: float = 1.0  # times that stated, of its measurements


def standing_of(found: Sequence[Finding]) -> Standing:
    """Return the detector of standstills that a check found, else the usual one."""
    by = {f.code: float(f.value) for f in found if not f.warns and f.value is not None}
    plain = Standing()
    return plain._replace(
        accel_sd=by.get("standstill.accel", plain.accel_sd),
        gyro_sd=by["standstill.gyro"] * DEG if "standstill.gyro" in by else plain.gyro_sd,
    )


def choose_measurements(
    experiment: Experiment,
    plain: Scored,
    params_of: Callable[[Filter], Params],
    tried: Sequence[Option],
    begin: Callable[[], None] = lambda: None,
) -> Choice:
    """Add measurements one after the other, each if it predicts better than without it.

    All are tried in one filter, so that they share its program: those that are not are channels without a fix and
    states of sd 0, which change nothing.

    Each is tried with its sd as stated and three and ten times as large, and with larger ones yet where innovations ask
    for them (`growth`): errors of wheels, constraints and pressures last for seconds, so that a filter that takes them
    for noise trusts them too much. The training and the validation windows decide: no more horizontal drift, less drift
    in three dimensions by more than chance, and a higher likelihood of the hidden fixes of the validation part.

    Args:
        experiment: the recording and its windows.
        plain: the filter without them.
        params_of: parameters of a filter, such as the datasheet with the scan's noise.
        tried: in their order.
        begin: called before each.

    Returns:
        The filter with the taken ones, what each did, and the factors on sd.
    """
    whole = filt = plain.filter
    for option in tried:
        whole = extended(whole, option)
    best, done, factors, params = plain, list[Tried](), dict[str, float](), params_of(whole)
    for option in tried:
        begin()
        more = extended(filt, option)
        run = partial(experiment.scores, whole, sees=more.model.measurements)
        own = factors | dict(option.factors)
        new, own, row = _tried(option, best, run, without_states(params, more.model.states), own)
        done.append(row)
        if row.taken:
            best, filt, factors = new, more, own
    return Choice(filt, done, factors)


def extended(filt: Filter, option: Option) -> Filter:
    """Return a filter with the measurements and states of an option."""
    names = {*filt.model.measurements, *option.measurements}
    filt = changed(filt, measurements=tuple(name for name in MEASUREMENTS if name in names))
    return with_states(filt, *option.states)


def _tried(
    option: Option,
    before: Scored,
    run: Callable[[list[Params]], list[Scored]],
    params: Params,
    own: dict[str, float],
) -> tuple[Scored, dict[str, float], Tried]:
    """Return the likeliest run with an option of those that are taken, else of all, its factors, and what it did."""
    leaves = [sd_leaf(params, name) for name in option.measurements]
    for _ in range(1 + ROUNDS):
        each = [own | {leaf: k * own.get(leaf, 1.0) for leaf in leaves} for k in (SDS if leaves else SDS[:1])]
        runs = run([larger(params, factors) for factors in each])
        times = [factors[leaves[0]] if leaves else 1.0 for factors in each]
        done = [compare(option, before, after)._replace(sd=sd) for after, sd in zip(runs, times, strict=True)]
        ways = list(zip(runs, each, done, strict=True))
        more = [growth(after) for after in runs]
        fair = [way for way, asked in zip(ways, more, strict=True) if max([1.0, *asked.values()]) < MAX_GROWTH]
        if fair:
            break
        own = {leaf: each[-1].get(leaf, 1.0) * more[-1].get(leaf, 1.0) for leaf in {*each[-1], *more[-1]}}
    fair = fair or ways[-1:]
    good = [way for way in fair if way[2].taken] or fair
    return min(good, key=lambda way: float(way[0].hidden("training", "validation").nll().mean()))


def sd_leaf(params: Params, name: str) -> str:
    """Return the leaf that the sd of a measurement grow by."""
    ends = ("scale",) if name in RECEIVER else ("sd_scale", "sd")
    return next(leaf for end in ends if has(params, leaf := f"measurements.{name}.{end}"))


def larger(params: Params, factors: dict[str, float]) -> Params:
    """Return parameters with leaves multiplied by factors."""
    for leaf, factor in factors.items():
        params = put(params, leaf, factor * get(params, leaf))
    return params


def growth(run: Scored) -> dict[str, float]:
    """Return the factors on the sd of measurements, by leaf, that innovations of the training part ask for.

    A measurement that is new shows errors of the others too: each has its own factor, and none is below one.

    Args:
        run: the filter with all measurements.
    """
    used, info, found = run.used, run.info, dict[str, float]()
    places = layout(rows(run.filter.model.measurements))
    counts = (used.t <= used.layout.train) & ~used.windows.hidden
    square = squares(info)[counts]
    for name, place in places.items():
        own = square[:, place][np.isfinite(square[:, place])]
        nis = float(own.mean()) if own.size else 0.0
        if nis > MIN_NIS:
            found[sd_leaf(run.params, name)] = nis**0.5
    return found


def compare(option: Option, before: Scored, after: Scored) -> Tried:
    """Return whether the runs with an option predict better than those without it.

    Only windows in which its measurements are used can show a gain: a constraint at rest has none on the way.
    """
    parts = before.used.parts
    seen, blocks = parts["training"] | parts["validation"], blocks_of([before.used])
    space = lambda s, at: np.linalg.norm(s.error[at], axis=1)
    used = seen & measured(option, after)
    level = block_ratio(before.horizontal[seen], after.horizontal[seen], blocks[seen])
    nll = [float(s.hidden("validation").nll().mean()) for s in (before, after)]
    taken = False
    if used.any() and level.ratio < MAX_HARM_RATIO and nll[1] < nll[0]:
        taken = drifts_less(space(before, used), space(after, used), blocks[used])
    return Tried(option, level.ratio, nll[0] - nll[1], taken and bool(np.isfinite(after.error[seen]).all()))


def measured(option: Option, run: Scored) -> np.ndarray:
    """Return the windows (W,) in which an option's measurements are used; all of one that has none."""
    windows, length = run.used.windows, run.used.layout.window
    if not option.measurements:
        return np.ones(windows.start.size, bool)
    places = layout(rows(run.filter.model.measurements))
    valid = np.asarray(run.info.valid)
    there = np.any([valid[..., places[name]].any(-1) for name in option.measurements], 0)
    begin, end = (np.searchsorted(run.used.t, x + TICK) for x in (windows.start, windows.start + length))
    total = np.pad(np.cumsum(there, 1), ((0, 0), (1, 0)))
    return np.asarray(total[windows.phase, end] > total[windows.phase, begin])


def finding_of(row: Tried) -> Finding:
    """Return the finding of an option."""
    name = " and ".join(row.option.names)
    code = "solve.measurement" if row.taken else "solve.left_out"
    times = "" if row.sd == 1.0 else f" with {row.sd:.2g} times its sd"
    return finding(code, name, row.drift_ratio, gain=row.gain, times=times)
