"""A run to zoom into: track, errors, innovations and biases on one axis of time, by bokeh."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxnav.analysis.plots.base import BLUE, COLORS, ORANGE, VERMILION, Outages
from jaxnav.maths import earth, units

if TYPE_CHECKING:
    from jaxnav.analysis.evaluate import Trace
    from jaxnav.measurements import Measurement
    from jaxnav.types import Samples, Track

MAX_POINTS = 6000  # points of a line: longer ones are thinned, so that a report of an hour stays below 5 MB
WIDTH = 1000


def run_layout(
    sol: "Trace",
    truth: "Track | None",
    fixes: "Samples | None",
    measurements: Sequence["Measurement"],
    outages: Outages,
    states: Sequence[str],
) -> Any:
    """Everything of one run, as a bokeh layout.

    Raises:
        ImportError: bokeh is not installed.
    """
    from bokeh.layouts import column
    from bokeh.models import Range1d

    t = sol.track.t
    shared = Range1d(float(t[0]), float(t[-1]))
    rows = [_track(sol, truth, fixes)]
    rows += _errors(sol, truth, shared, outages) if truth is not None else _sd(sol, shared, outages)
    rows += _innovations(sol, tuple(measurements), shared, outages)
    rows += _biases(sol, states, shared, outages)
    return column(*rows, sizing_mode="stretch_width", max_width=WIDTH)


def _thin(n: int) -> slice:
    return slice(None, None, max(1, -(-n // MAX_POINTS)))


def _axes(title: str, unit: str, shared: Any, outages: Outages) -> Any:
    from bokeh.models import BoxAnnotation
    from bokeh.plotting import figure

    fig = figure(
        title=title, sizing_mode="stretch_width", height=230, x_range=shared, x_axis_label="t (s)", y_axis_label=unit,
        tools="xpan,xwheel_zoom,box_zoom,reset,save,crosshair", active_scroll="xwheel_zoom", output_backend="webgl",
    )  # fmt: skip
    for begin, end in outages:
        fig.add_layout(BoxAnnotation(left=begin, right=end, fill_color="gray", fill_alpha=0.15, level="underlay"))
    return fig


def _track(sol: "Trace", truth: "Track | None", fixes: "Samples | None") -> Any:
    from bokeh.models import ColumnDataSource, HoverTool
    from bokeh.plotting import figure

    origin = sol.track.lla[0]
    fig = figure(
        title="Track, m east and north of the start", sizing_mode="stretch_width", height=620, match_aspect=True,
        x_axis_label="east (m)", y_axis_label="north (m)", tools="pan,wheel_zoom,box_zoom,reset,save",
        active_scroll="wheel_zoom",
    )  # fmt: skip
    if fixes is not None and fixes.t.size:
        where, thin = earth.enu_path(fixes.value, origin), _thin(fixes.t.size)
        fig.scatter(where[thin, 0], where[thin, 1], size=3, color="silver", legend_label="fixes")
    if truth is not None:
        where, thin = earth.enu_path(truth.lla, origin), _thin(truth.t.size)
        fig.line(where[thin, 0], where[thin, 1], color=VERMILION, line_dash="dashed", legend_label="truth")
    where, thin = earth.enu_path(sol.track.lla, origin)[:, :3], _thin(sol.track.t.size)
    data = {
        "t": sol.track.t[thin],
        "east": where[thin, 0],
        "north": where[thin, 1],
        "height": sol.track.lla[thin, 2],
        "heading": np.degrees(sol.track.rph[thin, 2]) % 360,
        "speed": np.linalg.norm(sol.track.vel[thin], axis=1),
        "sd": np.hypot(sol.sd[thin, 0], sol.sd[thin, 1]),
    }
    source = ColumnDataSource(data)
    line = fig.line("east", "north", source=source, color=BLUE, line_width=2, legend_label="solution")
    tips = [("t", "@t{0.00} s"), ("height", "@height{0.0} m"), ("heading", "@heading{0.0} deg"),
            ("speed", "@speed{0.00} m/s"), ("horizontal sd", "@sd{0.00} m")]  # fmt: skip
    fig.add_tools(HoverTool(renderers=[line], tooltips=tips, line_policy="nearest"))
    fig.legend.click_policy = "hide"
    return fig


def _lines(
    fig: Any,
    t: np.ndarray,
    values: np.ndarray,
    names: Sequence[str],
    band: np.ndarray | None = None,
    centre: np.ndarray | None = None,
) -> Any:
    """Draw ``values`` (E, k), and ``band`` (E, k) above and below of zero or of ``centre`` (E, k), dotted."""
    from bokeh.models import ColumnDataSource, Line

    thin = _thin(t.size)
    columns = {"t": t[thin]} | {name: values[thin, i] for i, name in enumerate(names)}
    if band is not None:
        middle = np.zeros_like(band) if centre is None else centre
        sides = {
            f"{side} {name}": (middle + sign * band)[thin, i]
            for i, name in enumerate(names)
            for side, sign in (("above", 1), ("below", -1))
        }
        columns |= sides
    source = ColumnDataSource(columns)
    for i, name in enumerate(names):
        for side in ("above", "below") if band is not None else ():
            style = {"line_color": COLORS[i], "line_dash": "dotted", "line_alpha": 0.6}
            fig.add_glyph(source, Line(x="t", y=f"{side} {name}", **style))
        fig.line("t", name, source=source, color=COLORS[i], legend_label=name)
    return _legend(fig)


def _legend(fig: Any) -> Any:
    fig.legend.click_policy = "hide"
    fig.legend.label_text_font_size = "8pt"
    return fig


def _errors(sol: "Trace", truth: "Track", shared: Any, outages: Outages) -> list[Any]:
    from jaxnav.analysis.evaluate import ned_errors

    error, sd = ned_errors(sol, truth)
    groups = (
        ("Position error, 3 sd dotted", "m", ("north", "east", "down")),
        ("Velocity error, 3 sd dotted", "m/s", ("north", "east", "down")),
        ("Attitude error, 3 sd dotted", "deg", ("roll", "pitch", "heading")),
    )
    out = []
    for k, (title, unit, names) in enumerate(groups):
        axes = slice(3 * k, 3 * k + 3)
        out.append(_lines(_axes(title, unit, shared, outages), sol.track.t, error[:, axes], names, 3 * sd[:, axes]))
    return out


def _sd(sol: "Trace", shared: Any, outages: Outages) -> list[Any]:
    fig = _lines(
        _axes("Standard deviation of the position", "m", shared, outages),
        sol.track.t,
        sol.sd[:, :3],
        ("east", "north", "up"),
    )
    attitude = np.degrees(sol.sd_rph)
    return [fig, _lines(_axes("Standard deviation of the attitude", "deg", shared, outages), sol.track.t, attitude,
                        ("roll", "pitch", "heading"))]  # fmt: skip


def _innovations(sol: "Trace", measurements: tuple[Any, ...], shared: Any, outages: Outages) -> list[Any]:
    from bokeh.models import Span

    from jaxnav.measurements import layout

    info, t = sol.info, sol.track.t
    z = np.asarray(info.nu) / np.sqrt(np.diagonal(np.asarray(info.S), axis1=1, axis2=2))
    out = []
    for m, channels in zip(measurements, layout(measurements).values(), strict=True):
        if not np.asarray(info.valid)[:, channels].any():
            continue
        fig = _axes(
            f"Innovations of {m.name.replace('_', ' ')}, in their sd; refused ones are crosses", "", shared, outages
        )
        for i in range(channels.start, channels.stop):
            valid, used = np.asarray(info.valid)[:, i], np.asarray(info.used)[:, i]
            good, gone = np.flatnonzero(valid & used), np.flatnonzero(valid & ~used)
            thin = good[_thin(good.size)]
            k = i - channels.start
            fig.scatter(t[thin], z[thin, i], size=3, color=COLORS[k % len(COLORS)], legend_label=m.channels[k])
            if gone.size:
                fig.scatter(t[gone], z[gone, i], size=6, marker="x", color="black", legend_label="refused")
        for level in (-3, 3):
            fig.add_layout(Span(location=level, dimension="width", line_color=ORANGE, line_dash="dashed"))
        out.append(_legend(fig))
    return out


def _biases(sol: "Trace", states: Sequence[str], shared: Any, outages: Outages) -> list[Any]:
    from jaxnav.states import table

    out, places = [], table.layout(table.chosen(tuple(states)))
    rows = (
        ("gyro_bias", "Gyro biases, sd dotted", "deg/h", units.DEG_PER_HOUR),
        ("accel_bias", "Accelerometer biases, sd dotted", "mg", units.MG),
    )
    variance = np.diagonal(np.asarray(sol.info.P), axis1=1, axis2=2)
    for name, title, unit, factor in rows:
        if name in places and name in sol.info.nav.errors:
            value = np.asarray(sol.info.nav.errors[name]) / factor
            sd = np.sqrt(variance[:, places[name]]) / factor
            out.append(_lines(_axes(title, unit, shared, outages), sol.track.t, value, "xyz", sd, value))
    return out
