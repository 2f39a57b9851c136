"""Figures of statistics: innovations, NIS, outage drift, error distribution, tuning history.

Same rules as `jaxnav.analysis.plots.base`, which also has `save`: host numpy arrays in, a Figure out. A dict gives one
curve a name, in its order; nan is a missing value.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtri

from jaxnav.analysis.plots.base import (
    BLACK,
    BLUE,
    COLORS,
    GREEN,
    VERMILION,
    Array,
    Outages,
    dress,
    figure,
    legend,
    limit,
    panels,
    percent,
    reach,
    remark,
    table,
    time_axis,
    times,
)
from jaxnav.types import Json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONGEST_TITLE = 36  # characters over a small panel; a longer name breaks before its last part
DASHES = ("-", "--", "-.", ":")  # for more methods than colours, and for grey print


def _known(name: str, errors: Mapping[str, Array]) -> dict[str, Array]:
    """Return the finite values of each curve; raise an error that names a curve without any."""
    known = {k: np.asarray(v, float).ravel() for k, v in errors.items()}
    known = {k: v[np.isfinite(v)] for k, v in known.items()}
    empty = [k for k, v in known.items() if not v.size]
    if empty or not known:
        raise ValueError(f"{name} has no finite value in {', '.join(map(repr, empty)) or 'any curve'}")
    return known


def _style(i: int) -> Json:
    return {"color": COLORS[i % len(COLORS)], "linestyle": DASHES[(i // len(COLORS) + i) % len(DASHES)]}


def _log(ax: "Axes", which: str, values: Array, least: float) -> bool:
    """Make the axis ``which`` log, with plain numbers on it, if the values are positive and spread over ``least``."""
    from matplotlib import ticker

    values = values[np.isfinite(values)]
    if not values.size or values.min() <= 0.0 or values.max() <= least * values.min():
        return False
    ratio = float(values.max() / values.min())
    ax.set(**{f"{which}scale": "log"})
    axis = ax.xaxis if which == "x" else ax.yaxis
    if ratio < 4.0:
        axis.set_major_locator(ticker.MaxNLocator(4, steps=[1, 2, 5, 10]))
    else:
        subs = (1.0, 2.0, 3.0, 4.0, 6.0) if ratio < 10.0 else (1.0, 2.0, 5.0) if ratio < 300.0 else (1.0,)
        axis.set_major_locator(ticker.LogLocator(subs=subs, numticks=7))
    axis.set_major_formatter(ticker.FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())
    return True


def _metres(value: Any) -> str:
    return f"{value:#.3g}".rstrip(".") + " m"


def _steps(ax: "Axes", values: Array, label: str, style: Json) -> None:
    """Return the share of values at or below x, in percent."""
    x = np.sort(values)
    share = 100.0 * np.arange(x.size + 1) / x.size
    ax.plot(np.concatenate([x[:1], x]), share, drawstyle="steps-post", linewidth=1.4, label=label, **style)


def innovations(
    t: Array,
    nu: Array,
    S: Array,
    valid: Array,
    names: Sequence[str],
    outages: Outages = (),
    at_most: int | None = 6,
) -> "Figure":
    """Innovations nu (N, m) over the root of the diagonal of S (N, m, m), for the channels that are ever valid (N, m).

    A consistent filter gives an RMS of 1 and 99.7 % inside +-3. ``at_most=None`` shows every channel.
    """
    t = times(t)
    m = len(names)
    nu, valid = table("nu", nu, (t.size, m)), table("valid", valid, (t.size, m)) > 0.0
    ever = [i for i in range(m) if valid[:, i].any()]
    shown = ever[:at_most]
    if not shown:
        raise ValueError(f"valid has no measurement in any of the {m} channels")
    variance = np.diagonal(table("S", S, (t.size, m, m)), axis1=1, axis2=2)
    columns = 2 if len(shown) in (2, 4) else min(3, len(shown))
    fig = figure(1.0 + 3.4 * columns, 0.8 + 2.2 * -(-len(shown) // columns))
    if len(shown) < len(ever):
        fig.suptitle(f"first {len(shown)} of {len(ever)} channels", fontsize=9)
    for j, (ax, i) in enumerate(zip(panels(fig, len(shown), columns, "Time (s)"), shown)):
        z = nu[:, i] / np.sqrt(np.where(valid[:, i] & (variance[:, i] > 0.0), variance[:, i], np.nan))
        known = z[~np.isnan(z)]
        rms = float(np.sqrt(np.mean(known**2))) if known.size else np.nan
        ax.set_title(f"{names[i]}: RMS {rms:.2f}, {percent(np.abs(known) <= 3.0)} inside ±3", fontsize=9)
        if j % columns == 0:
            ax.set_ylabel("Innovation / its sd (–)", fontsize=9)
        for bound in (-3.0, 3.0):
            ax.axhline(bound, color=BLACK, linewidth=0.9, linestyle="--", label="±3")
        ax.plot(t, z, ".", color=BLUE, markersize=2.5, markeredgewidth=0, label="innovation / its sd")
        top = max(4.6, reach(z))
        limit(ax, t, z, -top, top)
        time_axis(ax, t, outages)
    legend(fig)
    return fig


def nis(t: Array, nis: Array, dof: Array, outages: Outages = (), window: int = 50) -> "Figure":
    """NIS (N,) of dof (N,) channels, 0 where there is no fix, against two-sided 95 % chi-square bounds.

    Below, the sum of NIS over the sum of dof of the last ``window`` fixes, with the bounds of that mean: they hold if
    the innovations are white.
    """
    t = times(t)
    nis, dof = table("nis", nis, t.shape), table("dof", dof, t.shape)
    fix = (dof > 0.0) & ~np.isnan(nis)
    if not fix.any():
        raise ValueError("dof is 0 (no fix) at every epoch")
    w = max(1, min(window, int(fix.sum())))
    fig = figure(9.0, 5.6)
    above, below = panels(fig, 2, 1, "Time (s)")

    at, value, freedom = t[fix], nis[fix], dof[fix]
    lo, hi = chdtri(freedom, 0.975), chdtri(freedom, 0.025)  # by the upper tail
    share = percent((value >= lo) & (value <= hi))
    dress(above, f"each fix: {share} inside the 95 % bounds", ylabel="NIS (–)")
    above.set_yscale("log")
    above.plot(at, value, ".", color=BLUE, markersize=3.5, markeredgewidth=0, label="NIS")
    _bounds(above, at, lo, hi)
    limit(
        above, at, value, 0.1 * float(lo.min()), 2.0 * float(np.max(value, where=np.isfinite(value), initial=hi.max()))
    )

    at = at[w - 1 :]
    total, freedom = (np.convolve(a, np.ones(w), "valid") for a in (value, freedom))
    mean, lo, hi = total / freedom, chdtri(freedom, 0.975) / freedom, chdtri(freedom, 0.025) / freedom
    title = f"mean of the last {w} fixes: {percent((mean >= lo) & (mean <= hi))} inside its 95 % bounds"
    dress(below, title, "Time (s)", "NIS / dof (–)")
    below.axhline(1.0, color="0.6", linewidth=0.8)
    below.plot(at, mean, color=VERMILION, linewidth=1.0, label="running mean of NIS / dof")
    _bounds(below, at, lo, hi)
    _log(below, "y", np.concatenate([mean, lo, hi]), 1.0)
    for ax in (above, below):
        time_axis(ax, t, outages)
    legend(fig)
    return fig


def _bounds(ax: "Axes", t: Array, lo: Array, hi: Array) -> None:
    for bound in (lo, hi):
        ax.plot(t, bound, color=BLACK, linewidth=0.9, linestyle="--", label="95 % chi-square bounds")


def outage_drift(
    drift: Mapping[str, Array],
    labels: Mapping[str, str] | None = None,
    labelled: tuple[str, str] = ("windows", "Horizontal error at the end of the outage (m)"),
) -> "Figure":
    """Horizontal errors (W,) m at the end of each outage window, by method; ``labels`` renames methods.

    ``labelled``: names of the samples and of their error.

    Left the share of windows below x. Right, of two methods, one point a window (they must come in the same order);
    otherwise a box for each method.
    """
    known = _known("drift", drift)
    labels = {k: (labels or {}).get(k, k) for k in known}
    fig = figure(10.0, 4.8)
    left, right = fig.subplots(1, 2, width_ratios=(1.2, 1.0))
    dress(left, "", labelled[1], f"Share of {labelled[0]} below (%)")
    for i, (name, v) in enumerate(known.items()):
        summary = f"RMS {_metres(np.sqrt(np.mean(v**2)))}, median {_metres(np.median(v))}, {v.size} {labelled[0]}"
        _steps(left, v, f"{labels[name]}: {summary}", _style(i))
    left.set_ylim(0.0, 102.0)
    if not _log(left, "x", np.concatenate(list(known.values())), 10.0):
        left.set_xlim(left=0.0)
    if len(known) == 2:
        _paired(right, [np.asarray(drift[k], float) for k in known], list(labels.values()), labelled[0])
    else:
        _boxes(right, list(known.values()), list(labels.values()))
    legend(fig, 1 if len(known) < 4 else 2)
    return fig


def _paired(ax: "Axes", pair: Sequence[Array], names: Sequence[str], samples: str) -> None:
    before, after = pair
    if before.shape != after.shape:
        raise ValueError(f"drift of two methods must be over the same {samples}, got {before.shape} and {after.shape}")
    both = np.isfinite(before) & np.isfinite(after)
    title = f"{names[1]} is smaller in {int((after < before)[both].sum())} of {int(both.sum())} {samples}"
    dress(ax, title, f"{names[0]} (m)", f"{names[1]} (m)")
    ax.set_aspect("equal")
    ax.plot(before[both], after[both], "o", color=BLUE, alpha=0.6, markersize=5, markeredgewidth=0)
    shown = np.concatenate([before[both], after[both]])
    log = _log(ax, "x", shown, 10.0) and _log(ax, "y", shown, 10.0)
    lo, hi = (shown.min() / 1.3, shown.max() * 1.3) if log else (0.0, 1.08 * shown.max(initial=0.0) or 1.0)
    ax.plot([lo, hi], [lo, hi], color=BLACK, linewidth=0.9, linestyle="--", label="equal")
    ax.set_xlim(lo, hi)
    ax.set_ylim(lo, hi)


def _boxes(ax: "Axes", values: Sequence[Array], names: Sequence[str]) -> None:
    dress(ax, "box: quartiles and median; whiskers: 5 to 95 %", "", "Horizontal error (m)")
    parts = ax.boxplot(list(values), whis=(5, 95), widths=0.5, showfliers=False, patch_artist=True)
    for i, (box, median) in enumerate(zip(parts["boxes"], parts["medians"])):
        box.set(facecolor=COLORS[i % len(COLORS)], alpha=0.35)
        median.set(color=BLACK, linewidth=1.4)
    for i, v in enumerate(values):
        x = i + 1 + 0.36 * (np.arange(v.size) / max(1, v.size - 1) - 0.5)
        ax.plot(x, v, ".", color=COLORS[i % len(COLORS)], markersize=4, alpha=0.7, markeredgewidth=0)
    crowded = len(names) * max(map(len, names)) > 45
    ax.set_xticks(range(1, len(names) + 1), names, rotation=25 if crowded else 0, ha="right" if crowded else "center")
    ax.grid(False, axis="x")
    if not _log(ax, "y", np.concatenate(list(values)), 10.0):
        ax.set_ylim(bottom=0.0)


def _column(history: Sequence[Mapping[str, Any]], key: str) -> Array:
    """One number a step, nan where the key is missing or None."""
    return np.array([np.nan if row.get(key) is None else float(row[key]) for row in history])


def tuning(history: Sequence[Mapping[str, Any]], truth: Mapping[str, Any] | None = None) -> "Figure":
    """Loss, gradient norm and every parameter against the step; ``truth`` gives true values by name of parameter.

    A row of history has step, loss, grad_norm, params (name -> number or array, the unit in the name) and may have
    validation. Best is the step of the least validation loss, or of the least loss where there is no validation.
    """
    if not history:
        raise ValueError("history is empty")
    step, loss, held_out = (_column(history, key) for key in ("step", "loss", "validation"))
    gradient = _column(history, "grad_norm")
    score = held_out if np.isfinite(held_out).any() else loss
    best = int(np.nanargmin(score)) if np.isfinite(score).any() else None
    names = list(history[0]["params"])
    rows, span = -(-len(names) // 4), max(step[-1] - step[0], 20.0)
    fig = figure(11.0, 3.6 + 1.9 * rows)
    parts: Any = fig.subfigures(2, 1, height_ratios=(2.6, 1.9 * max(1, rows))) if rows else (fig, fig)
    losses, gradients = parts[0].subplots(1, 2, sharex=True)
    dress(losses, "", "Step", "Loss (–)")
    line: Json = {"color": BLUE, "linewidth": 1.2, "marker": "o" if len(history) == 1 else ""}
    losses.plot(step, loss, label="training loss", **line)
    if np.isfinite(held_out).any():
        seen = np.isfinite(held_out)
        losses.plot(step[seen], held_out[seen], ".-", color=VERMILION, linewidth=1.2, label="validation loss")
    _log(losses, "y", np.concatenate([loss, held_out]), 30.0)
    dress(gradients, "", "Step", "Gradient norm (–)")
    gradients.plot(step, np.where(gradient > 0.0, gradient, np.nan), **line)
    if not _log(gradients, "y", gradient[gradient > 0.0], 1.0):
        gradients.set_yscale("log")
    grid = [losses, gradients]
    if names:
        small = panels(parts[1], len(names), 4, "Step")
        for ax, name in zip(small, names):
            values = np.array([_components(row["params"][name]) for row in history])
            true = None if truth is None or name not in truth else np.asarray(truth[name], float).ravel()
            _parameter(ax, name, step, values, true, best)
        grid += small
    for ax in grid:
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.set_xlim(step[0] - 0.03 * span, step[-1] + 0.03 * span)
        if best is not None:
            ax.axvline(step[best], color="0.5", linewidth=0.9, linestyle=":", label="best step")
    legend(fig)
    return fig


def _components(value: Any) -> Array:
    """Return a parameter's numbers; of a lower triangular root those that are not always zero, row by row."""
    value = np.asarray(value, float)
    root = value.ndim == 2 and value.shape[0] == value.shape[1] and not np.triu(value, 1).any()
    return value[np.tril_indices(len(value))] if root else value.ravel()


def _parameter(ax: "Axes", name: str, step: Array, values: Array, truth: Array | None, best: int | None) -> None:
    """One parameter, (steps, components)."""
    tables, dot, key = name.rpartition(".")
    ax.set_title(name if len(name) <= LONGEST_TITLE else f"{tables}{dot}\n{key}", fontsize=8.5)
    everything = values if truth is None else np.concatenate([values.ravel(), truth])
    single = values.shape[1] == 1
    for i, v in enumerate(values.T):
        label = "" if single else f"component {i + 1}"
        ax.plot(step, v, color=COLORS[i % len(COLORS)], linewidth=1.2, label=label)
        if best is not None:
            ax.plot(step[best], v[best], "*", color=VERMILION, markersize=9, label="best", zorder=4)
        ax.plot(step[:1], v[:1], "o", color=BLACK, markerfacecolor="none", markersize=5, label="start", zorder=5)
    for i, v in enumerate(() if truth is None else truth):
        color = GREEN if single else COLORS[i % len(COLORS)]
        ax.axhline(v, color=color, linewidth=1.1, linestyle="--", label="true value")
    if not np.isfinite(values).any():
        remark(ax, f"always {values.flat[0]:g}")  # tau = inf is a random walk
    _log(ax, "y", everything, 1.5)
