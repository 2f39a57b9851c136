"""Figures of Monte Carlo runs: errors over time, consistency, and how the runs spread.

Same rules as `jaxnav.analysis.plots.base`. Curves are named after the filters.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from jaxnav.analysis import metrics
from jaxnav.analysis.montecarlo import MonteCarlo, percentile
from jaxnav.analysis.plots.base import BLACK, Outages, dress, figure, legend, panels, time_axis
from jaxnav.analysis.plots.stats import _log, _style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = ("Horizontal (m)", "Vertical (m)", "Velocity (m/s)", "Tilt (deg)", "Yaw (deg)")
UNIT = np.array([1.0, 1.0, 1.0, 180 / np.pi, 180 / np.pi])


def figures(found: Mapping[str, MonteCarlo], outages: Outages = ()) -> "dict[str, Figure]":
    """Draw the figures of these runs (one candidate each), by name of file."""
    return {
        "mc_errors": errors(found, outages),
        "mc_consistency": consistency(found, outages),
        "mc_spread": spread(found),
    }


def errors(found: Mapping[str, MonteCarlo], outages: Outages = ()) -> "Figure":
    """Median and 95th percentile over the runs of each absolute error, at every epoch."""
    fig = figure(10.0, 5.6)
    axes = panels(fig, 5, 2, "Time (s)")
    for j, ax in enumerate(axes):
        seen = []
        for i, (name, one) in enumerate(found.items()):
            color = _style(i)["color"]
            for q, line in ((50, "-"), (95, ":")):
                values = np.where(one.course.runs > 0, percentile(one.course, q)[:, j], np.nan) * UNIT[j]
                ax.plot(one.course.t, values, line, color=color, linewidth=1.2, label=f"{name}, {q} %")
                seen.append(values)
        dress(ax, ylabel=NAMES[j], xlabel=ax.get_xlabel())
        _log(ax, "y", np.concatenate(seen), 10.0)
        time_axis(ax, next(iter(found.values())).course.t, outages)
    legend(fig, 4)
    return fig


def consistency(found: Mapping[str, MonteCarlo], outages: Outages = ()) -> "Figure":
    """Mean over the runs of NEES / 9 and NIS / dof at every epoch, with two-sided 95 % chi-square bounds."""
    fig = figure(9.0, 5.6)
    axes = panels(fig, 2, 1, "Time (s)")
    for i, (name, one) in enumerate(found.items()):
        c, look = one.course, _style(i)
        with np.errstate(divide="ignore", invalid="ignore"):
            nees = np.where(c.runs > 0, c.nees / 9, np.nan)
            nis = np.where(c.fixes > 0, c.nis / c.dof, np.nan)
        axes[0].plot(c.t, nees, linewidth=1.0, label=name, **look)
        axes[1].plot(c.t, nis, linewidth=1.0, label=name, **look)
    c = next(iter(found.values())).course
    for ax, dof, title in ((axes[0], 9.0 * c.runs, "Mean NEES / 9"), (axes[1], c.dof * c.fixes, "Mean NIS / channels")):
        bounds = {d: metrics.chi2_bounds(d) for d in np.unique(dof[dof > 0])}
        for side in (0, 1):
            edge = [bounds[d][side] / d if d > 0 else np.nan for d in dof]
            ax.plot(c.t, edge, "--", color=BLACK, linewidth=0.9, label="95 % bounds")
        dress(ax, ylabel=title, xlabel=ax.get_xlabel())
        values = np.concatenate([line.get_ydata() for line in ax.lines])
        _log(ax, "y", np.asarray(values, float), 30.0)
        time_axis(ax, c.t, outages)
    legend(fig)
    return fig


def spread(found: Mapping[str, MonteCarlo]) -> "Figure":
    """Histograms over the runs that did not diverge of their horizontal and vertical RMS."""
    fig = figure(9.0, 3.6)
    for ax, axis in zip(fig.subplots(1, 2), ("horizontal", "vertical")):
        values = {name: getattr(one.scores, axis)[one.scores.ok] for name, one in found.items()}
        every = np.concatenate(list(values.values()))
        every = every[every > 0]
        low, high = (every.min(), every.max()) if every.size else (1.0, 2.0)
        edges = np.geomspace(low / 1.02, high * 1.02, 1 + int(np.clip(2 * np.sqrt(every.size / len(values)), 5, 40)))
        for i, (name, some) in enumerate(values.items()):
            ax.hist(some, edges, histtype="step", linewidth=1.4, label=f"{name} ({some.size} runs)", **_style(i))
        dress(ax, xlabel=f"{axis.capitalize()} RMS of a run (m)", ylabel="Runs")
        _log(ax, "x", edges, 1.0)
    legend(fig)
    return fig
