"""KF-GINS's executable on the drive of `benchmarks.recordings.drive`: the same hidden windows, the same score."""

import subprocess
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from benchmarks.recordings import drive
from jaxnav.filters import epochs
from jaxnav.initialization.initialize import Initialization
from jaxnav.io.formats.kfgins import read_kfgins_nav
from jaxnav.maths import earth, rotations
from jaxnav.types import Params, Recording, Track
from tuning.recordings.targets import delay_of, write_kfgins

RESULT = "KF_GINS_Navresult.nav"
LIMIT = 300  # s of a run


def run(binary: Path, rec: Recording, params: Params, begin: Initialization) -> Track:
    """Its solution, every sample."""
    with tempfile.TemporaryDirectory() as folder:
        write_kfgins(Path(folder), rec, params, begin)
        job = [binary.resolve(), "kf-gins.yaml"]
        done = subprocess.run(job, cwd=folder, capture_output=True, text=True, timeout=LIMIT)
        if not (Path(folder) / RESULT).exists():
            raise RuntimeError(f"{binary} wrote no solution: {done.stdout[-500:]}{done.stderr[-500:]}")
        return read_kfgins_nav(Path(folder) / RESULT)


def without(rec: Recording, windows: list[tuple[float, float]]) -> Recording:
    """The recording without the fixes of these windows."""
    aiding = {}
    for name, s in rec.aiding.items():
        keep = ~epochs.within(s.t, windows)
        aiding[name] = s._replace(t=s.t[keep], value=s.value[keep], sd=s.sd[keep], corr=s.corr[keep])
    return rec._replace(aiding=aiding)


def antenna_errors(track: Track, rec: Recording, params: Params, begin: Initialization, at: np.ndarray) -> np.ndarray:
    """Of the fixes ``at`` (W,) int: the solution's antenna minus the fix at the fix's time, (W, 3) m ENU."""
    fixes = rec.aiding["position"]
    t = fixes.t[at] - delay_of(params, begin, fixes.t[at])
    lla = np.stack([np.interp(t, track.t, track.lla[:, i]) for i in range(3)], 1)
    rph = np.stack([np.interp(t, track.t, np.unwrap(track.rph[:, i])) for i in range(3)], 1)
    errors = []
    for own, angles, fix in zip(lla, rph, fixes.value[at], strict=True):
        arm = rotations.from_rph(jnp.asarray(angles)) @ params.mounting.lever_arm
        errors.append(np.asarray(earth.enu_difference(jnp.asarray(own), jnp.asarray(fix)) + arm))
    return np.array(errors)


def scored(binary: Path, rec: Recording, by_block: dict[int, Params], begin: Initialization) -> np.ndarray:
    """Horizontal errors (W,) m of all windows, each run with the parameters of its block."""
    fixes, last_fix, found = rec.aiding["position"], float(rec.aiding["position"].t[-1]), {}
    for offset in drive.PHASES:
        starts = drive.window_starts(last_fix, offset)
        hidden = without(rec, [(start, start + drive.OUTAGE) for start in starts])
        block = np.searchsorted(drive.BLOCKS, starts + drive.OUTAGE / 2)
        runs: dict[int, Track] = {}
        for start, b in zip(starts, block, strict=True):
            params = by_block.get(int(b), by_block[min(by_block)])
            if id(params) not in runs:
                runs[id(params)] = run(binary, hidden, params, begin)
            last = np.flatnonzero(epochs.within(fixes.t, [(start, start + drive.OUTAGE)]))[-1:]
            found[start] = np.hypot(*antenna_errors(runs[id(params)], rec, params, begin, last)[0, :2])
    return np.array([found[start] for start in sorted(found)])
