"""Noise parameters back from the innovations alone, started a factor off in every one of them; truth only scores.

`--data navego`: NaveGo's synthetic recording, IMU samples read as means (which they are). `--data simulated`: many
repeats of a short drive with known noise: how often the 95 % intervals hold the truth, and the error of the tuned
filter on drives that no repeat has seen, against the filter with the true noise. `--data drive`: the real drive, see
`benchmarks.recordings.recover_drive`.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks import common
from benchmarks.recordings import navego
from jaxnav import reading
from jaxnav.analysis import metrics
from jaxnav.filters.border import component
from jaxnav.filters.catalogue import build
from jaxnav.filters.parameters import change, get
from jaxnav.filters.run import prepare, run
from jaxnav.simulate.scenarios import URBAN_SHORT, Scenario
from jaxnav.simulate.simulation import matched_params, simulate
from jaxnav.states.grades import GRADES
from jaxnav.types import Finding, Params
from tuning import uncertainty
from tuning.fit.transforms import LOG, Spec, join, labels, split, tied
from tuning.likelihood import Surface, information, rows, runs_of
from tuning.recordings import scoring
from tuning.recordings.report import Row
from tuning.uncertainty import Information

SPEC: Spec = {
    "noise.gyro": tied(LOG), "noise.accel": tied(LOG),
    "states.gyro_bias.driving_noise": tied(LOG), "states.accel_bias.driving_noise": tied(LOG),
    "measurements.position.scale": tied(LOG, (0, 0, 1)), "measurements.velocity.scale": tied(LOG, (0, 0, 1)),
}  # fmt: skip
WELL = (
    "noise.gyro_deg_per_sqrt_hour",
    "noise.accel_ug_per_sqrt_hz",
    "measurements.position.scale",
    "measurements.velocity.scale",
)  # ARW, VRW, GNSS sd
BLOCK = 10.0  # s of a recording that are drawn together


# ---------------------------------------------------------------------------- NaveGo


def recording(imu: str, factor: float) -> dict:
    """Tune on the recording with one of its IMUs."""
    folder = reading.verify("navego_synthetic")
    rec, true = reading.load("navego_synthetic", imu=imu), navego.parameters(folder, imu)
    packed, nav = navego.cut(rec, instantaneous=False)
    filt = build("ekf15", cov_stride=packed.epochs.imu.dt.shape[1])
    block = (packed.t // BLOCK).astype(int)
    many = lambda tree: jax.tree.map(lambda a: np.asarray(a)[None], tree)
    epochs = prepare(filt, packed.epochs)
    runs = runs_of(filt, true, many(nav), many(epochs), np.ones((1, block.size), bool), block[None])
    inform = lambda r: information(runs, SPEC, true, r)
    raw = split(SPEC, true)
    flat, back = ravel_pytree(raw)
    start = flat + np.log(factor)
    found = scoring.maximise(inform, start, report=show(packed.t.size))
    tuned = join(SPEC, back(found.raw), true)
    said = rows(Surface(inform, raw, packed.t.size), SPEC, tuned, true, {})
    names = {"true": true, "start": join(SPEC, back(start), true), "tuned": tuned}
    scores = {name: navego.solve(rec, p, instantaneous=False) for name, p in names.items()}
    print(f"NaveGo {imu}, every parameter started x{factor:g}, RMSE after {navego.SETTLED:g} s")
    print(f"  {'':12} {'true noise':>11} {'start':>11} {'tuned':>11}   tuned / true")
    for key in navego.KEYS:
        a, b, c = (scores[name][0][key] for name in names)
        print(f"  {key:12} {a:11.5f} {b:11.5f} {c:11.5f}   {c / a:.3f}")
    print("  normalised innovations, tuned:", np.round(scores["tuned"][1], 3))
    result: dict = {f"rmse_{name}": rmse for name, (rmse, _) in scores.items()}
    result |= {f"innovation_rms_{name}": rms for name, (_, rms) in scores.items()}
    return result | {"innovation_rms": scores["tuned"][1], "imu": imu, "factor": factor} | parameters_of(said)


def parameters_of(said: tuple[list[Row], list[Finding]]) -> dict:
    """Print the parameters, the truth in the datasheet's place, and return them."""
    rows = {}
    for p in said[0]:
        rows[p.name] = {"value": p.value, "low": p.low, "high": p.high, "unit": p.unit, "truth": p.datasheet}
        print(f"  {p.name:36} {p.value:10.4g}   {p.low:10.4g} to {p.high:<10.4g} truth {p.datasheet:.4g} {p.unit}")
    for f in said[1]:
        print(f"  {f.message}")
    return {"parameters": rows, "identifiability": [f.message for f in said[1]]}


def show(fixes: int):
    """A line for every evaluation: the likelihood, and the expected gain of the next step."""

    def report(i: int, search: scoring.Search) -> None:
        nll = np.asarray(search.best.nll) / fixes
        print(f"  evaluation {i:2d}: nll per fix {np.mean(nll):.5f}, still promised {np.max(search.expected):.3g}",
              flush=True)  # fmt: skip

    return report


# ---------------------------------------------------------------------------- simulated


class Study(NamedTuple):
    """How large the simulated study is."""

    repeats: int
    runs: int  # of a repeat
    held: int  # runs to score on
    duration_s: float


FULL, QUICK = Study(40, 2, 20, 300.0), Study(4, 1, 2, 80.0)


def scenario(study: Study) -> Scenario:
    """A drive in town without outages; an IMU bad enough that its noise shows between two fixes of half a second."""
    gnss = URBAN_SHORT.gnss._replace(position_sd_m=(1.0, 1.0, 2.0), velocity_sd_mps=(0.05, 0.05, 0.08), outages_s=())
    return URBAN_SHORT._replace(
        duration_s=study.duration_s, imu_rate_hz=20.0, gnss_rate_hz=2.0, gnss=gnss,
        imu=URBAN_SHORT.imu._replace(imu_noise_factor=10.0),
    )  # fmt: skip


def truth_of(what: Scenario) -> Params:
    """The parameters that made the data."""
    params, grade, k = matched_params(what), GRADES[what.imu.grade], what.imu.imu_noise_factor
    drive = k * np.sqrt(2 / grade.tau)
    drives = {"gyro_bias": drive * grade.gyro_instability, "accel_bias": drive * grade.accel_instability}
    values = {"noise.gyro": k * grade.arw, "noise.accel": k * grade.vrw}
    return change(params, values | {f"states.{name}.driving_noise": value for name, value in drives.items()})


def informed(filt, params: Params, sims) -> Callable[[jax.Array], Information]:
    """Information of every repeat at its numbers: flat (N, P), runs (N, R, ...), each run a block."""
    late = np.asarray(sims.truth.t) > 10.0  # the start is the prior's business
    block = np.broadcast_to(np.arange(late.shape[1])[:, None], late.shape[1:])
    repeats = [jax.tree.map(lambda a, i=i: a[i], sims) for i in range(len(late))]
    runs = [
        runs_of(filt, params, one.initial, prepare(filt, one.epochs), keep, block)
        for one, keep in zip(repeats, late, strict=True)
    ]

    def inform(flat: jax.Array) -> Information:
        parts = [information(one, SPEC, params, r) for one, r in zip(runs, np.asarray(flat), strict=True)]
        return Information(*map(np.stack, zip(*parts, strict=True)))

    return inform


@partial(jax.jit, static_argnums=0)
def _rmse(filt, params: Params, sims) -> jax.Array:
    """RMSE of position (m), velocity (m/s) over the runs after 20 s, all axes together, (2,)."""

    def one(sim):
        info = run(filt, params, sim.initial, sim.epochs)
        late = (sim.truth.t > 20.0)[:, None]
        position = jax.vmap(metrics.position_error)(info.nav, sim.truth.pos)
        square = lambda e: jnp.sum(jnp.where(late, e, 0.0) ** 2) / jnp.sum(late)
        return jnp.stack([square(position), square(info.nav.vel - sim.truth.vel)])

    return jnp.sqrt(jax.vmap(one)(sims).mean(0))


def simulated(study: Study, factor: float, seed: int) -> dict:
    """Repeat the recovery on fresh data; coverage of the intervals, and RMSE held out."""
    what = scenario(study)
    true = truth_of(what)
    make = jax.jit(jax.vmap(partial(simulate, scenario=what)))
    N, R = study.repeats, study.runs
    drives = make(jax.random.split(jax.random.key(seed), N * R + study.held))
    sims = jax.tree.map(lambda a: a[: N * R].reshape(N, R, *a.shape[1:]), drives)
    filt = build("ekf15", cov_stride=sims.epochs.imu.dt.shape[-1])
    flat, back = ravel_pytree(split(SPEC, true))
    inform = informed(filt, true, sims)
    start = jnp.tile(flat + np.log(factor), (N, 1))
    found = scoring.maximise(inform, start, tolerance=0.02, report=show(R * sims.truth.t.shape[2]))
    names = [component(n) for n in labels(SPEC, back(flat))]
    rows = []
    for i in range(N):
        cov = uncertainty.covariance(np.asarray(found.best.fisher[i]), np.asarray(found.best.blocks[i]))
        rows.append(uncertainty.intervals(SPEC, back(found.raw[i]), cov))
    held = jax.tree.map(lambda a: a[N * R :], drives)
    reference = np.asarray(_rmse(filt, true, held))
    scores = np.array([np.asarray(_rmse(filt, join(SPEC, back(r), true), held)) for r in found.raw])
    begun = np.asarray(_rmse(filt, join(SPEC, back(start[0]), true), held))
    return summary(names, rows, true, reference, begun, scores) | {"factor": factor, "seed": seed} | study._asdict()


def summary(names, rows, true: Params, reference, start, scores) -> dict:
    """Coverage by parameter and the ratio of RMSE to that of the true noise, printed."""
    n, parameters = len(rows), {}
    print(f"Simulated, {n} repeats\n  {'':36} covered  identified  median factor off")
    for j, name in enumerate(names):
        mine = [r[j] for r in rows]
        leaf, _, index = mine[0].name.partition("[")
        value = np.ravel(get(true, leaf))
        at = float(value[min(2 * int(index.rstrip("]")) if index else 0, value.size - 1)])
        covered = sum(i.low <= at <= i.high for i in mine) / n
        known = sum(i.identified for i in mine) / n
        off = float(np.exp(np.median([abs(np.log(i.value / at)) for i in mine])))
        well = name.partition("[")[0] in WELL
        print(f"  {name:36} {covered:6.0%} {known:10.0%} {off:14.3f}{'   well identified' if well else ''}")
        parameters[name] = {
            "coverage": covered, "identified": known, "well": well, "truth": at,
            "repeats": [{"value": i.value, "low": i.low, "high": i.high} for i in mine],
        }  # fmt: skip
    ratio = scores / reference
    print(f"  held-out RMSE against the true noise: position {np.median(ratio[:, 0]):.4f} (largest "
          f"{ratio[:, 0].max():.4f}), velocity {np.median(ratio[:, 1]):.4f} ({ratio[:, 1].max():.4f}); start "
          f"{start[0] / reference[0]:.3f}, {start[1] / reference[1]:.3f}")  # fmt: skip
    return {"parameters": parameters, "rmse_true": reference, "rmse_start": start, "rmse_tuned": scores}


def main(argv: list[str]) -> None:
    """Print the tables, write the JSON."""
    parser = common.options("recover", __doc__.splitlines()[0])
    parser.add_argument("--data", choices=("navego", "simulated", "drive"), default="navego")
    parser.add_argument("--imu", choices=("imu1", "imu2"), default="imu2", help="of NaveGo, default imu2")
    parser.add_argument("--factor", type=float, default=10.0, help="start so many times off, default 10")
    parser.add_argument("--quick", action="store_true", help=f"simulated: {QUICK.repeats} short repeats")
    parser.add_argument("--steps", type=int, default=12, help="drive: of tuning by drift for each block, default 12")
    parser.add_argument("--seed", type=int, default=0, help="of the simulated data, or the bootstrap; default 0")
    args = parser.parse_args(argv)
    if args.data == "drive":
        from benchmarks.recordings import recover_drive

        common.write_json(args.json, recover_drive.recover(args.steps, args.seed))
    elif args.data == "navego":
        common.write_json(args.json, recording(args.imu, args.factor))
    else:
        common.write_json(args.json, simulated(QUICK if args.quick else FULL, args.factor, args.seed))
