"""Figures of a fuzzy system: its memberships and its control surface."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.analysis.plots.base import BLACK, COLORS, dress, figure, legend
from jaxnav.filters.rules import fuzzy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Span = tuple[float, float]


def memberships(
    theta: fuzzy.System,
    table: Any,
    spans: Sequence[Span],
    names: Sequence[str],
    labels: Sequence[Sequence[str]],
    before: fuzzy.System | None = None,
) -> "Figure":
    """Draw the sets of each input over its span; ``labels`` name the sets. The sets of ``before`` are dashed."""
    shape = np.shape(table)
    fig = figure(3.6 * len(shape), 2.9)
    for i, ax in enumerate(fig.subplots(1, len(shape), squeeze=False)[0]):
        x = np.linspace(*spans[i], 401)
        for system, style in ((before, "--"), (theta, "-")):
            if system is None:
                continue
            for j, (c, s) in enumerate(zip(*map(np.asarray, fuzzy.sets(system, shape)[i]), strict=True)):
                name = labels[i][j] if system is theta else f"{labels[i][j]}, before"
                width = 1.0 if system is before else 1.6
                ax.plot(x, np.exp(-0.5 * ((x - c) / s) ** 2), style, color=COLORS[j], lw=width, label=name)
        dress(ax, xlabel=names[i], ylabel="membership" if i == 0 else "")
        ax.set_ylim(0, 1.05)
        ax.set_xlim(*spans[i])
    legend(fig)
    return fig


def surface(
    theta: fuzzy.System,
    table: Any,
    spans: Sequence[Span],
    names: Sequence[str],
    answer: str,
    conjunction: fuzzy.Conjunction = fuzzy.product,
    points: int = 81,
    labels: Sequence[str] | None = None,
) -> "Figure":
    """Draw the answer of a system of two inputs over their spans, with the centres and consequents of its rules.

    ``labels`` name the consequents, by default their numbers.
    """
    if np.ndim(table) != 2:
        raise ValueError(f"a control surface has two inputs, the table has {np.ndim(table)}")
    axes = [np.linspace(*span, points) for span in spans]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    y = jax.vmap(lambda x: fuzzy.infer(theta, table, x, conjunction))(jnp.asarray(grid))
    fig = figure(5.2, 3.9)
    ax = fig.subplots()
    filled = ax.contourf(axes[0], axes[1], np.asarray(y).reshape(points, points).T, levels=15, cmap="cividis")
    bar = fig.colorbar(filled, ax=ax)
    bar.set_label(answer, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    first, second = (np.asarray(c) for c, _ in fuzzy.sets(theta, np.shape(table)))
    for i, a in enumerate(first):
        for j, b in enumerate(second):
            if spans[0][0] <= a <= spans[0][1] and spans[1][0] <= b <= spans[1][1]:
                ax.plot(a, b, "o", ms=13, mfc="white", mec=BLACK, mew=0.8)
                k = np.asarray(table)[i, j]
                name = labels[k] if labels else str(k)
                ax.annotate(name, (a, b), ha="center", va="center_baseline", fontsize=8)
    dress(ax, xlabel=names[0], ylabel=names[1])
    ax.grid(False)
    return fig
