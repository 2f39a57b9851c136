"""Heading behind a pause of a log: error and stated sd, in simulated drives without samples or fixes for some time."""

from collections.abc import Sequence

import jax
import numpy as np

from benchmarks.common import options, write_json
from jaxnav.filters.catalogue import build
from jaxnav.maths.units import DEG
from jaxnav.navigation import navigate
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_runs, to_recording
from jaxnav.types import ImuLog, Recording, sample_rows

LENGTHS, BEGINS = (1.0, 3.0, 20.0, 60.0, 200.0), (150.0, 220.0, 333.0)  # s
BEHIND = (1.0, 5.0, 10.0, 20.0, 30.0, 60.0)  # s
SECONDS, RATE_HZ = 600.0, 50.0


def paused(rec: Recording, begin: float, end: float) -> Recording:
    """Return a recording without the data of a pause."""
    keep = lambda t: (t <= begin) | (t > end)
    aiding = {name: sample_rows(s, keep(s.t)) for name, s in rec.aiding.items()}
    return rec._replace(imu=ImuLog(*(a[keep(rec.imu.t)] for a in rec.imu)), aiding=aiding)


def headings(rec: Recording, begin: float, end: float) -> np.ndarray:
    """Return error and sd of the heading (deg) at the times `BEHIND` a pause: (B, 2)."""
    filt = build("ekf15")
    sol = navigate(paused(rec, begin, end), filt, filt.params("consumer"))
    assert rec.truth is not None
    found = []
    for late in BEHIND:
        i, j = (int(np.abs(t - end - late).argmin()) for t in (sol.t, rec.truth.t))
        found.append((((sol.rph[i, 2] - rec.truth.rph[j, 2]) / DEG + 180) % 360 - 180, sol.sd[i, 8] / DEG))
    return np.array(found)


def drive(seed: int, seconds: float = SECONDS, rate: float = RATE_HZ) -> Recording:
    """Return a simulated drive in a town with fixes of 2 m every second."""
    scenario = URBAN_SHORT._replace(duration_s=seconds, imu_rate_hz=rate, gnss=URBAN_SHORT.gnss._replace(outages_s=()))
    runs = simulate_runs(run_keys(seed, Purpose.SINGLE, np.arange(1)), scenario)
    return to_recording(jax.tree.map(lambda a: a[0], runs), scenario)


def main(argv: Sequence[str] | None = None) -> int:
    """Every length of pause, a line for each time behind it."""
    parser = options("pauses", __doc__ or "")
    parser.add_argument("--drives", type=int, default=4, help="three pauses of each length in each; default 4")
    args = parser.parse_args(argv)
    drives = [drive(seed) for seed in range(args.drives)]
    result = []
    print("pause (s)  behind (s)  error rms (deg)  sd median (deg)  error / sd: rms  largest")
    for length in LENGTHS:
        found = np.array([headings(rec, begin, begin + length) for rec in drives for begin in BEGINS])
        for late, (error, sd) in zip(BEHIND, found.transpose(1, 2, 0), strict=True):
            z = error / sd
            root = lambda x: float(np.sqrt(np.mean(x**2)))
            row = [length, late, root(error), float(np.median(sd)), root(z), float(np.abs(z).max())]
            print("{:9g}  {:10g}  {:15.1f}  {:15.1f}  {:15.2f}  {:7.1f}".format(*row))
            result.append(row)
    write_json(args.json, {"rows": result, "drives": args.drives})
    return 0
