"""Heading of vehicles that are parked first or stop in between: error and stated sd, at rest and in motion.

A car or an aircraft with consumer and tactical sensors stands for 30 to 300 s, then moves for a minute and a half.
While it stands nothing shows heading, so that its stated sd must not shrink.
"""

from itertools import product

import numpy as np

from benchmarks.common import options, write_json
from benchmarks.simulated.vehicles import simulated
from jaxnav.filters.catalogue import build
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.maths.units import DEG
from jaxnav.navigation import navigate

LENGTHS = (30.0, 100.0, 300.0)  # s at rest
MOVING, SETTLED = 90.0, 20.0  # s in motion, and of it before heading is judged
BEFORE = 60.0  # s in motion before a stop in between


def one(kind: str, grade: str, rest: tuple[float, float], seed: int) -> dict:
    """Return heading z (rms) after moving off, the error and sd there, and how far the sd shrank at rest."""
    clear_caches_if_needed()
    rng = np.random.default_rng([seed, int(rest[1]), *map(ord, kind + grade)])
    rec, _ = simulated(kind, grade, True, rng, span=rest[1] + MOVING, late=0.0, rest=rest)
    sol = navigate(rec, build("ekf15", cov_stride=5))
    assert rec.truth is not None
    true = np.interp(sol.t, rec.truth.t, np.unwrap(rec.truth.rph[:, 2]))
    error, sd = (sol.rph[:, 2] - true + np.pi) % (2 * np.pi) - np.pi, sol.sd[:, 8]
    after = sol.t > rest[1] + SETTLED
    still = (sol.t > rest[0] + 15.0) & (sol.t < rest[1] - 1.0)
    shrunk = float((sd[still] / np.maximum.accumulate(sd[still])).min()) if still.sum() > 2 else 1.0
    z = error[after] / sd[after]
    off = float(np.abs(error[still] / sd[still]).max()) if still.any() else 0.0
    return {
        "kind": kind, "grade": grade, "rest_s": rest, "z": float(np.sqrt(np.mean(z**2))),
        "error_deg": float(np.sqrt(np.mean(error[after] ** 2)) / DEG), "sd_deg": float(np.median(sd[after]) / DEG),
        "sd_at_rest_deg": float(sd[still][-1] / DEG) if still.any() else None, "shrunk": shrunk, "z_at_rest": off,
        "starts_s": float(sol.t[0]), "how": sol.initialization.how,
    }  # fmt: skip


def main(argv: list[str]) -> None:
    """Print a line for each case, write the JSON."""
    parser = options("parked", __doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=3, help="of each case, default 3")
    parser.add_argument("--seed", type=int, default=0, help="default 0")
    args = parser.parse_args(argv)
    rows = []
    rests = [(0.0, length) for length in LENGTHS] + [(BEFORE, BEFORE + length) for length in LENGTHS[1:]]
    for kind, grade, rest in product(("car", "aircraft"), ("consumer", "tactical"), rests):
        for run in range(args.runs):
            row = one(kind, grade, rest, args.seed + run)
            rows.append(row)
            print(
                f"{kind:9} {grade:9} rest {rest[0]:3.0f} to {rest[1]:3.0f} s: heading z {row['z']:5.2f}, error "
                f"{row['error_deg']:5.1f} deg, sd {row['sd_deg']:5.1f}; at rest sd {row['sd_at_rest_deg'] or 0:6.1f} "
                f"deg, least share of its largest {row['shrunk']:.2f}, largest z {row['z_at_rest']:.1f}; {row['how']}",
                flush=True,
            )
    z = float(np.sqrt(np.mean([row["z"] ** 2 for row in rows])))
    least = min(row["shrunk"] for row in rows)
    print(f"heading z rms {z:.2f} from {SETTLED:g} s after moving off; least share of the sd at rest {least:.2f}")
    write_json(args.json, {"z": z, "shrunk": least, "rows": rows, "seed": args.seed})
