"""Tight coupling in Tokyo: windows in which k satellites are left, tuned on the first half, judged on the second.

Orbits and satellite clocks are those of the station's broadcast messages. Errors are those against fixed RTK, with all
that the atmosphere leaves. Bars: RMS at 3 satellites 4.0 m, with all 1.5 m, tuned no worse than not tuned with any
number; the standing station within 1.0 m of its stated position.
"""

import os
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.io

from benchmarks import common
from jaxnav.analysis.noise_scan import NoiseScan
from jaxnav.analysis.tables import table
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.filters.lanes import RECEIVER_ERROR
from jaxnav.filters.run import prepare, run_jit
from jaxnav.gnss.corrections import RATES, at_reception, solved, with_rates
from jaxnav.gnss.orbits import Ephemeris, chosen
from jaxnav.gnss.ranges import LIGHT, Ranges, epochs, selected, streams, without_clock
from jaxnav.gnss.single_point import SinglePoint, single_point
from jaxnav.io.formats.rinex import read_navigation, read_observations
from jaxnav.maths.axes import geodetic, lla_to_local
from jaxnav.maths.gps_time import GPS_EPOCH, WEEK
from jaxnav.measurements import MEASUREMENTS
from jaxnav.navigation import navigate
from jaxnav.reading.datasets import DATA_DIR
from jaxnav.states.table import BIASES
from jaxnav.types import DataError, ImuLog, Params, Recording
from tuning.recordings.recorded import tune

DAY, GPS_WEEK, ORIGIN = "ixr_tokyo/2020-11-05", 2130, 364_400.0  # s of the week that is t = 0
IMU_BEHIND = 17.96  # s, of its clock behind GPS time (data/README.md)
LEVER_ARM = np.array([0.0, 0.0, -0.6])  # m
QZSS_RADIUS = 3e7  # m; GPS and QZSS share numbers there
LENGTH, EVERY, PHASES = 30.0, 60.0, 6
TIGHT, LOOSE = ("position", "pseudorange", "range_rate"), ("position", "velocity")
KS = (0, 1, 2, 3, 4, 5)
KEPT = (3, 1, 4, 2, 0)  # satellites that the windows of tuning keep, by turns
SURE = 0.3  # m between fixed RTK and the receiver's solution
BARS = {"3": 4.0, "all": 1.5, "station": 1.0}


class Case(NamedTuple):
    """The drive."""

    recording: Recording
    ranges: Ranges
    t: np.ndarray  # (R,) s, of a reference that is sure
    lla: np.ndarray  # (R, 3) of the antenna


def load(folder: Path) -> Case:
    """The drive with corrected ranges, single points, and the reference: fixed RTK that the receiver confirms."""
    rows = scipy.io.loadmat(folder / "GNSSTCData_GQ.mat")["GNSSTCData"]
    rows = rows[rows[:, 3] > 0]
    satellite = rows[:, 3].astype(int) + 100 * (np.linalg.norm(rows[:, 5:8], axis=1) > QZSS_RADIUS)
    order = np.lexsort((satellite, rows[:, 2]))
    rows, satellite = rows[order], satellite[order]
    t, moment = rows[:, 2] - ORIGIN, rows[:, 2] + GPS_EPOCH + GPS_WEEK * WEEK
    ranges = Ranges(t, satellite, rows[:, 4], rows[:, 8] + LIGHT * rows[:, 9], rows[:, 5:8], np.zeros((t.size, 3)),
                    np.radians(rows[:, 13]), rows[:, 14])  # fmt: skip
    first = single_point(ranges)
    receiver = np.stack([np.interp(t, first.t, x) for x in first.position.T], 1)
    eph, _ = read_navigation(folder / "base.nav")
    own = Ephemeris(*(a[chosen(eph, satellite, moment)] for a in eph))
    distance = np.linalg.norm(ranges.position - receiver, axis=1)
    rate = ranges.range_rate - np.interp(t, first.t, np.gradient(first.clock, first.t))
    before, after = (at_reception(own, moment + h, distance + h * rate, receiver)[0] for h in (-0.5, 0.5))
    at, _ = at_reception(own, moment, distance, receiver)
    ranges = ranges._replace(position=at, velocity=after - before)
    ranges, _ = without_clock(ranges, first.t, first.clock)
    sensor = scipy.io.loadmat(folder / "IMUData1105.mat")["IMUData"]
    sensor = sensor[sensor[:, 0] + IMU_BEHIND - ORIGIN < t[-1] + 1.0]
    body = lambda a: np.stack([a[:, 1], a[:, 0], -a[:, 2]], 1)  # right, forward, up -> FRD
    stamps = sensor[:, 0] + IMU_BEHIND - ORIGIN
    steps = np.diff(stamps, prepend=2 * stamps[0] - stamps[1])
    imu = ImuLog(stamps, steps, body(sensor[:, 4:7]), body(sensor[:, 1:4]))
    rec = Recording("tokyo", imu, fixes(single_point(ranges)) | streams(ranges), None, LEVER_ARM)
    rtk, other = (np.loadtxt(folder / name, delimiter=",") for name in ("RTK1105.csv", "ubox1105.csv"))
    near = np.stack([np.interp(rtk[:, 0], other[:, 0], x) for x in other[:, 1:4].T], 1)
    sure = (rtk[:, 4] == 1) & (np.linalg.norm(rtk[:, 1:4] - near, axis=1) < SURE)
    return Case(rec, ranges, rtk[sure, 0] - ORIGIN, geodetic(rtk[sure, 1:4]))


def fixes(found: SinglePoint) -> dict[str, Any]:
    """Single points as streams; their times are GPS time already."""
    return dict(zip(LOOSE, found._replace(clock=np.zeros_like(found.clock)).samples(), strict=True))


def free_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """The groups that are tuned."""
    return ("ranges",) if "pseudorange" in names else ("noise", "fixes")


def windows(t: np.ndarray, start: float, phases: int) -> list[np.ndarray]:
    """Hidden epochs (E,) of each phase: 30 s every 60 s."""
    shift = EVERY / PHASES
    return [((t - start - 30.0 - p * shift) % EVERY < LENGTH) & (t > start + 30.0) for p in range(phases)]


def ends(hidden: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The last epoch of each window that is whole."""
    last = np.flatnonzero(hidden[:-1] & ~hidden[1:])
    return last[t[last] - t[0] > LENGTH]


def errors(case: Case, lla: np.ndarray, sd: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Horizontal errors (E, 2) m of the antenna, their sd (E, 2), and which have a reference (E,)."""
    i = np.clip(np.searchsorted(case.t, t), 1, case.t.size - 1)
    i = np.where(np.abs(case.t[i] - t) < np.abs(case.t[i - 1] - t), i, i - 1)
    known = np.abs(case.t[i] - t) < 0.05
    scale = np.array([6.378e6 * np.cos(case.lla[0, 0]), 6.357e6])
    return (lla[:, [1, 0]] - case.lla[i][:, [1, 0]]) * scale, sd[:, :2], known


def figures(error: np.ndarray, sd: np.ndarray) -> dict[str, float]:
    """RMS, 95 % and NEES/2 of horizontal errors (W, 2)."""
    size = np.hypot(error[:, 0], error[:, 1])
    return {
        "rms_m": float(np.sqrt(np.mean(size**2))), "p95_m": float(np.percentile(size, 95)),
        "nees": float(np.mean(np.sum((error / sd) ** 2, 1)) / 2), "windows": len(size),
    }  # fmt: skip


class Method(NamedTuple):
    """A filter with parameters, ready to run."""

    filt: Filter
    params: Params
    nav: Any
    packed: ep.Packed


def method(
    case: Case, names: tuple[str, ...], states: tuple[str, ...] = (), tuned: bool = True, imu: Params | None = None
) -> Method:
    """A filter by the noise scan of the first half, tuned there or not; ``imu``: parameters with the IMU's noise."""
    rec = case.recording
    half = 0.5 * float(rec.aiding["position"].t[0] + rec.aiding["position"].t[-1])
    filt = build("ekf15", names, 5, states=states)
    sol = navigate(rec, filt, filt.params("consumer"), scan=True, stop=half)
    params, packed = (
        sol.params,
        ep.pack_recording(sol.recording, tuple(MEASUREMENTS[name] for name in names), float(sol.nav.t)),
    )
    if imu is not None:
        biases = {b: params.states[b]._replace(driving_noise=imu.states[b].driving_noise) for b in BIASES}
        params = params._replace(noise=imu.noise, states=params.states | biases)
    if tuned:
        params = tune(
            rec, sol.filter, params, free=free_of(names), initialization=sol.initialization, stop=half,
            hidden_satellites=KEPT if "pseudorange" in names else 0, scans=[NoiseScan()],
            log=partial(print, flush=True),
        ).params  # fmt: skip
    return Method(sol.filter, params, sol.nav, packed)


def judged(case: Case, one: Method, k: int | None, phases: int) -> dict[str, float]:
    """Errors at the ends of windows with k satellites in the second half; None: all epochs, nothing hidden."""
    t, half = one.packed.t, 0.5 * (one.packed.start + one.packed.t[-1])
    rows = tuple(MEASUREMENTS[name] for name in one.filt.model.measurements)
    tight = "pseudorange" in one.filt.model.measurements
    every: list[tuple[np.ndarray, np.ndarray]] = []
    hidden_of = [np.zeros(t.size, bool)] if k is None else windows(t, one.packed.start, phases)
    for hidden in hidden_of:
        packed = one.packed if tight or not k or k < 4 else with_few(case, one, hidden, k)
        hide = hidden if tight or not k or k < 4 else np.zeros(t.size, bool)
        info = run_jit(one.filt, one.params, one.nav, prepare(one.filt, ep.hide(packed.epochs, hide, rows, k or 0)))
        lla = antenna(info.nav)
        sd = np.sqrt(np.diagonal(np.asarray(info.P), axis1=1, axis2=2))
        error, spread, known = errors(case, lla, sd, t)
        at = np.flatnonzero(t > half) if k is None else ends(hidden, t)
        second = known & (t > half)
        at = at[second[at]]
        every.append((error[at], spread[at]))
    return figures(*(np.concatenate(a) for a in zip(*every, strict=True)))


def antenna(nav: Any) -> np.ndarray:
    """Latitude, longitude and height (E, 3) of the antenna, which is above the IMU."""
    lla = np.array(nav.pos)
    lla[:, 2] += -LEVER_ARM[2]
    return lla


def with_few(case: Case, one: Method, hidden: np.ndarray, k: int) -> ep.Packed:
    """The epochs of the loosely coupled filter with single points of the k highest satellites in windows."""
    times, of = epochs(case.ranges.t)
    inside = np.interp(times, one.packed.t, hidden.astype(float)) > 0.5
    rank = np.zeros(of.size, int)
    for e in np.flatnonzero(inside):
        rows = np.flatnonzero(of == e)
        rank[rows[np.argsort(-case.ranges.elevation[rows])]] = np.arange(rows.size)
    found = single_point(selected(case.ranges, ~inside[of] | (rank < k)))
    rec = case.recording._replace(aiding=fixes(found))
    rows = tuple(MEASUREMENTS[name] for name in one.filt.model.measurements)
    return ep.pack(rec.imu, rec.aiding, 0.2, rows, one.packed.start, cuts=one.packed.t)


def main(argv: list[str]) -> int:
    """Print the table, write the JSON."""
    parser = common.options("tight", __doc__ or "")
    parser.add_argument("--quick", action="store_true", help="two phases of the windows")
    parser.add_argument("--checks", action="store_true", help="time of a run and the station alone")
    args = parser.parse_args(argv)
    folder = Path(os.environ.get(DATA_DIR, "")) / DAY
    if not folder.is_dir():
        raise DataError(f"{folder}: not there: set {DATA_DIR}")
    case, phases = load(folder), 2 if args.quick else PHASES
    begin = time.perf_counter()
    fast = method(case, TIGHT, tuned=False)
    times, still = seconds(fast), station(folder)
    print(f"a run of {times['run_s']:.0f} s: {times['warm_s']:.1f} s, {times['first_s']:.1f} s with its compilation")
    print(
        f"station: {still['horizontal_m']:.2f} m horizontal about its mean, which is {still['mean_m']:.2f} m from the "
        f"stated position, {still['doppler_mps']:.3f} m/s by Doppler, "
        f"{still['phase_mps']:.3f} m/s by carrier phase, {still['epochs']} epochs"
    )
    if args.checks:
        common.write_json(args.json, {"seconds": times, "station": still})
        return 0
    loose = method(case, LOOSE, (RECEIVER_ERROR,))
    methods = {
        "loose": loose,
        "tight, not tuned": fast,
        "tight": method(case, TIGHT, imu=loose.params),
    }
    print(f"tuned in {time.perf_counter() - begin:.0f} s", flush=True)
    found = {name: {str(k): judged(case, one, k, phases) for k in KS} for name, one in methods.items()}
    every = {name: judged(case, one, None, phases) for name, one in methods.items()}
    rows = []
    for k in (*map(str, KS), "all"):
        each = [every[name] if k == "all" else found[name][k] for name in methods]
        rows.append([k, *(f"{e['rms_m']:.1f} ({e['p95_m']:.1f})" for e in each), *(f"{e['nees']:.2f}" for e in each)])
    head = ["satellites", *methods, *(f"NEES/2 {name}" for name in methods)]
    print(table(head, rows))
    values = {leaf: np.asarray(v).tolist() for leaf, v in tuned_values(methods["tight"].params).items()}
    print(values)
    result = {
        "windows": {k: e | {"loose_rms_m": found["loose"][k]["rms_m"]} for k, e in found["tight"].items()},
        "all": every["tight"] | {"loose_rms_m": every["loose"]["rms_m"]},
        "not_tuned": found["tight, not tuned"] | {"all": every["tight, not tuned"]},
        "loose": found["loose"], "tuned": values, "seconds": times, "station": still,
    }  # fmt: skip
    for line in bars(result):
        print(line)
    common.write_json(args.json, result)
    return 0


def station(folder: Path) -> dict[str, float]:
    """Single points of a standing station: mean against the stated position, spread, and velocity, RMS."""
    with (folder / "base_GQ_L1.obs").open() as text:
        stated = next(line.split()[:3] for line in text if "APPROX POSITION XYZ" in line)
    seen, _ = read_observations(folder / "base_GQ_L1.obs")
    messages, out = read_navigation(folder / "base.nav")[0], {}
    for rates in RATES:
        _, found = solved(with_rates(seen, rates)[0], messages)
        position, velocity = (stream.value for stream in found.samples())
        out[f"{rates}_mps"] = float(np.sqrt(np.mean(np.sum(velocity**2, 1))))
    metres = lla_to_local(position, position.mean(0))[:, :2]
    mean = lla_to_local(position, geodetic(np.array([stated], float))[0])[:, :2].mean(0)
    out["mean_m"] = float(np.hypot(*mean))
    return out | {"horizontal_m": float(np.sqrt(np.mean(np.sum(metres**2, 1)))), "epochs": len(position)}


def seconds(one: Method) -> dict[str, float]:
    """Times of one run of all epochs, the first with its compilation."""
    prepared, found = prepare(one.filt, one.packed.epochs), []
    for _ in range(3):
        begin = time.perf_counter()
        jax.block_until_ready(run_jit(one.filt, one.params, one.nav, prepared))
        found.append(time.perf_counter() - begin)
    return {"first_s": found[0], "warm_s": min(found), "run_s": float(one.packed.t[-1] - one.packed.start)}


def tuned_values(params: Params) -> dict[str, Any]:
    """The tuned numbers."""
    rows = {f"{name}.{leaf}": v for name in TIGHT[1:] for leaf, v in params.measurements[name]._asdict().items()}
    return rows | {
        f"{name}.{leaf}": v for name in ("range_error", "receiver_clock_bias", "receiver_clock_drift")
        for leaf, v in params.states[name]._asdict().items()
    } | {"noise.gyro": params.noise.gyro, "noise.accel": params.noise.accel}  # fmt: skip


def bars(result: dict[str, Any]) -> list[str]:
    """Each bar with its figure."""
    at, every = result["windows"], result["all"]
    found = [f"station: {result['station']['mean_m']:.2f} m (bar {BARS['station']})"]
    found.append(f"3 satellites: {at['3']['rms_m']:.1f} m (bar {BARS['3']}), NEES/2 {at['3']['nees']:.2f}")
    found.append(f"all: {every['rms_m']:.2f} m (bar {BARS['all']}), NEES/2 {every['nees']:.2f}")
    tuned = at | {"all": every}
    worse = {k: tuned[k]["rms_m"] / each["rms_m"] for k, each in result["not_tuned"].items()}
    return [*found, "tuned over not tuned: " + ", ".join(f"{k} {x:.2f}" for k, x in worse.items()) + " (bar 1)"]
