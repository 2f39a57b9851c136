"""Faults of a receiver, twenty-five kinds: rules compared with a filter that knows the time of the fault.

A simulated drive of 200 s with a consumer's IMU, position and velocity of one receiver at 5 Hz; from 90 s on it is
faulty. Nineteen kinds were in sight when the hypotheses of `ekf15_receiver` were made, six were written after that.
The figure of a kind is the 95th percentile over runs of the largest horizontal error.
"""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import options, write_json
from jaxnav.analysis import metrics
from jaxnav.analysis.plots import base as plots
from jaxnav.analysis.tables import table
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.filters.run import run
from jaxnav.maths import earth
from jaxnav.simulate import faults
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import SCENARIOS
from jaxnav.simulate.simulation import Simulated, matched_params, simulate
from jaxnav.types import Params

S = 90.0  # s, where a fault starts
SIZE = (1.0, 0.8, 0.6)  # of an offset in east, north, up
LOST = 30.0  # m, over the last 20 s
CHUNK = 16


def times(size: float) -> tuple[float, float, float]:
    """An offset of so many metres in east, less in the others."""
    return (SIZE[0] * size, SIZE[1] * size, SIZE[2] * size)


SEEN = {
    "slide of 60 m and back, 8 s": (faults.Slide(S, S + 8, times(60)),),
    "slide of 300 m and back, 35 s": (faults.Slide(S, S + 35, times(300)),),
    "step of 60 m, 3 s": (faults.Constant(S, S + 3, times(60)),),
    "step of 60 m, 40 s": (faults.Constant(S, S + 40, times(60)),),
    "velocity off by 5 m/s, 15 s": (faults.Constant(S, S + 15, velocity_mps=times(5)),),
    "white noise of 40 m and 5 m/s, 20 s": (faults.White(S, S + 20, (40.0,) * 3, (5.0,) * 3),),
    "step of 15 m, 20 s": (faults.Constant(S, S + 20, times(15)),),
    "slide of 80 m, 40 s, then a jump back": (faults.Slide(S, S + 40, times(80), back=False),),
    "drag-off of 1 m/s, 40 s": (faults.Ramp(S, S + 40, times(40)), faults.Constant(S, S + 40, velocity_mps=times(1))),
    "position drifts at 1 m/s, velocity does not, 40 s": (faults.Ramp(S, S + 40, times(40)),),
    "correlated noise of 20 m and 2 m/s, 5 s, for 30 s": (faults.GaussMarkov(S, S + 30, (20.0,) * 3, (2.0,) * 3, 5.0),),
    "step of 30 m and 3 m/s, 25 s": (faults.Constant(S, S + 25, times(30), times(3)),),
    "step of 25 m, 12 s": (faults.Constant(S, S + 12, times(25)),),
    "slide of 150 m and back, 20 s": (faults.Slide(S, S + 20, times(150)),),
    "correlated noise of 8 m and 0.5 m/s, 20 s, for 40 s": (
        faults.GaussMarkov(S, S + 40, (8.0,) * 3, (0.5,) * 3, 20.0),
    ),
    "velocity drifts to 4 m/s, 20 s": (faults.Ramp(S, S + 20, velocity_mps=times(4)),),
    "steps of 100 m and of 50 m after it, 10 s each": (
        faults.Constant(S, S + 10, times(100), times(0.5)), faults.Constant(S + 10, S + 20, times(-50)),
    ),
    "slide of 30 m, 60 s, then a jump back": (faults.Slide(S, S + 60, times(30), back=False),),
    "white noise of 10 m and 0.5 m/s, 30 s": (faults.White(S, S + 30, (10.0,) * 3, (0.5,) * 3),),
}  # fmt: skip
UNSEEN = {
    "step of 200 m, 15 s": (faults.Constant(S, S + 15, times(200)),),
    "slide of 40 m, 15 s, then a jump back": (faults.Slide(S, S + 15, times(40), back=False),),
    "correlated noise of 15 m and 1 m/s, 10 s, for 25 s": (
        faults.GaussMarkov(S, S + 25, (15.0,) * 3, (1.0,) * 3, 10.0),
    ),
    "velocity off by 1.5 m/s, 30 s": (faults.Constant(S, S + 30, velocity_mps=times(1.5)),),
    "step of 20 m and white noise of 20 m, 15 s": (
        faults.Constant(S, S + 15, times(20)), faults.White(S, S + 15, (20.0,) * 3),
    ),
    "position drifts to 100 m, velocity does not, 10 s": (faults.Ramp(S, S + 10, times(100)),),
}  # fmt: skip
KINDS = SEEN | UNSEEN
RULES = ("ekf15", "ekf15_gate", "ekf15_student", "ekf15_receiver")
KNOWN_TIME = "known time"


def scenario():
    """The drive, its receiver sound."""
    urban = SCENARIOS["urban_short"]
    return urban._replace(
        duration_s=200.0, imu_rate_hz=50.0, gnss_rate_hz=5.0, gnss=urban.gnss._replace(outages_s=(), random_outages=0),
        imu=urban.imu._replace(grade="consumer"),
    )  # fmt: skip


@partial(jax.jit, static_argnums=0)
def spoilt(kind: tuple, sims: Simulated, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Fixes (B, E, 6) with a fault, and where it is, (E,) bool."""

    def one(value, t, key):
        offset = faults.offsets(key, kind, t, jnp.zeros((t.size, 6)))
        return jnp.concatenate([jax.vmap(earth.move)(value[:, :3], offset[:, :3]), value[:, 3:] + offset[:, 3:]], 1)

    t = sims.truth.t
    values = jax.vmap(one)(sims.epochs.fix.value, t, keys)
    return values, (t[0] > S) & (t[0] <= max(f.stop_s for f in kind) + 1e-6)


@partial(jax.jit, static_argnums=0)
def errors(filt: Filter, params: Params, sims: Simulated, value: jax.Array, valid: jax.Array) -> jax.Array:
    """Horizontal errors (B, E) m."""

    def one(sim, value, valid):
        fix = sim.epochs.fix._replace(value=value, valid=valid)
        info = run(filt, params, sim.initial, sim.epochs._replace(fix=fix))
        error = jax.vmap(metrics.position_error)(info.nav, sim.truth.pos)
        return jnp.where(info.ok, jnp.hypot(error[:, 0], error[:, 1]), jnp.inf)

    return jax.vmap(one)(sims, value, valid)


def study(runs: int, seed: int) -> dict:
    """Every kind by every rule."""
    what = scenario()
    known = matched_params(what)
    draw = jax.jit(jax.vmap(partial(simulate, scenario=what)))
    keys = run_keys(seed, Purpose.STUDY, np.arange(runs))
    found: dict[str, dict[str, list]] = {kind: {} for kind in ("none", *KINDS)}
    for begin in range(0, runs, CHUNK):
        own = keys[begin : begin + CHUNK]
        sims = draw(own)
        for kind in found:
            value, wrong = sims.epochs.fix.value, jnp.zeros(sims.truth.t.shape[1], bool)
            if kind != "none":
                value, wrong = spoilt(KINDS[kind], sims, own)
            for name in (*RULES, KNOWN_TIME):
                filt = build("ekf15" if name == KNOWN_TIME else name, cov_stride=5)
                params = known._replace(rule=filt.params("consumer").rule)
                hidden = (wrong & (name == KNOWN_TIME))[None, :, None]
                off = errors(filt, params, sims, value, sims.epochs.fix.valid & ~hidden)
                found[kind].setdefault(name, []).append(np.asarray(off))
        print(f"{begin + len(own)} of {runs} runs", flush=True)
    return {kind: {name: np.concatenate(parts) for name, parts in row.items()} for kind, row in found.items()}


def draw(worst: dict[str, dict[str, float]], path: Path) -> None:
    """Every kind by every rule, m on a logarithmic axis."""
    fig = plots.figure(9, 8)
    ax = fig.subplots()
    plots.dress(ax, "95th percentile of the largest horizontal error, m")
    kinds = list(worst)[::-1]
    marks = {KNOWN_TIME: ("k", "|"), "ekf15": ("0.6", "x"), "ekf15_gate": ("tab:orange", "s"),
             "ekf15_student": ("tab:green", "^"), "ekf15_receiver": (plots.BLUE, "o")}  # fmt: skip
    for name, (colour, mark) in marks.items():
        ax.plot([worst[k][name] for k in kinds], range(len(kinds)), mark, color=colour, ms=12 if mark == "|" else 6,
                mew=2 if mark == "|" else 1, label=name)  # fmt: skip
    ax.set_xscale("log")
    ax.set_yticks(range(len(kinds)), [f"{k} *" if k in UNSEEN else k for k in kinds], fontsize=8)
    ax.legend(loc="lower right", fontsize=8)
    plots.save(fig, path)


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = options("faults", __doc__ or "")
    parser.add_argument("--runs", type=int, default=64, help="of each kind, default 64; 16 take 4 minutes")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    parser.add_argument("--figure", metavar="F", type=Path, help="draw it into F, a .png")
    args = parser.parse_args(argv)
    found = study(args.runs, args.seed)
    late = int(50 * 5)  # epochs until the start has settled
    worst = {k: {n: float(np.quantile(e[:, late:].max(1), 0.95)) for n, e in row.items()} for k, row in found.items()}
    lost = {k: {n: int((e[:, -100:].max(1) > LOST).sum()) for n, e in row.items()} for k, row in found.items()}
    clean = {n: float(np.sqrt(np.mean(e[:, late:] ** 2))) for n, e in found["none"].items()}
    robust = {
        name: {
            "p95_ratio": max(worst[k][name] / worst[k][KNOWN_TIME] for k in KINDS),
            "p95_ratio_unseen": max(worst[k][name] / worst[k][KNOWN_TIME] for k in UNSEEN),
            "lockouts": sum(lost[k][name] for k in KINDS), "cost_clean": clean[name] / clean["ekf15"] - 1,
        }
        for name in RULES
    }  # fmt: skip
    rows = [
        [k, *(worst[k][n] for n in (KNOWN_TIME, *RULES)), worst[k]["ekf15_receiver"] / worst[k][KNOWN_TIME]]
        for k in found
    ]
    print(table(["fault", KNOWN_TIME, *RULES, "ratio"], rows))
    heads = ["", "largest ratio to known time", "unseen kinds", "runs lost", "RMS without faults"]
    print(table(heads, [[n, *r.values()] for n, r in robust.items()]))
    if args.figure:
        draw(worst, args.figure)
    write_json(args.json, {"robust": robust["ekf15_receiver"], "rules": robust, "p95_m": worst, "lost": lost,
                           "clean_rms_m": clean, "runs": args.runs, "seed": args.seed})  # fmt: skip
