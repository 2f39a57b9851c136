"""Cost against the length of a run and the size of a batch, log-log, with slope 1."""

from pathlib import Path

import numpy as np

from benchmarks.speed.speed_work import exponent
from jaxnav.analysis.plots import base as plots


def growth(curves: dict[str, dict[str, list[list[float]]]], path: Path) -> None:
    """One axis a quantity, a line of (size, processor seconds) each form; the exponent is in the legend."""
    figure = plots.figure(5.2 * len(curves), 4.2)
    for ax, (quantity, lines) in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
        for (name, points), color in zip(lines.items(), plots.COLORS, strict=False):
            size, cost = np.array(points).T
            ax.loglog(size, cost, "o-", color=color, ms=4, lw=1.2, label=f"{name}: {exponent(size, cost):.2f}")
        size = np.array(sorted({p[0] for points in lines.values() for p in points}))
        cheapest = min(p[1] / p[0] for points in lines.values() for p in points)
        ax.loglog(size, 0.5 * cheapest * size, "k--", lw=0.8, label="slope 1")
        ax.set(xlabel=quantity, ylabel="processor time, s")
        ax.grid(alpha=0.3, lw=0.4)
        ax.legend(fontsize=8, title="slope of the fit", title_fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    plots.save(figure, path)
