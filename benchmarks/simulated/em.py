"""Expectation and maximisation beside the method of scoring: the same likelihood, the same data, the same start.

Simulated drives of five minutes with fixes at 1 Hz, the filter that knows all but the noise, whose numbers start three
times too large: those of the fixes, of the IMU's white noise and of what drives its biases. Scoring has all forward
derivatives of the filter; EM a run forth and one back. Both stop by themselves, or after so many evaluations.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks import common
from jaxnav import build
from jaxnav.analysis.tables import table
from jaxnav.filters.parameters import get, put
from jaxnav.filters.run import prepare, run
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import URBAN
from jaxnav.simulate.simulation import matched_params, simulate
from tuning import scoring, uncertainty
from tuning.em import em, expected
from tuning.transforms import LOG, Spec, join, split, tied

SCENARIO = URBAN._replace(duration_s=300.0, gnss=URBAN.gnss._replace(outages_s=(), random_outages=0))
LEVEL = (0, 0, 1)
SPEC: Spec = {
    "noise.gyro": tied(LOG), "noise.accel": tied(LOG),
    "states.gyro_bias.drive": tied(LOG), "states.accel_bias.drive": tied(LOG),
    "measurements.position.scale": tied(LOG, LEVEL), "measurements.velocity.scale": tied(LOG, LEVEL),
}  # fmt: skip
FIXES = ("measurements.position.scale", "measurements.velocity.scale")
WRONG = 3.0


def study(seed: int, steps: int) -> dict:
    """Both methods on one drive: evaluations, seconds a piece, likelihood, and each number over the true one."""
    ekf, true = build("ekf15", cov_stride=10), matched_params(SCENARIO)
    sim = jax.jit(partial(simulate, SCENARIO))(run_keys(seed, Purpose.STUDY, np.arange(1))[0])
    epochs, start = prepare(ekf, sim.epochs), true
    for name in SPEC:
        start = put(start, name, WRONG * get(true, name))
    flat, back = ravel_pytree(split(SPEC, start))
    truth = np.asarray(ravel_pytree(split(SPEC, true))[0])
    at = lambda r: join(SPEC, back(r), start)
    keep = jnp.ones(epochs.fix.valid.shape[0], bool)
    block = jnp.zeros(keep.size, int)
    solve = lambda r: run(ekf, at(r), sim.initial, epochs)
    inform = jax.jit(lambda r: uncertainty.information(solve, r, keep, block, 1))
    expect = jax.jit(lambda r: expected(ekf, at, r, sim.initial, epochs))
    found = {}
    for method, ask in (("scoring", inform), ("em", expect)):
        first = time.perf_counter()
        jax.block_until_ready(ask(flat))
        compiled, losses = time.perf_counter() - first, []
        begin = time.perf_counter()
        if method == "scoring":
            ended = scoring.maximise(
                ask, flat, steps, report=lambda i, s, losses=losses: losses.append(float(s.best.nll))
            )
            raw, value = ended.raw, ended.best.nll
        else:
            end = em(ask, flat, steps, report=lambda i, r, a, losses=losses: losses.append(float(a.nll)))
            raw, value = end.flat, end.at.nll
        numbers = dict(zip(_names(back(flat)), np.exp(np.asarray(raw) - truth).tolist(), strict=True))
        found[method] = {
            "first_s": compiled, "evaluations": len(losses) + 1, "nll": float(value), "ratios": numbers,
            "each_s": (time.perf_counter() - begin) / (len(losses) + 1), "losses": losses,
        }  # fmt: skip
    return found


def off(each: list[dict], names: tuple[str, ...]) -> float:
    """The factor by which numbers of these names are wrong, up or down, in the median."""
    logs = [abs(np.log(value)) for e in each for name, value in e["ratios"].items() if name.startswith(names)]
    return float(np.exp(np.median(logs)))


def _names(raw: dict[str, jax.Array]) -> list[str]:
    return [f"{name}[{i}]" if np.size(a) > 1 else name for name, a in sorted(raw.items()) for i in range(np.size(a))]


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("em", __doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=8, help="how many, default 8")
    parser.add_argument("--steps", type=int, default=60, help="evaluations at most, default 60")
    args = parser.parse_args(argv)
    found = [study(seed, args.steps) for seed in range(args.drives)]
    rows, result = [], {}
    for method in ("scoring", "em"):
        each, best = [f[method] for f in found], [f["scoring"]["nll"] for f in found]
        median = lambda key, each=each: float(np.median([e[key] for e in each]))
        result[method] = {
            "first_s": each[0]["first_s"], "each_s": median("each_s"), "evaluations": median("evaluations"),
            "nll_above_scoring": float(np.median([e["nll"] - b for e, b in zip(each, best, strict=True)])),
            "fixes_off": off(each, FIXES), "imu_off": off(each, ("noise", "states")),
        }  # fmt: skip
        rows.append([method, *result[method].values()])
    head = ["", "first, s", "each, s", "evaluations", "-log L above", "fixes off by x", "IMU off by x"]
    print(table(head, rows))
    common.write_json(args.json, {"drives": found, "summary": result})
