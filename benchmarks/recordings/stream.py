"""The filter sample by sample on a recording: beside the batch, with late fixes, across a restart; time of a sample.

Every sample of the recording is pushed as it comes, fixes after the sample at which they are due. *late*: each fix
comes up to half a second late. *restart*: from bytes in the middle. Differences are of positions at the ends of epochs.
"""

import time
from pathlib import Path

import jax
import numpy as np

from benchmarks import common
from benchmarks.recordings.wild import RECIPES
from jaxnav import Stream, build, navigate, read, start
from jaxnav.analysis.tables import table
from jaxnav.filters.compiler import held
from jaxnav.maths import earth

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


def apart(ends: dict, t: np.ndarray, lla: np.ndarray) -> float:
    """Largest distance, m, from positions (E, 3) at t (E,)."""
    both = [i for i, time_ in enumerate(t) if round(float(time_), 6) in ends]
    mine = np.array([np.asarray(ends[round(float(t[i]), 6)].state.past.pos[-1]) for i in both])
    return float(np.linalg.norm(jax.vmap(earth.enu_difference)(mine, lla[both]), axis=1).max())


def main(argv: list[str]) -> None:
    """Print the table, write the JSON."""
    parser = common.options("stream", __doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=RECIPES / "rtkexplorer.toml", help="default: a real drive")
    args = parser.parse_args(argv)
    rec = read(args.data)
    names = [name for name in ("position", "velocity") if name in rec.aiding]
    ekf = build("ekf15", measurements=names)
    params = ekf.params("consumer")
    begin = start(rec, params)
    sol = navigate(rec, ekf, params, begin=begin)
    interval, rate = float(np.median(np.diff(rec.aiding["position"].t))), 1 / float(np.median(rec.imu.dt))
    make = lambda: Stream(ekf, params, begin, interval=interval, rate=rate)
    moment = time.perf_counter()
    live = make()
    first = time.perf_counter() - moment
    rows, ends = rows_of(rec, names, begin.t), {}
    memory, moment = held().resident, time.perf_counter()
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
    t, lla = np.asarray(sol.trace.info.nav.t), np.asarray(sol.trace.info.nav.pos)
    result = {
        "samples": len(taken), "push_ms_median": 1e3 * float(np.median(taken)),
        "push_ms_p99": 1e3 * float(np.quantile(taken, 0.99)), "times_real_time": float(np.ptp(rec.imu.t)) / seconds,
        "batch_apart_m": apart(ends, t, lla), "late_apart_m": apart(late, t, lla), "restart_bit_equal": same,
        "refused_late": sum(shuffled.refused.values()), "samples_kept_most": most,
        "grown_mib": (held().resident - memory) / 2**20, "first_s": first,
    }  # fmt: skip
    print(table(["", "value"], [[k, v] for k, v in result.items()]))
    common.write_json(args.json, result)
