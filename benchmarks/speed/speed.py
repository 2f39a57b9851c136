"""Speed: jaxnav against a C++ floor, plain JAX, a numpy loop and other packages; every ratio is of one run.

One thread on one processor, processor time, medians of repeats that take turns. A ratio is to the row that is named;
less is faster. The floor, the plain forms and the numpy loop do the work of our stride 1 and give the same positions;
stride 10 moves the covariance every ten samples. Bars are goals, met or not.
"""

import importlib.metadata
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import chex
import jax
import numpy as np

from benchmarks import common
from benchmarks.speed import speed_child, speed_figures, speed_gate, speed_tables
from benchmarks.speed.speed_floor import compiler_version, floor
from benchmarks.speed.speed_peers import numpy_loop
from benchmarks.speed.speed_tables import QUICK, Sizes
from benchmarks.speed.speed_work import (
    FIRST,
    NAIVE,
    OURS,
    PARAMS,
    RATE,
    arguments,
    distance,
    executable,
    likelihood,
    still,
)  # fmt: skip
from jaxnav.filters.catalogue import build

PACKAGES = ("jaxlib", "chex", "python-ins", "numba", "filterpy", "kalman-py", "dynamax", "cuthbert")
SAME = 1e-3  # m, how far forms that do the same work may end from each other after a minute


def versions() -> dict[str, str]:
    """Packages, compiler and processor."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    info = Path("/proc/cpuinfo")
    model = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    return found | {
        "C++ compiler": compiler_version(),
        "processor": model[0].split(":")[1].strip() if model else platform.processor(),
        "processors given": os.environ[speed_child.CPUS], "XLA_FLAGS": os.environ["XLA_FLAGS"],
        "load at the start": f"{os.getloadavg()[0]:.2f}",
    }  # fmt: skip


def agreement(sizes: Sizes) -> dict[str, dict]:
    """Largest distance at the end of a minute from our stride 1, m."""
    rows, seconds = {}, sizes.lengths[0]
    given = arguments(seconds, 1)
    for n in sizes.states:
        ours = np.asarray(executable(OURS[0], n, seconds, 1).call().lla)
        ends = {}
        for form in sizes.plain:
            out = executable(form, n, seconds, 1).call()
            ends[form.label] = out[-1] if form is NAIVE else out.lla[-1]
        if (call := floor(n, 1, PARAMS(), *jax.tree.map(lambda a: a[None], given[1:]))) is not None:
            ends["floor"] = call()[0, -1, :3]
        ends["numpy loop"] = numpy_loop(n, PARAMS(), *given[1:])()[-1]
        for label, end in ends.items():
            rows[f"{label}, {n} states"] = {"m": distance(np.asarray(end)[None], ours[-1:])}
    print(f"\ndistance from our stride 1 after {seconds} s, m")
    for name, row in rows.items():
        differs = row["m"] > SAME and not name.startswith((FIRST.label, "floor"))  # which are of first order
        print(f"  {name:28} {row['m']:.2g}" + ("   NOT THE SAME WORK" if differs else ""))
    return rows


def strides(seconds: int) -> dict[str, float]:
    """Stride 10 against stride 1, 15 states: largest distance in m, and of the gradients over their norm."""
    given = arguments(seconds, 1)
    pair = {f.label: f for f in OURS}
    one, ten, ready = (executable(pair[f"stride {s}"], 15, seconds, 1).call().lla for s in (1, 10, "10, prepared"))
    names = ("gyro", "accel", "gyro_bias", "accel_bias", "position_scale", "velocity_scale")
    slopes = []
    for s in (1, 10):
        slope = executable(pair[f"stride {s}"], 15, seconds, 1, True).call()[1]
        # by the logarithm of each: the units do not matter
        slopes.append(np.concatenate([np.ravel(getattr(slope, k) * getattr(given[0], k)) for k in names]))
    apart = float(np.linalg.norm(slopes[1] - slopes[0]) / np.linalg.norm(slopes[0]))
    result = {"m": distance(ten, one), "prepared_m": distance(ready, one), "gradient": apart}
    print(f"stride 10 against stride 1 on {seconds} s: {1e3 * result['m']:.2g} mm, gradient {100 * apart:.2g} %")
    print(f"the same of prepared epochs: {1e3 * result['prepared_m']:.2g} mm")
    return result


def compiles_once() -> None:
    """Other values, the same program.

    Raises:
        AssertionError: a second trace.
    """
    filt = build("ekf9", cov_stride=10)
    call = jax.jit(chex.assert_max_traces(lambda *arguments: jax.grad(likelihood(filt))(*arguments), n=1))
    noise, nav, epochs = still(2, 1)
    call(noise, nav, epochs)
    call(jax.tree.map(lambda a: 1.1 * a, noise), nav._replace(pos=nav.pos + 1e-3), epochs)
    print("no second compilation when only values change")


def main(argv: list[str]) -> int:
    """Print the tables and the bars, draw the growth, write the JSON, compare with the baseline."""
    parser = common.options("speed", __doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three minutes: 15 states, short runs, few forms")
    parser.add_argument("--gate", action="store_true", help="fail where a ratio is 1.5 times the baseline's or more")
    parser.add_argument("--keep", action="store_true", help="make this run the baseline of its form, quick or full")
    parser.add_argument("--figures", type=Path, default=Path("out/speed"), metavar="DIR", help="default out/speed")
    args = parser.parse_args(argv)
    if not speed_child.is_pinned():
        command = [sys.executable, "-m", "benchmarks", "speed", *argv]
        return subprocess.run(command, env=speed_child.pinned()).returncode
    speed_child.keep_to(speed_child.cpus()[-1:])
    start, sizes = time.perf_counter(), QUICK if args.quick else Sizes()
    result: dict = {"mode": "quick" if args.quick else "full", "versions": versions() | common.environment()}
    for name, version in result["versions"].items():
        print(f"{name:18} {version}")
    result["accuracy"] = agreement(sizes)
    result["single"] = speed_tables.single(sizes)
    result["peers"], accuracy = speed_tables.peers(sizes)
    result["accuracy"] |= accuracy
    for name, row in accuracy.items():
        print(f"  {name:28} position RMS " + " ".join(f"{v:.3f}" for v in row["rms_m"]) + " m, east north up")
    result["batch"] = speed_tables.batch(sizes)
    result["states"] = speed_tables.larger(sizes)
    result["gradient"] = speed_tables.gradient(sizes)
    if sizes.full:
        result["accuracy"]["stride 10"] = strides(sizes.lengths[-1])
    result["compile"] = speed_tables.compiling(sizes)
    two = len(speed_child.cpus()) > 1 and sizes.full
    result["scaling"], curves = speed_tables.scaling(sizes, result["batch"], two)
    if sizes.full:
        compiles_once()
        speed_figures.growth(curves, args.figures / "growth.png")
        print(f"wrote {args.figures / 'growth.png'}")
    result["bars"] = speed_gate.bars(result)
    speed_gate.show_bars(result["bars"])
    result["seconds"] = time.perf_counter() - start
    print(f"{result['seconds']:.0f} s on {RATE} Hz data, load {os.getloadavg()[0]:.1f}")
    common.write_json(args.json, result)
    if args.keep:
        speed_gate.keep(result, result["mode"])
    return speed_gate.gate(result, result["mode"]) if args.gate else 0
