"""Choice of measurements in addition to the receiver's: those that the recording supports and that predict better."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.checkup.findings import finding
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.filters.standstill import Standing
from jaxnav.maths.units import DEG
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import Finding, Params, Recording
from tuning.recordings.choice import MIN_BLOCKS
from tuning.recordings.parts import blocks_of
from tuning.recordings.validation import block_ratio
from tuning.solving.hidden import COV_STRIDE, Bench, Scored

MAX_RATIO = 1.02  # of the horizontal drift on training and validation windows, up to which a measurement does no harm
MAX_YAW_DEG, MAX_YAW_SCATTER_DEG = 10.0, 5.0  # deg, of an IMU whose x axis is the vehicle's


class Option(NamedTuple):
    """Measurements that are tried together."""

    measurements: tuple[str, ...]
    states: tuple[str, ...] = ()


class Tried(NamedTuple):
    """An option, and what it did."""

    option: Option
    drift_ratio: float  # horizontal, on training and validation windows, over that without it
    gain: float  # log-likelihood of a hidden fix of the validation part
    taken: bool


def options(rec: Recording, found: Sequence[Finding]) -> list[Option]:
    """Return the measurements that a recording supports, in the order in which they are tried.

    Args:
        rec: the recording.
        found: findings of its check.
    """
    by, good = {f.code: f for f in found}, {f.code for f in found if not f.warns}
    tried = []
    if "speed" in rec.aiding:
        tried.append(Option(("speed",)))
    yaw = by.get("mounting.yaw")
    if yaw is not None and abs(yaw.value or 0.0) < MAX_YAW_DEG:
        tried.append(Option(("nonholonomic",)))
    if "standstill.accel" in good:
        tried.append(Option(("zero_velocity", "zero_rate")))
    if "barometer" in good:
        tried.append(Option(("barometer",), ("barometer_bias",)))
    if "magnetometer" in rec.aiding and good >= {"compass", "compass.turns"}:
        tried.append(Option(("magnetometer",), ("magnetometer_bias",)))
    return tried


def standing_of(found: Sequence[Finding]) -> Standing:
    """Return the detector of standstills that a check found, else the usual one."""
    by = {f.code: float(f.value) for f in found if not f.warns and f.value is not None}
    plain = Standing()
    return plain._replace(
        accel_sd=by.get("standstill.accel", plain.accel_sd),
        gyro_sd=by["standstill.gyro"] * DEG if "standstill.gyro" in by else plain.gyro_sd,
    )


def choose(
    bench: Bench, plain: Scored, params_of: Callable[[Filter], Params], tried: Sequence[Option],
    log: Callable[[str], None],
) -> tuple[Scored, list[Tried]]:  # fmt: skip
    """Add measurements one after the other, each if it predicts better than without it.

    The training and the validation windows decide: no more horizontal drift, less drift in three dimensions by more
    than chance, and a higher likelihood of the hidden fixes of the validation part.

    Args:
        bench: the recording and its windows.
        plain: the filter without them.
        params_of: parameters of a filter, such as the datasheet with the scan's noise.
        tried: in their order.
        log: called with a line on each.

    Returns:
        The filter with the taken ones, scored, and what each did.
    """
    best, done = plain, []
    for option in tried:
        names = {*best.filter.model.measurements, *option.measurements}
        filt = build(best.filter.name, [name for name in MEASUREMENTS if name in names], COV_STRIDE)
        more = [s for s in (*best.filter.model.states, *option.states) if s not in filt.model.states]
        if more and filt.with_states is not None:
            filt = filt.with_states(*more)
        new = bench.score(filt, params_of(filt))
        row = compare(option, best, new)
        done.append(row)
        log(f"{', '.join(option.measurements)}: drift {row.drift_ratio:.2f}, {'taken' if row.taken else 'left out'}")
        best = new if row.taken else best
    return best, done


def compare(option: Option, before: Scored, after: Scored) -> Tried:
    """Return whether the runs with an option predict better than those without it."""
    parts = before.used.parts
    seen, blocks = parts["training"] | parts["validation"], blocks_of([before.used])
    horizontal, space = (
        block_ratio(norm(before), norm(after), blocks[seen])
        for norm in (lambda s: s.horizontal[seen], lambda s: np.linalg.norm(s.error[seen], axis=1))
    )
    nll = [float(s.hidden("validation").nll().mean()) for s in (before, after)]
    clear = space.high < 1.0 if np.unique(blocks[seen]).size >= MIN_BLOCKS else space.ratio < 0.8
    taken = bool(np.isfinite(after.error[seen]).all() and horizontal.ratio < MAX_RATIO and clear and nll[1] < nll[0])
    return Tried(option, horizontal.ratio, nll[0] - nll[1], taken)


def finding_of(row: Tried) -> Finding:
    """Return the finding of an option."""
    name = " and ".join(row.option.measurements)
    code = "solve.measurement" if row.taken else "solve.left_out"
    return finding(code, name, row.drift_ratio, gain=row.gain)
