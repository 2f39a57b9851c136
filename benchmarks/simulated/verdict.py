"""The verdict of `tune` on simulated drives, half with a receiver fault in one part: true drift, parts named.

A drive in town with an IMU that is three times noisier than its datasheet. The fault is in the training, validation or
test part by turns: a step, a ramp of the position alone, noise, or a slide of position and velocity together that jumps
back. The true drift is that of the written position against the truth, which tuning never sees, at the ends of all
hidden windows that a fault does not touch.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import options, write_json
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run
from jaxnav.maths import earth
from jaxnav.measurements import MEASUREMENTS
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_runs, to_recording
from jaxnav.types import Epoch, Info, Nav, Params, Recording, Samples
from tuning.recordings.recorded import tune
from tuning.recordings.report import Tuned

SECONDS, RATE_HZ, NOISE = 400.0, 25.0, 3.0
PARTS = {"training": (110.0, 140.0), "validation": (232.0, 257.0), "test": (320.0, 350.0)}  # s, of the faults
RECOVERED = 20.0  # s after a fault
KINDS = ("step", "ramp", "noise", "slide")


def faulty(rec: Recording, kind: str, begin: float, end: float, rng: np.random.Generator) -> Recording:
    """Return the recording with a receiver fault between two times, s."""
    p, v = rec.aiding["position"], rec.aiding["velocity"]
    direction = rng.normal(size=3) * [1.0, 1.0, 0.5]
    direction /= np.linalg.norm(direction)

    def errors(s: Samples, velocity: bool) -> np.ndarray:
        inside = ((s.t > begin) & (s.t <= end))[:, None]
        age = np.maximum(s.t - begin, 0.0)[:, None]
        noise = rng.normal(size=s.value.shape)
        position, rate = {
            "step": (30.0 * direction, 0.0 * direction),
            "ramp": (1.5 * age * direction, 0.0 * direction),
            "noise": (15.0 * noise, 1.0 * noise),
            "slide": (2.0 * age * direction, 2.0 * direction),
        }[kind]
        return np.asarray(inside * (rate if velocity else position))

    metres = np.asarray(earth.metres_per_radian(jnp.asarray(p.value[0])))
    moved = p._replace(value=p.value + errors(p, False)[:, [1, 0, 2]] / metres)
    return rec._replace(
        aiding=rec.aiding | {"position": moved, "velocity": v._replace(value=v.value + errors(v, True))}
    )


@partial(jax.jit, static_argnums=0)
def runs(filt: Filter, params: Params, nav: Nav, epochs: Epoch) -> Info:
    """Run a filter over each of several sets of epochs (B, E, ...)."""
    return jax.vmap(lambda epochs: run(filt, params, nav, epochs))(epochs)


def true_drift(found: Tuned, filt: Filter, params: Params, rec: Recording, fault: tuple[float, float]) -> float:
    """Return the RMS (m) of the horizontal error of the written position at the ends of hidden windows."""
    used, windows = found.used[0], found.used[0].windows
    chosen = tuple(MEASUREMENTS[name] for name in filt.model.measurements)
    epochs = [ep.hide(used.packed.epochs, h[: used.packed.t.size], chosen) for h in windows.hidden]
    own = params._replace(states=used.datasheet.states | params.states)
    info = runs(filt, own, used.nav, jax.tree.map(lambda *a: jnp.stack(a), *epochs))
    t, truth = used.packed.t[windows.end], rec.truth
    assert truth is not None
    clean = (t < fault[0]) | (windows.start > fault[1] + RECOVERED)
    at, t = (windows.phase[clean], windows.end[clean]), t[clean]
    true = np.column_stack([np.interp(t, truth.t, c) for c in truth.lla.T])
    off = earth.enu_path(np.asarray(info.nav.pos)[at], true)
    return float(np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2)))


def one(number: int, seed: int) -> dict:
    """Tune one drive, and judge the verdict."""
    clear_caches_if_needed()
    gnss = URBAN_SHORT.gnss._replace(outages_s=())
    imu = URBAN_SHORT.imu._replace(imu_noise_factor=NOISE)
    scenario = URBAN_SHORT._replace(duration_s=SECONDS, imu_rate_hz=RATE_HZ, gnss=gnss, imu=imu)
    runs = simulate_runs(run_keys(seed, Purpose.SINGLE, np.arange(number, number + 1)), scenario)
    rec = to_recording(jax.tree.map(lambda a: a[0], runs), scenario)
    part, kind, fault = "", "", (np.inf, np.inf)
    if number % 2:
        part, kind = list(PARTS)[number // 2 % 3], KINDS[number // 2 % 4]
        fault = PARTS[part]
        rec = faulty(rec, kind, *fault, np.random.default_rng([seed, number]))
    filt = build("ekf15", cov_stride=5)
    found = tune(rec, filt, filt.params("consumer"))
    named = [f.subject for f in found.findings if f.code == "tune.fault"]
    trials = {name: found.trials[name] for name in ("datasheet", found.chosen)}
    drift = {name: true_drift(found, t.filter, t.params, rec, fault) for name, t in trials.items()}
    ratio = drift[found.chosen] / drift["datasheet"]
    return {
        "part": part,
        "kind": kind,
        "chosen": found.chosen,
        "ratio": ratio,
        "named": named,
        "verdict": found.verdict,
    }


def main(argv: list[str]) -> None:
    """Print a line for each drive, write the JSON."""
    parser = options("verdict", __doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=40, help="default 40")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    args = parser.parse_args(argv)
    rows = []
    for number in range(args.drives):
        row = one(number, args.seed)
        rows.append(row)
        print(
            f"{number:3} {row['kind'] or 'no fault':9} {row['part']:11} {row['chosen']:12} true "
            f"drift {row['ratio']:.2f} of the datasheet's; named: {', '.join(row['named']) or 'nothing'}",
            flush=True,
        )
    faults = [row for row in rows if row["part"]]
    named = sum(row["part"] in row["named"] for row in faults)
    false = sum(bool(set(row["named"]) - {row["part"]}) for row in rows)
    worst = max(row["ratio"] for row in rows)
    print(
        f"true drift at most {worst:.2f} of the datasheet's; {named} of {len(faults)} faults named, {false} drives "
        "with another part named"
    )
    result = {"worst": worst, "named": named, "of": len(faults), "false": false, "rows": rows, "seed": args.seed}
    write_json(args.json, result)
