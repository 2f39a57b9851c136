"""The figure of `jaxnav allan`: one panel an axis, the curve with the lines that were read off it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxnav.analysis.allan import FLAT, Allan, ReadOff, gauss_markov_variance
from jaxnav.analysis.plots.base import BLACK, BLUE, GREEN, ORANGE, VERMILION, figure, legend, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def allan(groups: Sequence[tuple[str, str, float, Allan, Sequence[ReadOff]]]) -> "Figure":
    """Allan deviation on double logarithmic axes, a row of panels a group: (name, unit, unit in SI, curve, figures).

    The band is one standard deviation of the estimate, by its degrees of freedom.
    """
    columns = groups[0][3].deviation.shape[1]
    fig = figure(1.0 + 3.6 * columns, 0.9 + 2.6 * len(groups))
    axes = np.array(panels(fig, len(groups) * columns, columns, "Cluster time τ (s)")).reshape(len(groups), columns)
    for row, (name, unit, si, curve, figures) in zip(axes, groups):
        for i, (ax, found) in enumerate(zip(row, figures)):
            ax.set_title(f"{name} {'xyz'[i]}", fontsize=9)
            _panel(ax, curve.tau, curve.deviation[:, i] / si, curve.edf)
            _lines(ax, curve.tau, found, si)
        low = min(ax.get_ylim()[0] for ax in row)
        high = max(ax.get_ylim()[1] for ax in row)
        for ax in row:
            ax.set_ylim(low, high)
        row[0].set_ylabel(f"Allan deviation ({unit})", fontsize=9)
    legend(fig)
    return fig


def _panel(ax: "Axes", tau: np.ndarray, deviation: np.ndarray, edf: np.ndarray) -> None:
    spread = 1 / np.sqrt(2 * edf)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.fill_between(tau, deviation * (1 - np.minimum(spread, 0.9)), deviation * (1 + spread), color=BLUE, alpha=0.2,
                    linewidth=0, label="± 1 sd")  # fmt: skip
    ax.plot(tau, deviation, color=BLUE, linewidth=1.3, label="Allan deviation")
    ax.set_ylim(0.4 * deviation.min(), 2.0 * deviation.max())
    ax.grid(True, which="both", color="0.93", linewidth=0.5)


def _lines(ax: "Axes", tau: np.ndarray, found: ReadOff, si: float) -> None:
    """Draw the asymptotes, thick where they were read off."""
    shapes = (
        ("N / √τ", found.N, lambda v, t: v / np.sqrt(t), VERMILION, "--"),
        ("0.664 B", found.B, lambda v, t: FLAT * v * np.ones_like(t), GREEN, ":"),
        ("K √(τ / 3)", found.K, lambda v, t: v * np.sqrt(t / 3), BLACK, "-."),
    )
    for label, line, shape, color, style in shapes:
        if line is not None:
            ax.plot(tau, shape(line.value, tau) / si, color=color, linestyle=style, linewidth=1.1, label=label)
            inside = tau[(tau >= line.start) & (tau <= line.stop)]
            ax.plot(inside, shape(line.value, inside) / si, color=color, linewidth=3.5, alpha=0.35)
    hump = found.gauss_markov
    if hump is not None:
        curve = np.sqrt(gauss_markov_variance(tau, hump.sd, hump.tau)) / si
        ax.plot(tau, curve, color=ORANGE, linewidth=1.3, label="Gauss–Markov")
