"""What tuning costs: a gradient against CMA-ES, coordinate search and random search, in filter-run equivalents.

Five problems of 15 or more free parameters, each started anywhere within a decade of the datasheet. Every loss is a
logarithm (of a likelihood per fix, of a drift, of an RMSE), so that within 1 % of the best loss seen by any method is
within 0.01 of it. One evaluation costs the runs of the problem's batch; a gradient is charged what it was measured to
take on the same batch, and the method of scoring, which only likelihoods have, likewise.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from scipy import optimize

from benchmarks import common
from benchmarks.recordings import drive, navego
from benchmarks.speed import rivals
from jaxnav import data as io
from jaxnav.analysis import metrics
from jaxnav.filters.catalogue import FILTERS, build
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import get, put
from jaxnav.filters.run import run
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import matched_params, simulate_runs
from jaxnav.types import Epoch, Info, Nav, Params
from tuning import objectives, scoring, uncertainty
from tuning.batch import Data, Problem, evaluate, mean
from tuning.optimizers import adam
from tuning.train import _job
from tuning.transforms import LOG, TRANSFORMS, Spec, join, scaled, split

CLOSE = 0.01  # of a logarithm: 1 %
PER_PARAMETER = 200  # evaluations of a search without derivatives, for each parameter
STEPS, RATE = 100, 0.3  # of Adam
TOGETHER = 16  # candidates that are evaluated side by side
WHITE, DRIVES = ("noise.gyro", "noise.accel"), ("states.gyro_bias.driving_noise", "states.accel_bias.driving_noise")
SCALES = ("measurements.position.scale", "measurements.velocity.scale")
AXES = (*WHITE, *DRIVES, *SCALES)


class Runs(NamedTuple):
    """A batch for every objective; leading axis B."""

    nav: Nav
    epochs: Epoch
    keep: jax.Array  # (B, E) bool
    ends: jax.Array  # (B, W) int, last epochs of hidden windows
    lla: jax.Array  # (B, E, 3) truth, where it is used


class Setup(NamedTuple):
    """One tuning problem."""

    filter: Filter
    params: Params
    spec: Spec
    runs: Runs
    loss: Callable[[Params, Runs], jax.Array]  # of one run
    likelihood: bool  # whether the loss is one, per fix


def per_axis(params: Params) -> Params:
    """Noise with one number for every axis."""
    for name in AXES:
        params = put(params, name, jnp.broadcast_to(get(params, name), (3,)))
    return params


def free(*more: tuple[str, Any], axes: tuple[str, ...] = AXES) -> Spec:
    """Noise by axis, and what else is named."""
    return dict.fromkeys(axes, LOG) | dict(more)


def finite(info: Info, value: jax.Array) -> jax.Array:
    """A loss, inf where the run stopped being finite: its frozen innovations would look like none at all."""
    return jnp.where(info.ok.all(), value, jnp.inf)


def nll(filt: Filter) -> Callable:
    def loss(params, r):
        info = run(filt, params, r.nav, r.epochs)
        return finite(info, objectives.innovation_nll(info, r.keep))

    return loss


def log_drift(filt: Filter) -> Callable:
    def loss(params, r):
        info = run(filt, params, r.nav, r.epochs)
        return finite(info, objectives.log_mean_drift(info, r.ends, jnp.ones(r.ends.shape, bool)))

    return loss


def log_rmse(filt: Filter) -> Callable:
    def loss(params, r):
        info = run(filt, params, r.nav, r.epochs)
        error = jax.vmap(metrics.position_error)(info.nav, r.lla)
        return finite(info, 0.5 * jnp.log(jnp.mean(error**2)))

    return loss


# ---------------------------------------------------------------------------- problems


def town(count: int, late: float = 0.0, seed: int = 0) -> tuple[Runs, Params, int]:
    """Simulated drives in town with an outage each; fixes may be late."""
    imu = URBAN_SHORT.imu._replace(imu_noise_factor=5.0)
    what = URBAN_SHORT._replace(imu_rate_hz=10.0, imu=imu, gnss=URBAN_SHORT.gnss._replace(latency_s=late))
    sims = simulate_runs(what, jax.random.split(jax.random.key(seed), count))
    ends = jnp.sum(sims.truth.t[:, None] <= sims.outages[:, :, 1:] + 1e-6, axis=-1) - 1
    runs = Runs(sims.initial, sims.epochs, ~sims.hidden, ends, sims.truth.pos)
    return runs, per_axis(matched_params(what)), sims.epochs.imu.dt.shape[-1]


def simulated_likelihood() -> Setup:
    """15 states, simulated drives, likelihood of the innovations: 18 parameters."""
    runs, params, k = town(4)
    filt = build("ekf15", cov_stride=k)
    return Setup(filt, params, free(), runs, nll(filt), True)


def simulated_drift() -> Setup:
    """GPID with bias states, simulated drives, drift at the ends of outages: 20 parameters and more."""
    runs, params, k = town(4, seed=1)
    filt = build("gpid15", cov_stride=k)
    params = params._replace(rule=FILTERS["gpid15"].theta())
    rule = [(f"rule.{name}", TRANSFORMS[kind]) for name, kind in FILTERS["gpid15"].tunable.items()]
    return Setup(filt, params, free(*rule), runs, log_drift(filt), False)


def simulated_rmse() -> Setup:
    """9 states, fixes 0.2 s late, true position: noise, lever arm and latencies, 17 parameters."""
    runs, params, k = town(4, 0.2, seed=2)
    filt = build("ekf9", cov_stride=k, history=8)
    place = [("mounting.lever_arm", scaled(0.2)), ("measurements.position.latency", scaled(0.1)),
             ("measurements.velocity.latency", scaled(0.1))]  # fmt: skip
    axes = (*WHITE, *SCALES)
    return Setup(filt, params, free(*place, axes=axes), runs, log_rmse(filt), False)


def one(nav: Nav, data: Epoch, keep: np.ndarray) -> Runs:
    """A recording as a batch of one."""
    lead = lambda tree: jax.tree.map(lambda a: jnp.asarray(a)[None], tree)
    E = keep.size
    return Runs(lead(nav), lead(data), jnp.asarray(keep)[None], jnp.zeros((1, 1), int), jnp.zeros((1, E, 3)))


def navego_likelihood() -> Setup:
    """15 states, a minute of NaveGo's imu2, likelihood: 18 parameters."""
    folder = io.verify("navego_synthetic")
    packed, nav = navego.cut(io.read_navego(folder, "imu2"), instantaneous=False)
    E = int(np.searchsorted(packed.t, packed.t[0] + 60.0))
    filt = build("ekf15", cov_stride=packed.epochs.imu.dt.shape[1])
    data = jax.tree.map(lambda a: a[:E], packed.epochs)
    return Setup(filt, per_axis(navego.parameters(folder, "imu2")), free(), one(nav, data, np.ones(E, bool)), nll(filt),
                 True)  # fmt: skip


def drive_likelihood() -> Setup:
    """15 states and standstill updates, a stretch of the real drive, likelihood: noise, timing, lever arm, 25."""
    rec = io.read_drive(io.verify("rtkexplorer_drive"), imu_delay=drive.EARLY)
    data = drive.cut(rec, False, 146.0, 196.0)
    more = [("measurements.zero_velocity.sd", LOG), ("measurements.zero_rate.sd", LOG),
            ("mounting.time_offset", scaled(0.1)),
            ("measurements.velocity.latency", scaled(0.05)), ("mounting.lever_arm", scaled(0.2))]  # fmt: skip
    runs = one(data.nav, data.epochs, data.t > 146.0 + 10.0)
    return Setup(data.filt, per_axis(drive.parameters()), free(*more), runs, nll(data.filt), True)


PROBLEMS: dict[str, Callable[[], Setup]] = {
    "simulated_likelihood": simulated_likelihood, "simulated_drift": simulated_drift, "simulated_rmse": simulated_rmse,
    "navego_likelihood": navego_likelihood, "drive_likelihood": drive_likelihood,
}  # fmt: skip


# ---------------------------------------------------------------------------- methods


@partial(jax.jit, static_argnums=0)
def _population(problem: Problem, candidates: jax.Array, like: Any, data: Data) -> jax.Array:
    """Losses of many candidates (N, P), inf where a run fails, (N,)."""
    back = ravel_pytree(like)[1]
    one = jax.vmap(lambda r: evaluate(problem, back(r), data, slopes=False))(candidates)
    return jnp.where(one.good.all(1), one.value, jnp.inf)


@partial(jax.jit, static_argnums=0)
def _gradient(problem: Problem, raw: Any, data: Data):
    """Loss and its gradient."""
    e = evaluate(problem, raw, data)
    return e.value, e.grad


@partial(jax.jit, static_argnums=(0, 1))
def _inform(filt: Filter, items: tuple, flat: jax.Array, like: Any, params: Params, runs: Runs):
    spec, (_, back) = dict(items), ravel_pytree(like)

    def one(r: Runs):
        block = jnp.zeros(r.keep.shape, int)
        solve = lambda f: run(filt, join(spec, back(f), params), r.nav, r.epochs)
        return uncertainty.information(solve, flat, r.keep, block, 1)

    parts = jax.vmap(one)(runs)
    return uncertainty.Information(*(a.sum(0) for a in parts))


def seconds(call: Callable[[], Any], times: int = 5) -> float:
    """Least processor time of a call, after one to compile; other work on the machine does not lengthen it."""
    jax.block_until_ready(call())
    spent = []
    for _ in range(times):
        begin = time.process_time()
        jax.block_until_ready(call())
        spent.append(time.process_time() - begin)
    return min(spent)


def compare(name: str, setup: Setup, seed: int, per_parameter: int, steps: int) -> dict:
    """All methods on one problem: loss against cost, and the cost to come close to the best of all."""
    like = split(setup.spec, setup.params)
    flat, back = ravel_pytree(like)
    P = flat.size
    flat = np.asarray(flat) + np.random.default_rng(seed).uniform(-1, 1, P) * rivals.DECADE * decades(setup.spec, like)
    problem, data = _job(setup.loss, setup.spec, setup.params, (), [setup.runs], mean, None, 1.0, None)

    def many(candidates: np.ndarray) -> np.ndarray:
        """In one of two sizes, so that two programs serve every search."""
        n = len(candidates)
        filled = candidates if n == 1 else np.concatenate([candidates, np.repeat(candidates[-1:], TOGETHER - n, 0)])
        return np.asarray(_population(problem, filled, like, data))[:n]

    unit = seconds(lambda: many(flat[None]))
    first = back(jnp.asarray(flat))
    charge = {"gradient": seconds(lambda: _gradient(problem, first, data)) / unit}
    together = seconds(lambda: many(np.tile(flat, (TOGETHER, 1)))) / TOGETHER / unit
    curves: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    budget = per_parameter * P
    for rival in (rivals.cma, rivals.coordinate_search, rivals.random_search):
        best = rival(many, flat, budget, seed)
        curves[rival.__name__] = (np.arange(1, best.size + 1), best)
    gradient = partial(_gradient, problem, data=data)
    for label, method in (("adam", descend), ("lbfgs", quasi_newton)):
        losses = method(gradient, first, steps)
        curves[label] = (charge["gradient"] * np.arange(1, losses.size + 1), np.minimum.accumulate(losses))
    if setup.likelihood:
        items = tuple(setup.spec.items())
        inform = lambda f: _inform(setup.filter, items, f, like, setup.params, setup.runs)
        charge["scoring"] = seconds(lambda: inform(jnp.asarray(flat)), 3) / unit
        values: list[float] = [float(many(flat[None])[0])]
        scoring.maximise(
            inform, jnp.asarray(flat), 40, report=lambda i, s: values.append(float(many(np.asarray(s.raw)[None])[0]))
        )
        curves["scoring"] = (charge["scoring"] * np.arange(1, len(values) + 1), np.minimum.accumulate(values))
    return verdict(name, P, curves, charge, unit, together)


def descend(gradient: Callable[[Any], Any], raw: Any, steps: int) -> np.ndarray:
    """The losses of Adam's steps, (steps + 1,)."""
    optimizer, losses = adam(steps, RATE, 10.0), []
    state = optimizer.init(raw)
    update = jax.jit(optimizer.update)
    for _ in range(steps + 1):
        value, grad = gradient(raw)
        losses.append(float(value))
        updates, state = update(grad, state, raw)
        raw = optax.apply_updates(raw, updates)
    return np.where(np.isfinite(losses), losses, np.inf)


def quasi_newton(gradient: Callable[[Any], Any], raw: Any, most: int) -> np.ndarray:
    """The losses of every gradient that L-BFGS asks for, its line searches included, (most + 1,) at most.

    As `tune.method = "lbfgs"`, here by scipy, which counts them.
    """
    flat, back = ravel_pytree(raw)
    losses: list[float] = []

    def call(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, grad = gradient(back(jnp.asarray(x)))
        slope = np.asarray(ravel_pytree(grad)[0])
        sound = bool(np.isfinite(value)) and bool(np.isfinite(slope).all())
        losses.append(float(value) if sound else np.inf)
        return (losses[-1], slope) if sound else (1e6, np.zeros_like(slope))

    optimize.minimize(call, np.asarray(flat), jac=True, method="L-BFGS-B", options={"maxfun": most, "maxcor": 20})
    return np.asarray(losses[: most + 1])


def decades(spec: Spec, like: Any) -> np.ndarray:
    """How far a start is off: a decade where the parameter is positive, half of its unit elsewhere."""
    sizes = {name: jnp.full(jnp.shape(like[name]), 1.0 if spec[name].forward is LOG.forward else 0.2) for name in spec}
    return np.asarray(ravel_pytree(sizes)[0])


def verdict(name: str, P: int, curves: dict, charge: dict, unit: float, together: float) -> dict:
    """The cost of every method to come within CLOSE of the best loss of all, printed."""
    best = min(float(loss[-1]) for _, loss in curves.values())
    rows = {}
    print(f"{name}: {P} parameters, best loss {best:.4f}; a gradient costs {charge['gradient']:.1f} evaluations, "
          f"one of 16 side by side {together:.2f}", flush=True)  # fmt: skip
    for method, (cost, loss) in curves.items():
        near = np.flatnonzero(loss <= best + CLOSE)
        reached = float(cost[near[0]]) if near.size else None
        rows[method] = {"cost": reached, "spent": float(cost[-1]), "loss": float(loss[-1]), "start": float(loss[0]),
                        "curve": [[float(c), float(v)] for c, v in zip(*thin(cost, loss), strict=True)]}  # fmt: skip
        said = f"{reached:9.0f}" if reached is not None else f"  not in {cost[-1]:.0f}"
        print(f"  {method:18} loss {loss[-1]:9.4f}   evaluations to within 1 %: {said}", flush=True)
    return {"problem": name, "parameters": P, "best": best, "charge": charge, "seconds_an_evaluation": unit,
            "side_by_side": together, "methods": rows}  # fmt: skip


def thin(cost: np.ndarray, loss: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Only where the curve falls."""
    keep = np.concatenate([[True], np.diff(loss) < 0])
    return cost[keep], loss[keep]


def ratio(row: dict, rival: str, ours: str) -> float | None:
    """How many times a rival's cost is ours to come within CLOSE of the best loss that either of the two saw.

    From below where the rival never came close, None where we never did.
    """
    best = min(row["methods"][method]["loss"] for method in (rival, ours))
    theirs, own = (
        next((cost for cost, loss in row["methods"][method]["curve"] if loss <= best + CLOSE), None)
        for method in (rival, ours)
    )
    if own is None:
        return None
    return (row["methods"][rival]["spent"] if theirs is None else theirs) / own


def medians(rows: list[dict]) -> dict:
    """Of the ratios over the problems, printed: for each use of the gradient, against each search without."""
    choose = {
        "adam": lambda row: "adam",
        "lbfgs": lambda row: "lbfgs",
        # what one would take: the likelihood's own method where there is one
        "scoring, else lbfgs": lambda row: "scoring" if "scoring" in row["methods"] else "lbfgs",
    }
    out: dict = {}
    for label, pick in choose.items():
        for rival in ("cma", "coordinate_search", "random_search"):
            each = [ratio(row, rival, pick(row)) for row in rows]
            found = sorted(0.0 if r is None else r for r in each)  # where we never came close we are the dearer
            out.setdefault(label, {})[rival] = {"median": float(np.median(found)), "each": each}
            print(f"{rival}: {np.median(found):.1f} times the cost of {label}, median of {len(rows)} problems: "
                  + ", ".join("never" if r is None else f"{r:.1f}" for r in each))  # fmt: skip
    return out


def main(argv: list[str]) -> None:
    """Print the table of every problem, write the JSON."""
    parser = common.options("budget", __doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of starts and searches, default 0")
    parser.add_argument("--problem", choices=tuple(PROBLEMS), action="append", help="only this one; may be repeated")
    parser.add_argument("--quick", action="store_true", help="5 evaluations a parameter, 5 steps")
    args = parser.parse_args(argv)
    per, steps = (5, 5) if args.quick else (PER_PARAMETER, STEPS)
    rows = []
    for name in args.problem or PROBLEMS:
        rows.append(compare(name, PROBLEMS[name](), args.seed, per, steps))
        common.write_json(args.json, {"seed": args.seed, "problems": rows})  # so far
    common.write_json(args.json, {"seed": args.seed, "problems": rows, "ratios": medians(rows)})
