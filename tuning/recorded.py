"""`tune`: a filter's noise, fixes and clocks from a recording without truth, in a way that does no harm.

The recording is split in time: training, validation, and a test that nothing looks at before the end. What is minimised
over the training part is

    J(x) = N (mean negative log-likelihood of an innovation + H(x)) + 1/2 sum ((x - datasheet) / sd)^2

with x the unconstrained numbers (`tuning.priors`). The likelihood is *tempered*: it counts as N observations, the
number of hidden windows that fit into the training part, and not as thousands of epochs, for innovations are not white
where a receiver's errors are not, and then no prior would weigh anything beside them. H is the *horizon likelihood*:
the mean negative log-likelihood of hidden fixes at several ages of hidden windows, by a Student t, a proper score of
what users of a filter care about. Both have an information matrix, so that the method of scoring minimises J.

The search starts from the datasheet and from where the likelihood alone leads while receiver and clock are held; what
it finds competes with the datasheet on training and validation windows, and the datasheet stays unless all is better.
The winner is judged once, on the test.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxnav.analysis.windows import Windows, drift, hidden_windows
from jaxnav.data import epochs as ep
from jaxnav.data.start import Start, heading_bank, start
from jaxnav.filters.compiler import make_room
from jaxnav.filters.core import Filter, Step
from jaxnav.filters.parameters import history_for
from jaxnav.filters.run import prepare, require_x64, run
from jaxnav.measurements import MEASUREMENTS
from jaxnav.types import DataError, Epoch, Nav, Params, Recording
from tuning import scoring
from tuning.priors import PRIORS, in_words, kind_of, spec_of
from tuning.report import LEAST_WINDOWS, Row, in_words_of, shown, text, verdict
from tuning.transforms import Spec, join, labels, split
from tuning.uncertainty import Information, gaussian, pushed
from tuning.validation import PairedGain, paired_gain

REACH = 0.3  # s, of delay that tuning may add to what is known
FREEDOM = 4.0  # of the Student t of hidden fixes
AGES = (0.0, 1 / 3, 2 / 3, 1.0)  # of a window
PHASES = 5  # runs with windows shifted against each other
MOST, TOLERANCE = 25, 0.02  # evaluations of one search; gain in J that is worth another
HELD = ("measurements.position.scale", "mounting.clock_drift")  # while the likelihood alone leads the way
FAR = 2.0  # sd of a prior beyond which a parameter is said to be far
TINY = 1e-4  # of an sd: a parameter that is held
LEAST_LOG_M = 0.1  # m: smaller drifts count as this in mean logarithms


class Layout(NamedTuple):
    """How a recording is used, s."""

    window: float  # length of hidden windows
    every: float  # their spacing in a run
    settle: float  # nothing counts before this long after the start
    train: float  # time at which the training part ends
    validation: float  # and the validation part


class Trial(NamedTuple):
    """A candidate, and how it does against the datasheet."""

    params: Params
    drift: np.ndarray  # (W,) m, horizontal, at the end of each window
    ratios: tuple[float, float, float, float]  # RMS, mean log: training and validation together, validation alone


@dataclass(frozen=True)
class Tuned:
    """What tuning found, and whether it is any better; prints as a table."""

    params: Params  # the winner's: the datasheet's where nothing beats it
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
    standing: ep.Standing = ep.Standing(),
    say: Callable[[str], None] = lambda line: None,
) -> Tuned:
    """Tune ``params`` (such as ``filt.params("consumer")``, the datasheet) on a recording.

    ``free``: groups of `tuning.priors.GROUPS` or dotted leaves. ``widths``: priors of your own by leaf, one sd about
    ``params``: a factor where the parameter is positive, else in SI. ``begin``: `jaxnav.start` with settings of your
    own. ``stop``: s. ``window``: s, length of the hidden windows, by default 3 to 15 by the recording's length. ``say``
    hears of progress.

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
    if filt.keeping:
        filt = filt.keeping(history_for(params, rate, float(np.ptp(rec.imu.t)), REACH))
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
    spec = spec_of(filt, sheet, free, widths)
    job = Job(filt, spec, sheet, nav, epochs, packed, windows, parts["training"], layout)
    found, history = candidates(job, begin, say)
    say("scoring the candidates on hidden windows")
    offs = {name: level_drift(filt, p, nav, epochs, windows, chosen) for name, p in found.items()}
    trials = {
        name: Trial(found[name], off[0], ratios(offs["datasheet"][0], off[0], parts)) for name, off in offs.items()
    }
    best = choose(trials)
    test = parts["test"]
    blocks = np.floor((windows.start[test] - layout.validation) / layout.every)
    gain = None
    if best != "datasheet" and np.unique(blocks).size >= LEAST_WINDOWS and np.isfinite(offs[best][0]).all():
        gain = paired_gain(offs["datasheet"][0][test], offs[best][0][test], blocks)
    nis = {name: channels(off[1], chosen, packed.t > layout.validation) for name, off in offs.items()}
    scores = {name: spread(off[0][test]) for name, off in offs.items()}
    return Tuned(
        trials[best].params, best, verdict(best, trials, scores, parts), table(job, found[shown(best)]), trials, layout,
        windows, {name: int(mask.sum()) for name, mask in parts.items()}, job.effective, gain, scores, nis, begin, spec,
        history,
    )  # fmt: skip


# ---------------------------------------------------------------------------- parts of the recording


def plan(packed: ep.Packed, window: float | None = None) -> Layout:
    """Half of the time for training, 15 % for validation, the rest for the test; windows by the length of it all."""
    span = float(packed.t[-1]) - packed.start
    if window is None:
        window = 15.0 if span >= 300 else 10.0 if span >= 120 else 5.0 if span >= 50 else 3.0
    settle = min(30.0, 0.1 * span)
    begin = packed.start + settle
    left = span - settle
    return Layout(window, 3 * window, settle, begin + 0.5 * left, begin + 0.65 * left)


def parts_of(layout: Layout, windows: Windows) -> dict[str, np.ndarray]:
    """Masks (W,): windows that lie within a part."""
    end = windows.start + layout.window
    return {
        "training": end <= layout.train + ep.TICK,
        "validation": (windows.start >= layout.train - ep.TICK) & (end <= layout.validation + ep.TICK),
        "test": windows.start >= layout.validation - ep.TICK,
    }


def one_start(filt: Filter, params: Params, navs: Nav, epochs: Epoch, t: np.ndarray, until: float) -> Nav:
    """The start; of several the most probable one by the training part's innovations."""
    if navs.t.shape[0] == 1:
        return jax.tree.map(lambda a: a[0], navs)
    train = jax.tree.map(lambda a: a[: int(np.searchsorted(t, until + ep.TICK))], epochs)
    best = int(jax.jit(heading_bank, static_argnums=0)(filt, params, navs, train).best)
    return jax.tree.map(lambda a: a[best], navs)


# ---------------------------------------------------------------------------- what is minimised


class Evidence(NamedTuple):
    """Sums over what the training part shows: value (), score (P,), information (P, P), and of how many."""

    value: jax.Array
    score: jax.Array
    fisher: jax.Array
    number: jax.Array


class Seen(NamedTuple):
    """What is kept of an epoch."""

    nu: jax.Array
    S: jax.Array
    valid: jax.Array
    ok: jax.Array
    residual: jax.Array  # (3,) of the position
    P: jax.Array  # (3, 3) of it


def _keep(step: Step, beside: Any) -> Seen:
    info = step.info
    return Seen(info.nu, info.S, info.valid, info.ok, info.residual[:3], info.P[:3, :3])


@partial(jax.jit, static_argnums=(0, 1))
def _evidence(
    filt: Filter, items: tuple, flat: jax.Array, like: Any, params: Params, nav: Nav, epochs: Epoch, valid: jax.Array,
    keep: jax.Array, at: jax.Array, there: jax.Array, sd: jax.Array,
) -> tuple[Evidence, Evidence]:  # fmt: skip
    """Of innovations and of hidden fixes; valid (P, E, m), keep (P, E), at and there (P, A), sd (P, A, 3)."""
    spec, (_, back) = dict(items), ravel_pytree(like)

    def phase(valid, keep, at, there, sd):
        def outputs(r):
            own = join(spec, back(r), params)
            seen = run(filt, own, nav, epochs._replace(fix=epochs.fix._replace(valid=valid)), _keep)
            scale = own.measurements["position"].scale
            size = jnp.linalg.norm(scale, axis=-1) if jnp.ndim(scale) == 2 else jnp.broadcast_to(scale, (3,))
            R = jax.vmap(jnp.diag)((size * sd) ** 2)
            return (seen.nu, seen.S, seen.residual[at], seen.P[at] + R), (seen.valid, seen.ok)

        ((nu, S, y, C), (seen, ok)), (dnu, dS, dy, dC) = pushed(outputs, flat)
        own = jax.vmap(gaussian, (0, 0, 0, 1, 1))(nu, S, seen, dnu, dS)
        three = jnp.ones((at.size, 3), bool)
        far = jax.vmap(partial(gaussian, freedom=FREEDOM), (0, 0, 0, 1, 1))(y, C, three, dy, dC)
        lost = jnp.where((keep & ~ok).any(), jnp.inf, 0.0)
        counts = keep & seen.any(-1)

        def total(parts, mask):
            value, score, fisher = (jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0).sum(0) for a in parts)
            return Evidence(value, score, fisher, mask.sum())

        innovations = total(own, counts)
        return innovations._replace(value=innovations.value + lost), total(far, there)

    both = jax.vmap(phase)(valid, keep, at, there, sd)
    return jax.tree.map(lambda a: a.sum(0), both)


class Job:
    """The objective of one recording, for a search."""

    def __init__(
        self, filt: Filter, spec: Spec, sheet: Params, nav: Nav, epochs: Epoch, packed: ep.Packed, windows: Windows,
        training: np.ndarray, layout: Layout,
    ):  # fmt: skip
        E = int(np.searchsorted(packed.t, layout.train + ep.TICK))
        chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
        self.filt, self.spec, self.sheet, self.nav = filt, spec, sheet, nav
        self.raw = split(spec, sheet)
        self.flat, self.back = ravel_pytree(self.raw)
        self.items = tuple(spec.items())
        self.epochs = jax.tree.map(lambda a: a[:E], epochs)
        hidden = windows.hidden[:, :E]
        self.valid = jnp.stack([ep.hide(self.epochs, h, chosen).fix.valid for h in hidden])
        self.keep = jnp.asarray((packed.t[:E] >= packed.start + layout.settle) & ~hidden)
        there = np.all(np.asarray(packed.epochs.fix.valid)[:, :2], axis=1)
        self.at, self.there = ages(windows, packed.t, there, training, layout.window)
        self.sd = jnp.asarray(np.asarray(packed.epochs.fix.sd)[:, :3][self.at])
        self.effective = max(1.0, float(layout.train - packed.start - layout.settle) / layout.window)
        self.centre = self.flat
        self.width = np.concatenate([np.full(np.size(self.raw[name]), _width(spec, name)) for name in sorted(spec)])

    def evidence(self, flat: jax.Array) -> tuple[Evidence, Evidence]:
        """Of innovations, of hidden fixes."""
        return _evidence(
            self.filt, self.items, flat, self.raw, self.sheet, self.nav, self.epochs, self.valid, self.keep,
            jnp.asarray(self.at), jnp.asarray(self.there), self.sd,
        )  # fmt: skip

    def objective(self, horizon: bool = True, held: Sequence[str] = ()) -> Callable[[jax.Array], Information]:
        """J and its information, as `tuning.scoring.maximise` takes it."""
        names = [name for name in sorted(self.spec) for _ in range(np.size(self.raw[name]))]
        width = np.where(np.isin(names, held), TINY * self.width, self.width)

        def inform(flat: jax.Array) -> Information:
            parts = self.evidence(flat)[: 2 if horizon else 1]
            mean = [jax.tree.map(lambda a, e=e: a / jnp.maximum(e.number, 1), e) for e in parts]
            off = (flat - self.centre) / width
            value = self.effective * sum(e.value for e in mean) + 0.5 * jnp.sum(off**2)
            score = self.effective * sum(e.score for e in mean) + off / width
            fisher = self.effective * sum(e.fisher for e in mean) + jnp.diag(1 / jnp.asarray(width) ** 2)
            return Information(value, score, fisher, jnp.zeros((1, flat.size)))

        return inform

    def params(self, flat: jax.Array) -> Params:
        """The parameters that unconstrained numbers stand for."""
        return join(self.spec, self.back(flat), self.sheet)


def _width(spec: Spec, name: str) -> float:
    belief = spec[name].belief
    return 1e3 if belief is None else belief.sd


def ages(
    windows: Windows, t: np.ndarray, there: np.ndarray, mask: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Epochs of hidden fixes at `AGES` of each window of a mask, (P, A) int, and which are any, (P, A) bool."""
    rows: list[list[int]] = [[] for _ in windows.hidden]
    for phase, begin in zip(windows.phase[mask], windows.start[mask], strict=True):
        known = np.flatnonzero((t > begin + ep.TICK) & (t <= begin + length + ep.TICK) & there)
        rows[phase] += sorted({int(known[round(a * (known.size - 1))]) for a in AGES})
    most = max(1, max(len(row) for row in rows))
    at = np.array([row + [0] * (most - len(row)) for row in rows])
    return at, np.array([[True] * len(row) + [False] * (most - len(row)) for row in rows])


# ---------------------------------------------------------------------------- candidates


def candidates(
    job: Job, begin: Start, say: Callable[[str], None] = lambda line: None
) -> tuple[dict[str, Params], list[dict]]:
    """The datasheet, what the likelihood alone says with receiver and clock held, and the minimum of J."""
    history: list[dict] = []

    def search(name: str, objective: Callable, first: jax.Array) -> scoring.Search:
        def report(i: int, at: scoring.Search) -> None:
            row = {"search": name, "step": i, "loss": float(at.best.nll)}
            history.append(row)
            say(f"  {name}, evaluation {i}: J {row['loss']:.4f}")

        return scoring.maximise(objective, first, MOST, TOLERANCE, report)

    say(f"free: {', '.join(job.spec)}; compiling (first time, up to a minute; cached from then on)")
    held = search("held", job.objective(horizon=False, held=[h for h in HELD if h in job.spec]), _delayed(job, begin))
    whole = job.objective()
    ends = [search(f"tuned from {name}", whole, first) for name, first in (("held", held.raw), ("datasheet", job.flat))]
    best = min(ends, key=lambda each: float(each.best.nll))
    found = {"datasheet": job.sheet, "held": job.params(held.raw), "tuned": job.params(best.raw)}
    return found, history


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
        log = lambda e: 0.5 * np.log(e**2 + LEAST_LOG_M**2)  # noqa: E731
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
        rows.append(Row(_named(label), value, low, high, before, text, prior.words, remark))
    return rows


def _named(label: str) -> str:
    return label.removeprefix("measurements.").removeprefix("states.").removeprefix("mounting.")
