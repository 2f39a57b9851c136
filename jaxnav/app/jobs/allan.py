"""`jaxnav allan`: the noise figures of an IMU at rest."""

import math
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from jaxnav.analysis.allan import Allan, ReadOff, allan_deviation, at_least_rounding, read_off, regular
from jaxnav.analysis.plots import allan as plots_allan
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.tables import table
from jaxnav.app.config import Config
from jaxnav.app.results import Outcome, draws, picture
from jaxnav.app.sources import load
from jaxnav.checkup.inertial import resolution
from jaxnav.filters.border import NAMES, nested
from jaxnav.filters.standstill import is_driving, stationary
from jaxnav.findings import finding
from jaxnav.io import atomic_write
from jaxnav.io.json import write_json
from jaxnav.io.toml import to_toml
from jaxnav.maths.units import DEG, DEG_PER_HOUR, DEG_PER_SQRT_HOUR, TICK, UG
from jaxnav.types import DataError, ImuLog, Json, Samples

MIN_SAMPLES = 100  # samples
MOTION_FACTOR = 2.0  # factor, one sd, by which noise in motion is another than at rest
LEAVES = {sensor: (f"noise.{sensor}", f"states.{sensor}_bias.driving_noise") for sensor in ("gyro", "accel")}
"""White noise and the bias's driving noise, by sensor."""

KINDS = {
    "gyro": ("deg/h", DEG_PER_HOUR, {"N_deg_per_sqrt_hour": DEG_PER_SQRT_HOUR, "B_deg_per_hour": DEG_PER_HOUR,
             "K_deg_per_hour_per_sqrt_s": DEG_PER_HOUR, "gauss_markov_sd_deg_per_hour": DEG_PER_HOUR}),
    "accel": ("µg", UG, {"N_ug_per_sqrt_hz": UG, "B_ug": UG, "K_ug_per_sqrt_s": UG, "gauss_markov_sd_ug": UG}),
}  # fmt: skip
"""Sensor -> unit of the curve, its size in SI, and the quantities read off with the size of their unit."""


def allan(config: Config, folder: Path) -> Outcome:
    """Compute the Allan deviation of the recording between data.start and data.stop, and the noise that it shows.

    Raises:
        DataError: too few samples, or a gap.
    """
    begin = time.perf_counter()
    rec = load(config)
    imu = span(rec.imu, config.data.start, config.data.stop)
    gyro, accel, dt = regular(imu)
    found: Json = {
        "name": rec.name,
        "start_s": float(imu.t[0] - imu.dt[0]),
        "stop_s": float(imu.t[-1]),
        "rate_hz": 1 / dt,
    } | standing(config, imu, rec.aiding.get("velocity"))
    groups, rows, read, findings = [], {}, {}, []
    for kind, data in (("gyro", gyro), ("accel", accel)):
        unit, si, _ = KINDS[kind]
        curve, steps = allan_deviation(data, dt), resolution(getattr(imu, kind))
        shown = [read_off(curve, i) for i in range(3)]
        figures = [at_least_rounding(*each, dt) for each in zip(shown, curve.deviation[0], steps)]
        findings += [
            finding("imu.quantized", f"{kind} {axis}", step / si, unit_text=unit)
            for axis, step, before, after in zip("xyz", steps, shown, figures)
            if after != before
        ]
        rows[kind], read[kind] = [in_units(kind, f) for f in figures], (curve, figures)
        groups.append((kind, unit, si, curve, figures))
        found |= {f"{kind}_{axis}": row for axis, row in zip("xyz", rows[kind])}
        found[f"{kind}_curve"] = as_table(curve, unit, si)
    write_json(folder / "metrics.json", found | {"findings": [asdict(f) for f in findings]})
    head = f"# read off the Allan deviation of {rec.name} at rest; use: jaxnav tune --params grade.toml\n"
    atomic_write(folder / "grade.toml", head + to_toml(grade(read)))
    if draws(config):
        with picture("the deviations"):
            plots.save(plots_allan.allan(groups), folder / "allan.png")
    return Outcome(found, summary(found, rows), {"allan": time.perf_counter() - begin}, findings=findings)


def span(imu: ImuLog, start: float | None, stop: float | None) -> ImuLog:
    """Return the samples between two times.

    Raises:
        DataError: fewer than `MIN_SAMPLES`.
    """
    first = -np.inf if start is None else start
    last = np.inf if stop is None else stop
    inside = (imu.t - imu.dt >= first - TICK) & (imu.t <= last + TICK)
    if inside.sum() < MIN_SAMPLES:
        raise DataError(
            f"imu: {inside.sum()} samples between data.start and data.stop, at least {MIN_SAMPLES} are needed; "
            f"it covers {imu.t[0] - imu.dt[0]:.3f} to {imu.t[-1]:.3f} s"
        )
    return ImuLog(*(a[inside] for a in imu))


def standing(config: Config, imu: ImuLog, velocity: Samples | None = None) -> Json:
    """Return the share of time at rest by the detector of [filter] and by the receiver, and the longest rest (s)."""
    f = config.filter
    window = f.standing_window_s
    t = np.arange(imu.t[0] - imu.dt[0] + window, imu.t[-1] + TICK, window)
    if not t.size:
        return {}
    rest = stationary(imu, t, window, f.standing_accel_sd_mps2, f.standing_gyro_sd_deg_per_s * DEG)
    if velocity is not None:
        rest &= ~is_driving(velocity, t - window / 2) & ~is_driving(velocity, t)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rest.astype(int), [0]]))).reshape(-1, 2)
    if not edges.size:
        return {"share_at_rest": 0.0, "longest_rest_s": None}
    a, b = edges[np.argmax(np.diff(edges, axis=1))]
    return {"share_at_rest": float(rest.mean()), "longest_rest_s": [float(t[a] - window), float(t[b - 1])]}


def in_units(kind: str, found: ReadOff) -> dict[str, float | None]:
    """Return the quantities read off, in the units of their names; None where the data do not show one."""
    hump = found.gauss_markov
    lines = [None if line is None else line.value for line in found[:3]]
    values = [*lines, None if hump is None else hump.sd]
    row = {key: None if v is None else v / si for (key, si), v in zip(KINDS[kind][2].items(), values)}
    return row | {"gauss_markov_tau_s": None if hump is None else hump.tau}


def grade(read: dict[str, tuple[Allan, list[ReadOff]]]) -> Json:
    """Return settings of the noise that shows at rest, with [tune] prior: one sd as a factor.

    White noise by axis; the driving noise of a bias by its random walk, else by its Gauss-Markov hump. The prior is the
    figure's uncertainty, by the degrees of freedom of the curve where it was read, and `MOTION_FACTOR`.
    """
    params: Json = {}
    prior: dict[str, float] = {}
    for kind, leaves in LEAVES.items():
        curve, axes = read[kind]
        units = KINDS[kind][2]
        for leaf, of, si in zip(leaves, (_white, _driven), (list(units.values())[0], list(units.values())[2])):
            known = [found for axis in axes if (found := of(axis)) is not None]
            if not known:
                continue
            usual = float(np.exp(np.mean([math.log(value) for value, _ in known])))  # of an axis that shows nothing
            params[NAMES[leaf]] = [float(f"{(usual if (f := of(axis)) is None else f[0]) / si:.5g}") for axis in axes]
            edf = np.mean([np.interp(math.log(tau), np.log(curve.tau), curve.edf) for _, tau in known])
            prior[leaf] = float(f"{math.exp(math.hypot(1 / math.sqrt(2 * edf), math.log(MOTION_FACTOR))):.3g}")
    return nested(params) | {"tune": {"prior": prior}}


def _white(axis: ReadOff) -> tuple[float, float] | None:
    """Root PSD of white noise and the middle of the cluster times (s) that it was read from."""
    return None if axis.N is None else (axis.N.value, math.sqrt(axis.N.start * axis.N.stop))


def _driven(axis: ReadOff) -> tuple[float, float] | None:
    """Return the root PSD of the bias's driving noise."""
    if axis.K is not None:
        return axis.K.value, math.sqrt(axis.K.start * axis.K.stop)
    hump = axis.gauss_markov
    return None if hump is None else (hump.sd * math.sqrt(2 / hump.tau), 1.89 * hump.tau)


def as_table(curve: Allan, unit: str, si: float) -> Json:
    """Return the curve for JSON."""
    return {"unit": unit, "tau_s": curve.tau, "deviation": (curve.deviation / si).T, "edf": curve.edf}


def summary(found: Json, rows: dict[str, list[dict[str, float | None]]]) -> str:
    """Return the tables for the terminal."""
    lines = [f"{found['name']}: {found['start_s']:.1f} to {found['stop_s']:.1f} s at {found['rate_hz']:.4g} Hz"]
    if found.get("share_at_rest", 1.0) < 1.0:
        rest = found["longest_rest_s"]
        hint = f"; the longest rest is --start {rest[0]:.1f} --stop {rest[1]:.1f}" if rest else ""
        share = 100 * found["share_at_rest"]
        lines.append(f"at rest {share:.0f} % of this time only, the figures are of motion too{hint}")
    heads = {
        "gyro": ["gyro", "N deg/√h", "B deg/h", "K deg/h/√s", "GM sd deg/h", "GM tau s"],
        "accel": ["accel", "N µg/√Hz", "B µg", "K µg/√s", "GM sd µg", "GM tau s"],
    }
    for kind, head in heads.items():
        known = [[math.nan if v is None else v for v in row.values()] for row in rows[kind]]
        body = [[axis, *values] for axis, values in zip("xyz", known)]
        lines += ["", table(head, body)]
    return "\n".join(lines)
