"""The GIP-KF paper's Figures 5 to 10 on one simulated drive."""

from pathlib import Path

import jax
import numpy as np

from benchmarks.papers import gipkf_study as study
from jaxnav.analysis import metrics
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run_jit
from jaxnav.maths import rotations, units
from jaxnav.types import Info, Params


def solve(filt: Filter, params: Params, drives: study.Drives, windows: jax.Array, i: int) -> Info:
    """One drive with its outages."""
    one = jax.tree.map(lambda a: a[i], drives)
    return run_jit(filt, params, one.initial, study.hide(one.epochs, one.truth.t, windows[i])[0])


def angles(q: jax.Array) -> np.ndarray:
    """Roll, pitch and continuous heading in degrees, (E, 3)."""
    rph = jax.vmap(lambda q: rotations.to_rph(rotations.to_dcm(q)))(q)
    return np.rad2deg(np.unwrap(np.asarray(rph), axis=0))


def draw(path: Path, infos: dict[str, Info], truth, windows: np.ndarray) -> None:
    """Six panels as the paper's figures: way, estimated way, errors of position and velocity, biases, attitude."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 2, figsize=(13, 14), constrained_layout=True)
    (way, estimated), (position, velocity), (bias, attitude) = axes
    t = np.asarray(truth.t)
    enu = lambda lla: np.asarray(jax.vmap(metrics.earth.enu_difference, (0, None))(lla, truth.pos[0]))
    true = enu(truth.pos)
    inside = [(t > a) & (t <= b) for a, b in windows]
    for panel in (way, estimated):
        panel.plot(true[:, 0], true[:, 1], "k", lw=1, label="true")
        panel.set(xlabel="east / m", ylabel="north / m", aspect="equal")
    for n, hidden in enumerate(inside):
        label = f"outage {n + 1}, {study.LENGTHS[n]:g} s"
        way.plot(true[hidden, 0], true[hidden, 1], lw=4, alpha=0.5, label=label)
    for c, (name, info) in enumerate(infos.items()):
        found, color = enu(info.nav.pos), f"C{c}"
        for hidden in inside:
            estimated.plot(*found[hidden, :2].T, color, label=name if hidden is inside[0] else None)
        position.plot(t, np.hypot(*(found - true)[:, :2].T), color, label=name)
        velocity.plot(t, np.hypot(*np.asarray(info.nav.vel - truth.vel)[:, :2].T), color, label=name)
        for axis, style in enumerate(("-", "--", ":")):
            error = np.asarray(info.nav.errors["accel_bias"] - truth.errors["accel_bias"])[:, axis] / units.MG
            bias.plot(t, error, color + style, lw=1, label=f"{name}, {'xyz'[axis]}")
        attitude.plot(t, (angles(info.nav.q) - angles(truth.q))[:, 2], color, label=f"{name}, heading")
        attitude.plot(t, (angles(info.nav.q) - angles(truth.q))[:, 1], color + "--", lw=1, label=f"{name}, pitch")
    position.set(ylabel="horizontal error / m", yscale="symlog")
    velocity.set(ylabel="horizontal velocity error / m/s", yscale="symlog")
    bias.set(ylabel="error of accelerometer bias / mg", ylim=(-25, 25))
    attitude.set(ylabel="error of attitude / deg", ylim=(-3, 3))
    titles = ("Fig. 5: drive and outages", "Fig. 6: estimated in the outages", "Fig. 7: position", "Fig. 8: velocity",
              "Fig. 9: biases", "Fig. 10: attitude")  # fmt: skip
    for panel, title in zip(axes.ravel(), titles, strict=True):
        panel.set_title(title)
        panel.legend(fontsize=7)
        panel.grid(alpha=0.3)
    for panel in (position, velocity, bias, attitude):
        panel.set_xlabel("t / s")
        for a, b in windows:
            panel.axvspan(a, b, color="0.9")
    figure.savefig(path, dpi=80)
    plt.close(figure)
    print(f"wrote {path}")
