"""Starts in motion: attitude at the end of the alignment against the truth, or against an onboard filter.

Simulated (python-ins makes the samples): random begins of eleven vehicles with consumer and tactical sensors, fixes 0
to 0.3 s late, with velocities or with positions of 2 m or 3 cm alone. The normalised squared error of the attitude has
three degrees of freedom, that of the velocity one an axis; a start with an unknown heading is counted separately.
Recorded: begins in flight of `umn`, NaveGo's set and a fixed wing of 2014.
"""

import io
import itertools
import os
import zipfile
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import common
from benchmarks.simulated.vehicles import MOTIONS, simulated
from jaxnav import build, navigate, read
from jaxnav.analysis.metrics import chi2_bounds
from jaxnav.initialization import initialize as starting
from jaxnav.initialization.alignment import rotations_since
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.reading.datasets import load
from jaxnav.types import DataError, Recording, Track
from tuning.recordings.recorded import tune

TUNED_SPAN = 240.0  # s, of a drive that is tuned
UMN = (272.0, 302.0, 335.0, 455.0)  # s, begins in flight
NAVEGO, FIXED_WING = (20.0, 100.0, 250.0), (15.0, 30.0, 50.0)
AFTER_S, SMALL_DEG, BANK_HZ = (30.0, 45.0, 75.0), 5.0, 5.0  # of a start with twelve headings
FIXES = {"velocity": (1.5, True), "positions 2 m": (2.0, False), "positions 3 cm": (0.03, False)}
"""sd of positions, m, and whether there are velocities of sd 0.1 m/s."""


def difference(found: starting.Initialization, truth: Track) -> np.ndarray:
    """Rotation (3,) rad in ENU from the true attitude to that of the start."""
    rph = np.array([np.interp(found.t, truth.t, np.unwrap(c)) for c in truth.rph.T])
    true = np.asarray(rotations.from_rph(jnp.asarray(rph)))
    C = np.asarray(rotations.to_dcm(found.navs.q[0]))
    return Rotation.from_matrix(C @ true.T).as_rotvec()


def study(runs: int, seed: int) -> dict:
    """The simulated begins."""
    rng, rows = np.random.default_rng(seed), []
    filt = build("ekf15")
    cases = list(itertools.product(MOTIONS, FIXES, ("consumer", "tactical")))
    for i in range(runs):
        kind, fixes, grade = cases[i % len(cases)]
        sd, velocity = FIXES[fixes]
        rec, late = simulated(kind, grade, velocity, rng, sd)
        found = starting.initialize(rec, filt.params(grade), t_start=float(rng.uniform(0, 5)))
        known = found.navs.t.shape[0] == 1 and found.alignment is not None
        row = {"motion": kind, "grade": grade, "fixes": fixes, "late_s": late, "known": known}
        if known:
            at, phi = found.alignment, difference(found, rec.truth)
            P = np.asarray(at.P[:3, :3])
            off = at.vel - np.array([np.interp(at.t, rec.truth.t, v) for v in rec.truth.vel.T])
            row |= {"nees": float(phi @ np.linalg.solve(P, phi)), "error_deg": (phi / DEG).tolist(),
                    "sd_deg": (np.sqrt(np.diag(P)) / DEG).tolist(), "delay_s": at.delay, "window_s": found.t - 5.0,
                    "velocity_z": (off / np.asarray(found.prior.velocity)).tolist()}  # fmt: skip
        rows.append(row)
    good = [r for r in rows if r["known"]]
    nees = np.array([r["nees"] for r in good])
    bound = chi2_bounds(3.0, 1, 0.98)[1]
    print(f"Simulated, {runs} begins in motion, heading known in {len(good)}")
    table, inside_bars = [], 0
    for kind, fixes in itertools.product(MOTIONS, FIXES):
        mine = [r for r in good if (r["motion"], r["fixes"]) == (kind, fixes)]
        if not mine:
            continue
        mean = float(np.mean([r["nees"] for r in mine]) / 3)
        z = float(np.sqrt(np.mean(np.square([r["velocity_z"] for r in mine]))))
        error = np.sqrt(np.mean([np.square(r["error_deg"]) for r in mine], axis=0))
        late = float(np.sqrt(np.mean([(r["delay_s"] - r["late_s"]) ** 2 for r in mine])))
        table.append({"motion": kind, "fixes": fixes, "known": len(mine), "nees": mean, "velocity_z": z})
        inside_bars += 0.6 <= mean <= 1.6 and z <= 1.4
        print(f"  {kind:10} {fixes:14} {len(mine):3d} known, NEES / 3 {mean:6.2f}, velocity z {z:5.2f}, RMS E, N, U "
              f"{np.round(error, 2)} deg, delay off by {late:.3f} s")  # fmt: skip
    mean, inside = float(nees.mean() / 3), float(np.mean(nees < bound))
    print(f"  all: NEES / 3 {mean:.2f}, below the 99 % bound in {100 * inside:.1f} %; "
          f"{inside_bars} of {len(table)} rows with NEES / 3 in 0.6 to 1.6 and velocity z at most 1.4")  # fmt: skip
    return {"nees": mean, "inside": inside, "known": len(good), "rows": table, "runs": rows}


def tuned(drives: int, seed: int) -> dict:
    """Heading error over its sd at the start of `navigate` with the result of `tune`, on simulated drives of a car."""
    rng, rows = np.random.default_rng(seed), []
    filt = build("ekf15", cov_stride=5)
    for i in range(drives):
        rec, late = simulated("car", "consumer", True, rng, span=TUNED_SPAN)
        fit = tune(rec, filt, filt.params("consumer"))
        sol = navigate(rec, fit.filter, fit.params)
        at = sol.initialization._replace(navs=jax.tree.map(lambda a: a[None], sol.nav))
        error, sd = difference(at, rec.truth)[2], float(sol.initialization.prior.attitude[2])
        row = {"late_s": late, "chosen": fit.chosen, "heading_deg": error / DEG, "sd_deg": sd / DEG, "z": error / sd}
        rows.append(row)
        print(
            f"  drive {i}: {fit.chosen}, heading {row['heading_deg']:+.2f} deg off, sd {row['sd_deg']:.2f}", flush=True
        )
    z = float(np.sqrt(np.mean([r["z"] ** 2 for r in rows])))
    print(f"Tuned, then started again, {drives} drives of {TUNED_SPAN:g} s: heading z rms {z:.2f}")
    return {"heading_z": z, "rows": rows}


def bank(runs: int, seed: int) -> dict:
    """Heading of a walker and a ship that start with twelve headings: its error, and from when on it is small."""
    filt, found = build("ekf15", cov_stride=5), {}
    for kind in ("walk", "ship"):
        errors, nees, small = [], [], []
        for i in range(runs):
            rec, _ = simulated(kind, "consumer", True, np.random.default_rng([seed, i]), 1.5, 120.0, BANK_HZ, 0.0)
            begin = partial(starting.initialize, heading="unknown", t_start=1.0)
            sol = navigate(rec, filt, filt.params("consumer"), scan=False, initialization=begin)
            true = np.interp(sol.t, rec.truth.t, np.unwrap(rec.truth.rph[:, 2]))
            off = (sol.rph[:, 2] - true + np.pi) % (2 * np.pi) - np.pi
            since = sol.t - sol.t[0]
            far = np.flatnonzero(np.abs(off) > SMALL_DEG * DEG)
            small.append(0.0 if not far.size else since[min(far[-1] + 1, since.size - 1)])
            errors.append(np.interp(AFTER_S, since, np.abs(off)) / DEG)
            nees.append(np.interp(AFTER_S, since, (off / sol.sd[:, 8]) ** 2))
        rms, nees_of = np.sqrt(np.mean(np.square(errors), 0)), np.mean(nees, 0)
        found[kind] = {"rms_deg": rms.tolist(), "nees": nees_of.tolist(), "below_5_deg_s": float(np.median(small))}
        print(f"  {kind}: heading off after {AFTER_S} s by {np.round(rms, 1)} deg RMS, NEES {np.round(nees_of, 2)}; "
              f"below {SMALL_DEG:g} deg from {np.median(small):.0f} s on (median)")  # fmt: skip
    return found


def onboard(data: Path) -> Track:
    """The attitude that the fixed wing of 2014 had on board."""
    with zipfile.ZipFile(data / "px4_2014" / "InputFilesPX4.zip") as archive:
        name = next(n for n in archive.namelist() if n.endswith("ATT.txt"))
        rows = np.loadtxt(io.BytesIO(archive.read(name)))
    three = np.zeros((len(rows), 3))
    return Track(rows[:, 0] * 1e-3, three, three, np.unwrap(np.radians(rows[:, 2:5]), axis=0))


def against_gyros(rec: Recording, reference: Track, span: float = 5.0) -> float:
    """Difference (deg, median) of a reference's attitude within ``span`` s from the integral of the gyros."""
    imu, off = rec.imu, []
    at = lambda t: Rotation.from_matrix(np.asarray(rotations.from_rph(jnp.asarray(
        [np.interp(t, reference.t, np.unwrap(c)) for c in reference.rph.T]))))  # fmt: skip
    for begin in np.arange(max(imu.t[0], reference.t[0]), min(imu.t[-1], reference.t[-1]) - span, 2 * span):
        rows = (imu.t > begin) & (imu.t <= begin + span)
        if rows.sum() > 10:
            ends = rotations_since(imu.gyro[rows], imu.dt[rows])[1]
            off.append(((at(begin) * Rotation.from_matrix(ends[-1])).inv() * at(begin + span)).magnitude())
    return float(np.degrees(np.median(off)))


def recorded() -> dict:
    """Begins in flight, on the road, and in the air."""
    data = Path(os.environ.get("JAXNAV_DATA_DIR", "."))
    recipe = Path(__file__).parents[2] / "docs" / "recipes" / "px4_fixed_wing.toml"
    cases = {
        "umn": (lambda: load("umn_thor75"), None, UMN, "adis1640x_airframe"),
        "navego_synthetic": (lambda: load("navego_synthetic"), None, NAVEGO, "adis16488"),
        "px4_fixed_wing": (lambda: read(recipe), onboard, FIXED_WING, "consumer"),
    }
    found: dict[str, list] = {}
    for name, (get, reference, begins, grade) in cases.items():
        try:
            rec = get()
        except DataError as error:
            print(f"  {name}: {error}")
            continue
        truth = rec.truth if reference is None else reference(data)
        print(f"  {name}: in 5 s the reference departs by {against_gyros(rec, truth):.1f} deg (median) from its gyros")
        found[name] = []
        for begin in begins:
            at = starting.initialize(rec, build("ekf15").params(grade), t_start=begin)
            rph = np.asarray(rotations.to_rph(rotations.to_dcm(at.navs.q[0])))
            true = np.array([np.interp(at.t, truth.t, np.unwrap(c)) for c in truth.rph.T])
            off = np.degrees((rph - true + np.pi) % (2 * np.pi) - np.pi)
            delay = None if at.alignment is None else at.alignment.delay
            row = dict(zip(("roll_deg", "pitch_deg", "heading_deg"), off.tolist(), strict=True))
            found[name].append({"begin": begin, "t": at.t, **row, "delay_s": delay, "how": at.how})
            print(f"  {name:16} from {begin:5.1f} s, deg off: roll {off[0]:5.1f}, pitch {off[1]:5.1f}, "
                  f"heading {off[2]:5.1f}; {at.how}")  # fmt: skip
    return found


def main(argv: list[str]) -> None:
    """Print the tables, write the JSON."""
    parser = common.options("start", __doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=396, help="simulated, default 396; 0: only recorded starts")
    parser.add_argument("--seed", type=int, default=0, help="of the simulations, default 0")
    parser.add_argument("--tune", type=int, default=0, metavar="N", help="N drives tuned, then started again, instead")
    parser.add_argument("--bank", type=int, default=0, metavar="N", help="N starts with twelve headings each, instead")
    args = parser.parse_args(argv)
    if args.bank:
        common.write_json(args.json, {"bank": bank(args.bank, args.seed), "seed": args.seed})
        return
    if args.tune:
        common.write_json(args.json, {"tuned": tuned(args.tune, args.seed), "seed": args.seed})
        return
    result = {"simulated": study(args.runs, args.seed) if args.runs else {}, "seed": args.seed}
    result["recorded"] = recorded()
    common.write_json(args.json, result)
