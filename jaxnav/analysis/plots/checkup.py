"""One picture of the contents of a recording: streams in time, speed, turns, height, specific force."""

from typing import TYPE_CHECKING

import numpy as np

from jaxnav.analysis.plots.base import BLUE, COLORS, GREEN, PURPLE, VERMILION, dress, figure
from jaxnav.checkup.motion import turns_of
from jaxnav.checkup.shared import level_velocity
from jaxnav.maths.units import DEG
from jaxnav.types import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_POINTS = 20_000  # points of a line


def overview(rec: Recording) -> "Figure":
    """Five panels over time; `jaxnav check` writes it."""
    fig = figure(11, 9.5)
    fig.suptitle(f"{rec.name}: the recording against itself", fontsize=11)
    axes = fig.subplots(5, 1, sharex=True, height_ratios=[1, 1.3, 1.3, 1.3, 1.3])
    for draw, ax in zip((_streams, _speed, _turns, _height, _force), axes, strict=True):
        draw(ax, rec)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=8, loc="upper right", ncols=4)
    axes[-1].set_xlabel("t (s)", fontsize=9)
    return fig


def _thin(*columns: np.ndarray) -> list[np.ndarray]:
    step = max(1, len(columns[0]) // MAX_POINTS)
    return [c[::step] for c in columns]


def _streams(ax: "Axes", rec: Recording) -> None:
    dress(ax, "samples of each stream")
    times = {"imu": rec.imu.t, **{name: s.t for name, s in rec.aiding.items()}}
    for i, t in enumerate(times.values()):
        step = np.diff(t)
        gaps = np.flatnonzero(step > 2.5 * np.median(step)) if t.size > 1 else np.zeros(0, int)
        edges = np.concatenate([[0], np.repeat(gaps, 2), [t.size - 1]]).astype(int)
        edges[2::2] += 1
        for a, b in edges.reshape(-1, 2):
            ax.plot([t[a], t[b]], [i, i], lw=5, solid_capstyle="butt", color=COLORS[i % len(COLORS)])
    ax.set_yticks(range(len(times)), list(times), fontsize=8)
    ax.invert_yaxis()


def _speed(ax: "Axes", rec: Recording) -> None:
    dress(ax, "speed over ground", ylabel="m/s")
    for name, color in (("velocity", BLUE), ("position", GREEN)):
        aiding = {name: rec.aiding[name]} if name in rec.aiding else {}
        v = level_velocity(aiding)
        if v is not None:
            t, speed = _thin(v.t, np.hypot(v.value[:, 0], v.value[:, 1]))
            ax.plot(t, speed, color=color, lw=1, label="velocity" if name == "velocity" else "differences of positions")
    if "speed" in rec.aiding:
        t, speed = _thin(rec.aiding["speed"].t, rec.aiding["speed"].value[:, 0])
        ax.plot(t, speed, color=VERMILION, lw=1, label="wheels")


def _turns(ax: "Axes", rec: Recording) -> None:
    dress(ax, "turns: rate of the course, and the gyros", ylabel="deg/s")
    x = turns_of(rec)
    if x is None:
        t, *gyro = _thin(rec.imu.t, *rec.imu.gyro.T)
        for name, column, color in zip("xyz", gyro, COLORS[1:], strict=False):
            ax.plot(t, column / DEG, lw=0.6, color=color, label=f"gyro {name}")
    else:
        for name, column, color in zip("xyz", x.gyro.T, (PURPLE, GREEN, VERMILION), strict=True):
            faint = 1.0 if name == "z" else 0.4
            ax.plot(*_thin(x.t, column / DEG), lw=0.7, color=color, label=f"gyro {name}", alpha=faint)
        ax.plot(*_thin(x.t, np.where(x.weight > 0, x.course / DEG, np.nan)), lw=1, color=BLUE, label="course")


def _height(ax: "Axes", rec: Recording) -> None:
    dress(ax, "height, less its mean", ylabel="m")
    if "position" in rec.aiding:
        p = rec.aiding["position"]
        ax.plot(*_thin(p.t, p.value[:, 2] - p.value[:, 2].mean()), color=BLUE, lw=1, label="receiver")
    if "barometer" in rec.aiding:
        b = rec.aiding["barometer"]
        ax.plot(*_thin(b.t, b.value[:, 0] - b.value[:, 0].mean()), color=VERMILION, lw=1, label="barometer")


def _force(ax: "Axes", rec: Recording) -> None:
    dress(ax, "specific force, means over a second: at rest 0, 0, -9.8", ylabel="m/s$^2$")
    n = max(1, round(1.0 / float(np.median(rec.imu.dt))))
    m = rec.imu.t.size // n
    mean = rec.imu.accel[: m * n].reshape(m, n, 3).mean(1)
    for name, column, color in zip(("forward", "right", "down"), mean.T, COLORS, strict=False):
        ax.plot(*_thin(rec.imu.t[n - 1 : m * n : n], column), lw=1, color=color, label=name)
