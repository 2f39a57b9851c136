"""Dead reckoning of wheeled vehicles: constraints with a learned sd against a constant one, on drives not trained on.

Fixes are hidden for 60 s, again and again, in two runs of a recording; the drift is the horizontal distance from the
last hidden fix, after 30 and after 60 s. The filter has positions, constraints of wheels (`window_constraints`) and the
vehicle's axes as states; noise is that of the noise scan. A recording is judged with weights that were trained on the
others: the constant sd alone, and from there on the network over the IMU's samples. Both have the same loss, the mean
log drift after 10 and 20 s in windows of 20 s, and the same steps; the best step is that of windows of 60 s of the same
recordings, so that a network that gains nothing there stays the constant.
"""

import time
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav import initialize, scan_noise
from jaxnav.analysis.tables import table
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build, rows
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import installed
from jaxnav.filters.run import prepare, run
from jaxnav.reading.datasets import load
from jaxnav.reading.read import read
from jaxnav.types import Nav, Params, Recording
from tuning.fit.objectives import log_mean_drift, outage_error
from tuning.fit.optimizers import adam
from tuning.fit.train import fit
from tuning.fit.transforms import IDENTITY, TREE
from tuning.recordings.runs import Run

RECIPES = Path(__file__).parents[2] / "docs" / "recipes"
SOURCES = ("kitti", "husky", "kth_gnss_ins", "rtkexplorer_drive")  # a car, a robot, and two cars
NAMES = ("position", "nonholonomic")
WARM_UP_S, PHASES = 60.0, 2  # before the first window; runs with windows at other times


class Windows(NamedTuple):
    """Hidden windows of a run."""

    length_s: float
    every_s: float  # from the begin of one to the next


TRAIN, JUDGE = Windows(20.0, 36.0), Windows(60.0, 110.0)
LONGEST_S = 360.0  # of a recording that is used
CONSTANT, LEARNED = {"adapter.log_sd": IDENTITY}, {"adapter": TREE}


def recorded(name: str) -> Recording:
    """Return a recording of a recipe or of a known data set."""
    recipe = RECIPES / f"{name}.toml"
    return read(recipe) if recipe.is_file() else load(name)


def filter_of() -> Filter:
    """Return the filter of all recordings."""
    return build("ekf15", NAMES, 10, states=("vehicle_axes",), adapter="window_constraints")


def runs_of(rec: Recording, filt: Filter, *kinds: Windows) -> list[Run]:
    """Return the runs of a recording for each kind of windows; ends are those after half of them and all."""
    params = installed(filt.params("consumer"), rec.lever_arm)
    begin = initialize(rec, params)
    stop = begin.t + LONGEST_S
    seen = rec._replace(aiding={"position": rec.aiding["position"]})
    params = begin.apply_to(scan_noise(seen, params, initialization=begin, stop=stop).applied(params))
    packed = ep.pack_recording(seen, rows(NAMES), begin.t, stop=min(stop, float(rec.imu.t[-1])))
    nav = jax.tree.map(lambda a: a[0], begin.navs)
    fixed = np.asarray(packed.epochs.fix.valid)[:, 0]
    last = packed.t[fixed]
    return [_hidden(filt, params, nav, packed, fixed, kind, float(last[-1]), begin.t + WARM_UP_S) for kind in kinds]


def _hidden(
    filt: Filter, params: Params, nav: Nav, packed: ep.Packed, fixed: np.ndarray, kind: Windows, last: float,
    first: float,
) -> Run:  # fmt: skip
    """Return the runs with hidden windows of one kind, from ``first`` to ``last`` s."""
    out = []
    for phase in np.arange(PHASES) * kind.every_s / PHASES:
        starts = np.arange(first + phase, last - kind.length_s - 5.0, kind.every_s)
        hidden = ((packed.t[:, None] > starts) & (packed.t[:, None] <= starts + kind.length_s)).any(1)
        spans = (0.5 * kind.length_s, kind.length_s)
        at = [np.flatnonzero(fixed & (packed.t <= s + span))[-1] for s in starts for span in spans]
        ends = np.resize(np.array(at, int), 2 * int(LONGEST_S / kind.every_s + 1))
        scored = np.arange(ends.size) < len(at)
        keep = np.ones(packed.t.size, bool)
        epochs = prepare(filt, ep.hide(packed.epochs, hidden, rows(NAMES)))
        out.append(Run(params, nav, epochs, jnp.array(ends), jnp.array(scored), jnp.array(keep), jnp.array(keep)))
    return jax.tree.map(lambda *each: jnp.stack([jnp.asarray(a) for a in each]), *out)


def loss(filt: Filter, params: Params, case: Run) -> jax.Array:
    """Return the mean log drift of a run with the adapter of ``params`` and all else its own."""
    info = run(filt, case.params._replace(adapter=params.adapter), case.nav, case.epochs)
    return jnp.where(info.ok.all(), log_mean_drift(info, case.ends, case.scored), jnp.inf)


@cache
def drifts(filt: Filter):
    """Return the distances (B, W) m of runs by weights, jitted."""

    def one(weights, case: Run):
        info = run(filt, case.params._replace(adapter=weights), case.nav, case.epochs)
        return outage_error(info, case.ends)

    return jax.jit(jax.vmap(one, (None, 0)))


def judged(filt: Filter, params: Params, case: Run) -> np.ndarray:
    """Return the drifts of all windows, (W, 2) m, after 30 and 60 s."""
    found = np.asarray(drifts(filt)(params.adapter, case))
    return found[np.asarray(case.scored)].reshape(-1, 2)


def study(quick: bool, steps: int = 25) -> dict:
    """Return the ratios of the drift at 60 s, learned over constant, of recordings that were not trained on."""
    filt, start = filter_of(), filter_of().params("consumer")
    names = SOURCES[:2] if quick else SOURCES
    short, cases = {}, {}
    for name in names:
        begin = time.perf_counter()
        short[name], cases[name] = runs_of(recorded(name), filt, TRAIN, JUDGE)
        counts = " and ".join(str(int(each[name].scored.sum()) // 2) for each in (short, cases))
        print(f"{name}: {counts} windows, {time.perf_counter() - begin:.0f} s", flush=True)
    table_rows, ratios = [], {}
    for name in names:
        train, validation = ([each[other] for other in names if other != name] for each in (short, cases))
        found, weights = {}, start
        for kind, spec, rate in (("constant", CONSTANT, 0.05), ("learned", LEARNED, 0.01)):
            each = partial(loss, filt)
            weights = fit(
                each, spec, weights, 10 if quick else steps, adam(steps, rate), cases=train, validation=each,
                validation_cases=validation, every=5, progress=True,
            ).params  # fmt: skip
            found[kind] = judged(filt, weights, cases[name])
        paper = judged(filt, start, cases[name])
        median = {kind: np.median(off, 0) for kind, off in (found | {"paper": paper}).items()}
        ratios[name] = float(np.exp(np.mean(np.log(found["learned"][:, 1] / found["constant"][:, 1]))))
        table_rows.append([name, *(f"{median[k][i]:.1f}" for i in (0, 1) for k in ("paper", "constant", "learned")),
                           f"{ratios[name]:.2f}"])  # fmt: skip
        print(table_rows[-1], flush=True)
    heads = ["recording", "30 s: 1 and 3 m/s", "constant", "learned", "60 s: 1 and 3 m/s", "constant", "learned",
             "ratio"]  # fmt: skip
    print(table(heads, table_rows))
    return {"median_ratio": float(np.median(list(ratios.values()))), "ratios": ratios}
