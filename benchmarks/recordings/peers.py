"""Filters of other people: the same samples, fixes, noise, hidden windows and scores.

Simulated drives in town, where the truth is known: python-ins and KF-GINS (its executable, where the environment
variable KFGINS_BIN names it) with the true noise, and filterpy's Kalman filter on the fixes alone, with a constant
velocity, for the value of an IMU. Then the drive of `benchmarks.recordings.drive`: KF-GINS and a filter of ours that
measures and estimates the same (positions; 21 states) with the datasheet's noise, with the drive's timing, and with the
result of `jaxnav tune --for kfgins` on stretches that do not touch the window's quarter. Errors are horizontal, at the
last hidden fix. Between them python-ins with scale factors (21 states), and with misalignment too (33): an hour of its
sine motion, of sensors that have both, and NaveGo's synthetic data. GTSAM: `python -m benchmarks kitti`.
"""

import os
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.recordings import drive, navego, peers_kfgins
from benchmarks.speed.speed_peers import found as installed
from benchmarks.speed.speed_peers import python_ins
from jaxnav import build, reading, recording
from jaxnav.analysis.tables import table
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import with_history
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.run import initial_nav, run_jit
from jaxnav.initialization.initialize import Initialization
from jaxnav.maths import earth, units
from jaxnav.measurements import POSITION
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import URBAN, Scenario
from jaxnav.simulate.simulation import Simulated, matched_params, simulate
from jaxnav.states.grades import GRADES
from jaxnav.states.table import STATES
from jaxnav.types import Epoch, Fix, Imu, ImuLog, Nav, Params, Recording, StateParams, sample_rows
from tuning import tune
from tuning.recordings.recorded import spread
from tuning.recordings.targets import TARGETS

LIKE = TARGETS["kfgins"]
WINDOWS = ((60.0, 75.0), (100.0, 115.0), (140.0, 155.0))  # s, simulated
SCENARIO: Scenario = URBAN._replace(
    duration_s=170.0, gnss=URBAN.gnss._replace(outages_s=(), random_outages=0), imu=URBAN.imu._replace(grade="consumer")
)
GUARD, SHORTEST = 8.0, 60.0  # s between a window and a stretch that is tuned on, and the least of one
MOVING = drive.prior((2.0, 2.0, 2.0), 0.3, np.array([3.0, 3.0, 15.0]) * units.DEG)


# ---------------------------------------------------------------------------- simulated


def horizontal(lla: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Metres between positions (W, 3)."""
    off = np.asarray(jax.vmap(earth.enu_difference)(jnp.asarray(lla), jnp.asarray(truth)))
    return np.hypot(off[:, 0], off[:, 1])


def one_run(seed: int, binary: Path | None) -> dict[str, np.ndarray]:
    """Errors (W,) m at the ends of the windows, by filter."""
    params = matched_params(SCENARIO)
    sim: Simulated = jax.jit(partial(simulate, scenario=SCENARIO))(run_keys(seed, Purpose.STUDY, np.arange(1))[0])
    t, truth = np.asarray(sim.truth.t), np.asarray(sim.truth.pos)
    hidden = ep.within(t, WINDOWS)
    last = np.array([np.flatnonzero(ep.within(t, [w]))[-1] for w in WINDOWS])
    epochs = ep.hide(sim.epochs, hidden)
    ekf = build("ekf15", cov_stride=10)
    ours = np.asarray(run_jit(ekf, params, sim.initial, epochs).nav.pos)
    errors = {"jaxnav, 15 states": horizontal(ours[last], truth[last])}
    call = python_ins(params, sim.initial, epochs, 0.1)
    if call is not None:
        errors["python-ins, 15 states"] = horizontal(call()[last], truth[last])
    rec, begin = (
        as_recording(sim),
        Initialization(jax.tree.map(lambda a: a[None], sim.initial), params.prior, 0.0),
    )
    like, sheet = like_kfgins(params)
    packed = ep.pack_recording(rec, (POSITION,), 0.0)
    hidden = ep.within(packed.t, WINDOWS)
    mine = np.asarray(run_jit(like, sheet, sim.initial, ep.hide(packed.epochs, hidden, (POSITION,))).nav.pos)
    ends = np.searchsorted(packed.t, t[last] - 1e-6)
    errors["jaxnav, positions, 21 states"] = horizontal(mine[ends], truth[last])
    if binary is not None:
        track = peers_kfgins.run(binary, peers_kfgins.without(rec, list(WINDOWS)), sheet, begin)
        theirs = np.stack([np.interp(t[last], track.t, track.lla[:, i]) for i in range(3)], 1)
        errors["KF-GINS, positions, 21 states"] = horizontal(theirs, truth[last])
    package = installed("filterpy.kalman")
    if package is not None:
        alone = constant_velocity(package, sim, ~ep.within(t, WINDOWS))
        errors["filterpy, fixes alone"] = horizontal(alone[last], truth[last])
    return errors


def as_recording(sim: Simulated) -> Recording:
    """The simulated samples and fixes as a recording from 0 s."""
    dt, gyro, accel = (np.asarray(a).reshape(-1, *a.shape[2:]) for a in sim.epochs.imu)
    imu = ImuLog(np.cumsum(dt), dt, gyro, accel)
    value, sd = np.asarray(sim.epochs.fix.value), np.asarray(sim.epochs.fix.sd)
    return recording(imu, position=(np.asarray(sim.truth.t), value[:, :3], sd[:, :3]), name="simulated")


def like_kfgins(params: Params) -> tuple[Filter, Params]:
    """A filter with the measurements and states of KF-GINS, and the parameters in its shape."""
    like = build(LIKE.filter, LIKE.measurements, cov_stride=10, states=LIKE.states)
    own = like.params("consumer").states
    states = params.states | {name: own[name] for name in LIKE.states}
    return like, LIKE.shaped(params._replace(states=states, measurements={"position": params.measurements["position"]}))


def constant_velocity(package, sim: Simulated, seen: np.ndarray) -> np.ndarray:
    """Positions (E, 3) of a constant velocity with an acceleration of 2 m/s^2 as white noise, by the fixes alone."""
    value, sd = np.asarray(sim.epochs.fix.value), np.asarray(sim.epochs.fix.sd)
    origin, dt = value[0, :3], float(np.diff(sim.truth.t).mean())
    scale = np.asarray(earth.metres_per_radian(jnp.asarray(origin)))
    local = np.stack([(value[:, i] - origin[i]) * scale[i] for i in (1, 0, 2)], 1)
    kf = package.KalmanFilter(dim_x=6, dim_z=6)
    kf.F, kf.H = np.block([[np.eye(3), dt * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]]), np.eye(6)
    push = np.concatenate([0.5 * dt**2 * np.eye(3), dt * np.eye(3)])
    kf.Q, kf.P, kf.x = 4.0 * push @ push.T, 100.0 * np.eye(6), np.concatenate([local[0], value[0, 3:]])[:, None]
    out = []
    for own, v, s, use in zip(local, value[:, 3:], sd, seen, strict=True):
        kf.predict()
        if use:
            kf.update(np.concatenate([own, v])[:, None], R=np.diag(s**2))
        east, north, up = kf.x[:3, 0]
        out.append(origin + np.array([north, east, up]) / scale)
    return np.array(out)


# ---------------------------------------------------------------------------- errors of scale and axes by python-ins

SINE: dict[str, Any] = {"lla0": [55, 37, 1500], "velocity_mean": [5, -3, 0.2], "velocity_change_amplitude": 5}
ERROR, FIX_SD, VELOCITY_SD = 2e-3, 2.0, 0.1  # of scale and, in rad, of the axes; m; m/s
SCALES = ("gyro_scale", "accel_scale")


def sine_drive(duration: float, seed: int) -> tuple[Nav, Epoch, np.ndarray]:
    """Start, epochs of 1 Hz and true positions (E, 3) of python-ins' sine motion, its sensors with errors."""
    from pyins import sim

    rng = np.random.default_rng(seed)
    motion, log = sim.generate_sine_velocity_motion(0.01, duration + 1.0, sensor_type="increment", **SINE)
    E, grade = int(duration), GRADES["adis16465"]
    readings = log.to_numpy()[1 : 100 * E + 1] / 0.01
    rates, forces = readings[:, :3], readings[:, 3:]
    white = [g / np.sqrt(0.01) * rng.normal(size=rates.shape) for g in (grade.arw, grade.vrw)]
    biases = [sd * rng.normal(size=3) for sd in (grade.gyro_turn_on, grade.accel_turn_on)]
    mixed = [np.eye(3) + ERROR * rng.normal(size=(3, 3)) for _ in range(2)]
    gyro, accel = (a @ M.T + b + w for a, M, b, w in zip((rates, forces), mixed, biases, white, strict=True))
    imu = Imu(np.full((E, 100), 0.01), gyro.reshape(E, 100, 3), accel.reshape(E, 100, 3))
    rows = motion.iloc[100 : 100 * E + 1 : 100]
    radians = np.array([units.DEG, units.DEG, 1.0])
    lla = rows[["lat", "lon", "alt"]].to_numpy() * radians
    vel = rows[["VE", "VN", "VD"]].to_numpy() * [1, 1, -1]
    noise = np.concatenate([FIX_SD * rng.normal(size=(E, 3)), VELOCITY_SD * rng.normal(size=(E, 3))], 1)
    seen = np.asarray(jax.vmap(earth.move)(jnp.asarray(lla), jnp.asarray(noise[:, :3])))
    sd = np.broadcast_to([FIX_SD] * 3 + [VELOCITY_SD] * 3, (E, 6))
    fix = Fix(np.concatenate([seen, vel + noise[:, 3:]], 1), sd, np.zeros((E, 6)), np.ones((E, 6), bool))
    first = motion.iloc[0]
    begin = initial_nav(
        first[["lat", "lon", "alt"]].to_numpy() * radians, first[["VE", "VN", "VD"]].to_numpy() * [1, 1, -1],
        first[["roll", "pitch", "heading"]].to_numpy() * units.DEG,
    )  # fmt: skip
    return begin, jax.tree.map(jnp.asarray, Epoch(imu, fix)), lla


def beside(params: Params, nav: Nav, epochs: Epoch, truth: np.ndarray, states: tuple[str, ...]) -> dict[str, float]:
    """RMS of the position error in m, three axes, of python-ins and of ours with the same states."""
    ekf = build("ekf15", cov_stride=10, states=states)
    known = params.states | {name: StateParams(jnp.asarray(ERROR), 0.0, jnp.inf) for name in states}
    params = jax.tree.map(jnp.asarray, params._replace(states=known))
    rms = lambda lla: float(np.sqrt(np.mean(np.square(jax.vmap(earth.enu_difference)(jnp.asarray(lla), truth[:-1])))))
    found = {"jaxnav": rms(run_jit(ekf, params, nav, epochs).nav.pos[:-1])}
    call = python_ins(params, nav, epochs, 0.1)
    return found if call is None else found | {"python-ins": rms(call())}


def with_more_states(duration: float) -> dict[str, dict[str, float]]:
    """Both with 21 and 33 states, on python-ins' sine motion and on NaveGo's synthetic data."""
    given = {"sine": (build("ekf15").params("adis16465"), *sine_drive(duration, 0))}
    folder = reading.verify("navego_synthetic")
    rec, params = reading.load("navego_synthetic"), navego.parameters(folder, "imu2")
    packed, nav = navego.cut(rec, instantaneous=True)
    truth = np.column_stack([np.interp(packed.t, rec.truth.t, column) for column in rec.truth.lla.T])
    given["navego"] = (params, nav, packed.epochs, truth)
    found = {}
    for name, case in given.items():
        for states in (SCALES, (*SCALES, "gyro_misalignment", "accel_misalignment")):
            clear_caches_if_needed()
            found[f"{name}, {15 + sum(STATES[s].size for s in states)} states"] = beside(*case, states)
    return found


# ---------------------------------------------------------------------------- the drive


def crop(rec: Recording, first: float, last: float) -> Recording:
    """Samples between two times."""
    keep = (rec.imu.t > first) & (rec.imu.t <= last)
    inside = lambda s: (s.t > first) & (s.t <= last)
    aiding = {n: sample_rows(s, inside(s)) for n, s in rec.aiding.items()}
    return rec._replace(name=f"{first:.0f} to {last:.0f} s", imu=ImuLog(*(a[keep] for a in rec.imu)), aiding=aiding)


def begin_at(rec: Recording, time: float, prior) -> Initialization:
    """Where the drive's protocol starts a stretch."""
    return Initialization(jax.tree.map(lambda a: jnp.asarray(a)[None], drive.start_at(rec, time)), prior, time)


def tuned_for(rec: Recording, sheet: Params) -> dict[int, Params]:
    """For each block of the drive the result of `tune --for kfgins` on the stretches outside of it."""
    like, _ = like_kfgins(sheet)
    edges = [drive.START, *drive.BLOCKS, float(rec.aiding["position"].t[-1])]
    out = {}
    for block in range(len(edges) - 1):
        spans = [(edges[0], edges[block] - GUARD), (edges[block + 1] + GUARD, edges[-1])]
        spans = [(a, b) for a, b in spans if b - a > SHORTEST]
        begins = [begin_at(rec, a if a == drive.START else a + 2.0, sheet.prior if a == drive.START else MOVING)
                  for a, _ in spans]  # fmt: skip
        recs = [crop(rec, a, b) for a, b in spans]
        found = tune(recs, like, sheet, free=LIKE.free, initialization=begins, window=drive.OUTAGE, extend=False)
        print(f"  without block {block}: {found.verdict}", flush=True)
        out[block] = found.params._replace(prior=sheet.prior)
    return out


def ours_scored(rec: Recording, by_block: dict[int, Params]) -> np.ndarray:
    """Errors (W,) m of our filter of the same kind, like `peers_kfgins.scored`."""
    like, _ = like_kfgins(by_block[0])
    nav, last_fix = drive.start_at(rec, drive.START), float(rec.aiding["position"].t[-1])
    like = with_history(like, drive.HISTORY)
    packed = ep.pack_recording(rec, (POSITION,), drive.START)
    found: dict[float, float] = {}
    for offset in drive.PHASES:
        starts = drive.window_starts(last_fix, offset)
        hidden, ends = ep.outage_windows(packed.t, starts, drive.OUTAGE)
        there = np.asarray(packed.epochs.fix.valid)[:, :2].all(1)
        epochs = ep.hide(packed.epochs, hidden, (POSITION,))
        block = np.searchsorted(drive.BLOCKS, starts + drive.OUTAGE / 2)
        for b in np.unique(block):
            params = by_block.get(int(b), by_block[0])
            residual = np.asarray(run_jit(like, params, nav, epochs).residual)
            for start, end in zip(starts[block == b], ends[block == b], strict=True):
                own = np.flatnonzero(there[: end + 1])[-1]
                found[start] = float(np.hypot(*residual[own, :2]))
    return np.array([found[start] for start in sorted(found)])


def on_the_drive(binary: Path | None, tuned: bool) -> dict[str, dict]:
    """KF-GINS and ours, by noise."""
    rec = drive.recording()
    begin = begin_at(rec, drive.START, drive.parameters().prior)
    sheet = lambda *timing: like_kfgins(drive.parameters(*timing))[1]
    cases = {"datasheet": {0: sheet()}, "timing": {0: sheet(*drive.CLOCK)}}
    if tuned:
        cases["tuned"] = tuned_for(rec, sheet())
    found: dict[str, dict] = {"kfgins": {}, "jaxnav": {}}
    for name, by_block in cases.items():
        found["jaxnav"][name] = spread(ours_scored(rec, by_block))
        if binary is not None:
            found["kfgins"][name] = spread(peers_kfgins.scored(binary, rec, by_block, begin))
        print(name, {who: rows.get(name) for who, rows in found.items()}, flush=True)
    return found


def main(argv: list[str]) -> None:
    """Print the tables, write the JSON."""
    parser = common.options("peers", __doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=8, help="simulated drives, default 8")
    parser.add_argument("--quick", action="store_true", help="two drives, and no tuning on the real one")
    args = parser.parse_args(argv)
    given = os.environ.get("KFGINS_BIN")
    if given is None:
        print("KFGINS_BIN does not name KF-GINS's executable: its rows are left out")
    binary = None if given is None else Path(given)
    runs = [one_run(seed, binary) for seed in range(2 if args.quick else args.runs)]
    simulated = {name: spread(np.concatenate([r[name] for r in runs])) for name in runs[0]}
    rows = [[name, *r.values()] for name, r in simulated.items()]
    print(table(["simulated, 15 s without fixes", "RMS m", "median m", "largest m"], rows))
    scales = with_more_states(300.0 if args.quick else 3600.0)
    print(
        table(
            ["with scale factors and axes", *next(iter(scales.values()))], [[k, *r.values()] for k, r in scales.items()]
        )
    )
    found = on_the_drive(binary, not args.quick)
    rows = [[who, noise, *r.values()] for who, each in found.items() for noise, r in each.items()]
    print(table(["the drive, 89 windows", "noise", "RMS m", "median m", "largest m"], rows))
    common.write_json(args.json, {"simulated": simulated, "scales": scales, **found})
