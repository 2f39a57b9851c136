"""The smoother on simulated drives with outages: is it consistent in the middle of them, and how much nearer is it?

Urban drives with outages of 15 and of 60 s, a consumer's IMU, position and velocity at 1 Hz, the filter that knows the
noise. *anees_mid*: NEES of position, velocity and attitude per degree of freedom at the middle of the outages, over
runs, which are independent, so that the mean has chi-square bounds. *ratio*: RMS of the smoothed horizontal error over
the inside of the outages against the RMS of the filter's at their ends. *lag*: the same with a fixed lag of 2 s. Then
the real drive, `benchmarks.recordings.drive_smooth`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.recordings import drive_smooth
from jaxnav import build
from jaxnav.analysis import metrics
from jaxnav.analysis.tables import table
from jaxnav.filters.core import Filter
from jaxnav.filters.smoother import reach_of, smooth
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import URBAN, Scenario
from jaxnav.simulate.simulation import matched_params, simulate
from jaxnav.types import Params

LENGTHS = (15.0, 60.0)
BEGIN = 120.0  # s, of the outage
CHUNK = 32


def scenario(length: float) -> Scenario:
    """A drive with one outage; the receiver's errors are white."""
    gnss = URBAN.gnss._replace(outages_s=((BEGIN, BEGIN + length),))
    return URBAN._replace(duration_s=BEGIN + length + 80.0, gnss=gnss, imu=URBAN.imu._replace(grade="consumer"))


@partial(jax.jit, static_argnums=(0, 1, 5))
def errors(filt: Filter, what: Scenario, params: Params, keys: jax.Array, reach: jax.Array, most: int) -> dict:
    """Horizontal errors (R, E) of the filter, the smoother and the lagged one, and NEES (R, E) of the smoother."""

    def one(key):
        sim = simulate(key, what)
        off = lambda info: jnp.linalg.norm(jax.vmap(metrics.position_error)(info.nav, sim.truth.pos)[:, :2], axis=1)
        filtered, whole = smooth(filt, params, sim.initial, sim.epochs)
        _, lagged = smooth(filt, params, sim.initial, sim.epochs, reach, most)
        x = jax.vmap(metrics.state_error)(whole.nav, sim.truth)
        nees = jax.vmap(metrics.nees)(x, whole.P[:, :9, :9])
        return {"filter": off(filtered), "smooth": off(whole), "lag": off(lagged), "nees": nees}

    return jax.vmap(one)(keys)


def study(length: float, runs: int, seed: int) -> dict:
    """The figures of one length."""
    what, ekf = scenario(length), build("ekf15", cov_stride=10)
    params, t = matched_params(what), np.arange(1.0, what.duration_s + 0.5)
    reach, most = reach_of(t, 2.0)
    keys = run_keys(seed, Purpose.STUDY, np.arange(runs))
    parts = [jax.device_get(errors(ekf, what, params, keys[i : i + CHUNK], reach, most)) for i in range(0, runs, CHUNK)]
    found = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    inside = (t > BEGIN) & (t <= BEGIN + length)
    last, middle = int(np.flatnonzero(inside)[-1]), int(np.flatnonzero(inside)[int(length / 2)])
    outside = int(np.flatnonzero(t == BEGIN - 20.0)[0])
    rms = lambda a: float(np.sqrt(np.mean(a**2)))
    bounds = (np.array(metrics.chi2_bounds(9, runs)) / 9).tolist()
    end = rms(found["filter"][:, last])
    anees = {"anees_mid": middle, "anees_outside": outside}
    return {k: float(found["nees"][:, i].mean() / 9) for k, i in anees.items()} | {
        "bounds": bounds, "filter_end_m": end, "smooth_inside_m": rms(found["smooth"][:, inside]),
        "rms_ratio": rms(found["smooth"][:, inside]) / end, "lag_ratio": rms(found["lag"][:, inside]) / end,
    }  # fmt: skip


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("smooth", __doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=128, help="simulated, default 128; 0: none")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    parser.add_argument(
        "--steps", type=int, default=100, help="of tuning on the real drive, default 100; 0: without it"
    )
    args = parser.parse_args(argv)
    found = {f"{length:g}": study(length, args.runs, args.seed) for length in LENGTHS if args.runs}
    plain = lambda v: np.round(v, 3).tolist() if isinstance(v, list) else v
    result: dict = {}
    if found:
        rows = [[name, *map(plain, row.values())] for name, row in found.items()]
        print(table(["outage s", *next(iter(found.values()))], rows))
        ratios = {k: r["rms_ratio"] for k, r in found.items()}
        result["simulated"] = {"rms_ratio": ratios, "by_length": found, "runs": args.runs}
    if args.steps:
        drives = drive_smooth.study(args.steps)
        rows = [[name, length, *row.values()] for name, each in drives.items() for length, row in each.items()]
        print(
            table(["the drive", "window s", "largest inside, RMS m", "median m", "NEES in the middle", "windows"], rows)
        )
        result["drive"] = drives
    common.write_json(args.json, result)
