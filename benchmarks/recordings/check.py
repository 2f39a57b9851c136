"""`jaxnav.checkup` on recordings that are damaged in one way each, and on those that are not.

A damage counts as named where a finding that says that something is wrong has its code, or where the recording is
refused with a sentence that names it. A false alarm is a finding of wrong in a recording as it is; what is known to be
wrong with it (docs/recordings.md) is listed apart.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import sources
from jaxnav import read
from jaxnav.analysis.tables import table
from jaxnav.checkup import checkup
from jaxnav.checkup.findings import line
from jaxnav.io.checks import check_recording
from jaxnav.maths import rotations
from jaxnav.types import DataError, ImuLog, Recording, Samples

KNOWN = {  # what is wrong with the recordings as they are
    "rtkexplorer": {"time.drift"},  # the tag stretches the ticks by 290 ppm
    "phone": {
        "imu.slow",
        "compass.strength",
        "compass.inconsistent",
    },  # 1 Hz; 240 uT: not calibrated
    "kth": {"time.jump"},  # one fix half a second early
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
    source: str
    make: Callable[[Recording], Recording]
    codes: tuple[str, ...]  # that name it, or words of a refusal


DAMAGES = (
    Damage("velocity: east and north swapped", "umn", stream("velocity", swapped(0, 1)), ("velocity.swapped",)),
    Damage("velocity: down taken for up", "px4_quad106", stream("velocity", times(1, 1, -1)), ("velocity.vertical",)),
    Damage("velocity: west taken for east", "px4_quad106", stream("velocity", times(-1, 1, 1)), ("velocity.sign",)),
    Damage("velocity in km/h", "rtkexplorer", stream("velocity", times(3.6, 3.6, 3.6)), ("velocity.units",)),
    Damage("velocity in knots", "umn", stream("velocity", times(1.944, 1.944, 1.944)), ("velocity.units",)),
    Damage("gyro in degrees per second", "kitti", imu(gyro=lambda a: 57.3 * a), ("gyro.units", "degrees per second")),
    Damage("accelerometer in g", "kth", imu(accel=lambda a: a / 9.81), ("g instead of m/s^2",)),
    Damage("axes forward, left, up", "kitti", imu(gyro=times(1, -1, -1), accel=times(1, -1, -1)), ("axes.gravity",)),
    Damage("IMU turned by 90 deg", "rtkexplorer", imu(gyro=turned, accel=turned), ("mounting.turned",)),
    Damage("gyro z with the wrong sign", "umn", imu(gyro=times(1, 1, -1)), ("gyro.sign",)),
    Damage("gyro x and y swapped", "px4_quad106", imu(gyro=swapped(0, 1)), ("gyro.swapped",)),
    Damage("gyro x and z swapped", "rtkexplorer", imu(gyro=swapped(0, 2)), ("gyro.axes", "gyro.swapped")),
    Damage("gyro z dead", "kitti", imu(gyro=times(1, 1, 0)), ("imu.dead",)),
    Damage("accelerometer x with the wrong sign", "rtkexplorer", imu(accel=times(-1, 1, 1)), ("accel.sign",)),
    Damage("accelerometer x and y swapped", "umn", imu(accel=swapped(0, 1)), ("accel.swapped",)),
    Damage("accelerometer 10 % too large", "rtkexplorer", imu(accel=lambda a: 1.1 * a), ("imu.gravity", "gravity")),
    Damage("fixes 0.5 s late", "kitti", later(0.5), ("time.late",)),
    Damage("fixes in UTC, 18 s off", "kitti", later(-18.0), ("time.offset",)),
    Damage("clock drift of 500 ppm", "umn", later(0.0, 500.0), ("time.drift",)),
    Damage("antenna on an arm of 3 m", "navego_synthetic", on_an_arm, ("lever_arm",)),
    Damage("wheel speed in km/h", "comma2k19", stream("speed", lambda v: 3.6 * v), ("speed.units",)),
    Damage("barometer upside down", "px4_quad106", stream("barometer", lambda v: -v), ("barometer.sign",)),
    Damage("barometer in feet", "px4_fixed_wing", stream("barometer", lambda v: 3.28084 * v), ("barometer.units",)),
    Damage("IMU polled: one row in twenty repeated", "kth", polled, ("imu.polled",)),
    Damage("every fix logged four times", "umn", repeated, ("position.repeats",)),
)  # fmt: skip


def named(rec: Recording, codes: tuple[str, ...]) -> tuple[bool, str]:
    """Is one of the codes among what is wrong, or in the words of a refusal? And what was said."""
    try:
        check_recording(rec)
    except DataError as error:
        return any(code in str(error) for code in codes), str(error)
    bad = [f for f in checkup(rec) if f.warns]
    hit = [f for f in bad if any(f.code.startswith(code) for code in codes)]
    return bool(hit), "; ".join(f"{f.code}: {line(f)}" for f in (hit or bad)) or "nothing"


def as_floats(rec: Recording) -> Recording:
    """Plain arrays, whatever the damage made of them."""
    return rec._replace(imu=ImuLog(*(np.ascontiguousarray(a, float) for a in rec.imu)))


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("check", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="without the recordings as they are")
    args = parser.parse_args(argv)
    found, known, rows = sources(), {}, []
    for damage in DAMAGES:
        if damage.source not in known:
            known[damage.source] = read(found[damage.source])
        ok, said = named(as_floats(damage.make(known[damage.source])), damage.codes)
        rows.append({"damage": damage.name, "source": damage.source, "named": ok, "said": said})
        print(f"  {'named ' if ok else 'MISSED'} {damage.name} ({damage.source}): {said[:230]}", flush=True)
    alarms = {}
    for name, path in {} if args.quick else found.items():
        rec = known[name] if name in known else read(path)
        alarms[name] = [f"{f.code}: {f.message}" for f in checkup(rec) if f.warns and f.code not in KNOWN.get(name, ())]
    count = sum(r["named"] for r in rows)
    wrong = sum(bool(a) for a in alarms.values())
    print(f"{count} of {len(rows)} damages named; false alarms on {wrong} of {len(alarms)} recordings")
    print(table(["recording", "false alarms"], [[name, "; ".join(said)] for name, said in alarms.items() if said]))
    common.write_json(args.json, {"named": count, "of": len(rows), "damages": rows, "false_alarms": alarms})
