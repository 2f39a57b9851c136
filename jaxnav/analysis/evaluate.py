"""Evaluation of a run: errors against truth in north, east, down, innovations, NIS, and its figures."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np

from jaxnav.analysis import metrics
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.plots import stats as plots_stats
from jaxnav.filters.run import track
from jaxnav.filters.scores import mean_nis
from jaxnav.maths.interpolation import columns_at
from jaxnav.maths.units import DEG
from jaxnav.measurements import Measurement, clock_offset, layout
from jaxnav.states import table
from jaxnav.states.table import BIASES
from jaxnav.types import Info, Json, Params, Samples, Track

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NED = [1, 0, 2]
SIGN = np.array([1.0, 1.0, -1.0])
ERRORS = (
    "north_m", "east_m", "down_m", "vn_mps", "ve_mps", "vd_mps", "roll_deg", "pitch_deg", "heading_deg",
)  # fmt: skip
Outages = list[tuple[float, float]]


class Trace(NamedTuple):
    """One run on the host."""

    track: Track  # in GNSS time
    sd: np.ndarray  # (E, 9) position m, velocity m/s, attitude rad, each in E, N, U
    sd_rph: np.ndarray  # (E, 3) rad, of roll, pitch, heading
    info: Info  # numpy


def trace(info: Info, params: Params) -> Trace:
    """Return a run (E, ...) of local level navigation on the host."""
    info = jax.tree.map(np.asarray, info)
    found = track(info.nav)
    variance = np.diagonal(info.P, axis1=1, axis2=2)
    attitude = info.P[:, 6:9, 6:9]
    heading = found.rph[:, 2]
    zero = np.zeros_like(heading)
    forward = np.stack([np.sin(heading), np.cos(heading), zero], 1)
    right = np.stack([np.cos(heading), -np.sin(heading), zero], 1)
    about = lambda axis: np.sqrt(np.einsum("ei,eij,ej->e", axis, attitude, axis))
    sd_rph = np.stack([about(forward), about(right), np.sqrt(attitude[:, 2, 2])], 1)
    found = found._replace(t=found.t + np.asarray(clock_offset(params.mounting, info.nav)))
    return Trace(found, np.sqrt(variance[:, :9]), sd_rph, info)


def ned_errors(sol: Trace, truth: Track) -> tuple[np.ndarray, np.ndarray]:
    """Errors (E, 9) in the units of ERRORS and their sd by the filter; nan where there is no truth, as in its holes.

    Attitude errors are rotations about the axes of their sd: level forward, level right, down.
    """
    e = metrics.errors(sol.track, truth)
    position, velocity = (np.asarray(a)[:, NED] * SIGN for a in (e.position, e.velocity))
    error = np.concatenate([position, velocity, metrics.attitude_errors(sol.track, truth) / DEG], 1)
    error[~metrics.covered_by(sol.track.t, truth.t)] = np.nan
    sd = np.concatenate([sol.sd[:, :3][:, NED], sol.sd[:, 3:6][:, NED], sol.sd_rph / DEG], 1)
    return error, sd


def error_metrics(error: np.ndarray, sd: np.ndarray, hidden: np.ndarray) -> Json:
    """RMS, 95 % and maximum by channel, with the share inside 3 sd; horizontal with and without fixes."""
    out: Json = {}
    for i, name in enumerate(ERRORS):
        known = np.isfinite(error[:, i])
        if known.any():
            a = np.abs(error[known, i])
            out[name] = _spread(a) | {"inside_3sd": float(np.mean(a <= 3 * sd[known, i]))}
    horizontal = np.hypot(error[:, 0], error[:, 1])
    for name, where in (("all", hidden | True), ("with_fixes", ~hidden), ("in_outages", hidden)):
        a = horizontal[where & np.isfinite(horizontal)]
        if a.size:
            out[f"horizontal_m_{name}" if name != "all" else "horizontal_m"] = _spread(a)
    return out


def _spread(a: np.ndarray) -> dict[str, float]:
    return {"rms": float(np.sqrt(np.mean(a**2))), "p95": float(np.quantile(a, 0.95)), "max": float(a.max())}


MAX_PANELS, FEW_PANELS = 24, 12  # channels that a figure of innovations shows, and of more, such as satellites'


def channel_names(measurements: tuple[Measurement, ...]) -> tuple[list[int], list[str], np.ndarray]:
    """Return the order of channels in reports (north, east, down), their names and the sign of each."""
    order, names, sign = [], [], []
    for m, s in zip(measurements, layout(measurements).values(), strict=True):
        places = np.arange(s.start, s.stop)
        if m.reported:
            places = places[NED]
            sign += [1.0, 1.0, -1.0]
        else:
            sign += [1.0] * places.size
        order += places.tolist()
        names += [f"{m.name.replace('_', ' ')} {axis}" for axis in m.reported or m.channels]
    return order, names, np.array(sign)


def innovation_metrics(info: Info, measurements: tuple[Measurement, ...]) -> Json:
    """RMS of the normalised innovations by channel, NIS by degree of freedom and its share inside 95 % bounds."""
    order, names, _ = channel_names(measurements)
    z = metrics.normalized_innovations(info)[:, order]
    rms = {name: float(metrics.rms(z[:, i])) for i, name in enumerate(names) if np.isfinite(z[:, i]).any()}
    dof = info.valid.sum(1)
    some = dof > 0
    bounds = {d: metrics.chi2_bounds(float(d)) for d in np.unique(dof[some]).tolist()}
    inside = [bounds[d][0] <= n <= bounds[d][1] for d, n in zip(dof[some].tolist(), info.nis[some])]
    share = float(np.mean(inside)) if inside else float("nan")
    return {"innovation_rms": rms, "nis_per_dof": mean_nis(info, np.asarray(some)), "nis_share_inside_95": share}


def figures(
    sol: Trace,
    truth: Track | None,
    fixes: Samples | None,
    measurements: tuple[Measurement, ...],
    outages: Outages,
    true_errors: tuple[np.ndarray, dict[str, np.ndarray]] | None = None,
    states: tuple[str, ...] = BIASES,
) -> "dict[str, Figure]":
    """Draw the figures of one run, by name of file; ``states``: its optional ones, in their order."""
    t, info = sol.track.t, sol.info
    valid, P = np.asarray(info.valid), np.asarray(info.P)
    found = {"trajectory": plots.trajectory(sol.track, truth, fixes, outages)}
    if truth is not None:
        error, sd = ned_errors(sol, truth)
        found["errors"] = plots.errors(t, error, sd, outages)
    order, names, sign = channel_names(measurements)
    nu, S = np.asarray(info.nu)[:, order] * sign, np.asarray(info.S)[:, order][:, :, order]
    if valid.any():
        most = None if valid.any(0).sum() <= MAX_PANELS else FEW_PANELS
        found["innovations"] = plots_stats.innovations(t, nu, S, valid[:, order], names, outages, most)
        found["nis"] = plots_stats.nis(t, np.asarray(info.nis), valid.sum(1), outages)
    if set(BIASES) <= set(states) & set(info.nav.errors):
        b_g, b_a = (np.asarray(info.nav.errors[name]) for name in BIASES)
        sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        true_g, true_a = (
            (None, None)
            if true_errors is None
            else (columns_at(t, true_errors[0], true_errors[1][name]) for name in BIASES)
        )
        places = table.layout(table.chosen(states))
        sd_g, sd_a = (sd[:, places[name]] for name in BIASES)
        found["biases"] = plots.biases(t, b_g, b_a, sd_g, sd_a, true_g, true_a, outages)
    return found
