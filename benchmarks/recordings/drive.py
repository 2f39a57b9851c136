"""A real drive with hidden GNSS windows: datasheet against tuned, every window scored by parameters that never saw it.

Protocol of the data set (nine phases of 15 s windows every 45 s, pooled): the error is that of the antenna at the last
hidden fix, through the measurement model, so lever arm and timing count. Four filters of 15 states: `datasheet` and
`tuned` with GNSS and standstill updates, `datasheet_constraints` and `tuned_constraints` with the non-holonomic
constraint too. Nothing reads a fix before its time; mending the IMU log takes a fixed lag of 0.3 s.

Tuning for a block of the drive uses three stretches outside of it, each with an initialization, and hidden windows
within them; a guard of 8 s keeps every scored window clear of them.
"""

import tomllib
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from jaxnav import io, reading
from jaxnav import measurements as ms
from jaxnav.filters import epochs
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import datasheet_params, get, late, mounting, prior
from jaxnav.filters.run import initial_nav, run
from jaxnav.filters.standstill import constraint_samples, stationary
from jaxnav.initialization import initialize as alignment
from jaxnav.io import mend
from jaxnav.io.column_map import described
from jaxnav.io.readers import read_parts
from jaxnav.maths import units
from jaxnav.reading import timescale
from jaxnav.states.grades import GRADES
from jaxnav.types import Epoch, Nav, Params, Recording, Track
from tuning.fit import objectives
from tuning.fit.optimizers import adam
from tuning.fit.train import fit
from tuning.fit.transforms import LOG, scaled
from tuning.recordings.validation import paired_gain

AUTHOR = {  # the data author's filter on this protocol: horizontal RMS, median, max, vertical RMS in m
    "without constraints": (6.30, 2.49, 27.3, 0.60),
    "with constraints": (5.40, 2.12, 26.5, 1.19),
}
WIDEN = 10.0  # tuning starts from white noise this much above the datasheet's: a filter that is too sure is wild
OUTAGE, EVERY, FIRST, LAST = 15.0, 45.0, 60.0, 30.0  # s
PHASES = np.arange(0.0, 45.0, 5.0)
INTERVAL = 0.25  # s, of the fixes
START = 4.0  # s
LEVER_ARM = np.array([0.0, -0.05, 0.0])  # m, IMU -> antenna, body FRD
# the log is read 0.3 s early, so that the estimated time offset is positive: fixes are compared with
# navigation that is already there
EARLY = -0.30
AUTHOR_DELAY = -0.125  # s, the delay of the IMU log that the author of the data found by hand
CLOCK = (-0.20, -290e-6)  # s halfway, s/s: the ticks of the log as they stand, not stretched to its tag
HISTORY = 40  # samples: the offset and the 0.125 s of the velocity fit in
SETTLED = 30.0  # s into a stretch: innovations count from then on
RECOVERY = 8  # fixes after a window that do not count as outside of it
BLOCKS = np.array([136.0, 272.0, 406.0])  # s, edges of the four blocks
PIECES = np.array([10.0, 146.0, 280.0, 414.0])  # s, starts of the stretches to tune on
PIECE = 118.0  # s
TRAIN = ((30.0, 75.0), (45.0, 90.0), (60.0, 102.0))  # s into a stretch: windows of each training run
STILL, ACCEL_SPREAD, GYRO_SPREAD = 2.0, 0.15, 3.5 * units.DEG  # s; a car that stands with its engine on


class Data(NamedTuple):
    """The drive cut for one filter."""

    filt: Filter
    epochs: Epoch
    t: np.ndarray
    nav: Nav


def measurements(constraints: bool) -> tuple[ms.Measurement, ...]:
    """GNSS and standstill, and the wheels if asked."""
    standing = (*ms.GNSS, ms.ZERO_VELOCITY, ms.ZERO_RATE)
    return (*standing, ms.NONHOLONOMIC) if constraints else standing


def parameters(delay: float = AUTHOR_DELAY, drift: float = 0.0) -> Params:
    """The datasheet's figures and the timing that the data's author gives."""
    install = mounting(LEVER_ARM, time_offset=delay - EARLY, clock_drift=drift)
    return late(datasheet_params(GRADES["consumer"], install=install), 0.0, 0.125)


def recording(repair: bool = True) -> Recording:
    """Return the drive read `EARLY`, with t = 0 at the first fix of the file; truth is the RTK, without attitude.

    Args:
        repair: mend the log of the IMU, which was polled.
    """
    dataset, folder = reading.DATASETS["rtkexplorer_drive"], reading.verify("rtkexplorer_drive")
    table = tomllib.loads(dataset.map.read_text())
    table["imu"] |= {"time_shift_s": EARLY, "repair": repair}
    rec = timescale.in_one_scale(mend.applied(described(table, str(dataset.map), folder, read_parts), mend.Changes()))
    file = io.read_pos(folder / table["read"]["file"]).aiding["position"].t
    later = file[-1] - file[0] - rec.aiding["position"].t[-1]
    moved = {name: s._replace(t=s.t + later) for name, s in rec.aiding.items()}
    position, velocity = moved["position"], moved["velocity"]
    truth = Track(position.t, position.value, velocity.value, np.full_like(position.value, np.nan))
    return rec._replace(imu=rec.imu._replace(t=rec.imu.t + later), aiding=moved, truth=truth)


def start_at(rec: Recording, time: float) -> Nav:
    """Navigation from the fix at ``time``: level, course if it moves, else the course of its first motion after."""
    position, velocity = rec.aiding["position"], rec.aiding["velocity"]
    i = int(np.searchsorted(position.t, time - 1e-3))
    _, heading = alignment.course(velocity, 2.0, after=time)
    nav = initial_nav(position.value[i], velocity.value[i], (0.0, 0.0, heading), t=time)
    return ms.counted_from(nav, BLOCKS[1])


def cut(rec: Recording, constraints: bool, start: float, stop: float | None = None, nav: Nav | None = None) -> Data:
    """Epochs from ``start`` with the pseudo-measurements at their ends."""
    cuts = epochs.cut_times(rec.imu, rec.aiding, INTERVAL, start, stop)
    standing = stationary(rec.imu, cuts, STILL, ACCEL_SPREAD, GYRO_SPREAD)
    chosen = measurements(constraints)
    made = constraint_samples(rec.imu, cuts, chosen, standing, STILL)
    packed = epochs.pack(rec.imu, rec.aiding | made, INTERVAL, chosen, start=start, cuts=cuts)
    filt = build("ekf15", chosen, cov_stride=packed.epochs.imu.dt.shape[1], history=HISTORY)
    return Data(filt, packed.epochs, packed.t, start_at(rec, start) if nav is None else nav)


def window_starts(last_fix: float, offset: float, length: float = OUTAGE, every: float = EVERY) -> np.ndarray:
    """Starts (W,) s of the windows of one phase inside the data."""
    starts = FIRST + offset + every * np.arange(100)
    return starts[starts + length <= last_fix - LAST]


def phase_windows(data: Data, last_fix: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Hidden epochs (phases, E), and of all windows pooled: phase (W,), last epoch (W,), start (W,) s."""
    hidden, phase, end, begin = [], [], [], []
    for p, offset in enumerate(PHASES):
        starts = window_starts(last_fix, offset)
        inside, last = epochs.outage_windows(data.t, starts, OUTAGE)
        hidden.append(inside)
        phase.append(np.full(starts.size, p))
        end.append(last)
        begin.append(starts)
    return np.array(hidden), np.concatenate(phase), np.concatenate(end), np.concatenate(begin)


def masks(data: Data, hidden: np.ndarray, constraints: bool) -> jax.Array:
    """Valid (..., E, m) with the receiver's channels of the hidden epochs (..., E) taken out."""
    chosen = measurements(constraints)
    return jnp.stack([epochs.hide(data.epochs, h, chosen).fix.valid for h in hidden])


def with_valid(data: Epoch, valid: jax.Array) -> Epoch:
    """The epochs with another mask."""
    return data._replace(fix=data.fix._replace(valid=valid))


@partial(jax.jit, static_argnums=0)
def solve(filt: Filter, params: Params, nav: Nav, data: Epoch, valid: jax.Array):
    """Residual (phases, E, 3), innovation statistics, and whether all was finite, for every phase's mask."""
    info = jax.vmap(lambda v: run(filt, params, nav, with_valid(data, v)))(valid)
    return info.residual[..., :3], info.nis, info.valid, info.ok.all()


def spec(constraints: bool) -> dict:
    """Free parameters: white noise of the IMU and of the fixes, timing, and those of the wheels.

    Bias instabilities stay at the datasheet's: two minutes have no information on a drift over ten.
    """
    white = ("noise.gyro", "noise.accel", "measurements.position.scale", "measurements.velocity.scale")
    free = dict.fromkeys(white, LOG)
    free |= {"mounting.time_offset": scaled(0.1), "measurements.velocity.latency": scaled(0.05)}
    free |= {"mounting.clock_drift": scaled(300 * units.PPM)}
    if constraints:
        free |= {
            "measurements.nonholonomic.sd": LOG,
            "mounting.vehicle": scaled(0.02),
            "mounting.wheel_arm": scaled(0.3),
        }
    return free


def stack(trees: list):
    """Trees of equal shapes side by side."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def over_stretches(weight: jax.Array, values: jax.Array) -> jax.Array:
    """The weighted mean over stretches (B,); stretches of weight zero may have failed."""
    return weight @ jnp.where(weight > 0, values, 0.0) / weight.sum()


@cache
def _training_loss(filt: Filter, objective: str):
    """Loss of parameters over the stretches with weights: drift at the ends of hidden windows, or innovations."""

    def nll(params, nav, data, settled):
        return objectives.innovation_nll(run(filt, params, nav, data), settled)

    def squares(params, nav, data, valid, ends):
        info = jax.vmap(lambda v: run(filt, params, nav, with_valid(data, v)))(valid)
        return jax.vmap(objectives.outage_error)(info, ends) ** 2

    def likelihood(params, weight, nav, data, valid, ends, settled):
        return over_stretches(weight, jax.vmap(partial(nll, params))(nav, data, settled))

    def drift(params, weight, nav, data, valid, ends, settled):
        h2 = jax.vmap(partial(squares, params))(nav, data, valid, ends).reshape(weight.size, -1)
        typical = over_stretches(weight, jnp.mean(jnp.log(h2 + 0.01), axis=1))  # every window counts alike
        return 0.25 * jnp.log(over_stretches(weight, jnp.mean(h2, axis=1))) + 0.25 * typical

    return {"likelihood": likelihood, "drift": drift}[objective]


def training_stretches(rec: Recording, constraints: bool):
    """The four stretches, cut to one shape: filter, nav, epochs, masks (runs, E, m), window ends, settled epochs."""
    data = [cut(rec, constraints, start, start + PIECE) for start in PIECES]
    k = max(d.epochs.imu.dt.shape[1] for d in data)
    E = min(d.t.size for d in data)
    pad = lambda a: jnp.pad(a[:E], [(0, 0), (0, k - a.shape[1])] + [(0, 0)] * (a.ndim - 2), mode="edge")
    made = []
    for d, start in zip(data, PIECES, strict=True):
        imu = jax.tree.map(pad, d.epochs.imu)
        imu = imu._replace(dt=jnp.where(jnp.arange(k) < d.epochs.imu.dt.shape[1], imu.dt, 0.0))
        d = d._replace(epochs=Epoch(imu, jax.tree.map(lambda a: a[:E], d.epochs.fix)), t=d.t[:E])
        windows = [epochs.outage_windows(d.t, start + np.array(run), OUTAGE) for run in TRAIN]
        valid = masks(d, np.array([hidden for hidden, _ in windows]), constraints)
        ends = jnp.array([last for _, last in windows])
        made.append((d.nav, d.epochs, valid, ends, jnp.asarray(d.t > start + SETTLED)))
    filt = build("ekf15", measurements(constraints), cov_stride=k, history=HISTORY)
    return filt, stack(made)


def tune(rec: Recording, constraints: bool, steps: int, blocks: list[int], objective: str) -> dict[int, Params]:
    """Parameters for each block of the drive, tuned on the stretches outside of it."""
    filt, stretches = training_stretches(rec, constraints)
    loss = _training_loss(filt, objective)
    start = parameters()
    white = ("gyro", "accel")
    widened = {name: WIDEN * getattr(start.noise, name) for name in white}
    moving = prior((2.0, 2.0, 2.0), 0.3, np.array([3.0, 3.0, 15.0]) * units.DEG)
    start = start._replace(noise=start.noise._replace(**widened), prior=moving)
    tuned = {}
    for block in blocks:
        weight = jnp.asarray(np.arange(PIECES.size) != block, float)
        tuned[block] = fit(loss, spec(constraints), start, steps, adam(steps, 0.15, 5.0),
                           arguments=(weight, *stretches), progress=True).params  # fmt: skip
        tuned[block] = tuned[block]._replace(prior=parameters().prior)  # the drive itself starts at rest
    return tuned


def score(data: Data, params: Params, valid: jax.Array):
    """Residuals of every phase, (phases, E, 3) ENU m, NIS and which channels were valid."""
    residual, nis, used, ok = solve(data.filt, params, data.nav, data.epochs, valid)
    if not bool(ok):
        print("  a run stopped being finite")
    return np.asarray(residual), np.asarray(nis), np.asarray(used)


def summary(horizontal: np.ndarray, vertical: np.ndarray, outside: np.ndarray, nis: float, begin: np.ndarray) -> dict:
    """The figures of one row of the table, each computed from its errors."""
    rms = lambda e: float(np.sqrt(np.mean(np.square(e))))
    order = np.argsort(begin, kind="stable")
    return {
        "horizontal_rms_m": rms(horizontal), "horizontal_median_m": float(np.median(horizontal)),
        "horizontal_max_m": float(horizontal.max()), "vertical_rms_m": rms(vertical), "nis_mean": nis,
        "outside_rms_m": rms(outside),
        "per_window": [
            {"start_s": float(begin[i]), "horizontal_m": float(horizontal[i]), "vertical_m": float(vertical[i])}
            for i in order
        ],
    }  # fmt: skip


def evaluate(data: Data, constraints: bool, by_block: dict[int, Params], last_fix: float) -> dict:
    """Score every window with the parameters of its block."""
    hidden, phase, end, begin = phase_windows(data, last_fix)
    block = np.searchsorted(BLOCKS, begin + OUTAGE / 2)
    epoch_block = np.searchsorted(BLOCKS, data.t)
    valid = masks(data, hidden, constraints)
    settling = np.array([[h[max(0, i - RECOVERY) : i + 1].any() for i in range(h.size)] for h in hidden])
    error = np.full((begin.size, 3), np.nan)
    outside, nis, dof = [], [], []
    done: dict[int, tuple] = {}
    for b in np.unique(block):
        params = by_block[b] if b in by_block else next(iter(by_block.values()))
        key = id(params)
        done[key] = done[key] if key in done else score(data, params, valid)
        residual, value, used = done[key]
        mine = block == b
        error[mine] = residual[phase[mine], end[mine]]
        open_sky = ~settling & (epoch_block == b) & (data.t > FIRST) & used[..., 0]
        outside.append(np.hypot(*residual[open_sky][:, :2].T))
        nis.append(value[open_sky])
        dof.append(used[open_sky].sum(-1))
    horizontal = np.hypot(error[:, 0], error[:, 1])
    nis_mean = float(np.concatenate(nis).sum() / np.concatenate(dof).sum())
    return summary(horizontal, np.abs(error[:, 2]), np.concatenate(outside), nis_mean, begin)


def row(name: str, r: dict) -> str:
    """One line of the table."""
    return (f"  {name:38} {r['horizontal_rms_m']:6.2f} {r['horizontal_median_m']:7.2f} {r['horizontal_max_m']:7.1f}"
            f" {r['vertical_rms_m']:7.2f} {r['outside_rms_m']:8.3f} {r['nis_mean']:7.2f}")  # fmt: skip


def steps_taken(last_fix: float) -> dict:
    """Gain of each change, one after the other, before any tuning."""
    found = {}
    raw, mended = recording(repair=False), recording()
    wide = lambda p: p._replace(noise=p.noise._replace(gyro=10 * p.noise.gyro, accel=10 * p.noise.accel))
    cases = {
        "log as it stands, datasheet": (raw, False, parameters()),
        "log mended": (mended, False, parameters()),
        "and timing -0.21 s": (mended, False, parameters(-0.21)),
        "and drift of the clock -290 ppm": (mended, False, parameters(*CLOCK)),
        "and white noise x10": (mended, False, wide(parameters(*CLOCK))),
        "and non-holonomic": (mended, True, wide(parameters(*CLOCK))),
        "all but mended": (raw, True, wide(parameters(*CLOCK))),
        "all but the drift": (mended, True, wide(parameters(-0.21))),
    }
    for name, (rec, constraints, params) in cases.items():
        found[name] = evaluate(cut(rec, constraints, START), constraints, {0: params}, last_fix)
        print(row(name, found[name]), flush=True)
    return found


def main(argv: list[str]) -> None:
    """Print the tables, write the JSON."""
    parser = common.options("drive", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="3 steps of tuning")
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap, default 0")
    parser.add_argument("--steps", type=int, default=100, help="steps of tuning for each block, default 100")
    help = "of tuning: innovations (no truth, no windows), or drift at the ends of hidden windows"
    parser.add_argument("--objective", choices=("likelihood", "drift"), default="likelihood", help=help)
    args = parser.parse_args(argv)
    rec = recording()
    last_fix = float(rec.aiding["position"].t[-1])
    header = (
        f"  {'':38} {'H rms':>6} {'median':>7} {'max':>7} {'V rms':>7} {'outside':>8} {'NIS/dof':>7}   m, 15 s hidden"
    )
    result: dict = {"seed": args.seed, "author": AUTHOR, "steps": args.steps, "objective": args.objective}
    print("Gain of each change, untuned\n" + header)
    result["steps_taken"] = steps_taken(last_fix)
    print("Datasheet against tuned, every window held out\n" + header)
    for suffix, constraints in (("", False), ("_constraints", True)):
        data = cut(rec, constraints, START)
        before = evaluate(data, constraints, {0: parameters()}, last_fix)
        print(row("datasheet" + suffix, before), flush=True)
        tuned = tune(rec, constraints, 3 if args.quick else args.steps, list(range(PIECES.size)), args.objective)
        after = evaluate(data, constraints, tuned, last_fix)
        print(row("tuned" + suffix, after), flush=True)
        result |= {"datasheet" + suffix: before, "tuned" + suffix: after}
        errors = [np.array([w["horizontal_m"] for w in r["per_window"]]) for r in (before, after)]
        # windows of different phases that start within 45 s overlap: blocks of one 45 s cycle are drawn together
        cycle = np.array([int((w["start_s"] - FIRST) // EVERY) for w in before["per_window"]])
        result["paired_gain" + suffix] = paired_gain(*errors, blocks=cycle, seed=args.seed)._asdict()
        names = list(spec(constraints))
        result["parameters" + suffix] = {
            f"block_{b}": {n: np.asarray(get(p, n)).tolist() for n in names} for b, p in tuned.items()
        }
    for name, (rms, median, worst, vertical) in AUTHOR.items():
        print(f"  {'data author, ' + name:38} {rms:6.2f} {median:7.2f} {worst:7.1f} {vertical:7.2f}")
    for key in ("paired_gain", "paired_gain_constraints"):
        g = result[key]
        print(f"  {key}: RMS {g['gain']:.2f} times smaller, 95 % interval {g['low']:.2f} to {g['high']:.2f}")
    common.write_json(args.json, result)
