"""Figures of one run: trajectory, errors and sensor biases; and the common style of all figures.

Host numpy arrays in, a `matplotlib.figure.Figure` out, written by `save`; no pyplot, so no display and no global
state. Angles and biases are drawn in deg, deg/h (or deg/s) and mg, errors in the order north, east, down. Every figure
shades the outages ``[(t0, t1), ...]``, and samples that would flatten a panel are triangles at its edge ("off scale").
Innovations, and figures over windows, methods and tuning steps, are in `jaxnav.analysis.plots.stats`.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxnav.maths import units
from jaxnav.types import Json, Samples, Track

if TYPE_CHECKING:  # 0.8 s of import: only when something is drawn
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

Array = np.ndarray
Outages = Sequence[tuple[float, float]]

BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"  # Okabe and Ito, safe for colour-blind
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
TITLES = {
    "nis": "NIS",
    "mc_errors": "Errors of all runs",
    "mc_consistency": "Consistency of all runs",
    "mc_spread": "Spread of all runs",
}
"""Titles of figures whose names are none."""

# ---------------------------------------------------------------------------- shared by all figures


def figure(width: float, height: float) -> "Figure":
    """Return an empty figure in inches, laid out so that no label is clipped."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.07, h_pad=0.06))


def save(fig: "Figure", path: str | os.PathLike[str]) -> Path:
    """Write a PNG of 120 dpi, the same bytes for the same figure; a failure leaves neither a part nor a temporary."""
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise ValueError(f"path must end in .png, got {target.name!r}")
    temporary, engine = target.with_name(f".{target.name}.{os.getpid()}.tmp"), fig.get_layout_engine()
    try:
        if engine is not None:  # once, and not at each of the two draws that saving takes
            engine.execute(fig)
            fig.set_layout_engine("none")
        fig.savefig(temporary, format="png", dpi=120, metadata={"Software": None})
        os.replace(temporary, target)
    finally:
        fig.set_layout_engine(engine)
        temporary.unlink(missing_ok=True)
    return target


def name(fig: "Figure", key: str, subject: str) -> None:
    """Write a title above a figure: its name, such as ``"trajectory"``, and its subject."""
    title = TITLES.get(key, key.replace("_", " ").capitalize())
    more = f" ({more})" if (more := fig.get_suptitle()) else ""
    fig.suptitle(f"{title}: {subject}{more}", x=0.01, ha="left", fontsize=11)


def dress(ax: "Axes", title: str = "", xlabel: str = "", ylabel: str = "") -> None:
    """Give a panel the common look."""
    ax.set_title(title, fontsize=9)
    ax.set_xlabel(xlabel, fontsize=9)
    ax.set_ylabel(ylabel, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.ticklabel_format(axis="y", useOffset=False)
    ax.xaxis.get_offset_text().set_fontsize(8)  # of seconds since 1970
    ax.yaxis.get_offset_text().set_fontsize(8)
    ax.grid(True, color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def panels(fig: "FigureBase", n: int, columns: int, xlabel: str) -> "list[Axes]":
    """Panels, n of them, that share x, row by row, with the x axis labelled on the lowest panel of every column."""
    grid = fig.subplots(-(-n // columns), columns, squeeze=False, sharex=True).ravel()
    for spare in grid[n:]:
        spare.remove()
    for i, ax in enumerate(grid[:n]):
        dress(ax, xlabel=xlabel if i + columns >= n else "")
        ax.tick_params(labelbottom=i + columns >= n)
    return list(grid[:n])


def legend(fig: "Figure", columns: int = 6) -> None:
    """One legend below the panels, each label once, so that it never covers data."""
    entries: Json = {}
    for ax in fig.axes:
        for handle, label in zip(*ax.get_legend_handles_labels()):
            entries.setdefault(label, handle)
    if not entries:
        return
    columns = min(columns, len(entries))
    look: Json = {"loc": "outside lower center", "ncols": columns, "fontsize": 8.5, "frameon": False}
    box = fig.legend(list(entries.values()), list(entries), **look)
    for draw_state in box.legend_handles:
        if draw_state is not None and getattr(draw_state, "get_marker", str)() == ".":
            draw_state.set(markersize=8, alpha=1.0)  # the colour of small dots is hard to see


def time_axis(ax: "Axes", t: Array, outages: Outages) -> None:
    """Limit x to the run and shade the outages inside it."""
    pad = 0.5 if t[0] == t[-1] else 0.0
    ax.set_xlim(t[0] - pad, t[-1] + pad)
    for start, end in outages:
        if not end > start:
            raise ValueError(f"outages must be (start, end) with start < end, got ({start}, {end})")
        if end > t[0] and start < t[-1]:
            lo, hi = max(start, t[0]), min(end, t[-1])
            ax.axvspan(lo, hi, facecolor=ORANGE, alpha=0.22, linewidth=0, zorder=0.5, label="GNSS outage")


def reach(values: Array, envelope: Array | None = None) -> float:
    """How far from 0 a panel must reach: all of |values|, unless 0.5 % of them are over three times the rest.

    The envelope is shown wherever it is usual, and at its peaks only as far as that does not flatten the values.
    """
    a = np.sort(np.abs(values[np.isfinite(values)]), axis=None)
    if not a.size:
        return 0.0
    rest = a[-1 - max(1, a.size // 200)] if a.size >= 20 else a[-1]
    top = 1.5 * rest if a[-1] > 3.0 * rest > 0.0 else a[-1]
    if envelope is not None and np.isfinite(envelope).any():
        e = np.abs(envelope[np.isfinite(envelope)])
        top = max(top, float(np.quantile(e, 0.9)), min(float(e.max()), 2.5 * top))
    return 1.1 * float(top)


def limit(ax: "Axes", t: Array, values: Array, lo: float, hi: float) -> None:
    """Set the y limits and put a triangle at the edge for every sample beyond them."""
    lo, hi = (lo, hi) if hi > lo else (lo - 1.0, hi + 1.0)
    ax.set_ylim(lo, hi)
    for beyond, edge, marker in ((values > hi, hi, "^"), (values < lo, lo, "v")):
        if beyond.any():
            x, y = t[beyond], np.full(int(beyond.sum()), edge)
            ax.plot(x, y, marker, color=VERMILION, markersize=4, clip_on=False, zorder=5, label="off scale")


def times(t: Array) -> Array:
    """T (N,) as floats, at least one and in order."""
    t = np.asarray(t, float)
    if t.ndim != 1 or not t.size or not (np.diff(t) >= 0.0).all():
        raise ValueError(f"t must be (N,) s, N > 0, never decreasing, got shape {t.shape}")
    return t


def table(name: str, values: Array, shape: tuple[int, ...]) -> Array:
    """Return the values as floats; raise the reason why their shape is wrong."""
    out = np.asarray(values, float)
    if out.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {out.shape}")
    return out


def remark(ax: "Axes", text: str) -> None:
    """Say in an empty panel why it is empty."""
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color="0.4", fontsize=9)
    ax.set_yticks([])


def percent(inside: Array) -> str:
    """Return the share of true values, "98.7 %"."""
    return f"{100.0 * np.mean(inside):.1f} %"


# ---------------------------------------------------------------------------- figures


def _east_north(lla: Array, origin: Array) -> tuple[Array, Array]:
    """Metres east and north of origin (lat rad, lon rad, h m), by the radii of WGS-84 there: for drawing only."""
    a, e2 = 6378137.0, 6.69437999014e-3
    w = 1.0 - e2 * np.sin(origin[0]) ** 2
    lon = np.mod(lla[:, 1] - origin[1] + np.pi, 2.0 * np.pi) - np.pi
    east = (a / np.sqrt(w) + origin[2]) * np.cos(origin[0]) * lon
    return east, (a * (1.0 - e2) / w**1.5 + origin[2]) * (lla[:, 0] - origin[0])


def trajectory(
    track: Track, truth: Track | None = None, fixes: Samples | None = None, outages: Outages = ()
) -> "Figure":
    """East and north about the first point of the track, to one scale; fixes are `Samples` of (lat, lon, h)."""
    t = times(track.t)
    known = np.isfinite(track.lla).all(axis=1)
    if not known.any():
        raise ValueError("track.lla has no finite position")
    origin = track.lla[known.argmax()]
    east, north = _east_north(track.lla, origin)
    curves = [np.stack([east, north])]
    if truth is not None:
        curves.append(np.stack(_east_north(truth.lla, origin)))
    lo, hi = (f(np.concatenate(curves, axis=1), axis=1) for f in (np.nanmin, np.nanmax))  # a stray fix is left out
    extent = np.maximum(hi - lo, 0.4 * max(2.0, float((hi - lo).max())))
    fig = figure(7.5, 7.5 * float(np.clip(extent[1] / extent[0], 0.45, 1.2)) + 0.4)
    ax = fig.subplots()
    dress(ax, xlabel="East (m)", ylabel="North (m)")
    ax.set_aspect("equal")
    low, high = 0.5 * (lo + hi) - 0.56 * extent, 0.5 * (lo + hi) + 0.56 * extent
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))

    lost = np.zeros(t.size, bool)
    for start, end in outages:
        lost |= (t >= start) & (t <= end)
    if lost.any():
        x, y = np.where(lost, east, np.nan), np.where(lost, north, np.nan)
        ax.plot(x, y, color=ORANGE, alpha=0.4, linewidth=9, solid_capstyle="round", label="GNSS outage", zorder=1.5)
    if fixes is not None:
        x, y = _east_north(fixes.value, origin)
        ax.plot(x, y, ".", color=GREEN, markersize=4.5, markeredgewidth=0, label="GNSS", zorder=2)
    ax.plot(east, north, color=BLUE, linewidth=1.3, label="estimated", zorder=3)
    if truth is not None:
        ax.plot(*curves[1], color=BLACK, linewidth=0.8, linestyle=(0, (5, 3)), label="truth", zorder=4)
    ax.plot(east[known][:1], north[known][:1], "o", color=BLACK, markersize=5, label="start", zorder=5)
    ax.plot(east[known][-1:], north[known][-1:], "s", color=BLACK, markersize=5, label="end", zorder=5)
    legend(fig)
    return fig


def _nine(name: str, values: Array | Mapping[str, Array], n: int) -> Array:
    """(N, 9) from itself, or from position, velocity, attitude by name, nan where one is missing."""
    if isinstance(values, Mapping):
        unknown = np.full((n, 3), np.nan)
        values = np.concatenate([values.get(k, unknown) for k in ("position", "velocity", "attitude")], axis=1)
    return table(name, values, (n, 9))


def errors(
    t: Array,
    error: Array | Mapping[str, Array],
    sd: Array | Mapping[str, Array] | None = None,
    outages: Outages = (),
) -> "Figure":
    """Errors (N, 9) in m, m/s and deg with +-3 sd: position and velocity NED, then roll, pitch, heading.

    nan is unknown: a row without any truth is left out. Also takes dicts with the keys position, velocity, attitude.
    """
    t = times(t)
    error = _nine("error", error, t.size)
    sd = np.full_like(error, np.nan) if sd is None else _nine("sd", sd, t.size)
    names = ["north", "east", "down"] * 2 + ["roll", "pitch", "heading"]
    rows = [r for r in range(3) if np.isfinite(error[:, 3 * r : 3 * r + 3]).any()] or [0, 1, 2]
    fig = figure(11.0, 0.8 + 2.2 * len(rows))
    channels = [3 * r + c for r in rows for c in range(3)]
    for ax, i in zip(panels(fig, len(channels), 3, "Time (s)"), channels):
        if i % 3 == 0:
            ax.set_ylabel(("Position error (m)", "Velocity error (m/s)", "Attitude error (deg)")[i // 3], fontsize=9)
        _error_panel(ax, names[i], t, error[:, i], sd[:, i])
        time_axis(ax, t, outages)
    legend(fig)
    return fig


def _error_panel(ax: "Axes", name: str, t: Array, error: Array, sd: Array) -> None:
    known = ~np.isnan(error)  # an infinite error is outside
    if not known.any():
        ax.set_title(name, fontsize=9)
        remark(ax, "no truth")
        return
    both = known & ~np.isnan(sd)
    inside = np.abs(error[both]) <= 3.0 * sd[both]
    ax.set_title(f"{name}: {percent(inside)} inside ±3σ" if both.any() else name, fontsize=9)
    if np.isfinite(sd).any():
        ax.fill_between(t, -3.0 * sd, 3.0 * sd, color=SKY, alpha=0.35, linewidth=0, label="±3σ of the filter")
    ax.axhline(0.0, color="0.6", linewidth=0.6)
    ax.plot(t, error, color=BLUE, linewidth=0.8, label="estimate − truth")
    top = reach(error, 3.0 * sd)
    limit(ax, t, error, -top, top)


def biases(
    t: Array,
    b_g: Array,
    b_a: Array,
    sd_g: Array | None = None,
    sd_a: Array | None = None,
    truth_g: Array | None = None,
    truth_a: Array | None = None,
    outages: Outages = (),
) -> "Figure":
    """Gyro (N, 3) rad/s and accelerometer (N, 3) m/s^2 biases in deg/h (deg/s from 1000 deg/h) and mg, with +-3 sd.

    Truth is (N, 3), or (3,) where it is constant.
    """
    t = times(t)
    fast = reach(np.asarray(b_g, float)) > 1000.0 * units.DEG_PER_HOUR
    gyro = ("Gyro bias (deg/s)", units.DEG) if fast else ("Gyro bias (deg/h)", units.DEG_PER_HOUR)
    rows = ((*gyro, "b_g", b_g, sd_g, truth_g), ("Accelerometer bias (mg)", units.MG, "b_a", b_a, sd_a, truth_a))
    fig = figure(11.0, 5.4)
    grid = panels(fig, 6, 3, "Time (s)")
    for r, (label, unit, name, bias, sd, truth) in enumerate(rows):
        shape = (t.size, 3)
        bias = table(name, bias, shape) / unit
        sd = np.full(shape, np.nan) if sd is None else table(f"sd of {name}", sd, shape) / unit
        truth = np.full(shape, np.nan) if truth is None else np.broadcast_to(np.asarray(truth, float), shape) / unit
        grid[3 * r].set_ylabel(label, fontsize=9)
        for c, axis in enumerate(("forward", "right", "down")):
            ax = grid[3 * r + c]
            if r == 0:
                ax.set_title(axis, fontsize=9)
            _bias_panel(ax, t, bias[:, c], sd[:, c], truth[:, c])
            time_axis(ax, t, outages)
    legend(fig)
    return fig


def _bias_panel(ax: "Axes", t: Array, bias: Array, sd: Array, truth: Array) -> None:
    if np.isfinite(sd).any():
        lo, hi = bias - 3.0 * sd, bias + 3.0 * sd
        ax.fill_between(t, lo, hi, color=SKY, alpha=0.35, linewidth=0, label="±3σ of the filter")
    ax.plot(t, bias, color=BLUE, linewidth=1.0, label="estimated")
    if np.isfinite(truth).any():
        ax.plot(t, truth, color=BLACK, linewidth=1.0, linestyle="--", label="truth")
    if np.isfinite(bias).any():
        centre = float(np.nanmedian(bias))
        both = np.concatenate([bias, truth]) - centre
        up = reach(np.maximum(both, 0.0), np.maximum(bias - centre + 3.0 * sd, 0.0))
        down = reach(np.maximum(-both, 0.0), np.maximum(centre - bias + 3.0 * sd, 0.0))
        margin = 0.05 * (up + down)
        limit(ax, t, bias, centre - down - margin, centre + up + margin)
