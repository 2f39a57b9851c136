"""Claims of the GIP-KF paper beyond its table: observability, stability, errors after outages, Figures 7 to 10."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.papers import gipkf_study as study
from benchmarks.papers import stability
from benchmarks.papers.gipkf_figures import angles
from jaxnav.analysis import metrics
from jaxnav.analysis.plots import base as plots
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run
from jaxnav.maths import rotations, units
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.trajectories import Circle, shape_of
from jaxnav.types import Epoch, Info, Nav, Params

# of the largest singular value, below which one counts as zero, in units that make P0 one: usable for a filter, and
# not zero by rounding, such as through the Earth's rate
USABLE, ROUNDING = 1e-4, 1e-10
AGAIN = 2.0  # times the error before the outage, below which it has converged again


@partial(jax.jit, static_argnums=0)
def _transitions(filt: Filter, params: Params, nav: Nav, epochs: Epoch) -> jax.Array:
    """Phi (E, n, n) of every epoch."""
    return run(filt, params, nav, epochs, lambda step, _: step.transition.Phi, epochs)


def ranks(filt: Filter, params: Params, drives: study.Drives, span: int = 60) -> dict[str, dict[str, int]]:
    """Ranks of the observability matrices over ``span`` s of a drive at rest and in motion.

    ``state``: x by the F of eq. 22 and the H of eq. 26. ``input``: x with a constant unknown input m of eq. 23.
    """
    one = jax.tree.map(lambda a: a[0], drives)
    Phi = np.asarray(_transitions(filt, params, one.initial, one.epochs))
    n = filt.model.n_states
    scale = np.sqrt(np.diag(np.asarray(filt.model.covariance(params, filt.model.enter(one.initial)))))
    H = np.eye(6, n)
    speed = np.linalg.norm(np.asarray(one.truth.vel), axis=1)
    moves = int(np.argmax(speed > 1.0))
    found = {}
    for name, first in (("at rest", 0), ("in motion", moves)):
        last = first + (min(span, moves) if name == "at rest" else span)
        rows, more = [], []
        W, V = np.eye(n), np.zeros((n, n))  # d x(k) / d x(0), d x(k) / d m
        for k in range(first, last):
            rows.append(H @ W)
            more.append(np.hstack([H @ W, H @ V]))
            W, V = Phi[k] @ W, Phi[k] @ V + np.eye(n)
        D = np.diag(scale)
        found[name] = {
            "state": rank(np.vstack(rows) @ D, H @ D, USABLE),
            "state_of": n,
            "input": rank(np.vstack(more) @ np.kron(np.eye(2), D), H @ D, USABLE),
            "input_by_rounding": rank(np.vstack(more) @ np.kron(np.eye(2), D), H @ D, ROUNDING),
            "input_of": 2 * n,
        }
    return found


def rank(M: np.ndarray, unit: np.ndarray, least: float) -> int:
    """How many directions ``M`` sees by more than ``least`` of the best, its rows in units of the rows of ``unit``."""
    rows = np.linalg.norm(unit, axis=1)
    M = M / np.tile(np.where(rows > 0, rows, 1.0), M.shape[0] // rows.size)[:, None]
    values = np.linalg.svd(M, compute_uv=False)
    return int(np.sum(values > least * values[0]))


def growth(filters: dict[str, tuple[Filter, Params]]) -> dict[str, float]:
    """Rate at which a small error grows on a circle with fixes of 1 Hz, 1/s; negative is stable."""
    circle = Circle(10.0, 126.0)
    shape = shape_of(jax.random.key(0), circle, 126.0)
    lat, lon, h = SCENARIOS["gipkf_urban"].start_deg_m
    navs, epochs = stability.perfect(shape, [lat * units.DEG, lon * units.DEG, h], round(circle.period_s))
    return {name: stability.growth_rate(filt, params, navs, epochs) for name, (filt, params) in filters.items()}


@partial(jax.jit, static_argnums=0)
def _around(filt: Filter, params: Params, drives: study.Drives, windows: jax.Array):
    """Horizontal error (B, E) m, and attitude's (B, E, 3) rad about E, N and U, and each's last."""

    def one(initial: Nav, epochs: Any, truth: Nav, windows: jax.Array):
        epochs, _, last = study.hide(epochs, truth.t, windows)
        info = run(filt, params, initial, epochs)
        phi = jax.vmap(lambda a, b: rotations.log(rotations.multiply(a, rotations.conjugate(b))))(info.nav.q, truth.q)
        error = jax.vmap(metrics.position_error)(info.nav, truth.pos)
        return jnp.hypot(error[:, 0], error[:, 1]), phi, last

    return jax.vmap(one)(*drives, windows)


def around(filt: Filter, params: Params, drives: study.Drives, windows: jax.Array) -> dict[str, list[float]]:
    """By outage: attitude before it and at its end, and how long the fixes then take to bring the position back.

    Back: within `AGAIN` times the RMS over all drives of the half minute before the outage; a run that is not back
    when the next outage begins counts as that long.
    """
    error, phi, last = (np.asarray(a) for a in _around(filt, params, drives, windows))
    out: dict[str, list[float]] = {"tilt_before_deg": [], "tilt_end_deg": [], "heading_before_deg": [],
                                   "heading_end_deg": [], "again_median_s": [], "again_p90_s": []}  # fmt: skip
    for i, length in enumerate(study.LENGTHS):
        end, begin = last[:, i], last[:, i] - int(length)
        pick = lambda a, k: a[np.arange(len(a)), k]
        for name, at in (("before", begin), ("end", end)):
            angle = pick(phi, at) / units.DEG
            up = 2  # attitude errors are in ENU
            out[f"heading_{name}_deg"].append(float(metrics.rms(angle[:, up])))
            out[f"tilt_{name}_deg"].append(float(np.sqrt(np.mean(np.sum(angle[:, :2] ** 2, 1)))))
        calm = AGAIN * metrics.rms(np.concatenate([error[b, k - 30 : k] for b, k in enumerate(begin)]))
        times = []
        for b, k in enumerate(end):
            stop = last[b, i + 1] - int(study.LENGTHS[i + 1]) if i + 1 < last.shape[1] else error.shape[1]
            within = error[b, k + 1 : stop] < calm
            times.append(int(np.argmax(within)) + 1 if within.any() else within.size)
        out["again_median_s"].append(float(np.median(times)))
        out["again_p90_s"].append(float(np.quantile(times, 0.9)))
    return out


def draw(path: Path, infos: dict[str, Info], truth: Nav, windows: np.ndarray) -> str:
    """Figures 7 to 10 with the paper's axes: estimates, not errors, of position, velocity, biases and attitude."""
    t = np.asarray(truth.t)
    enu = lambda lla: np.asarray(jax.vmap(metrics.earth.enu_difference, (0, None))(lla, truth.pos[0]))
    rows = [
        ("Fig. 7: position, m", ("east", "north"), lambda nav: enu(nav.pos)[:, :2]),
        ("Fig. 8: velocity, m/s", ("east", "north", "up"), lambda nav: np.asarray(nav.vel)),
        ("Fig. 9a: accelerometer biases, mg", ("x", "y", "z"),
         lambda nav: np.asarray(nav.errors["accel_bias"]) / units.MG),
        ("Fig. 9b: gyro biases, deg/h", ("x", "y", "z"),
         lambda nav: np.asarray(nav.errors["gyro_bias"]) / units.DEG_PER_HOUR),
        ("Fig. 10: attitude, deg", ("roll", "pitch", "heading"), lambda nav: angles(nav.q)),
    ]  # fmt: skip
    fig = plots.figure(12.0, 13.0)
    axes = fig.subplots(len(rows), 3)
    for row, (title, names, of) in zip(axes, rows, strict=True):
        for i, ax in enumerate(row):
            if i >= len(names):
                ax.axis("off")
                continue
            plots.dress(ax, f"{title}: {names[i]}", "t (s)", "")
            for begin, end in windows:
                ax.axvspan(begin, end, color="0.9")
            for (name, info), color in zip(infos.items(), (plots.BLUE, plots.VERMILION, "0.6"), strict=False):
                ax.plot(t, of(info.nav)[:, i], color=color, lw=0.9, label=name)
            true = of(truth)[:, i]
            span = np.ptp(true) + (1.0 if np.ptp(true) < 1.0 else 0.0)
            ax.plot(t, true, "k--", lw=0.8, label="true")
            if not title.startswith("Fig. 9"):
                ax.set_ylim(true.min() - 0.4 * span, true.max() + 0.4 * span)
    axes[0, 0].legend(fontsize=7)
    plots.save(fig, path)
    print(f"wrote {path}")
    return str(path)
