"""A batch in float32: errors against float64 over ten minutes with two outages of a minute, 15 states, eight runs.

Near latitude and longitude zero a float32 resolves positions as finely as offsets from a float64 origin: the difference
there is the filter's rounding. Elsewhere the resolution of a latitude, 0.4 m, is added.
"""

import pickle
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.common import options, write_json
from jaxnav.analysis.tables import table
from jaxnav.filters.catalogue import build
from jaxnav.filters.core import Filter
from jaxnav.maths import earth
from jaxnav.simulate.keys import Purpose, run_keys
from jaxnav.simulate.scenarios import URBAN
from jaxnav.simulate.simulation import matched_params, simulate_runs
from jaxnav.types import Info

PLACES = {"offsets": (0.0, 0.0, 100.0), "latitude and longitude": (48.2, 16.4, 100.0)}
FRAMES = ("local_level", "tangent")
OUTAGES = ((200.0, 260.0), (400.0, 460.0))


@partial(jax.jit, static_argnums=0)
def solved(filt: Filter, params, navs, epochs) -> Info:
    """Return the runs, as `jaxnav.filters.run.run`, which asks for float64."""
    one = lambda nav, epochs: lax.scan(partial(filt.step, params), filt.init(params, nav), epochs)[1]
    return jax.vmap(one)(navs, epochs)


def single(tree):
    """Return the tree's numbers in float32."""
    return jax.tree.map(lambda a: np.asarray(a, np.float32) if np.asarray(a).dtype.kind == "f" else a, tree)


def errors(frame: str, place: tuple[float, float, float], runs: int, seed: int) -> dict:
    """Return rms and largest difference of both precisions, m, and the error of the solution itself."""
    scenario = URBAN._replace(duration_s=600.0, start_deg_m=place, gnss=URBAN.gnss._replace(outages_s=OUTAGES))
    sims = simulate_runs(run_keys(seed, Purpose.STUDY, np.arange(runs)), scenario)
    params, filt = matched_params(scenario), build("ekf15", cov_stride=5, frame=frame)
    wide = jax.device_get(solved(filt, params, sims.initial, sims.epochs).nav.pos)
    given = single(jax.device_get((params, sims.initial, sims.epochs)))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "runs.pickle"
        file.write_bytes(pickle.dumps((frame, given)))
        subprocess.run([sys.executable, "-m", __name__, str(file)], check=True)
        narrow = np.load(file.with_suffix(".npy"))
    difference = lambda a, b: np.asarray(jax.vmap(jax.vmap(earth.enu_difference))(jnp.asarray(a), jnp.asarray(b)))
    off, error = difference(narrow, wide), difference(wide, sims.truth.pos)
    rms = lambda a: float(np.sqrt(np.mean(np.sum(a**2, -1))))
    return {"rms_m": rms(off), "largest_m": float(np.abs(off).max()), "error_m": rms(error)}


def other_process(file: Path) -> None:
    """Solve runs in float32 in a process that never had float64: constants keep the precision of their first use."""
    frame, given = pickle.loads(file.read_bytes())
    found = solved(build("ekf15", cov_stride=5, frame=frame), *given).nav.pos
    assert found.dtype == np.float32
    np.save(file.with_suffix(".npy"), np.asarray(found, float))


def main(argv: list[str]) -> None:
    """Compare both precisions in two frames and at two places."""
    parser = options("float32", __doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    found = {(frame, name): errors(frame, place, args.runs, args.seed)
             for frame in FRAMES for name, place in PLACES.items()}  # fmt: skip
    print(table(["frame", "positions as", "rms, m", "largest, m", "error of the solution, m"],
                [[*key, f"{e['rms_m']:.3f}", f"{e['largest_m']:.3f}", f"{e['error_m']:.2f}"]
                 for key, e in found.items()]))  # fmt: skip
    write_json(args.json, {"float32": {f"{frame}, {name}": e for (frame, name), e in found.items()}})


if __name__ == "__main__":
    other_process(Path(sys.argv[1]))
