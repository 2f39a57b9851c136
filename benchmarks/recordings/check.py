"""`jaxnav.checkup` on recordings that are damaged in one way each, and on those that are not.

Every damage on every recording with the damaged stream: eight real ones and sixteen simulated. A cell counts as named
where a finding that says that something is wrong has the damage's code, or where the recording is refused with a
sentence that names it. A cell that is not named and that physics cannot show is marked with the reason, which the
undamaged recording gives (`Damage.hidden`). A false alarm is a warning on a recording as it is, except the
faults in `KNOWN` (docs/recordings.md).
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import sources
from benchmarks.simulated.vehicles import simulated
from jaxnav import read
from jaxnav.analysis.tables import table
from jaxnav.checkup import checkup, motion
from jaxnav.checkup.alternatives import aligned
from jaxnav.checkup.shared import level_velocity
from jaxnav.filters.compiler import clear_caches_if_needed
from jaxnav.findings import line
from jaxnav.io.checks import check_recording
from jaxnav.maths import rotations
from jaxnav.maths.units import DEG
from jaxnav.types import DataError, ImuLog, Recording, Samples

KNOWN = {  # faults of the recordings as they are
    "rtkexplorer": {"time.drift"},  # the tag stretches the ticks by 290 ppm
    "phone": {
        "imu.slow",
        "compass.strength",
        "compass.inconsistent",
    },  # 1 Hz; 240 uT: not calibrated
    "kth": {"time.jump"},  # one fix half a second early
    "comma2k19": {"time.late"},  # velocity: 0.17 s against the IMU, 0.16 s against the wheels, 0.14 s against the truth
    "ekf2_replay": {"imu.lost"},  # 18 % of the rows come after two intervals: the logger drops them
    "px4_sitl_truth": {"imu.lost"},  # 25 %
    "dataflash": {"imu.lost"},  # 10 %
    "navego_synthetic": {"gyro.bias", "accel.bias"},  # 3 deg/s and 50 mg: its data sheet's static biases
    "umn": {"time.jump"},  # 0.22 s, once, of position and velocity alike
}


def imu(**parts: Callable[[np.ndarray], np.ndarray]) -> Callable[[Recording], Recording]:
    """Damage of the IMU's columns."""
    return lambda rec: rec._replace(imu=rec.imu._replace(**{k: f(getattr(rec.imu, k)) for k, f in parts.items()}))


def stream(name: str, value=None, t=None) -> Callable[[Recording], Recording]:
    """Damage of a stream's values or times."""

    def damaged(rec: Recording) -> Recording:
        s = rec.aiding[name]
        s = s._replace(value=s.value if value is None else value(s.value), t=s.t if t is None else t(s.t))
        return rec._replace(aiding=rec.aiding | {name: s})

    return damaged


def both(a: Callable, b: Callable) -> Callable[[Recording], Recording]:
    """One after the other."""
    return lambda rec: b(a(rec))


def later(seconds: float = 0.0, ppm: float = 0.0) -> Callable[[Recording], Recording]:
    """All fixes at other times."""
    shift = lambda t: t + seconds + 1e-6 * ppm * (t - t[0])

    def damaged(rec: Recording) -> Recording:
        return rec._replace(aiding={name: s._replace(t=shift(s.t)) for name, s in rec.aiding.items()})

    return damaged


def on_an_arm(rec: Recording) -> Recording:
    """The antenna three metres ahead and one up, by the recording's true attitude."""
    arm, truth = np.array([3.0, 0.5, -1.0]), rec.truth
    C = np.array([rotations.from_rph(jnp.asarray(rph)) for rph in truth.rph[::20]])
    t, moved = truth.t[::20], C @ arm
    turned = np.gradient(moved, t, axis=0)
    at = lambda t_, a: np.column_stack([np.interp(t_, t, c) for c in a.T])
    p, v = rec.aiding["position"], rec.aiding["velocity"]
    e = at(p.t, moved)
    metres = np.array([6.37e6, 6.37e6 * np.cos(p.value[0, 0]), 1.0])
    position = p._replace(value=p.value + e[:, [1, 0, 2]] / metres)
    return rec._replace(
        aiding=rec.aiding | {"position": position, "velocity": v._replace(value=v.value + at(v.t, turned))}
    )


def polled(rec: Recording) -> Recording:
    """One sample in twenty is the one before."""
    rows = np.arange(rec.imu.t.size)
    rows[7::20] -= 1
    return rec._replace(imu=rec.imu._replace(gyro=rec.imu.gyro[rows], accel=rec.imu.accel[rows]))


def lost(rec: Recording) -> Recording:
    """Three rows in ten are missing, at random; those that are left know nothing of it."""
    keep = np.random.default_rng(0).random(rec.imu.t.size) > 0.3
    left = ImuLog(*(a[keep] for a in rec.imu))
    return rec._replace(imu=left._replace(dt=np.diff(left.t, prepend=left.t[0] - left.dt[0])))


def repeated(rec: Recording) -> Recording:
    """Every position is logged four times."""
    p = rec.aiding["position"]
    t = np.linspace(p.t[0], p.t[-1], 4 * p.t.size - 3)
    rows = np.minimum(np.searchsorted(p.t, t + 1e-6) - 1, p.t.size - 1)
    return rec._replace(aiding=rec.aiding | {"position": Samples(t, p.value[rows], p.sd[rows], p.corr[rows])})


def swapped(a: int, b: int) -> Callable[[np.ndarray], np.ndarray]:
    """Two columns exchanged."""
    order = [0, 1, 2]
    order[a], order[b] = b, a
    return lambda value: value[:, order]


def times(*factors: float) -> Callable[[np.ndarray], np.ndarray]:
    """Columns times factors."""
    return lambda value: value * np.array(factors)


def turned(value: np.ndarray) -> np.ndarray:
    """The sensor turned by 90 degrees about down."""
    return value[:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0])


class Damage(NamedTuple):
    """One way to be wrong."""

    name: str
    make: Callable[[Recording], Recording]
    codes: tuple[str, ...]  # that name it, or words of a refusal
    hidden: Callable[[Recording, Recording], str]  # of a recording as it is and damaged: why that cannot show, or ""
    needs: tuple[str, ...] = ("position",)  # streams, and "truth"


# ---------------------------------------------------------------------------- damages that cannot show


def shows(rec: Recording, bad: Recording) -> str:
    """Nothing hides it."""
    return ""


def moves(part: slice) -> Callable[[Recording, Recording], str]:
    """The damage of the velocity must exceed the noise of differences of positions."""

    def hidden(rec: Recording, bad: Recording) -> str:
        p, v, w = rec.aiding["position"], rec.aiding["velocity"], bad.aiding["velocity"]
        effect = float(np.sqrt(np.mean((v.value - w.value)[:, part] ** 2)))
        sd = np.hypot(np.sqrt(2) * np.median(p.sd[:, part]) / 2.0, np.median(v.sd[:, part]))
        return "" if effect > 3 * sd else f"changes velocity by {effect:.2g} m/s, known to {sd:.2g} m/s"

    return hidden


def windows(rec: Recording) -> list:
    """Alignments of a recording as it is, once for each."""
    key = (rec.name, rec.imu.t.size, rec.imu.t[0])
    if key not in _WINDOWS:
        _WINDOWS[key] = motion.alignments(rec, level_velocity(rec.aiding))
    return _WINDOWS[key]


_WINDOWS: dict = {}


def fits_better(rec: Recording, bad: Recording) -> str:
    """The IMU as it was must fit the fixes better than the damaged one, at any attitude."""
    gain = 0.0
    for window, a in windows(rec):
        other = aligned(bad, window)
        dof = (2 if "velocity" in rec.aiding else 1) * a.fixes
        gain += 0.0 if other is None else 0.5 * dof * np.log(max(other.chi2, 0.1) / max(a.chi2, 0.1))
    return "" if gain > 20.0 else f"the right IMU fits no better ({gain:.0f} nats)"


def heads(rec: Recording, bad: Recording) -> str:
    """Heading must be seen in two windows, and be the course's."""
    sure = [a for _, a in windows(rec) if np.hypot(a.vel[0], a.vel[1]) > 2.0 and a.sd[2] < 8 * DEG]
    if len(sure) < 2:
        return "no heading by motion"
    off = [np.arctan2(a.C[0, 0], a.C[1, 0]) - np.arctan2(a.vel[0], a.vel[1]) for a in sure]
    spread = float(np.abs(np.mean(np.exp(1j * np.array(off)))))
    return "" if spread > 0.98 else "moves sideways"


def timed(limit: float) -> Callable[[Recording, Recording], str]:
    """The delay must be known to a fifth of ``limit`` s."""

    def hidden(rec: Recording, bad: Recording) -> str:
        weight = sum(1 / np.hypot(a.sd[9], 0.005) ** 2 for _, a in windows(rec))
        sd = float(1 / np.sqrt(weight)) if weight else np.inf
        return "" if 5 * sd < limit else f"the delay is known to {sd:.2g} s"

    return hidden


def drifts(ppm: float) -> Callable[[Recording, Recording], str]:
    """Delays in several windows must show the drift by 5 sd."""

    def hidden(rec: Recording, bad: Recording) -> str:
        each = windows(rec)
        if len(each) < 4:
            return "too short for windows"
        t = np.array([0.5 * sum(w) for w, _ in each])
        weight = np.array([1 / np.hypot(a.sd[9], 0.005) ** 2 for _, a in each])
        left = t - (weight * t).sum() / weight.sum()
        delay = np.array([a.delay for _, a in each])
        rate = float((weight * left * delay).sum() / (weight * left**2).sum())
        rest = delay - (weight * delay).sum() / weight.sum() - rate * left
        loose = max(1.0, float(np.sqrt((weight * rest**2).sum() / (len(each) - 2))))
        sd = 1e6 * loose / float(np.sqrt((weight * left**2).sum()))
        return "" if 5 * sd < ppm else f"drift is known to {sd:.0f} ppm"

    return hidden


def turning(rec: Recording, bad: Recording) -> str:
    """The course's rate must belong to one gyro at the right time."""
    x = motion.turns_of(rec)
    best = 0.0 if x is None else max(abs(motion.correlation(x, i, lag)) for i in range(3) for lag in range(-10, 11))
    return "" if best > 0.7 else f"course and gyros correlate by {best:.2f} only"


def arm_known(rec: Recording, bad: Recording) -> str:
    """Turns must show a lever arm of three metres."""
    arm = motion.arm_of(rec, windows(rec))
    return "" if arm is not None and arm[1][0] < 0.3 else "too few turns"


def climbs(rec: Recording, bad: Recording) -> str:
    """The vehicle must climb by more than the noise of the fixes."""
    spread, sd = float(rec.aiding["position"].value[:, 2].std()), float(np.median(rec.aiding["position"].sd[:, 2]))
    return "" if spread > 2 * sd else f"height varies by {spread:.1f} m, known to {sd:.1f} m"


def goes(rec: Recording, bad: Recording) -> str:
    """The vehicle must move between most fixes."""
    v = level_velocity(rec.aiding)
    fast = 0.0 if v is None else float(np.median(np.hypot(*v.value[:, :2].T)))
    return "" if fast > max(1.0, 3 * float(np.median(v.sd[:, :2]))) else f"{fast:.2g} m/s, known as badly"


VELOCITY = ("position", "velocity")
DAMAGES = (
    Damage("velocity: east and north swapped", stream("velocity", swapped(0, 1)),
           ("velocity.swapped", "fixes.swapped"), moves(slice(2)), VELOCITY),
    Damage("velocity: down taken for up", stream("velocity", times(1, 1, -1)),
           ("velocity.vertical",), moves(slice(2, 3)), VELOCITY),
    Damage("velocity: west taken for east", stream("velocity", times(-1, 1, 1)),
           ("velocity.sign", "fixes.sign"), moves(slice(1)), VELOCITY),
    Damage("velocity in km/h", stream("velocity", times(3.6, 3.6, 3.6)),
           ("velocity.units",), moves(slice(2)), VELOCITY),
    Damage("velocity in knots", stream("velocity", times(1.944, 1.944, 1.944)),
           ("velocity.units",), moves(slice(2)), VELOCITY),
    Damage("gyro in degrees per second", imu(gyro=lambda a: 57.3 * a),
           ("gyro.units", "degrees per second"), fits_better),
    Damage("accelerometer in g", imu(accel=lambda a: a / 9.81), ("g instead of m/s^2",), shows),
    Damage("axes forward, left, up", imu(gyro=times(1, -1, -1), accel=times(1, -1, -1)), ("axes.gravity",), shows),
    Damage("IMU turned by 90 deg", imu(gyro=turned, accel=turned), ("mounting.turned",), heads),
    Damage("gyro z with the wrong sign", imu(gyro=times(1, 1, -1)),
           ("gyro z has the wrong sign", "all gyros have"), fits_better),
    Damage("gyro x and y swapped", imu(gyro=swapped(0, 1)), ("gyro x and y are swapped",), fits_better),
    Damage("gyro x and z swapped", imu(gyro=swapped(0, 2)), ("gyro x and z are swapped",), fits_better),
    Damage("gyro z dead", imu(gyro=times(1, 1, 0)), ("imu.dead",), shows),
    Damage("gyro 20 % too large", imu(gyro=lambda a: 1.2 * a), ("gyro.scale", "gyro.units"), fits_better),
    Damage("gyro bias of 5 deg/s", imu(gyro=lambda a: a + 5 * DEG), ("gyro.bias",), shows),
    Damage("accelerometer x with the wrong sign", imu(accel=times(-1, 1, 1)),
           ("accelerometer x has the wrong sign",), fits_better),
    Damage("accelerometer x and y swapped", imu(accel=swapped(0, 1)),
           ("accelerometer x and y are swapped",), fits_better),
    Damage("accelerometer 10 % too large", imu(accel=lambda a: 1.1 * a),
           ("imu.gravity", "accel.bias", "gravity"), shows),
    Damage("accelerometer bias of 1 m/s^2", imu(accel=lambda a: a + [1.0, 0, 0]), ("accel.bias",), fits_better),
    Damage("x and y of both sensors swapped", imu(gyro=swapped(0, 1), accel=swapped(0, 1)),
           ("imu.swapped", "x and y of both sensors"), fits_better),
    Damage("fixes 0.5 s late", later(0.5), ("time.late",), timed(0.5)),
    Damage("fixes in UTC, 18 s off", later(-18.0), ("time.offset",), turning),
    Damage("clock drift of 500 ppm", later(0.0, 500.0), ("time.drift",), drifts(500.0)),
    Damage("clock drift of 1000 ppm", later(0.0, 1000.0), ("time.drift",), drifts(1000.0)),
    Damage("antenna on an arm of 3 m", on_an_arm, ("lever_arm",), arm_known, (*VELOCITY, "truth")),
    Damage("wheel speed in km/h", stream("speed", lambda v: 3.6 * v), ("speed.units",), goes, ("position", "speed")),
    Damage("barometer upside down", stream("barometer", lambda v: -v),
           ("barometer.sign",), climbs, ("position", "barometer")),
    Damage("barometer in feet", stream("barometer", lambda v: 3.28084 * v),
           ("barometer.units",), climbs, ("position", "barometer")),
    Damage("IMU polled: one row in twenty repeated", polled, ("imu.polled",), shows),
    Damage("30 % of the IMU's rows lost", lost, ("imu.lost", "imu.gaps"), shows),
    Damage("every fix logged four times", repeated, ("position.repeats",), goes),
)  # fmt: skip


def named(rec: Recording, codes: tuple[str, ...]) -> tuple[bool, str]:
    """Return whether one of the codes is found, or in the words of a refusal; and the output."""
    try:
        check_recording(rec)
    except DataError as error:
        return any(code in str(error) for code in codes), str(error)
    bad = [f for f in checkup(rec) if f.warns]
    hit = [f for f in bad if any(f.code.startswith(code) or code in line(f) for code in codes)]
    return bool(hit), "; ".join(f"{f.code}: {line(f)}" for f in (hit or bad)) or "nothing"


def as_floats(rec: Recording) -> Recording:
    """Plain arrays after any damage."""
    return rec._replace(imu=ImuLog(*(np.ascontiguousarray(a, float) for a in rec.imu)))


# ---------------------------------------------------------------------------- recordings

REAL = ("umn", "rtkexplorer", "px4_quad106", "kth", "kitti", "navego_synthetic", "comma2k19", "px4_fixed_wing")
MOVING = ("car", "aircraft", "coach", "walk")  # each with two IMUs, and fixes at 1 and 5 Hz
CLEAN = ("ship", "train", "thermal", "jet", "mower", "walk", "coach", "table")
GRADED = ("consumer", "adis16465", "tactical")
LENGTH = 180.0  # s, of a simulation


def vehicle(kind: str, grade: str, fix_hz: float, seed: int) -> Recording:
    """Return a simulated recording without a delay, with a barometer, and wheels where it has any."""
    rng = np.random.default_rng([seed, *map(ord, kind + grade)])
    rec, _ = simulated(kind, grade, True, rng, span=LENGTH, fix_hz=fix_hz, late=0.0)
    k, truth = np.arange(1.0, LENGTH - 1, 0.1), rec.truth
    column = lambda value, sd: Samples(
        k, (value + sd * rng.normal(size=k.size))[:, None], np.full((k.size, 1), sd), np.zeros((k.size, 1))
    )
    aiding = rec.aiding | {"barometer": column(np.interp(k, truth.t, truth.lla[:, 2]), 0.3)}
    if kind in ("car", "coach", "train", "mower"):
        aiding["speed"] = column(np.interp(k, truth.t, np.hypot(*truth.vel[:, :2].T)), 0.1)
    return rec._replace(name=f"{kind}, {grade}, {fix_hz:g} Hz", aiding=aiding)


def matrix(recordings: Iterable[Recording], damages: Sequence[Damage] = DAMAGES) -> dict[str, dict[str, dict]]:
    """Return the cells by damage and recording: {"named", "said"}, or {"hidden"} where it cannot show."""
    cells: dict[str, dict[str, dict]] = {damage.name: {} for damage in damages}
    for rec in recordings:
        clear_caches_if_needed()
        for damage in damages:
            if any(rec.truth is None if n == "truth" else n not in rec.aiding for n in damage.needs):
                continue
            bad = as_floats(damage.make(rec))
            ok, said = named(bad, damage.codes)
            cell: dict = {"named": ok, "said": said[:300]}
            if not ok and (why := damage.hidden(rec, bad)):
                cell = {"hidden": why}
            cells[damage.name][rec.name] = cell
            if "hidden" in cell or not ok:
                print(f"  {rec.name:30} {damage.name:36} {cell.get('hidden') or 'MISSED: ' + said[:160]}", flush=True)
    return cells


def alarms_of(rec: Recording, known: Iterable[str] = ()) -> list[str]:
    """Return the warnings on a recording as it is."""
    return [f"{f.code}: {f.message}" for f in checkup(rec) if f.warns and f.code not in known]


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("check", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three recordings and two simulated ones, one alarm each")
    parser.add_argument("--only", help="damages with this in their name")
    parser.add_argument("--seed", type=int, default=0, help="of the simulations, default 0")
    args = parser.parse_args(argv)
    found, own = sources(), args.seed
    damages = [d for d in DAMAGES if not args.only or args.only in d.name]
    real = [read(found[name])._replace(name=name) for name in (REAL[:3] if args.quick else REAL)]
    cases = list(product(MOVING, ("consumer", "tactical"), (1.0, 5.0)))
    made = (vehicle(*case, own) for case in (cases[1:6:4] if args.quick else cases))
    cells = matrix([*real, *made], damages)
    alarms = {}
    for name in REAL[:3] if args.quick else found:
        alarms[name] = alarms_of(read(found[name]), KNOWN.get(name, ()))
    for kind, grade in list(product(CLEAN, GRADED))[:: 8 if args.quick else 1]:
        rec = vehicle(kind, grade, 5.0, own + 1)
        alarms[rec.name] = alarms_of(rec)
    every = [cell for row in cells.values() for cell in row.values() if "hidden" not in cell]
    count, wrong = sum(cell["named"] for cell in every), sum(bool(a) for a in alarms.values())
    rows = []
    for name, row in cells.items():
        shown = [cell for cell in row.values() if "hidden" not in cell]
        missed = [key for key, cell in row.items() if not cell.get("named", True)]
        rows.append([name, f"{len(shown) - len(missed)} of {len(shown)}", len(row) - len(shown), "; ".join(missed)])
    print(table(["damage", "named", "cannot show", "missed"], rows))
    print(table(["recording", "false alarms"], [[name, "; ".join(said)] for name, said in alarms.items() if said]))
    print(f"{count} of {len(every)} cells named; false alarms on {wrong} of {len(alarms)} recordings")
    result = {"named": count, "of": len(every), "false_alarms": alarms, "matrix": cells, "seed": args.seed}
    common.write_json(args.json, result)
