"""`tune`: a filter's noise, fixes and clocks from a recording without truth, in a way that does no harm.

The recording is split in time: training, validation, and a test that nothing looks at before the end. What is minimised
over the training part is

    J(x) = N (mean negative log-likelihood of an innovation + H(x)) + 1/2 sum ((x - datasheet) / sd)^2

with x the unconstrained numbers (`tuning.priors`). The likelihood is *tempered*: it counts as N observations, the
number of hidden windows that fit into the training part, and not as thousands of epochs, for innovations are not white
where a receiver's errors are not, and then no prior would weigh anything beside them. H is the *horizon likelihood*:
the mean negative log-likelihood of hidden fixes at several ages of hidden windows, by a Student t, a proper score of
what users of a filter care about. Both have an information matrix, so that the method of scoring minimises J.

The search starts from the datasheet and from where the likelihood alone leads while receiver and clock are held. Where
the position's innovations are correlated from fix to fix, as of a receiver whose errors are slow, a filter that
estimates them (`gnss_position_error`) is tuned as well. What is found competes with the datasheet on training and
validation windows, and the datasheet stays unless all is better. The winner is judged once, on the test.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.analysis.windows import Windows, drift, hidden_windows
from jaxnav.data import epochs as ep
from jaxnav.data.start import Start, heading_bank, start
from jaxnav.filters.compiler import make_room
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import history_for
from jaxnav.filters.run import prepare, require_x64
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import DataError, Epoch, Info, Nav, Params, Recording
from tuning import scoring
from tuning.evidence import SLOW, Job
from tuning.parts import Layout, parts_of, plan
from tuning.priors import PRIORS, in_words, kind_of, spec_of
from tuning.report import LEAST_WINDOWS, Row, in_words_of, shown, text, verdict
from tuning.transforms import LOG, Spec, Transform, labels, split
from tuning.validation import PairedGain, paired_gain

REACH = 0.3  # s, of delay that tuning may add to what is known
PHASES = 5  # runs with windows shifted against each other
MOST, TOLERANCE = 25, 0.02  # evaluations of one search; gain in J that is worth another
HELD = ("measurements.position.scale", "mounting.clock_drift")  # while the likelihood alone leads the way
FAR = 2.0  # sd of a prior beyond which a parameter is said to be far
LEAST_LOG_M = 0.1  # m: smaller drifts count as this in mean logarithms
CORRELATED = 0.15  # of a position's innovations from fix to fix, from which on slow errors are tried
SLOW_LEAVES = (f"states.{SLOW}.drive", f"states.{SLOW}.tau")


class Trial(NamedTuple):
    """A candidate, and how it does against the datasheet."""

    filter: Filter
    params: Params
    drift: np.ndarray  # (W,) m, horizontal, at the end of each window
    ratios: tuple[float, float, float, float]  # RMS, mean log: training and validation together, validation alone


@dataclass(frozen=True)
class Tuned:
    """What tuning found, and whether it is any better; prints as a table."""

    params: Params  # the winner's: the datasheet's where nothing beats it
    filter: Filter  # that they are for: the winner may have a state more
    chosen: str  # of `trials`
    verdict: str
    rows: list[Row]  # of the winner; where that is the datasheet, of what was tuned
    trials: dict[str, Trial]
    layout: Layout
    windows: Windows
    counts: dict[str, int]  # of windows by part
    effective: float  # N
    gain: PairedGain | None  # on the test, None where there are too few blocks
    test: dict[str, dict[str, float]]  # by candidate: rms_m, median_m, max_m
    nis: dict[str, dict[str, float]]  # by candidate: normalised innovations squared by channel, on the test
    start: Start
    spec: Spec
    history: list[dict] = field(default_factory=list)
    stopped: bool = False  # by Ctrl-C, with the best that was found until then

    def __str__(self) -> str:
        return text(self)


# ---------------------------------------------------------------------------- the function


def tune(
    rec: Recording,
    filt: Filter,
    params: Params,
    *,
    free: Sequence[str] = ("noise", "fixes", "timing"),
    widths: Mapping[str, float] | None = None,
    begin: Start | None = None,
    stop: float | None = None,
    window: float | None = None,
    priors: bool = True,
    standing: ep.Standing = ep.Standing(),
    say: Callable[[str], None] = lambda line: None,
) -> Tuned:
    """Tune ``params`` (such as ``filt.params("consumer")``, the datasheet) on a recording.

    ``free``: groups of `tuning.priors.GROUPS` or dotted leaves. ``widths``: priors of your own by leaf, one sd about
    ``params``: a factor where the parameter is positive, else in SI. ``begin``: `jaxnav.start` with settings of your
    own. ``stop``: s. ``window``: s, length of the hidden windows, by default 3 to 15 by the recording's length.
    ``priors``: False believes nothing before the data. ``say`` hears of progress.

    Raises:
        DataError: a recording that cannot be started from, or is too short for windows in every part.
        ValueError: the filter stops being finite with ``params``, or an unknown name.
    """
    make_room()
    require_x64(params)
    begin = start(rec, params) if begin is None else begin
    sheet = begin.given(params)
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    packed = ep.pack_recording(rec, chosen, begin.t, 0.0, stop, standing)
    rate = 1 / float(np.median(rec.imu.dt))
    samples = history_for(params, rate, float(np.ptp(rec.imu.t)), REACH)
    kept = lambda each: each.keeping(samples) if each.keeping else each
    filt = kept(filt)
    layout = plan(packed, window)
    windows = hidden_windows(packed, layout.window, layout.every, PHASES, layout.settle)
    parts = parts_of(layout, windows)
    for name, mask in parts.items():
        if not mask.any():
            raise DataError(
                f"{rec.name}: no hidden window of {layout.window:g} s fits into the {name} part of "
                f"{packed.t[-1] - packed.start:.0f} s: it is too short to tune on"
            )
    say(in_words_of(layout, parts, packed))
    epochs = prepare(filt, packed.epochs)
    nav = one_start(filt, sheet, begin.navs, epochs, packed.t, layout.train)
    spec = spec_of(filt, sheet, free, widths, priors)
    job = Job(filt, spec, sheet, nav, epochs, packed, windows, parts["training"], layout)
    say(f"free: {', '.join(spec)}; compiling (first time, up to a minute; cached from then on)")
    history: list[dict] = []
    found, stopped = candidates(job, begin, history, say)
    jobs = dict.fromkeys(found, job)
    say("scoring the candidates on hidden windows")
    score = lambda name: level_drift(jobs[name].filt, found[name], nav, epochs, windows, chosen)
    offs = {name: score(name) for name in found}
    slow = 0.0 if stopped else correlation(offs["tuned"][1], packed, layout)
    if slow > CORRELATED and filt.extended and SLOW not in filt.model.states:
        say(f"position innovations are correlated from fix to fix ({slow:.2f}): trying slow errors of the receiver")
        more = kept(filt.extended(SLOW))
        whole = sheet._replace(states=sheet.states | {SLOW: more.params().states[SLOW]})
        wider = spec | spec_of(more, whole, SLOW_LEAVES, widths, priors)
        other = Job(more, wider, whole, nav, epochs, packed, windows, parts["training"], layout)
        jobs["slow errors"] = other
        first = other.numbers(found["tuned"])
        ended = search("slow errors", other, other.objective(), first, history, say)
        found["slow errors"], stopped = other.params(ended.raw), bool(ended.interrupted)
        offs["slow errors"] = score("slow errors")
    trials = {
        name: Trial(jobs[name].filt, found[name], off[0], ratios(offs["datasheet"][0], off[0], parts))
        for name, off in offs.items()
    }
    best = choose(trials)
    test = parts["test"]
    blocks = np.floor((windows.start[test] - layout.validation) / layout.every)
    gain = None
    if best != "datasheet" and np.unique(blocks).size >= LEAST_WINDOWS and np.isfinite(offs[best][0]).all():
        gain = paired_gain(offs["datasheet"][0][test], offs[best][0][test], blocks)
    nis = {name: channels(off[1], chosen, packed.t > layout.validation) for name, off in offs.items()}
    scores = {name: spread(off[0][test]) for name, off in offs.items()}
    told = shown(best, trials)
    return Tuned(
        trials[best].params, trials[best].filter, best, verdict(best, trials, scores, parts),
        table(jobs[told], found[told]), trials, layout, windows,
        {name: int(mask.sum()) for name, mask in parts.items()}, job.effective, gain, scores, nis, begin,
        jobs[best].spec, history, stopped,
    )  # fmt: skip


# ---------------------------------------------------------------------------- parts of the recording


def one_start(filt: Filter, params: Params, navs: Nav, epochs: Epoch, t: np.ndarray, until: float) -> Nav:
    """The start; of several the most probable one by the training part's innovations."""
    if navs.t.shape[0] == 1:
        return jax.tree.map(lambda a: a[0], navs)
    train = jax.tree.map(lambda a: a[: int(np.searchsorted(t, until + ep.TICK))], epochs)
    best = int(jax.jit(heading_bank, static_argnums=0)(filt, params, navs, train).best)
    return jax.tree.map(lambda a: a[best], navs)


# ---------------------------------------------------------------------------- candidates


def search(
    name: str, job: Job, objective: Callable, first: jax.Array, history: list[dict], say: Callable[[str], None]
) -> scoring.Search:
    """Minimise an objective from a point, with a line and a row of the history for each evaluation."""

    def report(i: int, at: scoring.Search) -> None:
        row = {"search": name, "step": i, "loss": float(at.best.nll)}
        history.append(row)
        say(f"  {name}, evaluation {i}: J {row['loss']:.4f}")

    say(f"{name}: {len(job.flat)} numbers free")
    return scoring.maximise(objective, first, MOST, TOLERANCE, report)


def candidates(
    job: Job, begin: Start, history: list[dict], say: Callable[[str], None]
) -> tuple[dict[str, Params], bool]:
    """The datasheet, what the likelihood alone says with receiver and clock held, and the minimum of J.

    And whether Ctrl-C ended it; then what was not begun is left out.
    """
    alone, whole = job.objective(horizon=False, held=[h for h in HELD if h in job.spec]), job.objective()
    held = search("held", job, alone, _delayed(job, begin), history, say)
    found, ends, stopped = {"datasheet": job.sheet, "held": job.params(held.raw)}, [], bool(held.interrupted)
    for name, first in (("held", held.raw), ("datasheet", job.flat)):
        if not stopped:
            ends.append(search(f"tuned from {name}", job, whole, first, history, say))
            stopped = bool(ends[-1].interrupted)
    if ends:
        found["tuned"] = job.params(min(ends, key=lambda each: float(each.best.nll)).raw)
    return found, stopped


def correlation(info: Info, packed: ep.Packed, layout: Layout) -> float:
    """Of the position's normalised innovations from one fix to the next, before the test part; 0 of fewer than 30.

    ``info`` (P, E, ...); a hidden window between two fixes keeps them apart.
    """
    z = np.asarray(info.nu)[..., :3] / np.sqrt(np.diagonal(np.asarray(info.S), axis1=-2, axis2=-1)[..., :3])
    product, square, count = 0.0, 0.0, 0
    for used, row in zip(np.asarray(info.valid)[..., :3], z, strict=True):
        at = np.flatnonzero(used.all(1) & (packed.t > packed.start + layout.settle) & (packed.t < layout.validation))
        apart = np.diff(packed.t[at])
        near = apart < 1.5 * np.median(apart) if apart.size else np.zeros(0, bool)
        a, b = row[at[:-1]][near], row[at[1:]][near]
        product, square, count = product + (a * b).sum(), square + 0.5 * (a**2 + b**2).sum(), count + near.sum()
    return float(product / square) if count >= 30 else 0.0


def _delayed(job: Job, begin: Start) -> jax.Array:
    """The datasheet's numbers, with the delay that the start saw where the clock is free."""
    found = begin.alignment
    if found is None or "mounting.time_offset" not in job.spec or abs(found.delay) < 3 * found.sd[9]:
        return job.flat
    step = job.spec["mounting.time_offset"].inverse(jnp.asarray(found.delay))
    return ravel_pytree(job.raw | {"mounting.time_offset": job.raw["mounting.time_offset"] + step})[0]


def level_drift(
    filt: Filter, params: Params, nav: Nav, epochs: Epoch, windows: Windows, measurements: tuple
) -> tuple[np.ndarray, Any]:
    """Horizontal drift (W,) m at the windows' ends, and the runs."""
    error, info = drift(filt, params, nav, epochs, windows, measurements)
    return np.hypot(error[:, 0], error[:, 1]), info


def ratios(before: np.ndarray, after: np.ndarray, parts: Mapping[str, np.ndarray]) -> tuple[float, float, float, float]:
    """Drift against the datasheet's, RMS and mean log: on training and validation windows, on validation windows."""
    out = []
    for mask in (parts["training"] | parts["validation"], parts["validation"]):
        a, b = before[mask], after[mask]
        out.append(float(np.sqrt(np.mean(b**2) / np.mean(a**2))))
        log = lambda e: 0.5 * np.log(e**2 + LEAST_LOG_M**2)
        out.append(float(np.exp(np.mean(log(b) - log(a)))))
    return out[0], out[1], out[2], out[3]


def choose(trials: Mapping[str, Trial]) -> str:
    """The candidate that beats the datasheet in all four ways, by the most; else the datasheet."""
    passed = {name: float(np.mean(np.log(t.ratios))) for name, t in trials.items() if max(t.ratios) < 1.0}
    return min(passed, key=lambda name: passed[name]) if passed else "datasheet"


def spread(off: np.ndarray) -> dict[str, float]:
    """Figures of drifts (W,) m."""
    return {"rms_m": float(np.sqrt(np.mean(off**2))), "median_m": float(np.median(off)), "max_m": float(off.max())}


def channels(info: Any, measurements: tuple, part: np.ndarray) -> dict[str, float]:
    """Normalised innovations squared of every channel over all runs, in a part (E,) of the time."""
    used = np.asarray(info.valid) & part[:, None]
    square = np.asarray(info.nu) ** 2 / np.diagonal(np.asarray(info.S), axis1=-2, axis2=-1)
    names = [f"{m.name} {axis}" for m in measurements for axis in m.channels]
    return {n: float(square[..., i][used[..., i]].mean()) for i, n in enumerate(names) if used[..., i].any()}


# ---------------------------------------------------------------------------- in words


def table(job: Job, params: Params) -> list[Row]:
    """Every free number with the 95 % of the tempered posterior, its prior, and a remark."""
    raw = split(job.spec, params)
    flat, _ = ravel_pytree(raw)
    info = job.objective()(flat)
    sd = np.sqrt(np.diag(np.linalg.inv(np.asarray(info.fisher))))
    far = np.abs(np.asarray(flat - job.centre)) / job.width
    names, rows = labels(job.spec, raw), []
    sizes = [(name, i) for name in sorted(job.spec) for i in range(np.size(raw[name]))]
    for label, (name, _), x, s, w, f, x0 in zip(names, sizes, flat, sd, job.width, far, job.flat, strict=True):
        transform, (unit, text) = job.spec[name], in_words(name)
        value, low, high, before = (float(transform.forward(x + d)) / unit for d in (0.0, -1.96 * s, 1.96 * s, x0 - x))
        prior = PRIORS[kind_of(name)]
        remark = "the data add nothing to the prior" if s > 0.9 * w else ""
        if f > FAR:
            remark = f"{f:.1f} sd from the datasheet: {prior.far}"
        rows.append(Row(_named(label), value, low, high, before, text, prior_in_words(transform, unit, text), remark))
    return rows


def prior_in_words(transform: Transform, unit: float, text: str) -> str:
    """A prior in words: how far one sd is."""
    if transform.belief is None:
        return "none"
    if transform.forward is LOG.forward:
        return f"within a factor {math.exp(transform.belief.sd):.3g}"
    return f"within {float(transform.forward(jnp.asarray(transform.belief.sd))) / unit:.3g} {text}".rstrip()


def _named(label: str) -> str:
    return label.removeprefix("measurements.").removeprefix("states.").removeprefix("mounting.")
