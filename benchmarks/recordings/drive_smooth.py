"""The smoother inside of hidden windows of the real drive, by the protocol of `benchmarks.recordings.drive`.

Of every window the largest horizontal distance to the fixes hidden in it counts, 15 s windows in nine phases and, in
phases of 10 s, 45 s windows every 90 s. Parameters are tuned on stretches that do not touch the window's block.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.recordings import drive
from jaxnav.filters import epochs
from jaxnav.filters.core import Filter
from jaxnav.filters.smoother import smooth
from jaxnav.types import Epoch, Nav, Params

WINDOWS = {"15": (15.0, 45.0, np.arange(0.0, 45.0, 5.0)), "45": (45.0, 90.0, np.arange(0.0, 90.0, 10.0))}  # s


@partial(jax.jit, static_argnums=0)
def inside(filt: Filter, params: Params, nav: Nav, data: Epoch, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Residuals of the smoothed positions (E, 3) m ENU and their covariance with the fix's (E, 3, 3)."""
    found = smooth(filt, params, nav, drive.with_valid(data, valid))[1]
    noise = jax.vmap(jnp.diag)((params.measurements["position"].scale * data.fix.sd[:, :3]) ** 2)
    return found.residual[:, :3], found.P[:, :3, :3] + noise


def scores(data: drive.Data, constraints: bool, by_block: dict[int, Params], last_fix: float) -> dict[str, dict]:
    """By length of the windows: RMS and median over them of the largest error inside, NEES in the middle."""
    chosen, there = drive.measurements(constraints), np.asarray(data.epochs.fix.valid)[:, :2].all(1)
    found = {}
    for name, (length, every, phases) in WINDOWS.items():
        largest, nees = [], []
        for offset in phases:
            starts = drive.window_starts(last_fix, offset, length, every)
            hidden, _ = epochs.outage_windows(data.t, starts, length)
            valid = epochs.hide(data.epochs, hidden, chosen).fix.valid
            block = np.searchsorted(drive.BLOCKS, starts + length / 2)
            for b in np.unique(block):
                args = by_block.get(b, by_block[0]), data.nav, data.epochs, valid
                residual, C = map(np.asarray, inside(data.filt, *args))
                for start in starts[block == b]:
                    own = np.flatnonzero(epochs.within(data.t, [(start, start + length)]) & there)
                    largest.append(np.hypot(*residual[own, :2].T).max())
                    middle = own[np.argmin(np.abs(data.t[own] - start - length / 2))]
                    level = residual[middle, :2]
                    nees.append(level @ np.linalg.solve(C[middle, :2, :2], level) / 2)
        found[name] = {
            "max_in_window_rms_m": float(np.sqrt(np.mean(np.square(largest)))),
            "median_m": float(np.median(largest)), "nees_mid": float(np.mean(nees)), "windows": len(largest),
        }  # fmt: skip
    return found


def study(steps: int) -> dict:
    """Datasheet and tuned, with the wheels' constraint and without."""
    rec = drive.recording()
    last_fix, found = float(rec.aiding["position"].t[-1]), {}
    for suffix, constraints in (("", False), ("_constraints", True)):
        data = drive.cut(rec, constraints, drive.START)
        found["datasheet" + suffix] = scores(data, constraints, {0: drive.parameters()}, last_fix)
        tuned = drive.tune(rec, constraints, steps, list(range(drive.PIECES.size)), "likelihood")
        found["tuned" + suffix] = scores(data, constraints, tuned, last_fix)
        print(*(f"{k}: {v}" for k, v in found.items() if k.endswith(suffix)), sep="\n", flush=True)
    return found
