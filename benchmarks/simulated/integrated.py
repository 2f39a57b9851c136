"""A receiver whose position is the integral of its velocity, with an error of minutes: result of tuning.

Repeats of a drive in town (`urban_integrating`) with a stated sd of five times the white noise of positions, each tuned
by `tuning.tune` from the datasheet without truth. Where it chooses the filter with slow errors: how often the
intervals of the white noise of position and velocity hold the truth. Of all: the clock's drift, which is none, and the
position on drives that no repeat has seen, against the filter that knows every number.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from jaxnav import build
from jaxnav.analysis import metrics
from jaxnav.analysis.tables import table
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.filters.core import Filter
from jaxnav.filters.parameters import change
from jaxnav.filters.run import run
from jaxnav.simulate.scenarios import INTEGRATING
from jaxnav.simulate.simulation import Simulated, matched_params, simulate, to_recording
from jaxnav.types import Params
from tuning.recordings.recorded import tune

OVERSTATED = 5.0  # the receiver's sd of the position against its white noise
HELD, SETTLED = 20, 60.0  # drives to score on; s of each that are the start's
SLOW = "gnss_position_error"
TRUE = {"position.scale": 1 / OVERSTATED, "velocity.scale": 1.0}


def truth_of(sheet: Params) -> Params:
    """The parameters that made the data; integrated and slow errors fade alike, and are one process."""
    receiver, interval = INTEGRATING.gnss, 1 / INTEGRATING.gnss_rate_hz
    tau = receiver.slow_position_s
    drive = np.sqrt(2 * receiver.slow_position_sd_m**2 / tau + receiver.velocity_sd_mps[0] ** 2 * interval)
    values = {"measurements.position.scale": 1 / OVERSTATED, "measurements.velocity.scale": 1.0}
    slow = {"driving_noise": drive, "tau": tau, "sd": drive * np.sqrt(tau / 2)}
    values |= {f"states.{SLOW}.{leaf}": value for leaf, value in slow.items()}
    return change(sheet, values)


def overstated(sim: Simulated) -> Simulated:
    """The run with the receiver's stated sd."""
    fix = sim.epochs.fix
    return sim._replace(epochs=sim.epochs._replace(fix=fix._replace(sd=fix.sd.at[..., :3].multiply(OVERSTATED))))


@partial(jax.jit, static_argnums=0)
def rms_of(filt: Filter, params: Params, sims: Simulated) -> jax.Array:
    """RMS of the horizontal position error, m, over runs (R, ...)."""

    def one(sim):
        info = run(filt, params, sim.initial, sim.epochs)
        error = jax.vmap(metrics.position_error)(info.nav, sim.truth.pos)[:, :2]
        late = sim.truth.t > SETTLED
        return jnp.sum(jnp.where(late[:, None], error, 0.0) ** 2) / jnp.sum(late)

    return jnp.sqrt(jax.vmap(one)(sims).mean())


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("integrated", __doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=4, help="default 4; the published figures are of 40")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    args = parser.parse_args(argv)
    make = jax.jit(jax.vmap(lambda key: overstated(simulate(key, INTEGRATING))))
    sims = make(jax.random.split(jax.random.key(args.seed), args.repeats + HELD))
    held = jax.tree.map(lambda a: a[args.repeats :], sims)
    stride = INTEGRATING.imu_rate_hz / INTEGRATING.gnss_rate_hz
    plain, slow = (build("ekf15", cov_stride=int(stride), states=states) for states in ((), (SLOW,)))
    sheet = matched_params(INTEGRATING)
    states = sheet.states | {SLOW: slow.params().states[SLOW]}
    best = float(rms_of(slow, truth_of(sheet._replace(states=states)), held))
    rows = []
    for i in range(args.repeats):
        clear_caches_if_needed()
        begin = time.perf_counter()
        found = tune(to_recording(jax.tree.map(lambda a, i=i: a[i], sims), INTEGRATING), plain, sheet)
        numbers = {r.name: (r.value, r.low, r.high) for r in found.rows}
        own = found.params._replace(prior=sheet.prior)  # the start's is each run's own
        rows.append({
            "chosen": found.chosen, "numbers": numbers, "clock_ppm": numbers["clock_drift"][0],
            "rms_ratio": float(rms_of(found.filter, own, held)) / best,
            "drift_ratio": found.test[found.chosen]["rms_m"] / found.test["datasheet"]["rms_m"],
            "seconds": time.perf_counter() - begin,
        })  # fmt: skip
        print(f"{i}: {found.verdict}; clock {rows[-1]['clock_ppm']:.0f} ppm, RMS {rows[-1]['rms_ratio']:.3f} of the "
              "filter's that knows", flush=True)  # fmt: skip
        common.write_json(args.json, summary(rows) | {"rms_known_m": best, "seed": args.seed, "repeats": rows})
    result = summary(rows)
    print(table(["", "value"], [[k, v] for k, v in result.items()]))


def summary(rows: list[dict]) -> dict:
    """The figures over the repeats."""
    told = [r["numbers"] for r in rows if r["chosen"] == "slow errors"]
    clock = np.abs([r["clock_ppm"] for r in rows])
    ratio = np.array([r["rms_ratio"] for r in rows])
    out = {
        "chosen_slow": len(told) / len(rows), "clock_largest_ppm": clock.max(), "clock_median_ppm": np.median(clock),
        "rms_ratio_median": np.median(ratio), "rms_ratio_largest": ratio.max(),
        "drift_ratio_median": np.median([r["drift_ratio"] for r in rows]),
    }  # fmt: skip
    for name, true in TRUE.items():
        if told:
            out[f"{name}_covered"] = np.mean([n[name][1] <= true <= n[name][2] for n in told])
            out[f"{name}_median"] = np.median([n[name][0] for n in told])
    return {k: float(v) for k, v in out.items()}
