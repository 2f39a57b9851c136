"""The verdict of `solve` on simulated drives, healthy ones and ones with a fault, against the truth.

Drives of 240 s with a consumer's IMU and a receiver that states the sd of its error; slow errors are among the healthy
ones. The error over the stated sd is the largest RMS over `STRETCH_S` s of the horizontal error.
"""

import math
from collections.abc import Callable
from itertools import product
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.common import options, write_json
from benchmarks.simulated.earth import FIX_HZ, SECONDS, drive
from benchmarks.simulated.vehicles import simulated
from jaxnav.analysis.evaluate import ned_errors
from jaxnav.analysis.tables import table
from jaxnav.filters.catalogue import build
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.maths import earth
from jaxnav.maths.units import DEG
from jaxnav.navigation import navigate
from jaxnav.types import DataError, FilterError, Recording, Samples
from tuning.solving.solve import CONSISTENT, UNUSABLE, solve

VEHICLES = ("car", "steep", "walk", "ship", "train", "mower", "quadrotor", "helicopter", "bus", "aircraft")
RECEIVERS = ("white", "slow", "rtk")  # of the healthy drives, by turns
STRETCH_S, MAX_RATIO = 10.0, 2.5  # s; of a consistent drive
FLYING, DELAYS_S = ("steep", "quadrotor", "helicopter"), (-0.5, -0.25, 0.0, 0.25, 0.5)  # of the short flights
DARK = ((25.0, 30.0), (33.0, 38.0), (41.0, 46.0))  # s, their hidden windows
EARLY, LATE = (60.0, 100.0), (190.0, 225.0)  # s, of the faults


Change = Callable[[Recording, np.random.Generator], Recording]


def moved(rec: Recording, error: np.ndarray, rate: np.ndarray | None = None) -> Recording:
    """Return the recording with errors (K, 3) m, ENU, of its positions and (K, 3) m/s of its velocities."""
    p = rec.aiding["position"]
    metres = np.asarray(earth.metres_per_radian(p.value[0]))
    aiding = rec.aiding | {"position": p._replace(value=p.value + error[:, [1, 0, 2]] / metres)}
    if rate is not None:
        v = rec.aiding["velocity"]
        aiding["velocity"] = v._replace(value=v.value + rate)
    return rec._replace(aiding=aiding)


def dragged(when: tuple[float, float]) -> Change:
    """Drag positions and velocities off together by 2 m/s, which end with a jump back."""

    def apply(rec: Recording, rng: np.random.Generator) -> Recording:
        t, angle = rec.aiding["position"].t, rng.uniform(0, 2 * np.pi)
        inside = ((t > when[0]) & (t <= when[1]))[:, None]
        rate = 2.0 * inside * np.array([np.sin(angle), np.cos(angle), 0.0])
        return moved(rec, rate * (t[:, None] - when[0]), rate)

    return apply


def slow(rec: Recording, rng: np.random.Generator) -> Recording:
    """Add errors of 2 m over 400 s that the receiver does not state."""
    t, keep = rec.aiding["position"].t, math.exp(-1 / (FIX_HZ * 400.0))
    error = 2.0 * rng.normal(size=(t.size, 3))
    for k in range(1, t.size):
        error[k] = keep * error[k - 1] + math.sqrt(1 - keep**2) * error[k]
    return moved(rec, error)


def later(delay: float) -> Change:
    """Make all fixes late by ``delay`` s, or early."""
    move = lambda s: s._replace(t=s.t + delay)
    return lambda rec, rng: rec._replace(aiding={name: move(s) for name, s in rec.aiding.items()})


def arm(rec: Recording, rng: np.random.Generator) -> Recording:
    """Take the positions and velocities of an antenna 3 m off, which the recording does not state."""
    truth = rec.truth
    assert truth is not None
    angle = rng.uniform(0, 2 * np.pi)
    off = np.array([3.0 * np.cos(angle), 3.0 * np.sin(angle), 0.0])
    r, p, y = truth.rph.T
    cr, sr, cp, sp, cy, sy = np.cos(r), np.sin(r), np.cos(p), np.sin(p), np.cos(y), np.sin(y)
    north = off[0] * cp * cy + off[1] * (sr * sp * cy - cr * sy)
    east = off[0] * cp * sy + off[1] * (sr * sp * sy + cr * cy)
    down = -off[0] * sp + off[1] * sr * cp
    path = np.stack([east, north, -down], 1)
    at = lambda a: np.column_stack([np.interp(rec.aiding["position"].t, truth.t, c) for c in a.T])
    return moved(rec, at(path), at(np.gradient(path, truth.t, axis=0)))


def lying_height(rec: Recording, rng: np.random.Generator) -> Recording:
    """Let the receiver's height rise by 40 m, against the height of a barometer."""
    truth, t = rec.truth, rec.aiding["position"].t
    assert truth is not None
    k = np.arange(0.5, SECONDS, 0.2)
    height = np.interp(k, truth.t, truth.lla[:, 2]) + 0.3 * rng.normal(size=k.size)
    baro = Samples(k, height[:, None], np.full((k.size, 1), 0.5), np.zeros((k.size, 1)))
    up = 40.0 * np.clip((t - EARLY[0]) / 60.0, 0.0, 1.0)
    rec = moved(rec, np.stack([0 * up, 0 * up, up], 1))
    return rec._replace(aiding=rec.aiding | {"barometer": baro})


def sensors(gyro: np.ndarray | None = None, accel: np.ndarray | None = None) -> Change:
    """Multiply the sensors' axes by matrices (3, 3)."""
    turned = lambda a, M: a if M is None else a @ M.T
    return lambda rec, rng: rec._replace(
        imu=rec.imu._replace(gyro=turned(rec.imu.gyro, gyro), accel=turned(rec.imu.accel, accel))
    )


def clock_rate(rec: Recording, rng: np.random.Generator) -> Recording:
    """Let the IMU's clock run fast by 0.2 %."""
    return rec._replace(imu=rec.imu._replace(t=1.002 * rec.imu.t, dt=1.002 * rec.imu.dt))


FAULTS: dict[str, Change] = {
    "dragged early": dragged(EARLY),
    "dragged late": dragged(LATE),
    "slow errors": slow,
    "gyro scale": sensors(gyro=1.05 * np.eye(3)),
    "accelerometer scale": sensors(accel=1.1 * np.eye(3)),
    "early": later(-0.45),
    "late": later(0.35),
    "clock": clock_rate,
    "axes": sensors(gyro=np.eye(3)[[1, 0, 2]]),
    "units": sensors(gyro=np.eye(3) / DEG),
    "lever arm": arm,
    "height": lying_height,
}
"""By name; each is tried on some of the vehicles."""


def score(rec: Recording, fast: bool, clock: str = "imu") -> dict[str, Any]:
    """Return the verdict on a drive, and its errors over the stated sd; ``clock``: of the truth, "imu" or "fixes"."""
    clear_caches_if_needed()
    try:
        found = solve(rec, fast=fast)
    except (DataError, FilterError) as failure:
        return {"verdict": "refused", "why": str(failure), "error_over_sd": math.nan}
    sol = found.solution
    assert rec.truth is not None
    track, sd = sol.at_imu_time(sol.trace.track, sol.sd) if clock == "imu" else (sol.trace.track, sol.sd)
    error, sd = ned_errors(sol.trace._replace(track=track, sd=sd), rec.truth)
    square = ((error[:, :2] / sd[:, :2]) ** 2).mean(1)
    known = np.isfinite(square)
    n = max(1, round(STRETCH_S / float(np.median(np.diff(sol.t)))))
    mean = np.convolve(square[known], np.ones(n) / n, "valid")
    return {
        "verdict": found.verdict, "why": found.why, "error_over_sd": float(np.sqrt(mean.max())),
        "left_out": found.left_out, "error_m": float(np.sqrt((error[known][:, :2] ** 2).sum(1).mean())),
        "findings": sorted({f.code for f in found.findings if f.warns}),
    }  # fmt: skip


def short_flight(vehicle: str, delay: float, seed: int) -> dict[str, float]:
    """Return the drift, m, over hidden windows of a flight of 50 s: by scan, by the true delay, and by datasheet."""
    clear_caches_if_needed()
    rng = np.random.default_rng([seed, FLYING.index(vehicle), round(100 * delay) + 100])
    rec, _ = simulated(vehicle, "consumer", True, rng, sd=0.4, span=50.0, fix_hz=5.0, late=0.0)
    rec = later(delay)(rec, rng)
    truth, ekf = rec.truth, build("ekf15", cov_stride=5)
    assert truth is not None
    plain = ekf.params("consumer")
    stated = plain._replace(mounting=plain.mounting._replace(time_offset=jnp.asarray(delay)))
    found = {}
    for name, params, scan in (("scan", plain, True), ("stated", stated, True), ("datasheet", plain, False)):
        sol = navigate(rec, ekf, params, scan=scan, outages=DARK)
        ends = [int(np.searchsorted(sol.t, b)) for _, b in DARK]
        at = np.column_stack([np.interp(sol.t[ends] - delay, truth.t, c) for c in truth.lla.T])
        found[name] = float(np.sqrt((earth.enu_path(sol.lla[ends], at)[:, :2] ** 2).sum(1).mean()))
    return found


def short_flights(seed: int) -> dict[str, dict[str, float]]:
    """Print and return the drift of short flights with delays."""
    found = {}
    for vehicle, delay in product(FLYING, DELAYS_S):
        found[f"{vehicle}, {delay:+.2f} s"] = row = short_flight(vehicle, delay, seed)
        row["of stated"], row["of datasheet"] = row["scan"] / row["stated"], row["scan"] / row["datasheet"]
        print(f"{vehicle:12} {delay:+.2f} s  " + "  ".join(f"{k} {v:.2f}" for k, v in row.items()), flush=True)
    for key in ("of stated", "of datasheet"):
        ratios = [row[key] for row in found.values()]
        print(f"drift {key}: median {np.median(ratios):.2f}, largest {max(ratios):.2f}")
    return found


def summary(healthy: dict[str, dict[str, Any]], faulty: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the bars."""
    share = lambda word: sum(row["verdict"] == word for row in healthy.values()) / max(len(healthy), 1)
    lied = [n for n, row in faulty.items() if row["verdict"] == CONSISTENT and not row["error_over_sd"] <= MAX_RATIO]
    return {
        "healthy": len(healthy), "consistent": share(CONSISTENT), "not usable": share(UNUSABLE),
        "faulty": len(faulty), "consistent beyond the sd": len(lied), "they are": ", ".join(lied),
    }  # fmt: skip


def main(argv: list[str]) -> None:
    """Print a line for each drive, write the JSON."""
    parser = options("verdict", __doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=60, help="healthy and faulty each, default 60")
    parser.add_argument("--tune", action="store_true", help="tune as well")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), help="of them, default all")
    parser.add_argument("--delays", action="store_true", help="the drift of short flights with delays instead")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    args = parser.parse_args(argv)
    if args.delays:
        write_json(args.json, {"delays": short_flights(args.seed)})
        return
    found: dict[str, dict[str, dict[str, Any]]] = {"healthy": {}, "faulty": {}}
    for i in range(args.drives):
        vehicle, receiver = VEHICLES[i % len(VEHICLES)], RECEIVERS[i % len(RECEIVERS)]
        rec = drive(vehicle, receiver, 1.0, args.seed + i)
        cases = {"healthy": (f"{i} {vehicle}, {receiver}", rec)}
        if args.faults:
            name = args.faults[i % len(args.faults)]
            broken = FAULTS[name](drive(vehicle, "white", 1.0, args.seed + i), np.random.default_rng([args.seed, i]))
            cases["faulty"] = f"{i} {vehicle}, {name}", broken
        for kind, (label, case) in cases.items():
            clock = "fixes" if label.endswith("clock") else "imu"  # that one's IMU gains
            found[kind][label] = row = score(case, not args.tune, clock)
            print(f"{kind:8} {label:32} {row['verdict']:16} {row['error_over_sd']:6.2f}  {row['why']}; "
                  f"{' '.join(row.get('findings', []))}", flush=True)  # fmt: skip
    about = summary(found["healthy"], found["faulty"])
    print(table(["", ""], [[name, value] for name, value in about.items()]))
    write_json(args.json, found | {"summary": about})
