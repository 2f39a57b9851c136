"""The filter sample by sample on a recording: against the batch, with late fixes, across a restart; time of a sample.

Every sample of the recording is pushed as it comes, fixes after the sample at which they are due. *late*: each fix
comes up to half a second late. *restart*: from bytes in the middle. Differences are of positions at the ends of epochs.
"""

import time
from operator import attrgetter
from pathlib import Path

import jax
import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import sources
from jaxnav import Stream, build, initial_nav, initialize, navigate, read
from jaxnav.analysis.tables import table
from jaxnav.filters.compiler import process_usage
from jaxnav.filters.parameters import installed
from jaxnav.initialization.initialize import Initialization
from jaxnav.maths import earth
from jaxnav.types import Info

LATE = 0.5  # s


def fed(live: Stream, rec, rows: list, ends: dict[float, np.ndarray]) -> tuple[list[float], int]:
    """Push rows; seconds that each sample took, and the largest number of samples kept."""
    taken, most = [], 0
    for _, t, name, i in rows:
        begin = time.perf_counter()
        if name:
            s = rec.aiding[name]
            live.push(name, t, s.value[i], s.sd[i], s.corr[i])
        else:
            live.push_imu(t, rec.imu.gyro[i], rec.imu.accel[i], rec.imu.dt[i])
            taken.append(time.perf_counter() - begin)
        for each in live.kept[-3:]:
            ends[round(each.t, 6)] = each
        most = max(most, len(live.samples))
    return taken, most


def rows_of(rec, names: list[str], begin: float, late: np.ndarray | None = None) -> list:
    """(arrival, t, name, row) of everything after the start, in the order of arrival."""
    rows = [(t, t, "", i) for i, t in enumerate(rec.imu.t) if t > begin]
    fixes = [(t, t, name, i) for name in names for i, t in enumerate(rec.aiding[name].t) if begin < t <= rec.imu.t[-1]]
    if late is not None:
        fixes = [(t + d, *rest) for (t, *rest), d in zip(fixes, late * LATE)]
    return sorted(rows + fixes, key=lambda row: (row[0], row[2]))


def apart(ends: dict, info: Info, t: np.ndarray) -> tuple[float, float]:
    """From the batch, at the ends t (E,) of its epochs: largest distance, m, and the share that differs in some bit."""
    both = [i for i, time_ in enumerate(t) if round(float(time_), 6) in ends]
    mine = [ends[round(float(t[i]), 6)].state for i in both]
    last = lambda part: np.array([np.asarray(part(state.past))[-1] for state in mine])
    nav = jax.tree.map(lambda a: np.asarray(a)[both], info.nav)
    pairs = [(last(attrgetter(name)), getattr(nav, name)) for name in ("pos", "vel", "q", "omega", "force")]
    pairs += [(last(lambda n, of=name: n.errors[of]), nav.errors[name]) for name in nav.errors]
    pairs.append((np.array([np.asarray(state.P) for state in mine]), np.asarray(info.P)[both]))
    other = np.any([(a != b).reshape(len(both), -1).any(1) for a, b in pairs], 0)
    far = np.linalg.norm(jax.vmap(earth.enu_difference)(*pairs[0]), axis=1) * (pairs[0][0] != pairs[0][1]).any(1)
    return float(far.max()), float(other.mean())


def pad_epochs(seconds: float) -> tuple[float, int]:
    """MiB by which a stream of 100 Hz at rest, with fixes at 1 Hz, grows after its first 6 minutes; samples kept."""
    lla, rng, rate = (0.6, 0.2, 100.0), np.random.default_rng(1), 100.0
    ekf = build("ekf15", measurements=("position", "velocity"))
    params = ekf.params("consumer")
    nav = jax.tree.map(lambda a: np.asarray(a)[None], initial_nav(lla))
    live = Stream(ekf, params, Initialization(nav, params.prior, 0.0))
    before, most = 0.0, 0
    noise = rng.normal(size=(4096, 6)) * ([1e-3] * 3 + [1e-2] * 3)
    for i in range(1, round(seconds * rate)):
        t, row = i / rate, noise[i % 4096]
        live.push_imu(t, row[:3], row[3:] - [0, 0, 9.79])
        if i % 100 == 0:
            live.push("position", t, lla, (1.5, 1.5, 3.0))
            live.push("velocity", t, (0.0, 0.0, 0.0), 0.1)
        if i == round(360 * rate):
            before = process_usage().resident
        most = max(most, len(live.samples))
    return (process_usage().resident - before) / 2**20, most


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("stream", __doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=sources()["rtkexplorer"], help="default: a real drive")
    parser.add_argument("--quick", action="store_true", help="growth over six minutes instead of an hour")
    args = parser.parse_args(argv)
    rec = read(args.data)
    names = [name for name in ("position", "velocity") if name in rec.aiding]
    ekf = build("ekf15", measurements=names)
    params = installed(ekf.params("consumer"), rec.lever_arm)  # as `navigate` does
    begin = initialize(rec, params)
    sol = navigate(rec, ekf, params, initialization=begin)
    interval, rate = float(np.median(np.diff(rec.aiding["position"].t))), 1 / float(np.median(rec.imu.dt))
    make = lambda: Stream(ekf, params, begin, interval=interval, rate=rate)
    moment = time.perf_counter()
    live = make()
    first = time.perf_counter() - moment
    rows, ends = rows_of(rec, names, begin.t), {}
    moment = time.perf_counter()
    taken, most = fed(live, rec, rows, ends)
    seconds = time.perf_counter() - moment
    late, shuffled, rng = {}, make(), np.random.default_rng(0)
    count = sum(1 for row in rows if row[2])
    fed(shuffled, rec, rows_of(rec, names, begin.t, rng.random(count)), late)
    half, again = len(rows) // 2, {}
    one = make()
    fed(one, rec, rows[:half], again)
    two = Stream.from_bytes(one.to_bytes(), ekf, params, begin)
    fed(two, rec, rows[half:], again)
    same = all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(live.kept[-1].state), jax.tree.leaves(two.kept[-1].state), strict=True)
    )
    far, other = apart(ends, sol.trace.info, sol.trace.info.nav.t)
    hour, kept = pad_epochs(360.0 + 3600.0 * (0.1 if args.quick else 1.0))
    result = {
        "samples": len(taken), "push_ms_median": 1e3 * float(np.median(taken)),
        "push_ms_p99": 1e3 * float(np.quantile(taken, 0.99)), "times_real_time": float(np.ptp(rec.imu.t)) / seconds,
        "batch_apart_m": far, "states_not_bit_equal": other,
        "late_apart_m": apart(late, sol.trace.info, sol.trace.info.nav.t)[0],
        "restart_bit_equal": same, "refused_late": sum(shuffled.refused.values()), "samples_kept_most": most,
        "grown_in_an_hour_mib": hour, "samples_kept_most_in_an_hour": kept, "first_s": first,
    }  # fmt: skip
    print(table(["", "value"], [[k, v] for k, v in result.items()]))
    common.write_json(args.json, result)
