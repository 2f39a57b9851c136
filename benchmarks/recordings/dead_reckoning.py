"""Dead reckoning of wheeled vehicles: constraints with a learned sd against a constant one, on drives not trained on.

Fixes are hidden for 60 s, again and again, in two runs of a recording; the drift is the horizontal distance from the
last hidden fix, after 30 and after 60 s. The filter has positions, constraints of wheels (`window_constraints`) and the
vehicle's axes as states; noise is that of the noise scan. A recording is judged with weights that were trained on the
others: the constant sd alone, or with the network over the IMU's samples. Both have the same loss, the mean log drift,
and the same steps.
"""

import time
from functools import cache, partial
from pathlib import Path

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
from jaxnav.io.datasets import load
from jaxnav.io.read import read
from jaxnav.types import Params, Recording
from tuning.fit.objectives import log_mean_drift, outage_error
from tuning.fit.optimizers import adam
from tuning.fit.train import fit
from tuning.fit.transforms import IDENTITY, TREE
from tuning.recordings.runs import Run

RECIPES = Path(__file__).parents[2] / "docs" / "recipes"
SOURCES = ("kitti", "husky", "kth_gnss_ins", "rtkexplorer_drive")  # a car, a robot, and two cars
NAMES = ("position", "nonholonomic")
WINDOW_S, EVERY_S, WARM_UP_S = 60.0, 110.0, 60.0  # of hidden fixes; from one to the next; before the first
PHASES_S, HALF_S = (0.0, 55.0), 30.0
LONGEST_S = 360.0  # of a recording that is used
CONSTANT, LEARNED = {"adapter.log_sd": IDENTITY}, {"adapter": TREE}


def recorded(name: str) -> Recording:
    """Return a recording of a recipe or of a known data set."""
    recipe = RECIPES / f"{name}.toml"
    return read(recipe) if recipe.is_file() else load(name)


def filter_of() -> Filter:
    """Return the filter of all recordings."""
    return build("ekf15", NAMES, 10, states=("vehicle_axes",), adapter="window_constraints")


def runs_of(rec: Recording, filt: Filter) -> Run:
    """Return two runs of a recording with hidden windows at other times; ends are those after 30 and 60 s."""
    params = installed(filt.params("consumer"), rec.lever_arm)
    begin = initialize(rec, params)
    stop = begin.t + LONGEST_S
    seen = rec._replace(aiding={"position": rec.aiding["position"]})
    params = begin.apply_to(scan_noise(seen, params, initialization=begin, stop=stop).applied(params))
    packed = ep.pack_recording(seen, rows(NAMES), begin.t, stop=min(stop, float(rec.imu.t[-1])))
    nav = jax.tree.map(lambda a: a[0], begin.navs)
    fixed = np.asarray(packed.epochs.fix.valid)[:, 0]
    last = packed.t[fixed]
    out = []
    for phase in PHASES_S:
        starts = np.arange(begin.t + WARM_UP_S + phase, last[-1] - WINDOW_S - 5.0, EVERY_S)
        hidden = ((packed.t[:, None] > starts) & (packed.t[:, None] <= starts + WINDOW_S)).any(1)
        at = [np.flatnonzero(fixed & (packed.t <= s + span))[-1] for s in starts for span in (HALF_S, WINDOW_S)]
        ends = np.resize(np.array(at, int), 2 * int(LONGEST_S / EVERY_S + 1))
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
    cases = {}
    for name in names:
        begin = time.perf_counter()
        cases[name] = runs_of(recorded(name), filt)
        print(f"{name}: {int(cases[name].scored.sum()) // 2} windows, {time.perf_counter() - begin:.0f} s", flush=True)
    table_rows, ratios = [], {}
    for name in names:
        others, found = [cases[other] for other in names if other != name], {}
        for kind, spec in (("constant", CONSTANT), ("learned", LEARNED)):
            fitted = fit(
                partial(loss, filt), spec, start, 10 if quick else steps, adam(steps, 0.03), cases=others, progress=True
            )
            found[kind] = judged(filt, fitted.params, cases[name])
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
