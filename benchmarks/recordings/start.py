"""Starts in motion: attitude at the end of the alignment against the truth, or against an onboard filter.

Simulated (python-ins makes the samples): random begins of a car, an aircraft in turns, a walk and a robot, with
consumer and tactical sensors, fixes 0 to 0.3 s late, with velocities or with precise positions alone. The normalised
squared error of the attitude has three degrees of freedom; a start that says that it does not know the heading is
counted apart. Recorded: begins in flight of `umn`, NaveGo's set and a fixed wing of 2014.
"""

import io
import os
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import common
from jaxnav import build, read
from jaxnav.analysis.metrics import chi2_bounds
from jaxnav.data import start as starting
from jaxnav.data.alignment import rotations_since
from jaxnav.data.datasets import load
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.states.grades import GRADES
from jaxnav.types import DataError, ImuLog, Recording, Samples, Track

RATE, SPAN = 100.0, 70.0  # Hz, s
MOTIONS = ("car", "aircraft", "walk", "robot")
UMN = (272.0, 302.0, 335.0, 455.0)  # s, begins in flight
NAVEGO, FIXED_WING = (20.0, 100.0, 250.0), (15.0, 30.0, 50.0)


def motion(kind: str, rng: np.random.Generator, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity NED (N, 3) m/s and roll, pitch, heading (N, 3) rad of a random course."""
    wave = lambda low, high, n=3: sum(
        np.sin(2 * np.pi * t / rng.uniform(low, high) + rng.uniform(0, 6.3)) / n for _ in range(n)
    )
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum({"car": 0.25, "aircraft": 0.3, "walk": 0.25, "robot": 0.4}[kind] *
                                                    wave(8, 25)) / RATE  # fmt: skip
    speed = {"car": 9 + 6 * wave(12, 30), "aircraft": 24 + 4 * wave(15, 40), "walk": 1.3 + 0.4 * wave(6, 20)
             + 0.2 * np.sin(2 * np.pi * 1.9 * t), "robot": 0.7 + 0.6 * wave(6, 20)}[kind]  # fmt: skip
    climb = {"car": 0.3, "aircraft": 2.5, "walk": 0.05, "robot": 0.05}[kind] * wave(10, 30)
    rate = np.gradient(heading, t)
    roll = np.arctan(speed * rate / 9.8) if kind == "aircraft" else 0.03 * wave(3, 12)
    pitch = np.arcsin(np.clip(climb / np.maximum(speed, 5.0), -0.5, 0.5)) + 0.03 * wave(3, 12)
    crab = 0.1 * wave(10, 30) if kind == "aircraft" else 0.0
    vel = np.stack([speed * np.cos(heading + crab), speed * np.sin(heading + crab), -climb], 1)
    return vel, np.stack([roll, pitch, heading], 1)


def simulated(kind: str, grade: str, with_velocity: bool, rng: np.random.Generator) -> tuple[Recording, float]:
    """A recording, its truth, and how late its fixes are, s."""
    from pyins import sim

    t = np.arange(round(SPAN * RATE) + 1) / RATE
    vel, rph = motion(kind, rng, t)
    lla0 = (rng.uniform(-60, 60), rng.uniform(-180, 180), 300.0)
    frame, imu = sim.generate_imu(t, lla0, np.degrees(rph), vel, sensor_type="increment")
    dt, g = np.full(t.size - 1, 1 / RATE), GRADES[grade]
    apart = {"consumer": 3e-3, "tactical": 2e-4}[grade]  # scale errors and misalignment, sd
    skewed = lambda a: a @ (np.eye(3) + apart * rng.normal(size=(3, 3)))
    noise = lambda root, turn_on: root * np.sqrt(RATE) * rng.normal(size=(dt.size, 3)) + turn_on * rng.normal(size=3)
    gyro = skewed(imu.iloc[1:, :3].to_numpy() * RATE) + noise(g.arw, g.gyro_turn_on)
    accel = skewed(imu.iloc[1:, 3:].to_numpy() * RATE) + noise(g.vrw, g.accel_turn_on)
    lla = np.column_stack([np.radians(frame.lat), np.radians(frame.lon), frame.alt])
    enu = np.column_stack([frame.VE, frame.VN, -frame.VD])
    truth = Track(t, lla, enu, np.radians(frame[["roll", "pitch", "heading"]].to_numpy()))
    late, sd = rng.uniform(0, 0.3), 1.5 if with_velocity else 0.03
    k = np.arange(0.5, SPAN, 0.2)
    at = lambda a: np.column_stack([np.interp(k - late, t, c) for c in a.T])
    metres = np.array([6.37e6, 6.37e6 * np.cos(lla[0, 0]), 1.0])
    err = sd * rng.normal(size=(k.size, 3))
    position = Samples(k, at(lla) + err[:, [1, 0, 2]] / metres, np.full((k.size, 3), sd), np.zeros((k.size, 3)))
    aiding = {"position": position}
    if with_velocity:
        noisy = at(enu) + 0.1 * rng.normal(size=(k.size, 3))
        aiding["velocity"] = Samples(k, noisy, np.full((k.size, 3), 0.1), np.zeros((k.size, 3)))
    return Recording(f"{kind}, {grade}", ImuLog(t[1:], dt, gyro, accel), aiding, truth, np.zeros(3)), late


def difference(found: starting.Start, truth: Track) -> np.ndarray:
    """Rotation (3,) rad in ENU from the true attitude to that of the start."""
    rph = np.array([np.interp(found.t, truth.t, np.unwrap(c)) for c in truth.rph.T])
    true = np.asarray(rotations.from_rph(jnp.asarray(rph)))
    C = np.asarray(rotations.to_dcm(found.navs.q[0]))
    return Rotation.from_matrix(C @ true.T).as_rotvec()


def study(runs: int, seed: int) -> dict:
    """The simulated begins."""
    rng, rows = np.random.default_rng(seed), []
    filt = build("ekf15")
    for i in range(runs):
        kind, grade = MOTIONS[i % 4], ("consumer", "tactical")[(i // 4) % 2]
        rec, late = simulated(kind, grade, (i // 8) % 2 == 0, rng)
        found = starting.start(rec, filt.params(grade), begin=float(rng.uniform(0, 5)))
        known = found.navs.t.shape[0] == 1 and found.alignment is not None
        row = {"motion": kind, "grade": grade, "velocity": (i // 8) % 2 == 0, "late_s": late, "known": known}
        if known:
            phi = difference(found, rec.truth)
            P = np.asarray(found.alignment.P[:3, :3])
            row |= {"nees": float(phi @ np.linalg.solve(P, phi)), "error_deg": (phi / DEG).tolist(),
                    "sd_deg": (np.sqrt(np.diag(P)) / DEG).tolist(), "delay_s": found.alignment.delay,
                    "window_s": found.t - 5.0}  # fmt: skip
        rows.append(row)
    good = [r for r in rows if r["known"]]
    nees = np.array([r["nees"] for r in good])
    bound = chi2_bounds(3.0, 1, 0.98)[1]
    print(f"Simulated, {runs} begins in motion, heading known in {len(good)}")
    for key in ("motion", "grade", "velocity"):
        for value in dict.fromkeys(r[key] for r in rows):
            mine = [r for r in good if r[key] == value]
            if mine:
                error = np.sqrt(np.mean([np.square(r["error_deg"]) for r in mine], axis=0))
                mean = np.mean([r["nees"] for r in mine]) / 3
                late = np.sqrt(np.mean([(r["delay_s"] - r["late_s"]) ** 2 for r in mine]))
                print(f"  {key} {value!s:9} {len(mine):4d} known, NEES / 3 {mean:6.2f}, RMS E, N, U "
                      f"{np.round(error, 2)} deg, delay off by {late:.3f} s")  # fmt: skip
    mean, inside = float(nees.mean() / 3), float(np.mean(nees < bound))
    print(f"  all: NEES / 3 {mean:.2f}, below the 99 % bound in {100 * inside:.1f} %")
    return {"nees": mean, "inside": inside, "known": len(good), "runs": rows}


def onboard(data: Path) -> Track:
    """The attitude that the fixed wing of 2014 had on board."""
    with zipfile.ZipFile(data / "px4_2014" / "InputFilesPX4.zip") as archive:
        name = next(n for n in archive.namelist() if n.endswith("ATT.txt"))
        rows = np.loadtxt(io.BytesIO(archive.read(name)))
    three = np.zeros((len(rows), 3))
    return Track(rows[:, 0] * 1e-3, three, three, np.unwrap(np.radians(rows[:, 2:5]), axis=0))


def against_gyros(rec: Recording, reference: Track, span: float = 5.0) -> float:
    """How far (deg, median) a reference's attitude departs within ``span`` s from what the gyros integrate to."""
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
        print(
            f"  {name}: in 5 s the reference departs by {against_gyros(rec, truth):.1f} deg (median) from its own gyros"
        )
        found[name] = []
        for begin in begins:
            at = starting.start(rec, build("ekf15").params(grade), begin=begin)
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
    parser.add_argument("--runs", type=int, default=200, help="simulated, default 200; 0: only what is recorded")
    parser.add_argument("--seed", type=int, default=0, help="of what is simulated, default 0")
    args = parser.parse_args(argv)
    result = {"simulated": study(args.runs, args.seed) if args.runs else {}, "seed": args.seed}
    result["recorded"] = recorded()
    common.write_json(args.json, result)
